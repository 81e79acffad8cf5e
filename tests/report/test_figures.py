"""The convergence figure: what it shows, and that it refuses to draw what is not there."""
from __future__ import annotations

import dataclasses

import matplotlib.figure
import numpy as np
import pytest
from skimage.io import imread
from texts import assert_readable, rendered, visible

from olpm_bench.bench import config, statistics, summary
from olpm_bench.report import figures, sheet

TIMES = np.geomspace(1, 16, 9)


def panel(levels: dict[str, float], floor: float = 0.0, budget: float = 16) -> figures.Panel:
    curves = {name: statistics.common_curve([TIMES] * 3, [level * k / np.sqrt(TIMES) for k in (0.9, 1, 1.2)])
              for name, level in levels.items()}
    others = list(levels)[1:]
    return figures.Panel("scene", curves, {name: i for i, name in enumerate(levels)}, dict.fromkeys(others, 1.5), budget, floor,
                         dict.fromkeys(others, statistics.Interval(12.3, 10.4, 15.1)))


def drawn(*panels: figures.Panel) -> matplotlib.figure.Figure:
    with figures.style():
        return rendered(figures.draw(panels, "Title", "Note."))


def marks(figure: matplotlib.figure.Figure) -> list[matplotlib.lines.Line2D]:
    """Where training ends."""
    return [line for line in figure.axes[0].lines if line.get_markerfacecolor() == "white"]


@pytest.mark.parametrize("levels", [
    {"Path tracing": 1.0}, {"A": 1.0, "B": 0.99, "C": 0.98, "D": 0.97, "E": 0.2},
    {"A very long name of a method": 1, "B": 0.1}])
@pytest.mark.parametrize("floor", [0.0, 1e-5, 0.02, 0.1])
def test_no_text_overlaps_another_or_leaves_the_figure(levels, floor):
    assert_readable(drawn(panel(levels, floor), panel(levels, floor)))


@pytest.mark.parametrize("floor", [0.02, 0.01, 1e-5])
@pytest.mark.parametrize("ends", [(1.1, 1.15, 1.2), (6, 6.2, 6.4), (14, 14.2, 14.4), (2, 5, 9)])
def test_the_ends_of_training_are_told_by_their_markers_and_lie_clear_of_everything(floor, ends):
    """Each of its method's own shape, hollow, below the axes, on no other mark and on no text."""
    levels = {"Path tracing": 1.0, "A": 0.3, "B": 0.2, "C": 0.1}
    with figures.style():
        shapes = [style["marker"] for style in matplotlib.rcParams["axes.prop_cycle"]]
    figure = drawn(dataclasses.replace(panel(levels, floor), training=dict(zip(list(levels)[1:], ends, strict=True))))
    assert_readable(figure)
    axes, found = figure.axes[0], marks(figure)
    assert [mark.get_marker() for mark in found] == shapes[1:4]
    boxes = [mark.get_window_extent() for mark in found]
    centres = [axes.transData.inverted().transform(((box.x0 + box.x1) / 2, box.y0))[0] for box in boxes]
    assert centres == pytest.approx(ends, rel=1e-3)
    for i, box in enumerate(boxes):
        assert box.y1 <= axes.get_window_extent().y0
        assert not any(box.overlaps(other) for other in boxes[:i])
        for text in visible(figure):
            assert not box.overlaps(text.get_window_extent()), text.get_text()


def test_methods_differ_in_colour_and_in_marker_and_in_dash():
    with figures.style():
        styles = list(matplotlib.rcParams["axes.prop_cycle"])
    for key in ("color", "marker", "linestyle"):
        assert len({str(style[key]) for style in styles}) == len(styles) == config.LOOKS


