"""Experiment files: what is read, what is refused and with which words, and what determines a cell."""
from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from olpm_bench.bench import config, experiment_file
from olpm_bench.bench.config import ConfigError

MINIMAL = """
title = "Test"
seeds = 2
[budget]
spp = 8
[[scene]]
name = "cornell_box"
width = 16
height = 12
[training]
passes = 2
[[method]]
name = "Path tracing"
[[method]]
name = "Cosine"
representation = { type = "cosine" }
integrator = { roulette = "throughput" }
"""
XML = '<scene version="3.0.0"><default name="resx" value="4"/></scene>'


def load(tmp_path: Path, text: str, **arguments) -> config.Experiment:
    file = tmp_path / "test.toml"
    file.write_text(text)
    return experiment_file.load(file, **arguments)


def message(tmp_path: Path, text: str, **arguments) -> str:
    with pytest.raises(ConfigError) as error:
        load(tmp_path, text, **arguments)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_what_is_written_and_what_is_the_default(tmp_path):
    experiment = load(tmp_path, MINIMAL)
    assert experiment.seeds == [0, 1] and experiment.budget.checkpoints == 8
    scene, (unguided, cosine) = experiment.scene[0], experiment.method
    assert experiment.training_of(unguided) is None
    assert experiment.training_of(cosine).passes == 2
    assert experiment.integrator_of(scene, unguided).roulette == "contribution"
    assert experiment.integrator_of(scene, cosine).roulette == "throughput"
    assert experiment.path == tmp_path / "test.toml"


def test_methods_are_interleaved(tmp_path):
    cells = load(tmp_path, MINIMAL).cells()
    assert [c.method.name for c in cells] == ["Path tracing", "Cosine"] * 2 and [c.seed for c in cells] == [0, 0, 1, 1]


def test_a_scenes_depth_wins(tmp_path):
    text = MINIMAL.replace("height = 12", "height = 12\nmax_depth = 4") + "[integrator]\nmax_depth = 9\n"
    experiment = load(tmp_path, text)
    assert experiment.max_depth(experiment.scene[0]) == 4
    assert all(c.integrator.max_depth == 4 for c in experiment.cells())


def test_presets_apply_before_changes(tmp_path):
    experiment = load(tmp_path, MINIMAL.replace("passes = 2", 'preset = "paper2014"\npasses = 3'))
    assert experiment.training.gather == "nearest" and experiment.training.passes == 3
    own = load(tmp_path, MINIMAL + 'training = { preset = "paper2014", photons = 7 }\n')
    assert own.training_of(own.method[1]).gather == "nearest" and own.training_of(own.method[1]).photons == 7


def test_presets_bring_their_roulette(tmp_path):
    """A method's own words win over its preset's, those over the experiment's, and those over the experiment's preset's."""
    def roulettes(training: str = "", integrator: str = "", own: str = "") -> list[str]:
        text = MINIMAL.replace("passes = 2", training).replace('integrator = { roulette = "throughput" }', own)
        experiment = load(tmp_path, text + f"[integrator]\n{integrator}\n")
        return [experiment.integrator_of(experiment.scene[0], method).roulette for method in experiment.method]

    preset = 'preset = "paper2014_norr"'
    assert roulettes() == ["contribution"] * 2
    assert roulettes(preset) == ["contribution", "none"]                    # the unguided method has no preset
    assert roulettes(preset, 'roulette = "throughput"') == ["throughput"] * 2
    assert roulettes(integrator='roulette = "throughput"', own=f"training = {{ {preset} }}") == ["throughput", "none"]
    assert roulettes(integrator='roulette = "none"', own='training = { preset = "best" }') == ["none", "contribution"]
    assert roulettes(preset, own='integrator = { roulette = "throughput" }') == ["contribution", "throughput"]


