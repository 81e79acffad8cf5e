"""Scales: what they change, what they refuse, and which reference serves them."""
from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from olpm_bench.bench import config, experiment_file, run, scale, summary
from olpm_bench.bench.config import ConfigError
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.reference_file import Reference, write_reference
from olpm_bench.bench.results import Results
from olpm_bench.cli import app
from olpm_bench.report import page

TOML = """
title = "Test"
seeds = 3
[budget]
seconds = 60
[[scene]]
name = "cornell_box"
width = 64
height = 48
[[scene]]
name = "door_ajar"
parameters = { gap = 0.2 }
width = 32
height = 18
[training]
passes = 9
[[method]]
name = "Path tracing"
[[method]]
name = "Jensen"
representation = { type = "jensen", resolution = 8 }
training = { photons = 500 }
"""
SMALL = """
[scale.small]
seeds = 1
budget = { seconds = 2 }
scene = { width = 16, height = 12 }
training = { passes = 2 }
"""
ONE = """
[scale.one]
scene = [{ name = "door_ajar", parameters = { gap = 0.1 } }]
method = [{ name = "Jensen", training = { neighbours = 20 } }]
"""


def load(tmp_path: Path, scale: str | None, text: str = TOML + SMALL + ONE) -> config.Experiment:
    (tmp_path / "test.toml").write_text(text)
    return experiment_file.load(tmp_path / "test.toml", scale=scale)


def test_tables_are_merged_and_a_table_changes_all_scenes(tmp_path):
    full, small = load(tmp_path, None), load(tmp_path, "small")
    assert (small.seeds, small.budget.seconds, small.budget.checkpoints) == ([0], 2, full.budget.checkpoints)
    assert [(s.name, s.width, s.height) for s in small.scene] == [("cornell_box", 16, 12), ("door_ajar", 16, 12)]
    assert small.scene[1].parameters == {"gap": 0.2} and small.title == "Test (small)"
    training = small.training_of(small.method[1])
    assert (training.passes, training.photons) == (2, 500) and full.training_of(full.method[1]).passes == 9


def test_an_array_names_the_scenes_and_methods_that_stay(tmp_path):
    one = load(tmp_path, "one")
    assert [(s.name, s.width, s.parameters) for s in one.scene] == [("door_ajar", 32, {"gap": 0.1})]
    assert [m.name for m in one.method] == ["Jensen"] and one.seeds == [0, 1, 2]
    assert one.method[0].representation == {"type": "jensen", "resolution": 8}
    assert (one.training_of(one.method[0]).photons, one.training_of(one.method[0]).neighbours) == (500, 20)


def test_crops_change_with_the_size_of_the_image():
    own = {"crops": [[0, 0, 1, 1]]}
    data = {"scene": [{"name": "a", "width": 96, "height": 54, "crops": [[30, 29, 24, 14], [60, 4, 24, 14]]}], "scale": {
        "small": {"scene": {"width": 48, "height": 27}}, "tiny": {"scene": {"width": 16, "height": 9}},
        "large": {"scene": {"width": 192, "height": 108}}, "odd": {"scene": {"width": 64, "height": 36}},
        "narrow": {"scene": {"width": 48}}, "other": {"scene": {"width": 48, "height": 27, **own}}, "noisy": {"seeds": 1},
        "broken": {"scene": {"width": "48", "height": 0}}}}
    crops = {name: scale.scaled(data, name, "a.toml")["scene"][0].get("crops") for name in data["scale"]}
    assert crops == {"small": [[15, 14, 12, 7], [30, 2, 12, 7]], "tiny": [[5, 5, 4, 4], [10, 1, 4, 4]],
                     "large": [[60, 58, 48, 28], [120, 8, 48, 28]], "odd": [], "narrow": [], "other": own["crops"],
                     "noisy": data["scene"][0]["crops"], "broken": []}


@pytest.mark.parametrize("boxes", [[[0, 0, 24, 14], [0, 0, 12, 7]], [[0, 0, 24]], [["a", 0, 24, 14]], [[0, 0, 24.0, 14]], [3], 3])
def test_crops_that_fit_no_other_size_are_left_out(boxes):
    """12 x 7 and 6 x 3.5 pixels are not of one shape when rounded; the rest would be complained of at the size that it is for."""
    data = {"scene": [{"width": 96, "height": 54, "crops": boxes}], "scale": {"small": {"scene": {"width": 48, "height": 27}}}}
    assert scale.scaled(data, "small", "a.toml")["scene"][0]["crops"] == []


def test_a_scale_has_results_and_commands_of_its_own(tmp_path):
    full, small = load(tmp_path, None), load(tmp_path, "small")
    assert (full.stem, small.stem) == ("test", "test-small")
    words = ["olpm-bench", "run", str(tmp_path / "test.toml"), "--scale", "small"]
    assert shlex.split(small.command("run", Path("my results"))) == [*words, "--results", "my results"]
    assert small.of_scenes(["door_ajar"]).stem == "test-small"
    with pytest.raises(ResultError, match=r"olpm-bench reference .*test\.toml --scale small"):
        run.run(small, tmp_path / "results")
    assert not (tmp_path / "results").exists()
    (tmp_path / "resolved.toml").write_text(small.toml())
    assert [c.key for c in experiment_file.load(tmp_path / "resolved.toml").cells()] == [c.key for c in small.cells()]


