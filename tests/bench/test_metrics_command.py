"""`olpm-bench metrics`: from stored images to summary.json and table.csv, without a render."""
from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from olpm_bench.bench import experiment_file, metrics, run
from olpm_bench.bench.reference_file import Reference, write_reference
from olpm_bench.bench.results import Results
from olpm_bench.cli import app

TOML = """
title = "Known images"
seeds = 2
[budget]
spp = 4
[[scene]]
name = "cornell_box"
width = 12
height = 8
[[method]]
name = "Path tracing"
[[method]]
name = "Roulette"
integrator = { roulette = "throughput" }
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The results of an older version: known images, brighter than the reference by 0.1 (seed 0) and 0.2."""
    (tmp_path / "known.toml").write_text(TOML)
    experiment = experiment_file.load(tmp_path / "known.toml")
    truth = np.full((8, 12, 3), 0.5, np.float32)
    write_reference(tmp_path / "results" / "references" / experiment.reference_key(experiment.scene[0]),
                    Reference(truth, truth.copy(), truth, truth, {"spp_a": 1, "spp_b": 1}))
    results = Results(tmp_path / "results" / "known")
    results.write_text("experiment.toml", experiment.toml(results.folder))
    for spec in experiment.cells():
        image = truth + np.float32(0.1 * (spec.seed + 1))
        numbers = ("spp", "charged_seconds", "training_passes", "train_seconds", "render_seconds", "compile_seconds",
                   "wait_fraction", "records", "bytes_per_record", "particles", "mean", "mean_stderr")
        results.write_cell("cornell_box", spec.method.name, spec.seed, {"key": "older", **dict.fromkeys(numbers, 1.0)},
                           [{"seconds": 1.0, "spp": 4}], {"mean": image, "variance": truth, "count": truth[..., 0]}, [image],
                           spec.config())

    def render(*args, **kwargs):
        raise AssertionError("nothing may be rendered")
    for name in ("measure", "warm_up", "load_scene"):
        monkeypatch.setattr(run, name, render)
    return results.folder


def call(*arguments: object):
    return CliRunner().invoke(app, ["metrics", *map(str, arguments)])


def test_a_metric_added_to_the_registry_shows_without_a_render(folder, tmp_path, monkeypatch):
    monkeypatch.setitem(metrics.METRICS, "bias", lambda x, r: float(np.mean(x) - np.mean(r)))
    result = call(folder)
    assert result.exit_code == 0, result.output
    rows = json.loads((folder / "summary.json").read_text())["rows"]
    assert [row["bias"] for row in rows] == pytest.approx([0.15, 0.15]) == [row["l1"] for row in rows]
    table = list(csv.DictReader((folder / "table.csv").read_text().splitlines()))
    assert [float(row["bias"]) for row in table] == pytest.approx([0.15, 0.15])
    assert table[0]["seeds"] == "0 1" and set(metrics.METRICS) <= table[0].keys()
    header, first = result.stdout.splitlines()[:2]
    assert header.split() == ["scene", "method", *metrics.METRICS] and first.split()[-1] == "0.150"
    assert "4 of 4 cells were made by other code" in result.stdout


def test_the_toml_names_its_results_too(folder, tmp_path):
    by_folder = call(folder).stdout
    result = call(tmp_path / "known.toml", "--results", tmp_path / "results")
    assert result.exit_code == 0 and result.stdout == by_folder


@pytest.mark.parametrize("arguments, words", [
    (("nowhere",), ["nowhere", "no such file"]),
    (("known.toml", "--results", "elsewhere"), ["cell cornell_box / Path tracing / seed 0 in elsewhere/known is missing"]),
    ((".",), ["no folder of results", "experiment.toml"]),
])
def test_bad_input_is_one_line_and_exit_code_2(folder, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    result = call(*arguments)
    assert result.exit_code == 2 and len(result.stderr.splitlines()) == 1, result.output
    assert all(word in result.stderr for word in words)


def test_a_missing_cell_is_named(folder):
    (Results(folder).cell_folder("cornell_box", "Roulette", 1) / "cell.json").unlink()
    result = call(folder)
    assert result.exit_code == 2 and "cell cornell_box / Roulette / seed 1" in result.stderr and "is missing" in result.stderr
