"""The figure of sweeps against a results folder whose errors and memory are known."""
from __future__ import annotations

from types import SimpleNamespace

import matplotlib
import mitsuba as mi
import numpy as np
import pytest
from skimage.io import imread
from texts import assert_readable, rendered, visible

from olpm_bench.bench import config, experiment_file, results
from olpm_bench.bench.finished import Finished, read
from olpm_bench.bench.reference_file import Reference
from olpm_bench.bench.results import Results
from olpm_bench.check.small_scenes import box, grey
from olpm_bench.report import figures, sweeps
from olpm_bench.transport.particles import emit_photons, trace

TRUTH = np.ones((6, 8, 3), np.float32)
ERRORS = {"Path tracing": 0.9, "Stored": 2.0, "On-line": 1.0}      # over sqrt(passes) but for path tracing


def made(tmp_path, reference: str | None = None, passes: tuple[int, ...] = (1, 4, 16), most: int = 99, **sweep) -> Finished:
    """Cells with errors of ERRORS times 0.9, 1, 1.2 for three seeds; 1000 photons a pass, all stored or one pass at a time.

    most: on-line passes that were done, whatever was asked for.
    """
    scene = {"name": "door_ajar", "width": 8, "height": 6} | ({"reference": reference} if reference else {})
    series = {"representation": {"type": "jensen"}, "sweep": {"training.passes": list(passes)}}
    experiment = experiment_file.parse({
        "title": "Synthetic", "seeds": 3, "budget": {"spp": 16}, "scene": [scene], "sweep": sweep, "training": {"photons": 1000},
        "method": [{"name": "Path tracing"}, {"name": "Stored", **series, "training": {"schedule": "single_batch"}},
                   {"name": "On-line", **series}]}, "synthetic.toml", tmp_path)
    results = Results(tmp_path / "results" / "synthetic")
    for cell in experiment.cells():
        sweep = cell.method.series
        name, asked = (sweep.name, int(sweep.value)) if sweep else (cell.method.name, 0)
        image = TRUTH + np.float32(ERRORS[name] * (0.9, 1, 1.2)[cell.seed] / np.sqrt(max(asked, 1)))
        trained = [{"photons": 1000 * asked, "stored": 10_000 * asked}] if name == "Stored" else (
            [{"photons": 1000, "stored": 10_000}] * min(asked, most))
        info = {"key": cell.key, "records": 100 if asked else 0, "bytes_per_record": 200, "charged_seconds": 1.0,
                "train_seconds": 0.5 * asked, "passes": trained, "mean": 1.0, "mean_stderr": 0.1,
                "wait_fraction": 0.0}
        results.write_cell(cell.scene.name, cell.method.name, cell.seed, info, [{"seconds": 1.0, "train_seconds": 0, "spp": 16}],
                           {"mean": image, "variance": TRUTH, "count": TRUTH[..., 0]}, [image])
    results.write_json("env.json", {"schema_version": 1, "cpu": "Abacus 2", "threads": 2})
    reference = Reference(TRUTH, TRUTH + 0.01, TRUTH, TRUTH, {"spp_a": 1, "spp_b": 0})
    return read(experiment, results, {"door_ajar": reference})


@pytest.fixture
def drawn(monkeypatch):
    """What `sweeps` draws: its panels, and the figure."""
    seen = SimpleNamespace(panels=[], figure=None)
    draw = figures.draw

    def keep(panels, *arguments):
        seen.panels, seen.figure = panels, draw(panels, *arguments)
        return seen.figure

    monkeypatch.setattr(figures, "draw", keep)
    return seen


def test_a_curve_a_series_over_the_setting_and_level_lines(tmp_path, drawn):
    known = made(tmp_path)
    assert sweeps.sweeps(known)
    panel, = drawn.panels
    assert (panel.abscissa, panel.ordinate, panel.slope) == ("passes", "L1 error", False)
    assert list(panel.curves) == ["Path tracing", "Stored", "On-line"]
    np.testing.assert_array_equal(panel.curves["Stored"].times, [1, 4, 16])
    np.testing.assert_allclose(panel.curves["Stored"].median, [2, 1, 0.5], rtol=1e-6)
    np.testing.assert_array_equal(panel.curves["Path tracing"].times, [1, 16])
    np.testing.assert_allclose(panel.curves["Path tracing"].median, 0.9, rtol=1e-6)
    assert panel.curves["On-line"].errors.shape == (3, 3) and panel.floor == pytest.approx(0.005, rel=1e-3)
    assert imread(known.results.folder / "sweep.png").std() > 5
    assert (known.results.folder / "sweep.pdf").read_bytes().startswith(b"%PDF")


def test_passes_that_the_budget_cut_off_are_not_drawn_as_done(tmp_path, drawn):
    known = made(tmp_path, most=2)
    sweeps.sweeps(known)
    panel, = drawn.panels
    np.testing.assert_array_equal(panel.curves["Stored"].times, [1, 4, 16])         # all in one pass
    np.testing.assert_array_equal(panel.curves["On-line"].times, [1, 2, 2])
    assert "Drawn at what the budget had time for: On-line, passes 4 at 2; On-line, passes 16 at 2." in sweeps._caption(known)
    assert "Drawn at" not in sweeps._caption(made(tmp_path))
    sweeps.sweeps(made(tmp_path, most=0))                                           # no time for any
    assert list(drawn.panels[0].curves) == ["Path tracing", "Stored"]


