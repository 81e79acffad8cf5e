"""The picture of `olpm-bench inspect`, from numbers alone."""
from __future__ import annotations

import dataclasses
import math

import mitsuba as mi
import numpy as np
import pytest
from matplotlib.text import Text

from olpm_bench.bench.vertex import Density, Fit, Truth, Vertex, fit
from olpm_bench.report import figures, inspect
from representations import square

N = 8


def page() -> inspect.Page:
    rng = np.random.default_rng(1)
    truth = Truth(*rng.uniform(0.5, 1.5, (2, 4, N * N)), paths=256)
    d = np.array([0, 0.6, -0.8])
    vertex = Vertex(1, np.array([0, -3, 4.0]), d, np.zeros(3), np.eye(3), d * (1, 1, -1), True, "floor")
    even = np.full((4 * N, 4 * N), 1 / (2 * math.pi))
    columns = []
    densities = {"Path tracing": Density(even), "Even": Density(even, even, 0.3, 7, 12345, 0.1),
                 "Holes": Density(even, np.where(np.arange(4 * N) < 16, 0, 2 * even), 0.5, 7, 90, 0.1)}
    for look, (name, density) in enumerate(densities.items()):
        learnt = fit(truth.incident, density.guide) if density.guide is not None else None
        particles = {"photons": (np.array([[0, 0, 1], [0.6, 0, 0.8]]), np.array([1.5, 0.5]))} if learnt else {}
        columns.append(inspect.Column(name, look, density, learnt, fit(truth.reflected, density.mixture), particles))
    image = rng.uniform(0, 1, (12, 16, 3))
    return inspect.Page("door", image, rng.integers(-1, 5, (12, 16)), (3, 4), vertex, truth, columns)


def test_a_method_keeps_its_colour_where_others_are_left_out():
    whole = page()
    with figures.style():
        for shown in (whole, dataclasses.replace(whole, columns=whole.columns[1:]),
                      dataclasses.replace(whole, columns=whole.columns[:0:-1])):
            colours = {text.get_text(): text.get_color() for text in inspect.draw(shown).findobj(Text)}
            for column in shown.columns:
                assert colours[column.name] == figures.colour(column.look)
        assert len({figures.colour(column.look) for column in whole.columns}) == 3


def test_the_disk_shows_each_direction_in_its_bin():
    """Against the map of the representations: 500 directions, away from the borders of bins."""
    values = np.arange(N * N, dtype=float).reshape(N, N)
    image = inspect.disk(values, 800)
    rng = np.random.default_rng(5)
    s = ((rng.integers(0, N, (500, 2)) + rng.uniform(0.1, 0.9, (500, 2))) / N)
    d = np.stack([x.numpy() for x in square.to_hemisphere(mi.Point2f(*s.T))], 1).astype(float)
    x, y = (((inspect.project(d) + 1) / 2) * 800).astype(int).T
    np.testing.assert_array_equal(image[y, x], values[tuple((s[:, ::-1] * N).astype(int).T)])
    assert np.isnan(image[0, 0]) and abs(np.isfinite(image).mean() - np.pi / 4) < 1e-3


def test_a_density_over_the_sphere_integrates_to_one():
    assert inspect.over_sphere(np.full(N * N, 3.0)).mean() * 2 * math.pi == pytest.approx(1)
    assert (inspect.over_sphere(np.zeros(N * N)) == 0).all()


def test_the_figures_are_under_the_disks_and_the_best_is_bold():
    with figures.style():
        texts = inspect.draw(page()).texts
    shown = {text.get_text(): text.get_weight() for text in texts}
    assert {"door", "truth", "Path tracing", "Even", "Holes", "BSDF alone", "BSDF fraction 0.30", "2 photons"} <= shown.keys()
    assert any(text.startswith(r"KL $\infty$") for text in shown)               # what the holes miss
    assert any(text.startswith("0 where 5") and "% of the light" in text for text in shown)
    bold = [text for text, weight in shown.items() if weight == "bold"]
    assert len(bold) == 1 and "KL" in bold[0]


@pytest.mark.parametrize("guide", [None, "Holes"])
def test_the_caption_says_whose_direct_light_the_truth_has(guide):
    with figures.style():
        texts = [text.get_text().replace("\n", " ") for text in inspect.draw(dataclasses.replace(page(), guide=guide)).texts]
    caption = next(text for text in texts if text.startswith("The hemisphere"))
    assert ("the guide of \u201cHoles\u201d is to learn" in caption) == (guide is not None)


def test_a_picture_without_light_and_without_records_can_be_drawn(tmp_path):
    shown = page()
    dark = Truth(np.zeros((2, N * N)), np.zeros((2, N * N)), 128)
    nothing = Fit(math.nan, math.nan, math.nan)
    columns = [inspect.Column("Path tracing", 0, shown.columns[0].density, None, nothing, {})]
    dark_page = inspect.Page("dark", shown.image, None, (3, 4), shown.vertex, dark, columns)
    with figures.style():
        figures.save(inspect.draw(dark_page), tmp_path, "dark")
    assert (tmp_path / "dark.png").stat().st_size > 0 and (tmp_path / "dark.pdf").stat().st_size > 0