def test_a_panel_shows_medians_band_floor_slope_and_training():
    figure = drawn(panel({"Path tracing": 1.0, "GMM": 0.5}, floor=0.05))
    axes = figure.axes[0]
    assert {"Path tracing", "GMM", "noise of the reference", "slope \N{MINUS SIGN}1/2",
            "12\N{MULTIPLICATION SIGN} (10\N{EN DASH}15)"} <= {text.get_text() for text in visible(figure)}
    assert len(axes.collections) == 2                                   # bands
    solid = [line for line in axes.lines if line.get_transform() == axes.transData and len(line.get_xdata()) > 9]
    np.testing.assert_allclose(solid[0].get_ydata(), 1 / np.sqrt(solid[0].get_xdata()))
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "2", "5", "10", "16"]
    in_axes = [line for line in axes.lines if line.get_transform() == axes.transAxes]
    slope = next(line for line in in_axes if line.get_color() == figures.GREY)
    (x0, y0), (x1, y1) = np.log(axes.transData.inverted().transform(axes.transAxes.transform(slope.get_xydata())))
    assert (y1 - y0) / (x1 - x0) == pytest.approx(-0.5)


@pytest.mark.parametrize("interval, text", [
    (statistics.Interval(2.0, 1.5, 2.5), "2\N{MULTIPLICATION SIGN} (1.5\N{EN DASH}2.5)"),
    (statistics.Interval(2.0, np.nan, np.nan), ""),          # no number without its interval
    (statistics.Interval(3.0, np.nan, np.nan, ">"), ">3\N{MULTIPLICATION SIGN}"),
    (statistics.Interval(np.nan, np.nan, np.nan), "")])
def test_speed_ups_are_short(interval, text):
    assert figures.speed_up_label(interval) == text


def test_equal_samples_are_shown_beside_equal_time(finished, monkeypatch):
    panels = []
    monkeypatch.setattr(figures, "draw", lambda drawn, *_: panels.extend(drawn) or matplotlib.figure.Figure())
    figures.curves(finished)
    samples = finished.experiment.model_copy(update={"budget": config.Budget(spp=160, checkpoints=5)})
    figures.curves(dataclasses.replace(finished, experiment=samples))
    alone, spp, seconds = panels
    assert [p.abscissa for p in panels] == ["time [s], training included", "samples per pixel", "time [s], training included"]
    assert (spp.budget, spp.training, spp.speed_ups) == (160, {}, {}) and seconds.training == alone.training
    assert alone.training == {"Quick & dirty": pytest.approx(3.1)}          # median over seeds, on the axis of charged seconds
    assert list(alone.speed_ups) == ["Quick & dirty"] and alone.speed_ups["Quick & dirty"].value == pytest.approx(6.25, rel=0.2)
    assert seconds.speed_ups == alone.speed_ups and (alone.budget, seconds.budget) == (16, None)


def test_curves_near_the_noise_of_the_reference_are_faint():
    axes = drawn(panel({"A": 1.0}, floor=0.25)).axes[0]
    clear = next(line for line in axes.lines if np.isnan(line.get_ydata()).any())
    assert np.nanmin(clear.get_ydata()) >= figures.NEAR_FLOOR * 0.25


@pytest.mark.parametrize(("low", "high", "end", "expected"), [
    (0.6, 15.5, 15, [1, 2, 5, 10, 15]), (0.6, 60, 60, [1, 10, 60]), (9, 16, 15, [10, 15]),
    (0.01, 0.3, None, [0.01, 0.02, 0.05, 0.1, 0.2]), (0.52, 1.03, None, [0.6, 0.7, 0.8, 0.9, 1])])
def test_ticks_are_few_and_round(low, high, end, expected):
    found = figures.ticks(low, high, end)
    assert set(expected) <= set(found) and len(found) <= 7 and found == sorted(found)


def test_tick_labels_are_plain_numbers():
    assert [figures.tick_label(x) for x in (15, 0.02, 0.0005, 600)] == ["15", "0.02", "0.0005", "600"]
    assert figures.tick_label(2e-5) == r"$2\cdot 10^{-5}$" and figures.tick_label(1e-5) == "$10^{-5}$"


def test_spread_moves_as_little_as_needed():
    assert figures.spread([0.1, 0.9, 0.5], 0.1) == pytest.approx([0.1, 0.9, 0.5])
    assert figures.spread([0.5, 0.5], 0.2) == pytest.approx([0.4, 0.6])
    moved = np.array(figures.spread([0.3, 0.31, 0.32, 0.9], 0.1))
    assert np.diff(moved).min() >= 0.1 - 1e-12 and moved[3] == 0.9 and moved[:3].mean() == pytest.approx(0.31)