def test_presets_are_resolved_in_the_results_and_read_back_as_the_same_cells(tmp_path):
    text = MINIMAL.replace("passes = 2", 'preset = "paper2014"\npasses = 2\nshare = "auto"')
    text += 'training = { preset = "paper2014_norr", photons = 7 }\n'
    text += '[[method]]\nname = "Talk"\nrepresentation = { type = "jensen" }\n'
    text += '[[method]]\nname = "Best"\nrepresentation = { type = "jensen" }\ntraining = { preset = "best", share = 0.5 }\n'
    experiment = load(tmp_path, text.replace('integrator = { roulette = "throughput" }\n', ""))
    resolved = experiment.toml()
    assert "preset" not in resolved
    methods = {method["name"]: method for method in tomllib.loads(resolved)["method"]}
    assert [methods[m]["integrator"]["roulette"] for m in ("Path tracing", "Cosine", "Talk", "Best")] == [
        "contribution", "none", "throughput", "contribution"]
    assert methods["Cosine"]["training"]["photons"] == 7 and methods["Cosine"]["training"]["gather"] == "nearest"
    assert methods["Talk"]["training"]["share"] == "auto" and methods["Best"]["training"]["share"] == 0.5
    assert [c.key for c in load(tmp_path, resolved).cells()] == [c.key for c in experiment.cells()]


def test_a_scene_may_do_without_a_reference(tmp_path):
    assert load(tmp_path, MINIMAL).scene[0].has_reference
    experiment = load(tmp_path, MINIMAL.replace("width = 16", 'width = 16\nreference = "none"'))
    assert not experiment.scene[0].has_reference
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    assert tomllib.loads(experiment.toml(folder))["scene"][0]["reference"] == "none"
    (folder / "again.toml").write_text(experiment.toml(folder))
    assert not experiment_file.load(folder / "again.toml").scene[0].has_reference
    assert [c.key for c in experiment.cells()] == [c.key for c in load(tmp_path, MINIMAL).cells()]


def test_the_baseline_is_the_first_method_or_the_named_one(tmp_path):
    assert load(tmp_path, MINIMAL).baseline_name == "Path tracing"
    experiment = load(tmp_path, MINIMAL.replace("seeds = 2", 'seeds = 2\nbaseline = "Cosine"'))
    assert experiment.baseline_name == "Cosine" and load(tmp_path, experiment.toml()).baseline_name == "Cosine"


def test_some_scenes_of_an_experiment(tmp_path):
    second = '[[scene]]\nname = "door_ajar"\nwidth = 8\nheight = 8\n'
    experiment = load(tmp_path, MINIMAL + second)
    part = experiment.of_scenes(["door_ajar"])
    assert [s.name for s in part.scene] == ["door_ajar"] and part.path == experiment.path
    assert [c.key for c in part.cells()] == [c.key for c in experiment.cells()][4:]
    assert experiment.of_scenes([]).scene == experiment.scene
    with pytest.raises(ConfigError, match=r"no scene 'room' in test\.toml; known: cornell_box, door_ajar"):
        experiment.of_scenes(["room"])