def test_the_commands_that_are_suggested_are_those_that_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("my room.xml").write_text('<scene version="3.0.0"/>')
    Path("test.toml").write_text(TOML.replace('"cornell_box"', '"room"\nfile = "missing.xml"') + SMALL)
    small = experiment_file.load("test.toml", {"room": Path("my room.xml")}, "small")
    results, said = Results("out/test-small"), []
    for fails in (lambda: run.references(small.of_scenes(["door_ajar"]), Path("out")),
                  lambda: summary.complete_cells(small, results)):
        with pytest.raises(ResultError) as error:
            fails()
        said.append(str(error.value).partition("make it with: ")[2].partition(", or do without")[0])
    for command in (*said, *page.commands(small, results, [])):
        words = shlex.split(command)
        assert words[0] == "olpm-bench" and words[1] in ("run", "reference")
        assert words[2:] == ["test.toml", "--scale", "small", "--results", "out", "--scene=room=my room.xml"]
    result = CliRunner().invoke(app, [*words[1:], "--dry-run", "--with-reference"])
    assert words[1] == "run" and result.exit_code == 0, result.output
    results.write_text("experiment.toml", small.toml(results.folder))
    Path("experiments").mkdir()
    Path("test.toml").rename("experiments/test.toml")
    again = experiment_file.load(results.folder / "experiment.toml").of_results(results.folder.resolve())
    assert shlex.split(again.command("run", Path("out"))) == [*words[:2], "experiments/test.toml", *words[3:]]


def test_methods_look_as_at_full_scale(tmp_path):
    """The one that is left, a sweep with other values, and what is written into the results."""
    swept = SMALL + ONE + """
[[method]]
name = "GMM"
representation = { type = "gaussian_mixture" }
sweep = { "training.passes" = [2, 4] }
[scale.swept]
method = [{ name = "GMM", sweep = { "training.passes" = [1, 4] } }]
"""
    full, small = load(tmp_path, None, TOML + swept), load(tmp_path, "swept", TOML + swept)
    assert full.looks["GMM, passes 4"] == full.looks["GMM"] == len(full.method) - 1 and full.method[-1].look is None
    assert small.looks == {"GMM, passes 1": 4, "GMM, passes 4": full.looks["GMM"], "GMM": full.looks["GMM"]}
    (tmp_path / "resolved.toml").write_text(small.toml())
    assert experiment_file.load(tmp_path / "resolved.toml").looks == small.looks
    same = load(tmp_path, "small", TOML + swept)
    assert same.looks == full.looks and all(method.look is None for method in same.method)


@pytest.mark.parametrize("scale, text, words", [
    ("large", TOML + SMALL + ONE, "--scale large: test.toml has no [scale.large]; known: small, one"),
    ("small", TOML, "--scale small: test.toml has no [scale.small]; known: none"),
    ("small", TOML + SMALL.replace("seconds = 2", "spp = 4"), "[budget]: give one of seconds and spp"),
    ("small", TOML + SMALL.replace("width", "widht"), "unknown key 'widht' in test.toml --scale small [[scene]] 1; known: name"),
    ("one", TOML + ONE.replace("door_ajar", "room"), "[scale.one] scene: none is named 'room'; known: cornell_box, door_ajar"),
    ("one", TOML + ONE.replace('"Jensen"', '"Hey"'), "[scale.one] method: none is named 'Hey'; known: Path tracing, Jensen"),
    ("one", TOML.replace('"Path tracing"', "[3]") + ONE.replace('"Jensen"', "[4]"),
     "[scale.one] method: none is named '[4]'; known: [3], Jensen"),
    ("one", TOML + ONE.replace('name = "Jensen", ', ""), "method: none is named 'None'; known: Path tracing, Jensen"),
    (None, TOML.replace("[budget]", "scale = { small = 3 }\n[budget]"), "scale.small = 3: must be a"),
])
def test_mistakes_are_one_line_that_names_what_there_is(tmp_path, scale, text, words):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, scale, text)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_larger_reference_serves_averaged(tmp_path):
    """Of 64 x 48 for 16 x 12: means of 4 x 4 pixels, whose variance is a sixteenth."""
    small = load(tmp_path, "small").of_scenes(["cornell_box"])
    full = load(tmp_path, None)
    a = np.random.default_rng(1).uniform(0, 1, (48, 64, 3)).astype(np.float32)
    write_reference(tmp_path / "references" / full.reference_key(full.scene[0]),
                    Reference(a, a + 1, np.full_like(a, 3), a, {"spp_a": 1, "spp_b": 3}))
    found = run.references(small, tmp_path)["cornell_box"]
    assert found.mean.shape == (12, 16, 3)
    np.testing.assert_allclose(found.a[2, 5], a[8:12, 20:24].mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(found.mean, found.a + 0.75, rtol=1e-5)
    np.testing.assert_allclose(found.a_variance, 3 / 16, rtol=1e-5)
    own = np.zeros((12, 16, 3), np.float32)
    write_reference(tmp_path / "references" / small.reference_key(small.scene[0]),
                    Reference(own, own, own, own, {"spp_a": 1, "spp_b": 1}))
    assert not run.references(small, tmp_path)["cornell_box"].mean.any()        # its own comes first


def test_results_are_in_a_folder_of_their_own(tmp_path, monkeypatch):
    text = TOML.replace("seconds = 60", "spp = 4").replace("gap = 0.2 }", 'gap = 0.2 }\nreference = "none"')
    small = SMALL.replace("seconds = 2", "spp = 1").replace("scene = {", 'scene = { reference = "none",')
    monkeypatch.setattr(run, "_run_cell", lambda *_: None)
    assert run.run(load(tmp_path, "small", text + small), tmp_path / "results") == []
    assert [p.name for p in (tmp_path / "results").iterdir()] == ["test-small"]
    assert Results(tmp_path / "results" / "test-small").read_cell("door_ajar", "Jensen", 0) is None
