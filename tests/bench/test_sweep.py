"""Methods that sweep a setting: the methods that they stand for, and what is refused."""
from __future__ import annotations

from pathlib import Path

import pytest

from olpm_bench.bench import config, experiment_file, sweep
from olpm_bench.bench.config import ConfigError

TOML = """
title = "Test"
[budget]
spp = 4
[[scene]]
name = "cornell_box"
width = 8
height = 8
[training]
preset = "paper2014"
[[method]]
name = "Path tracing"
[[method]]
name = "GMM"
representation = { type = "gaussian_mixture" }
training = { importons = 3 }
sweep = { "training.photons" = [10_000, 500, 2_000_000] }
[[method]]
name = "Jensen"
representation = { type = "jensen" }
sweep = { "representation.resolution" = [4, 8] }
[sweep]
x = "photons"
y = ["l1", "bytes"]
"""


def load(tmp_path: Path, text: str = TOML) -> config.Experiment:
    (tmp_path / "test.toml").write_text(text)
    return experiment_file.load(tmp_path / "test.toml")


def test_a_sweep_is_a_method_for_each_value(tmp_path):
    experiment = load(tmp_path)
    assert [m.name for m in experiment.method] == [
        "Path tracing", "GMM, photons 10k", "GMM, photons 500", "GMM, photons 2M", "Jensen, resolution 4", "Jensen, resolution 8"]
    gmm = [experiment.training_of(m) for m in experiment.method[1:4]]
    assert [(t.photons, t.importons, t.gather) for t in gmm] == [(n, 3, "nearest") for n in (10_000, 500, 2_000_000)]
    assert [m.representation["resolution"] for m in experiment.method[4:]] == [4, 8]
    assert [(m.series.name, m.series.setting, m.series.value) for m in experiment.method[3:5]] == [
        ("GMM", "training.photons", 2_000_000), ("Jensen", "representation.resolution", 4)]
    assert experiment.method[0].series is None and experiment.sweep.y == ["l1", "bytes"]


def test_swept_cells_are_those_of_methods_written_out(tmp_path):
    swept = load(tmp_path).cells()[1].key
    plain = TOML.replace("importons = 3", "importons = 3, photons = 10_000").replace('sweep = { "training.photons"', "# ")
    assert load(tmp_path, plain).cells()[1].key == swept


def test_the_resolved_file_reads_back(tmp_path):
    experiment = load(tmp_path)
    again = load(tmp_path, experiment.toml())
    assert [c.key for c in again.cells()] == [c.key for c in experiment.cells()]
    assert [m.series for m in again.method] == [m.series for m in experiment.method] and again.sweep == experiment.sweep


def test_figures_of_single_methods_show_the_last_of_each_sweep_where_all_are_too_many(tmp_path):
    experiment = load(tmp_path)
    assert experiment.shown == experiment.method
    many = load(tmp_path, TOML.replace("[4, 8]", "[2, 3, 4, 5, 6, 8]"))
    assert [m.name for m in many.shown] == ["Path tracing", "GMM, photons 2M", "Jensen, resolution 8"]


@pytest.mark.parametrize("value, text", [
    (500, "500"), (1000, "1k"), (1500, "1500"), (20_000_000, "20M"), (1_200_000, "1200k"), (0.25, "0.25"), (1, "1")])
def test_values_are_short(value, text):
    assert sweep.short(value) == text


@pytest.mark.parametrize("new, words", [
    ('{ "training.photons" = [] }', "training.photons = []: must be different positive numbers"),
    ('{ "training.photons" = [1, 1] }', "must be different positive numbers"),
    ('{ "training.photons" = [0, 1] }', "must be different positive numbers"),
    ('{ "training.photons" = 3 }', "training.photons = 3: must be different positive numbers"),
    ('{ "training.photons" = [1], "training.passes" = [1] }', "must be one setting and its values"),
    ("3", "sweep = 3: must be one setting and its values"),
    ('{ "budget.spp" = [1, 2] }', "'budget.spp': must be TABLE.KEY with one of the tables training, integrator, representation"),
    ('{ photons = [1, 2] }', "'photons': must be TABLE.KEY"),
    ('{ "training.photon" = [1, 2] }', "unknown key 'photon'; known: schedule"),
    ('{ "training.photons" = [1.5] }', "photons = 1.5: must be"),
    (f'{{ "training.photons" = {list(range(1, 1002))} }}', "training.photons has 1001 values; must be at most 1000"),
])
def test_mistakes_are_one_line(tmp_path, new, words):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, TOML.replace('{ "training.photons" = [10_000, 500, 2_000_000] }', new))
    assert words in str(error.value) and "\n" not in str(error.value), str(error.value)


@pytest.mark.parametrize("old, new, words", [
    ('name = "Path tracing"', 'name = "GMM"', "two methods of one name 'GMM'; names must differ"),
    ('name = "Path tracing"', 'name = "Path tracing"\nsweeps = 3', "unknown key 'sweeps' in test.toml [[method]] 1; known: name"),
    ('y = ["l1", "bytes"]', 'y = ["seconds"]', "test.toml [sweep]: y.0 = 'seconds': must be 'l1', 'relmse'"),
    ('y = ["l1", "bytes"]', "y = []", "test.toml [sweep]: y"),
    ('x = "photons"', 'z = "photons"', "unknown key 'z' in test.toml [sweep]; known: x, y"),
])
def test_what_else_is_wrong_about_sweeps(tmp_path, old, new, words):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, TOML.replace(old, new))
    assert words in str(error.value), str(error.value)


def test_an_unguided_method_has_nothing_to_sweep_in_training(tmp_path):
    text = TOML.replace('name = "Path tracing"', 'name = "Path tracing"\nsweep = { "training.passes" = [1] }')
    with pytest.raises(ConfigError, match="no representation to train"):
        load(tmp_path, text)