@pytest.mark.parametrize("old, new, words", [
    ("seeds = 2", "sedes = 2", ["unknown key 'sedes' in test.toml", "known:", "seeds", "; did you mean 'seeds'?"]),
    ("spp = 8", "spps = 8", ["unknown key 'spps' in test.toml [budget]", "seconds, spp, checkpoints"]),
    ("width = 16", "widht = 16", ["'widht' in test.toml [[scene]] 1", "width"]),
    ("passes = 2", "pases = 2", ["unknown key 'pases' in test.toml [training]", "preset", "photons", "did you mean 'passes'?"]),
    ("[training]", "[trainig]", ["unknown key 'trainig' in test.toml", "did you mean 'training'?"]),
    ('roulette = "throughput"', 'roulete = "none"', ["'Cosine'", "unknown key 'roulete'", "did you mean 'roulette'?"]),
    ('roulette = "throughput"', 'roulette = "russian"', ["'Cosine'", "roulette", "'russian'", "'throughput'", "'none'"]),
    ('roulette = "throughput"', "max_depth = 5", ["max_depth", "[[scene]]"]),
    ("spp = 8", "spp = 8\nseconds = 3", ["[budget]", "give one of seconds and spp"]),
    ("spp = 8", "", ["[budget]", "give one of seconds and spp"]),
    ("spp = 8", "spp = -8", ["[budget]: spp", "-8", "greater than or equal to 1"]),
    ("spp = 8", "seconds = nan", ["[budget]: seconds"]),
    ("spp = 8", "seconds = 1e-300", ["[budget]: seconds", "0.001"]),
    ("spp = 8", "spp = 8.5", ["[budget]: spp", "8.5"]),
    ("width = 16", 'width = "16"', ["[[scene]] 1: width", "'16'", "integer"]),
    ("width = 16", "", ["missing key 'width'", "[[scene]] 1"]),
    ('title = "Test"', "", ["missing key 'title' in test.toml"]),
    ("passes = 2", "photons = -3", ["[training]", "photons = -3", ">= 1"]),
    ("passes = 2", 'passes = "2"', ["[training]", "passes", "'2'"]),
    ("passes = 2", 'preset = "slow"', ["[training]", "unknown preset 'slow'", "best, paper2014"]),
    ("seeds = 2", "seeds = 0", ["seeds = 0", "must be 1 to"]),
    ("seeds = 2", "seeds = [1, 1]", ["seeds", "different"]),
    ("seeds = 2", "seeds = [-1]", ["seeds", "0 to"]),
    ("seeds = 2", "schema_version = 2", ["schema_version = 2", "must be <= 1"]),
    ('name = "Cosine"', 'name = "Path tracing"', ["two methods of one name 'Path tracing'"]),
    ('name = "Cosine"', 'name = "Path-tracing"', ["'Path tracing' and 'Path-tracing'", "folder"]),
    ('type = "cosine"', 'type = "cosin"', ["'Cosine'", "unknown representation 'cosin'", "gaussian_mixture"]),
    ('type = "cosine"', 'type = "cosine", k = 8', ["representation 'cosine' has no parameter 'k'"]),
    ('type = "cosine"', 'type = "missing.py:A"', ["missing.py", "no such file"]),
    ('{ type = "cosine" }', "{ k = 8 }", ["representation needs a type", "cosine"]),
    ('name = "Path tracing"', 'name = "Path tracing"\ntraining = { passes = 1 }', ["no representation to train"]),
    ('"cornell_box"', '"cornel_box"', ["unknown scene", "'cornel_box'", "cornell_box", "door_ajar"]),
    ("width = 16", "width = 16\nparameters = { gap = 1 }", ["no parameter 'gap'", "light_size"]),
    ("width = 16", "width = 16\noverrides = { gap = 1 }", ["overrides belong to files"]),
    ("width = 16", 'width = 16\nfile = "no.xml"', ["no.xml", "no such file", "--scene"]),
    ("width = 16", 'width = 16\nreference = "no.exr"', ["no.exr", "no such file"]),
    ("width = 16", "width = 16\nmax_depth = 0", ["max_depth = 0", ">= 1, or -1"]),
    ("passes = 2", "preset = ['best']", ["[training]", "unknown preset ['best']", "best, paper2014"]),
    ('roulette = "throughput"', 'rr_depth = "two"', ["'Cosine' integrator", "rr_depth = 'two'", "a whole number"]),
    ('representation = { type = "cosine" }', 'representation = { type = "cosine" }\ntraining = { preset = ["best"] }',
     ["'Cosine' training", "unknown preset ['best']"]),
    ("passes = 2", "share = 0", ["[training]", "share = 0", "in (0, 1], or 'auto'"]),
    ("passes = 2", 'share = "all"', ["[training]: share", "'all'", "'auto'"]),
    ("passes = 2", "share = true", ["[training]: share", "True"]),
    ("seeds = 2", 'seeds = 2\nbaseline = "PT"', ["baseline = 'PT'", "no method of this name", "known: Path tracing, Cosine"]),
    ("seeds = 2", "seeds = 2\nbaseline = 3", ["baseline = 3", "string"]),
    ("width = 16", "width = 16\nreference = 3", ["[[scene]] 1: reference = 3"]),
    ("width = 16", 'width = 16\nreference = "None"', ["no such file or folder", '"none" does without']),
    ("passes = 2", "photons = 2.5", ["[training]", "photons", "2.5"]),
    ("width = 16", "width = 16\nparameters = { light_size = 3 }", ["'cornell_box'", "light_size = 3.0", "[0.01, 1.9]"]),
    ("width = 16", "width = 16\ncrops = [[10, 0, 8, 4]]", ["crop [10, 0, 8, 4]", "must be inside the image of 16 x 12"]),
    ("width = 16", "width = 16\ncrops = [[0, 0, 0, 4]]", ["crop [0, 0, 0, 4]", "[x, y, width, height]"]),
    ("width = 16", "width = 16\ncrops = [[0, 0, 8, 4], [0, 0, 4, 4]]", ["one shape, the same width : height"]),
    ("width = 16", "width = 16\ncrops = [[0, 0, 8]]", ["[[scene]] 1", "crop [0, 0, 8]: must be [x, y, width, height]"]),
    ("width = 16", "width = 16\ncrops = [0, 0, 8, 4]", ["[[scene]] 1: crops"]),
    ("spp = 8", "spp = ", ["test.toml is not valid TOML", "line 5"]),
])
def test_mistakes_are_named_with_what_is_allowed(tmp_path, old, new, words):
    assert old in MINIMAL
    text = message(tmp_path, MINIMAL.replace(old, new, 1))
    for word in words:
        assert word in text, text