def test_from_a_results_folder(finished):
    assert figures.curves(finished) == ["figure.png", "figure.pdf", "figure.svg"]
    assert imread(finished.results.folder / "figure.png").std() > 10
    assert (finished.results.folder / "figure.pdf").read_bytes().startswith(b"%PDF")
    note = figures.caption(finished, trained=True)
    assert note == ("Median and 5\N{EN DASH}95 % band of 3 seeds. Hollow markers below the axis: the end of training. "
                    "\N{MULTIPLICATION SIGN}: times as fast as Path tracing to an equal error, 90 % jackknife interval. "
                    "Abacus 2, 2 threads.")
    two = dataclasses.replace(finished, experiment=finished.experiment.model_copy(update={"seeds": [0, 1]}))
    assert "to an equal error. Abacus" in figures.caption(two)


def gain_rows(methods: list[str], scenes: list[str]) -> list[dict]:
    return [{"scene": scene, "method": method, "gain": 2.0 ** i, "gain_low": 1.8 ** i, "gain_high": 2.3 ** i,
             "gain_trimmed": 3.0 ** i, "gain_trimmed_low": 2.8 ** i, "gain_trimmed_high": 3.3 ** i}
            for scene in scenes for i, method in enumerate(methods)]


@pytest.mark.parametrize("methods, scenes", [
    (["A"], ["door_ajar"]), (["Quick", "A very long name of a method", "C"], ["door_ajar", "a rather long name of a scene"]),
    ([f"M{i}" for i in range(11)], ["x", "y", "z"])])
def test_gains_have_a_dot_an_interval_and_a_number_each(methods, scenes):
    """By the median filled, trimmed hollow; where there is no interval there is no dot either."""
    rows = gain_rows(methods, scenes)
    rows[-1] |= {"gain_low": None, "gain_high": None}
    with figures.style():
        figure = rendered(figures.draw_gains(rows, {name: 1 + i for i, name in enumerate(methods)}, "PT", "Title", "Note."))
    axes = figure.axes[0]
    dots = [line for line in axes.lines if len(line.get_xdata()) == 1]
    expected = [row[column] for row in rows for column in figures.GAINS if row[f"{column}_low"] is not None]
    assert [line.get_xdata()[0] for line in dots] == expected
    assert sum(line.get_markerfacecolor() == "white" for line in dots) == len(rows)
    assert len(axes.lines) == 1 + 2 * len(dots)             # 1, dots, intervals
    texts = [text.get_text() for text in visible(figure)]
    assert texts.count("1.00 (1.00\N{EN DASH}1.00)") == 2 * len(scenes) - (len(methods) == 1)
    assert texts.count("trimmed") == len(rows)
    low, high = axes.get_xlim()
    assert low < 1 < high and axes.get_xscale() == "log"
    assert_readable(figure)


def test_gains_from_a_results_folder(finished):
    assert figures.gains(finished, summary.summarise(finished)["rows"]) == ["gains.png", "gains.pdf", "gains.svg"]
    assert imread(finished.results.folder / "gains.png").std() > 10
    assert (finished.results.folder / "gains.pdf").read_bytes().startswith(b"%PDF")


def test_no_gains_without_another_method_or_seed(finished):
    alone = [row for row in summary.summarise(finished)["rows"] if row["method"] == "Path tracing"]
    one_seed = [{"scene": "door_ajar", "method": method, "gain": None, "gain_trimmed": None}
                for method in ("Path tracing", "Quick & dirty")]
    for rows in (alone, one_seed):
        assert figures.gains(finished, rows) == []
    assert not list(finished.results.folder.glob("gains.*"))


def test_scenes_without_reference_are_left_out(finished):
    def drawn() -> list:
        figures.curves(finished)
        sheet.sheet(finished, sheet.blocks(finished))
        return [imread(finished.results.folder / name).shape for name in ("figure.png", "sheet.png")]

    one, scene = drawn(), finished.scenes[0]
    finished.scenes.append(dataclasses.replace(scene, scene=scene.scene.model_copy(update={"name": "bare"}), reference=None))
    assert drawn() == one
    finished.scenes.pop(0)
    assert figures.curves(finished) == sheet.sheet(finished, sheet.blocks(finished)) == []
