"""`olpm-bench inspect`: from a TOML, from a results folder, with a guide from a file; and what it refuses."""
from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import box, camera, grey, wall
from test_cli import call, complaint

import olpm_bench
from olpm_bench.bench import config, experiment_file, inspect
from olpm_bench.bench.results import Results
from olpm_bench.scenes.load import load

TOML = """
title = "Test"
seeds = [3]
[budget]
seconds = 5
[[scene]]
name = "cornell_box"
width = 16
height = 12
max_depth = 3
reference = "none"
[training]
passes = 1
photons = 3000
importons = 500
camera_passes = 3
camera_paths = 1000
[[method]]
name = "Path tracing"
[[method]]
name = "Cosine"
representation = { type = "cosine" }
"""
TWO = TOML.replace("[[scene]]", '[[scene]]\nname = "door_ajar"\nwidth = 16\nheight = 12\n[[scene]]', 1)


@pytest.fixture
def experiment(tmp_path) -> Path:
    path = tmp_path / "test.toml"
    path.write_text(TOML)
    return path


def test_a_results_folder_gives_the_passes_of_its_cells(experiment, tmp_path):
    """A cosine is learnt and sampled on a diffuse block: as good as the BSDF, which is the same."""
    results, loaded = Results(tmp_path / "results" / "test"), experiment_file.load(experiment)
    results.write_text("experiment.toml", loaded.toml(results.folder))
    spec, grey_image = loaded.cells()[1], np.full((12, 16, 3), 0.5, np.float32)
    results.write_cell("cornell_box", "Cosine", 3, {"key": spec.key, "training_passes": 2}, [{"seconds": 1.0}],
                       {"mean": grey_image, "variance": grey_image, "count": grey_image[..., 0]}, [grey_image])
    result = call("inspect", results.folder, "--pixel", "8,10", "--passes", 2)
    assert result.exit_code == 0, result.output
    assert f"Cosine: trained with 2 passes, as its cell {results.folder}" in " ".join(result.stderr.split())
    assert "vertex 1, on low; noise of a sample: Path tracing " in result.stderr
    folder = results.folder / "inspect"
    assert [Path(line) for line in result.stdout.split()] == [folder / name for name in (
        "cornell_box_records_Cosine.png", "cornell_box_8_10_vertex1.png", "cornell_box_8_10_vertex1.pdf",
        "cornell_box_8_10_vertex1.json")]
    assert all((folder / line).stat().st_size > 0 for line in result.stdout.split())
    shown = json.loads((folder / "cornell_box_8_10_vertex1.json").read_text())
    assert shown["vertex"]["number"] == 1 and shown["truth"]["paths"] == 128 and shown["seed"] == 3
    assert shown["truth"]["guide"] == "Cosine"
    assert shown["vertex"]["shape"] == "low" and abs(shown["vertex"]["normal"][2]) < 1e-5   # the front of the low block
    plain, cosine = shown["methods"]["Path tracing"], shown["methods"]["Cosine"]
    assert plain["learnt"] is None and plain["fraction"] == 1 and cosine["record"] is not None
    for figure in ("divergence", "deviation"):                                              # cos / pi, all of them
        assert cosine["sampled"][figure] == pytest.approx(plain["sampled"][figure], rel=1e-3)
        assert cosine["learnt"][figure] == pytest.approx(plain["sampled"][figure], rel=1e-3)


def test_guides_are_read_from_files_and_paths_followed(experiment, tmp_path):
    scene = load("cornell_box", None, 16, 12, 3)
    guide = olpm_bench.train(scene, "cosine", max_depth=3, passes=1, photons=3000, importons=500, camera_passes=0)
    guide.save(tmp_path / "g.npz")
    result = call("inspect", experiment, "--pixel", "8,10", "--passes", 2, "--vertex", 2, "--results", tmp_path,
                  "--guide", f"Cosine={tmp_path / 'g.npz'}")
    assert result.exit_code == 0, result.output
    assert "Cosine: read from" in result.stderr
    assert (tmp_path / "test" / "inspect" / "cornell_box_8_10_vertex2.pdf").is_file()