def test_what_is_no_table_is_named(tmp_path):
    text = MINIMAL.replace("[training]\npasses = 2", "").replace('title = "Test"', 'title = "Test"\ntraining = 3')
    assert message(tmp_path, text) == "test.toml: [training] = 3: must be a table"
    text = MINIMAL.replace("[[scene]]", "").replace('name = "cornell_box"\nwidth = 16\nheight = 12', "")
    assert "[[scene]] 1 = 3: must be a table" in message(tmp_path, text.replace("seeds = 2", "seeds = 2\nscene = [3]"))


def test_the_hint_names_an_option_only_where_there_is_one(tmp_path):
    data = {"title": "", "budget": {"spp": 1}, "method": [{"name": "A"}],
            "scene": [{"name": "a room", "file": "no.xml", "width": 4, "height": 4}]}
    for scenes, hinted in ((None, False), ({}, True)):
        with pytest.raises(ConfigError, match="no such file") as error:
            experiment_file.parse(data, "command line", tmp_path, scenes)
        assert ("--scene 'a room'=PATH" in str(error.value)) == hinted


def test_the_key_follows_our_own_code_and_the_reference_does_not(tmp_path, monkeypatch):
    before = load(tmp_path, MINIMAL)
    keys = [c.key for c in before.cells()]
    assert config.own_code() == config.own_code()
    monkeypatch.setattr(config, "own_code", lambda: "changed")
    after = load(tmp_path, MINIMAL)
    assert not set(keys) & {c.key for c in after.cells()}
    assert before.reference_key(before.scene[0]) == after.reference_key(after.scene[0])


@pytest.mark.parametrize("name", ["cell.py", "clock.py", "accumulator.py", "materials.py", "path.py", "jensen.py"])
def test_our_own_code_is_that_of_cells_scenes_transport_and_representations(monkeypatch, name):
    before, read = config.own_code(), Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda file, **k: read(file, **k) + "#" * (file.name == name))
    assert config.own_code.__wrapped__() != before


def test_cells_of_another_variant_are_others(tmp_path, monkeypatch):
    keys = [c.key for c in load(tmp_path, MINIMAL).cells()]
    monkeypatch.setenv("OLPM_BENCH_VARIANT", "cuda_ad_rgb")
    assert not set(keys) & {c.key for c in load(tmp_path, MINIMAL).cells()}


def test_a_missing_file_and_one_that_is_no_text(tmp_path):
    with pytest.raises(ConfigError, match=r"nothing\.toml: there is no such file"):
        experiment_file.load(tmp_path / "nothing.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        experiment_file.load(tmp_path / "binary.toml")


def test_paths_are_relative_to_the_file(tmp_path, monkeypatch):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "room.xml").write_text(XML)
    (tmp_path / "mine.py").write_text("class Mine:\n    def __init__(self, k=3): self.k = k\n")
    monkeypatch.chdir(Path(__file__).parent)
    text = MINIMAL.replace("width = 16", 'width = 16\nfile = "scenes/room.xml"\noverrides = { resx = 8 }')
    experiment = load(tmp_path, text.replace('type = "cosine"', 'type = "mine.py:Mine"'))
    assert experiment.scene[0].file == (tmp_path / "scenes" / "room.xml").resolve()
    assert experiment.method[1].create().k == 3
    assert experiment.cells()[1].config()["representation"]["k"] == 3