@pytest.mark.parametrize("setting, done", [("training.passes", 2), ("training.camera_passes", 1), ("training.neighbours", 9)])
def test_passes_of_particles_and_of_camera_paths_are_counted_apart(tmp_path, setting, done):
    """Of passes of importons alone, of both, and of an image; and of one more image after training."""
    known = made(tmp_path)
    scene, method = known.scenes[0], known.experiment.method[-1]
    counts = [(0, 0), (1000, 0), (1000, 0), (0, 4), (0, 4)]
    for cell in scene.cells[method.name]:
        cell.info["passes"] = [{"index": i, "passes": 4, "photons": n, "spp": spp} for i, (n, spp) in enumerate(counts)]
    series = config.Series(name="On-line", setting=setting, value=9)
    assert sweeps._position(known.experiment, method, series, scene) == done


def test_memory_over_the_photons_traced(tmp_path, drawn):
    """Stored, all particles grow; on-line, those of one pass do not.  What learns nothing has no curve."""
    known = made(tmp_path, x="photons", y=["l1", "bytes", "train_seconds"])
    assert sweeps.sweeps(known)
    _, memory, seconds = drawn.panels
    assert memory.abscissa == "photons traced" and list(memory.curves) == ["Stored", "On-line"] == list(seconds.curves)
    for curve in memory.curves.values():
        np.testing.assert_array_equal(curve.times, [1000, 4000, 16_000])
    a_pass = 10_000 * results.bytes_per_particle() / 1e6
    np.testing.assert_allclose(memory.curves["Stored"].median, 0.02 + a_pass * np.array([1, 4, 16]))
    np.testing.assert_allclose(memory.curves["On-line"].median, 0.02 + a_pass)
    np.testing.assert_allclose(seconds.curves["On-line"].median, [0.5, 2, 8])


def test_the_bytes_of_a_particle_are_those_of_the_arrays_that_hold_it():
    n, depth = 1000, 5
    scene = mi.load_dict(box(grey(0.5), light={"type": "point", "intensity": 1.0}))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, n)
    photons = trace(scene, emit_photons(scene, sampler), sampler, None, 0.5, depth, mi.TransportMode.Importance)
    room = 2 * (depth - 2) * n          # a photon's path can have so many hits, and as many again by splitting
    shared = photons.position, photons.direction, photons.normal
    assert photons.place.numpy().max() < room and len(photons) > n
    per_hit = sum(array.numpy().nbytes for array in shared) / room + photons.place.numpy().nbytes / len(photons)
    assert results.bytes_per_particle() == per_hit


def test_no_text_overlaps_another_or_leaves_the_figure(tmp_path, drawn):
    known = made(tmp_path, x="photons", y=["l1", "bytes"])
    sweeps.sweeps(known)
    with figures.style():
        figure = rendered(drawn.figure)
    assert {"Stored", "On-line", "L1 error", "memory of learning [MB]"} <= {text.get_text() for text in visible(figure)}
    assert_readable(figure)


def test_errors_need_a_reference_and_memory_does_not(tmp_path, drawn):
    known = made(tmp_path, reference="none", y=["l1", "bytes"])
    assert sweeps.sweeps(known)
    assert [panel.ordinate for panel in drawn.panels] == ["memory of learning [MB]"]
    bare = made(tmp_path, reference="none", y=["relmse"])
    assert not sweeps.sweeps(bare)


def test_nothing_is_drawn_without_a_sweep(finished):
    assert sweeps.sweeps(finished) == []
    assert not list(finished.results.folder.glob("sweep.*"))


@pytest.mark.parametrize("passes", [(1, 4, 16), (1, 2, 4, 16)], ids=["a look each", "a look a sweep"])
def test_a_method_looks_the_same_in_all_figures(tmp_path, monkeypatch, passes):
    known, colours = made(tmp_path, passes=passes), {}
    gains = {column + end: value for column in figures.GAINS for end, value in (("", 2.0), ("_low", 1.5), ("_high", 2.5))}
    rows = [{"scene": "door_ajar", "method": method.name, "variance_passes": 96, **gains}
            for method in known.experiment.method]

    def keep(figure, folder, name: str) -> list[str]:
        texts = {text.get_text(): text.get_color() for text in figure.findobj(matplotlib.text.Text)}
        colours[name] = {look: texts[look] for look in known.experiment.looks if look in texts}
        return []

    monkeypatch.setattr(figures, "save", keep)
    figures.curves(known)
    figures.gains(known, rows)
    sweeps.sweeps(known)
    few = len(known.experiment.method) <= config.LOOKS
    assert len(colours["figure"]) == (7 if few else 3) and len(colours["gains"]) == len(known.experiment.method) - 1
    assert len(set(colours["figure"].values())) == len(colours["figure"])
    for name, colour in colours["figure"].items():
        assert colours["gains"].get(name, colour) == colour
    for name in ("Stored", "On-line"):
        assert colours["sweep"][name] == colours["figure"][f"{name}, passes 16"]
        assert few or {colours["gains"][f"{name}, passes {n}"] for n in passes} == {colours["sweep"][name]}
