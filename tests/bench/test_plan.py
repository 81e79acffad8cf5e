"""Dry runs: what they say, what they refuse, and that their work grows with the number of methods and not with its square."""
from __future__ import annotations

import functools
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from small_experiment import TOML
from typer.testing import CliRunner

from olpm_bench import scenes
from olpm_bench.bench import experiment_file, plan, reference, run
from olpm_bench.bench.config import Experiment
from olpm_bench.bench.reference_file import Reference, read_reference, write_reference
from olpm_bench.cli import app


def call(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def load(tmp_path: Path, text: str = TOML) -> Experiment:
    path = tmp_path / "test.toml"
    path.write_text(text)
    return experiment_file.load(path)


# ---------------------------------------------------------------- references

def test_a_dry_run_says_what_the_run_will_refuse_and_how_long_a_reference_takes(tmp_path):
    path, results = load(tmp_path).path, tmp_path / "results"
    dry, real = (call("run", path, "--results", results, *more) for more in (["--dry-run"], []))
    assert dry.exit_code == real.exit_code == 2
    assert dry.stderr == real.stderr and "has no reference cornell_box-16x12-" in dry.stderr
    assert "--with-reference" in dry.stderr and "olpm-bench reference" in dry.stderr
    assert "cornell_box: its reference still takes about 5 minutes (an estimate: 300 charged seconds, and" in dry.stdout
    assert "4 of 4 cells to run" in dry.stdout and not results.exists()
    promised = call("run", path, "--results", results, "--dry-run", "--with-reference")
    assert promised.exit_code == 0 and not promised.stderr


def test_a_dry_run_refuses_a_broken_reference_and_too_large_a_cell(tmp_path, monkeypatch):
    experiment, results = load(tmp_path), tmp_path / "results"
    grey = np.full((12, 16, 3), 0.5, np.float32)
    folder = results / "references" / experiment.reference_key(experiment.scene[0])
    write_reference(folder, Reference(grey, grey + 0.01, grey, grey, {"spp_a": 1, "spp_b": 1}))
    assert plan.plan(experiment, results).refusals == []
    (folder / "reference.exr").write_bytes(b"no image")
    monkeypatch.setattr(run, "memory", lambda spec: 1e9)
    broken, large = plan.plan(experiment, results).refusals
    assert "reference.exr" in broken and "GB" in large


@pytest.mark.parametrize("seconds, wanted", [(2, 300), (60, 1500)])
def test_a_reference_takes_longer_where_cells_do(tmp_path, seconds, wanted):
    experiment = load(tmp_path, TOML.replace("spp = 11", f"seconds = {seconds}"))
    assert reference.seconds_for(experiment) == wanted
    assert plan.plan(experiment, tmp_path).to_make == {"cornell_box": wanted}


def test_run_makes_the_missing_reference_and_ends_one_that_was_interrupted(tmp_path, monkeypatch):
    monkeypatch.setattr(reference, "LEAST_SECONDS", 1.0)
    monkeypatch.setattr(reference, "PASS_SECONDS", 0.05)
    experiment, results = load(tmp_path, TOML.replace("seeds = 2", "seeds = 1")), tmp_path / "results"
    ran = []
    monkeypatch.setattr(run, "run", lambda *arguments: ran.append(run.references(experiment, results)) or [])
    monkeypatch.setattr(run, "report", lambda *arguments: None)
    assert call("run", experiment.path, "--results", results, "--with-reference").exit_code == 0
    assert list(ran[0]) == ["cornell_box"]          # it was there before the first cell
    folder = results / "references" / experiment.reference_key(experiment.scene[0])
    first = read_reference(folder, 16, 12)
    assert first.meta["seconds"] >= first.meta["wanted_seconds"] == 1
    assert plan.plan(experiment, results).to_make == {}

    first.meta["seconds"] = 0.4                     # as if it had been interrupted then
    write_reference(folder, first)
    found = plan.plan(experiment, results)
    assert found.to_make == {"cornell_box": pytest.approx(0.6)} and not found.refusals     # what is there may be used
    reference.make(experiment, results)
    again = read_reference(folder, 16, 12)
    assert again.meta["spp_a"] > first.meta["spp_a"] and again.meta["wanted_seconds"] == pytest.approx(1)
    assert plan.plan(experiment, results).to_make == {}


@pytest.mark.parametrize("seconds, said", [(45, "45 seconds"), (300, "5 minutes"), (1500, "25 minutes"), (7500, "2.1 hours")])
def test_durations_in_words(seconds, said):
    assert plan.duration(seconds) == said


# ---------------------------------------------------------------- many methods

SWEEP = """
[[method]]
name = "Swept {name}"
representation = {{ type = "{kind}" }}
sweep = {{ "training.photons" = {values} }}
"""


def many(tmp_path: Path, methods: int, kind: str = "gaussian_mixture") -> Path:
    path = tmp_path / f"many{methods}.toml"
    values = [list(range(1000 * i, 1000 * i + methods // 4)) for i in range(1, 5)]
    path.write_text(TOML + "".join(SWEEP.format(name=i, kind=kind, values=values[i]) for i in range(4)))
    return path


def calls_of(body) -> int:
    """Functions that `body` calls, those of C included."""
    count = 0

    def counting(frame, event, argument):
        nonlocal count
        count += event in ("call", "c_call")

    before = sys.getprofile()
    sys.setprofile(counting)
    try:
        body()
    finally:
        sys.setprofile(before)
    return count


def test_the_work_of_a_dry_run_grows_with_the_number_of_methods(tmp_path, monkeypatch):
    def dry_run(methods: int) -> None:
        assert call("run", many(tmp_path, methods), "--results", tmp_path / "results", "--dry-run").exit_code == 2
    dry_run(8)                                      # imports
    few, more, most = (calls_of(functools.partial(dry_run, methods)) for methods in (200, 400, 800))
    # Linear: twice as many methods more are twice as many calls more.  A comparison of all pairs would be three times as many.
    assert most - more == pytest.approx(2 * (more - few), rel=0.1)
    assert (most - few) / 600 < 2000                # of each method with its two seeds


def test_the_code_of_a_representation_is_run_once_for_a_sweep(tmp_path):
    (tmp_path / "own.py").write_text(
        "from pathlib import Path\nfrom representations.cosine import CosineLobe\n"
        "with Path(__file__).with_suffix('.log').open('a') as log:\n    log.write('run\\n')\nclass Own(CosineLobe):\n    pass\n")
    experiment = experiment_file.load(many(tmp_path, 40, "own.py:Own"))
    assert (tmp_path / "own.log").read_text() == "run\n"
    assert len({cell.key for cell in experiment.cells()}) == 84
    assert (tmp_path / "own.log").read_text() == 2 * "run\n"               # its defaults are asked for


def test_the_files_of_a_scene_are_read_once_for_all_cells(tmp_path, monkeypatch):
    (tmp_path / "scene.xml").write_text('<scene version="3.0.0"><default name="x" value="4"/></scene>')
    experiment = experiment_file.load(many(tmp_path, 40), {"cornell_box": tmp_path / "scene.xml"})
    read = []
    monkeypatch.setattr(scenes, "digest", lambda *arguments: read.append(arguments) or "digest")
    keys = {json.dumps(cell.key) for cell in experiment.cells()}
    assert len(keys) == 84 and len(read) == 1
    other = experiment.scene[0].model_copy(update={"file": tmp_path / "other.xml"})
    assert other.digest() == "digest" and read[1][0] == tmp_path / "other.xml"