def test_a_scene_can_be_pointed_elsewhere(tmp_path):
    (tmp_path / "other.xml").write_text(XML)
    text = MINIMAL.replace("width = 16", 'width = 16\nfile = "no.xml"')
    assert load(tmp_path, text, scenes={"cornell_box": tmp_path / "other.xml"}).scene[0].file.name == "other.xml"
    assert "known: cornell_box" in message(tmp_path, text, scenes={"room": tmp_path / "other.xml"})


def test_the_resolved_file_describes_the_same_cells(tmp_path):
    (tmp_path / "room.xml").write_text(XML)
    second = '[[scene]]\nname = "a \\"room\\""\nfile = "room.xml"\nwidth = 8\nheight = 8\noverrides = { resx = 8 }\n'
    experiment = load(tmp_path, MINIMAL.replace("width = 16", "width = 16\ncrops = [[1, 2, 8, 4]]") + second)
    folder = tmp_path / "results" / "test"
    folder.mkdir(parents=True)
    (folder / "experiment.toml").write_text(experiment.toml(folder))
    again = experiment_file.load(folder / "experiment.toml")
    assert [c.key for c in again.cells()] == [c.key for c in experiment.cells()]
    assert again.scene[0].crops == [[1, 2, 8, 4]] and again.of_results(folder).path == Path("test.toml")
    resolved = tomllib.loads(experiment.toml())
    assert resolved["schema_version"] == 1 and resolved["method"][1]["training"]["neighbours"] == 1000
    assert resolved["scene"][0]["parameters"]["light_size"] == 0.5


@pytest.mark.parametrize("old, new", [
    ("spp = 8", "spp = 9"), ("width = 16", "width = 17"), ("passes = 2", "passes = 3"), ('"throughput"', '"none"'),
    ('type = "cosine"', 'type = "jensen"'), ("width = 16", "width = 16\nparameters = { rotation = 12 }"),
    ("width = 16", "width = 16\nmax_depth = 4"),
])
def test_the_key_changes_with_all_that_determines_the_cell(tmp_path, old, new):
    before, after = load(tmp_path, MINIMAL).cells()[1], load(tmp_path, MINIMAL.replace(old, new)).cells()[1]
    assert before.key != after.key


@pytest.mark.parametrize("old, new", [
    ('title = "Test"', 'title = "Another"'), ("seeds = 2", "seeds = [0, 7]"), ('"Cosine"', '"Lambert"'),
    ("width = 16", "width = 16\nparameters = { light_size = 0.5 }"), ("passes = 2", "passes = 2\nneighbours = 1000"),
    ("width = 16", "width = 16\ncrops = [[1, 2, 8, 4], [3, 4, 4, 2]]"),
])
def test_the_key_ignores_labels_and_written_out_defaults(tmp_path, old, new):
    assert load(tmp_path, MINIMAL).cells()[1].key == load(tmp_path, MINIMAL.replace(old, new)).cells()[1].key


def test_the_key_follows_the_scenes_files_and_not_their_dates(tmp_path):
    (tmp_path / "mesh.ply").write_text("ply")
    xml = tmp_path / "room.xml"
    shape = '<shape type="ply"><string name="filename" value="mesh.ply"/></shape>'
    xml.write_text(XML.replace("</scene>", shape + "</scene>"))
    text = MINIMAL.replace("width = 16", 'width = 16\nfile = "room.xml"')
    keys = [load(tmp_path, text).reference_key(load(tmp_path, text).scene[0])]
    for write in (lambda: xml.touch(), lambda: (tmp_path / "mesh.ply").write_text("PLY"),
                  lambda: xml.write_text(XML)):
        write()
        experiment = load(tmp_path, text)
        keys.append(experiment.reference_key(experiment.scene[0]))
    assert keys[0] == keys[1] and len(set(keys)) == 3
    assert all(key.startswith("cornell_box-16x12-") for key in keys)


def test_a_reference_depends_on_the_image_and_not_on_methods_or_budget(tmp_path):
    a, b = load(tmp_path, MINIMAL), load(tmp_path, MINIMAL.replace("spp = 8", "seconds = 3").replace("passes = 2", ""))
    c = load(tmp_path, MINIMAL + "[integrator]\nmax_depth = 3\n")
    assert a.reference_key(a.scene[0]) == b.reference_key(b.scene[0]) != c.reference_key(c.scene[0])
    assert a.cells()[0].reference_key == a.reference_key(a.scene[0])
