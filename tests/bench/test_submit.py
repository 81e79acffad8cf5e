"""Many machines: shards, workers on one folder, one of them killed, and what Slurm is asked for."""
from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from typer.testing import CliRunner

from olpm_bench.bench import experiment_file
from olpm_bench.bench.config import ConfigError
from olpm_bench.bench.results import Results
from olpm_bench.bench.shard import Shard
from olpm_bench.cli import app

ROOT = Path(__file__).resolve().parents[2]
TOML = """
title = "Shared"
seeds = 4
[budget]
spp = 2000
checkpoints = 1
[[scene]]
name = "cornell_box"
width = 32
height = 24
max_depth = 3
reference = "none"
[[method]]
name = "Path tracing"
[[method]]
name = "Roulette"
integrator = { roulette = "throughput" }
"""


@pytest.fixture
def experiment(tmp_path) -> Path:
    path = tmp_path / "shared.toml"
    path.write_text(TOML)
    return path


def call(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


# ---------------------------------------------------------------- shards

@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_shards_do_every_cell_once_and_keep_methods_together(experiment, count):
    cells = experiment_file.load(experiment).cells()
    parts = [Shard(i, count).of(cells) for i in range(1, count + 1)]
    assert sorted(str(spec) for part in parts for spec in part) == sorted(map(str, cells))
    assert max(map(len, parts)) - min(map(len, parts)) <= 2         # methods
    for index, part in enumerate(parts, 1):
        assert all(sum(spec.seed == other.seed for other in part) == 2 for spec in part)
        first = Shard(index, count).first(cells)
        assert first[:len(part)] == part and sorted(map(str, first)) == sorted(map(str, cells))


@pytest.mark.parametrize("text", ["0/2", "3/2", "1", "1/", "a/b", "1/0", "-1/2", "1/2/3", "١/2"])
def test_shards_that_are_none(text):
    with pytest.raises(ConfigError, match="must be i/n, from 1/n to n/n"):
        Shard.parse(text)


def test_the_last_shard_draws_the_report(experiment, tmp_path, monkeypatch):
    from olpm_bench.bench import run as runner

    reports = []
    monkeypatch.setattr(runner, "report", lambda *arguments: reports.append(arguments))
    experiment.write_text(TOML.replace("spp = 2000", "spp = 2").replace("seeds = 4", "seeds = 3"))
    results = tmp_path / "results"
    run = ("run", experiment, "--results", results)
    assert "2 of 2 cells to run" in call(*run, "--shard", "2/2", "--dry-run").stdout
    first = call(*run, "--shard", "2/2")
    assert first.exit_code == 0, first.output
    assert "shard 2/2 is complete; no table and no figures yet: 4 cells" in first.stdout
    assert len(list(results.rglob("cell.json"))) == 2 and not reports
    last = call(*run, "--shard", "1/2")
    assert last.exit_code == 0, last.output
    assert len(list(results.rglob("cell.json"))) == 6 and len(reports) == 1
    refused = call(*run, "--shard", "0/2")
    assert refused.exit_code == 2 and "--shard 0/2: must be i/n" in refused.stderr


# ---------------------------------------------------------------- workers

@pytest.mark.slow
def test_a_worker_is_killed_and_no_cell_is_lost_or_done_twice(experiment, tmp_path):
    results = tmp_path / "results"
    command = [sys.executable, "-m", "olpm_bench.cli", "submit", str(experiment), "--results", str(results), "--cluster", "local",
               "--workers", "2"]
    running = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        victim = _at_work(results, running)
        os.kill(victim, signal.SIGKILL)
        out, errors = running.communicate(timeout=300)
    finally:
        running.terminate()
        running.wait(30)
    assert running.returncode == 0, errors
    assert "Roulette" in out and (results / "shared" / "summary.json").exists()
    cells = experiment_file.load(experiment).cells()
    assert all(Results(results / "shared").verified_cell(c.scene.name, c.method.name, c.seed) for c in cells)
    assert not [f for f in results.rglob("*") if f.name == "lock" or ".tmp" in f.name]
    logs = "".join(log.read_text() for log in (results / "shared" / "jobs").glob("*_log.err"))
    done = re.findall(r"\[\d+/\d+\] (cornell_box / .* / seed \d): 2000 spp", logs)
    assert len(done) == len(set(done)) and len(set(map(str, cells)) - set(done)) <= 1      # killed before it said so


def _at_work(results: Path, running: subprocess.Popen[str]) -> int:
    """The process of a worker in the middle of a cell, once two cells are complete and both workers are at work."""
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline and running.poll() is None:
        owners = set()
        for lock in results.rglob("lock"):
            try:
                owners.add(json.loads(lock.read_text())["pid"])
            except (OSError, ValueError):
                continue
        if len(owners) == 2 and len(list(results.rglob("cell.json"))) >= 2:
            victim = owners.pop()
            assert psutil.Process(victim).parent() is not None and victim != os.getpid()
            return victim
        time.sleep(0.01)
    raise AssertionError(f"no two workers: {running.poll()}")


def test_a_failure_of_another_worker_is_not_repeated(experiment, tmp_path, monkeypatch):
    from olpm_bench.bench import run

    experiment.write_text(TOML.replace("spp = 2000", "spp = 2").replace("seeds = 4", "seeds = 1"))
    loaded, calls = experiment_file.load(experiment), []
    results = Results(tmp_path / "results" / "shared")

    def fail(spec, *args, **kwargs):
        calls.append(spec)
        if spec.method.name == "Path tracing":       # meanwhile, elsewhere
            results.write_failure("cornell_box", "Roulette", 0, "3 pixels are NaN")
        raise run.CellFailedError("5 pixels are NaN")
    monkeypatch.setattr(run, "measure", fail)
    problems = run.run(loaded, tmp_path / "results", together=True)
    assert len(calls) == 1
    assert problems == ["cornell_box / Path tracing / seed 0: 5 pixels are NaN",
                        "cornell_box / Roulette / seed 0: 3 pixels are NaN"]
    assert len(run.run(loaded, tmp_path / "results", together=True)) == 2 and len(calls) == 2       # another day, another try


def test_why_local_workers_failed_is_said(experiment, tmp_path, monkeypatch):
    from olpm_bench.bench import submit

    experiment.write_text(TOML.replace("seeds = 4", "seeds = 1"))
    monkeypatch.setattr(submit, "submit", lambda *_, **__: [])
    monkeypatch.setattr(submit, "wait", lambda *_: None)
    Results(tmp_path / "results" / "shared").write_failure("cornell_box", "Roulette", 0, "3 pixels are NaN")
    result = call("submit", experiment, "--results", tmp_path / "results", "--cluster", "local")
    assert result.exit_code == 1
    assert [line.removeprefix("olpm-bench: cornell_box / ") for line in result.stderr.splitlines()[:2]] == [
        "Path tracing / seed 0 is not complete", "Roulette / seed 0: 3 pixels are NaN"]
    assert "2 of 2 cells are not complete" in result.stderr


def test_what_is_in_other_hands_is_waited_for(experiment, tmp_path, monkeypatch):
    from olpm_bench.bench import run
    from olpm_bench.bench.lock import locked

    experiment.write_text(TOML.replace("spp = 2000", "spp = 2").replace("seeds = 4", "seeds = 1"))
    loaded, waited = experiment_file.load(experiment), []
    other = locked(Results(tmp_path / "results" / "shared").cell_folder("cornell_box", "Path tracing", 0))
    other.__enter__()

    def sleep(seconds):
        waited.append(seconds)
        if len(waited) == 2:
            other.__exit__(None, None, None)
    monkeypatch.setattr(run, "time", SimpleNamespace(sleep=sleep))     # not the one that subprocesses wait with
    assert run.run(loaded, tmp_path / "results", together=True) == []
    assert len(waited) == 2 and len(list((tmp_path / "results").rglob("cell.json"))) == 2


@pytest.mark.parametrize("options, words", [
    (("--cluster", "local", "--workers", 2), ["--workers 2", "budget of timed.toml is in seconds", "one worker a machine"]),
    (("--cluster", "sge"), ["--cluster sge", "slurm, local"]),
    (("--workers", 2), ["--cluster slurm", "srun"]),
])
def test_what_cannot_be_submitted(experiment, tmp_path, monkeypatch, options, words):
    monkeypatch.setenv("PATH", "")
    timed = tmp_path / "timed.toml"
    timed.write_text(TOML.replace("spp = 2000", "seconds = 5"))
    result = call("submit", timed, "--results", tmp_path / "results", *options)
    assert result.exit_code == 2 and len(result.stderr.splitlines()) == 1, result.output
    assert all(word in result.stderr for word in words)
    assert not list((tmp_path).rglob("cell.json"))


@pytest.fixture
def slurm(tmp_path, monkeypatch) -> None:
    """Commands of Slurm that keep what is asked for, as the file `asked`."""
    (tools := tmp_path / "bin").mkdir()
    for name, script in (("srun", "exit 1"), ("sbatch", f'cp "$1" {tmp_path}/asked; echo "Submitted batch job 42"')):
        (tools / name).write_text(f"#!/bin/sh\n{script}\n")
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")


@pytest.mark.usefixtures("slurm")
def test_timed_cells_on_any_model_of_slurms_nodes_are_warned_of(experiment, tmp_path):
    submit = ("submit", experiment, "--results", tmp_path / "results", "--workers", 2)
    assert "CPU" not in call(*submit).stderr                # a budget in samples
    experiment.write_text(TOML.replace("spp = 2000", "seconds = 5"))
    assert "CPU" not in call(*submit, "--constraint", "epyc7763").stderr
    warned = call(*submit)
    line, = (line for line in warned.stderr.splitlines() if "different CPU models" in line)
    assert line.startswith("olpm-bench: the budget of shared.toml is in seconds, and without --constraint its cells may land on")
    assert warned.exit_code == 0, warned.output


@pytest.mark.usefixtures("slurm")
def test_slurm_gets_an_array_of_whole_nodes_of_one_model(experiment, tmp_path):
    results = tmp_path / "results"
    result = call("submit", experiment, "--results", results, "--workers", 3, "--constraint", "epyc7763", "--minutes", 90)
    assert result.exit_code == 0, result.output
    assert "submitted: 42_0, 42_1, 42_2" in result.stdout
    assert experiment_file.load(experiment).command("run", results) in result.stdout
    (results / "shared" / "jobs").rename(tmp_path / "jobs")
    (results / "shared" / "jobs").symlink_to(tmp_path / "jobs")
    refused = call("submit", experiment, "--results", results)
    assert refused.exit_code == 2 and "by a link that leads out of" in refused.stderr
    asked = (tmp_path / "asked").read_text()
    for line in ("exclusive", "array=0-2%3", "constraint=epyc7763", "nodes=1", "time=90", "mem=0"):
        assert f"#SBATCH --{line}\n" in asked
    assert "--cpu-bind=none" in asked and "--partition" not in asked
    assert len(list((results / "shared" / "jobs").glob("42_*_submitted.pkl"))) == 3