def test_a_scale_has_pictures_of_its_own(experiment, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(inspect, "inspect", lambda loaded, folder, *_, **__: asked.append((loaded.scene[0].width, folder)) or [])
    experiment.write_text(TOML + "[scale.small]\nscene = { width = 8, height = 6 }\n")
    result = call("inspect", experiment, "--scale", "small", "--pixel", "1,1", "--results", tmp_path)
    assert result.exit_code == 0, result.output
    assert asked == [(8, tmp_path / "test-small")]


def test_the_first_scene_named_is_the_one_and_others_say_where_they_are(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(inspect, "inspect",
                        lambda loaded, *_, scene, **__: asked.append((scene, [s.file for s in loaded.scene])) or [])
    (tmp_path / "room.xml").write_text('<scene version="3.0.0"/>')
    (tmp_path / "two.toml").write_text(TWO.replace('name = "door_ajar"', 'name = "hall"\nfile = "hall.xml"')
                                       .replace('name = "cornell_box"', 'name = "room"\nfile = "nowhere.xml"'))
    result = call("inspect", tmp_path / "two.toml", "--pixel", "1,1", "--scene", f"room={tmp_path / 'room.xml'}",
                  "--scene", f"hall={tmp_path / 'room.xml'}")
    assert result.exit_code == 0, result.output
    assert asked == [("room", [tmp_path / "room.xml"] * 2)]


def test_methods_are_those_named_or_what_figures_show(tmp_path):
    def found(*methods: str) -> list[str]:
        return [spec.method.name for spec in inspect._specs(loaded, None, methods, 0)]

    sweep = 'sweep = { "training.photons" = [1000, 2000, 3000, 4000, 5000, 6000, 7000, 8000, 9000] }\n'
    (tmp_path / "sweep.toml").write_text(TOML + sweep)
    loaded = experiment_file.load(tmp_path / "sweep.toml")
    assert found() == ["Path tracing", "Cosine, photons 9k"]
    assert found("Cosine, photons 2k") == ["Cosine, photons 2k"]


def test_no_link_leads_out_of_the_results_folder(experiment, tmp_path):
    (tmp_path / "test").mkdir()
    (tmp_path / "test" / "inspect").symlink_to("/sys")
    said = complaint(call("inspect", experiment, "--pixel", "1,1", "--results", tmp_path))
    assert "test/inspect is /sys, by a link that leads out of" in said


@pytest.mark.parametrize("arguments, words", [
    (("missing.toml", "--pixel", "1,1"), ["missing.toml", "no such file"]),
    ((".", "--pixel", "1,1"), ["no experiment.toml", "no folder of results"]),
    (("two.toml", "--pixel", "1,1"), ["which scene? --scene NAME", "door_ajar, cornell_box"]),
    (("two.toml", "--pixel", "1,1", "--scene", "room"), ["no scene 'room'", "known: door_ajar, cornell_box"]),
    (("test.toml", "--pixel", "1"), ["--pixel 1:", "X,Y"]),
    (("test.toml", "--pixel", "1,1", "--method", "GMM"), ["--method GMM: no such method", "known: Path tracing, Cosine"]),
    (("test.toml", "--pixel", "16,3"), ["pixel 16,3 is outside the image, 16x12"]),
    (("test.toml", "--pixel", "8,10", "--vertex", "7"), ["has 2 vertices, no vertex 7"]),
    (("test.toml", "--pixel", "8,10", "--guide", "g.npz"), ["--guide g.npz: must be NAME=PATH"]),
    (("test.toml", "--pixel", "8,10", "--guide", "GMM=g.npz"), ["no method 'GMM' with a guide; known: Cosine"]),
    (("test.toml", "--pixel", "8,10", "--guide", "Cosine=g.npz"), ["g.npz", "No such file"]),
])
def test_bad_input_is_one_line(experiment, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    Path("two.toml").write_text(TWO)
    text = complaint(call("inspect", *arguments))
    for word in words:
        assert word in text


def test_pixels_that_see_nothing_or_mirrors_are_refused():
    sky = {"type": "constant"}
    empty = mi.load_dict({"type": "scene", "sensor": camera(), "sky": sky, "behind": wall((0, -2, 0), (0, 1, 0), bsdf=grey(0.5))})
    with pytest.raises(config.ConfigError, match="sees no surface"):
        inspect._vertex(empty, (8, 8), 4, None, 0)
    mirrors = mi.load_dict(box({"type": "conductor"}, sky=sky))         # merged into one mesh, which loses their names
    with pytest.raises(config.ConfigError, match="meets only mirrors and glass"):
        inspect._vertex(mirrors, (8, 8), 4, None, 0)
    with pytest.raises(config.ConfigError, match="vertex 2, on an unnamed shape, is a mirror or glass"):
        inspect._vertex(mirrors, (8, 8), 4, 2, 0)
