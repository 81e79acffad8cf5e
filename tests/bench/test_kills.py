"""Kill -9 at random moments of a run: the next goes on, and what it makes is what an undisturbed run makes, bit for bit.

A campaign of `OLPM_KILLS` kills, 5 by default, in tests of 5 (`-n 8 --dist load`, of pytest-xdist, runs 8 of them at a time):

    OLPM_KILLS=50 pytest tests/bench/test_kills.py -m slow -rP

A run is killed, started again, killed again, until it survives; then another folder.  Moments are drawn over CPU time, so that
the load of the machine does not matter, over what the process writes, so that they fall between any two of its writes, or are
that in which an unfinished file is seen.
"""
from __future__ import annotations

import json
import math
import os
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest

from olpm_bench.bench import experiment_file
from olpm_bench.bench.results import TRAINED, Results

ROOT = Path(__file__).resolve().parents[2]
KILLS = int(os.environ.get("OLPM_KILLS", "5"))
EACH = 5                # kills a test
PATIENCE = 1800.0       # [s] that a run may take on a busy machine
TOML = """
title = "Killed"
seeds = 2
[budget]
spp = 8
checkpoints = 2
[[scene]]
name = "cornell_box"
width = 16
height = 9
max_depth = 4
reference = "none"
[training]
passes = 1
photons = 20_000
importons = 10_000
camera_passes = 0
record_radius = 0.2
[[method]]
name = "Path tracing"
[[method]]
name = "GMM"
representation = { type = "gaussian_mixture", components = 4 }
"""
KINDS = ("CPU time", "write", "unfinished file")
TIMES = ("seconds", "fraction", "compile", "machine", "passes", "training_ended")     # what in a cell.json depends on the machine


class Run:
    """One process: `olpm-bench run` of the experiment into `results`.

    at: the file event at which it ends itself; 0: none.
    """

    def __init__(self, experiment: Path, results: Path, at: int = 0) -> None:
        self.results, self.count = results, experiment.with_name(f"{results.name}.count")
        command = [sys.executable, str(Path(__file__).with_name("killed.py")), str(results), str(at), str(self.count),
                   "run", str(experiment), "--results", str(results)]
        self.process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True,
                                        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        self.cpu_seconds, self.errors = 0.0, ""

    def watch(self, cpu_seconds: float = math.inf, unfinished: int = 0) -> bool:
        """Kill it after so much CPU time, or when so many unfinished files were seen; whether it was killed."""
        watched, seen, end = psutil.Process(self.process.pid), set[str](), time.monotonic() + PATIENCE
        try:
            while self.process.poll() is None:
                assert time.monotonic() < end, "a run hangs"
                times = watched.cpu_times()
                self.cpu_seconds = times.user + times.system
                if unfinished:
                    seen |= unfinished_files(self.results)
                if self.cpu_seconds >= cpu_seconds or (unfinished and len(seen) >= unfinished):
                    self.process.kill()
                    break
                time.sleep(0.001 if unfinished else 0.005)
        finally:
            self.process.kill()
            self.errors = self.process.communicate()[1]
        return self.process.returncode == -9


def unfinished_files(folder: Path) -> set[str]:
    """What is being written now.  Unlike `rglob`, `walk` goes on when a folder is renamed meanwhile."""
    return {os.path.join(parent, name) for parent, folders, files in os.walk(folder) for name in folders + files
            if name.startswith(".") and ".tmp" in name}


def complete(experiment: Path, results: Path) -> dict[str, tuple[int, int]]:
    """The cells that are complete: which file is their cell.json, and of when."""
    folder, found = Results(results / experiment.stem), {}
    for spec in experiment_file.load(experiment).cells():
        cell = folder.verified_cell(spec.scene.name, spec.method.name, spec.seed)
        if cell is not None and cell.info["key"] == spec.key:
            status = (cell.folder / "cell.json").stat()
            found[str(spec)] = status.st_ino, status.st_mtime_ns
    return found


def content(results: Path) -> dict[str, object]:
    """All files of a folder of results; of images their bytes, of cell.json what does not depend on the machine."""
    found: dict[str, object] = {}
    for path in (path for path in results.rglob("*") if path.is_file()):
        value: object = None
        if path.suffix == ".exr":
            value = path.read_bytes()
        elif path.name == "cell.json":
            info = json.loads(path.read_text())
            value = {k: v for k, v in info.items() if k != "digests" and not any(time in k for time in TIMES)}
        found[str(path.relative_to(results))] = value
    return found


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Run:
    experiment = tmp_path_factory.mktemp("undisturbed") / "killed.toml"
    experiment.write_text(TOML)
    run = Run(experiment, experiment.with_name("results"))
    assert not run.watch() and run.process.returncode == 0, run.errors
    assert len(complete(experiment, run.results)) == 4
    mixtures = [Results(run.results / experiment.stem).read_cell("cornell_box", "GMM", seed) for seed in (0, 1)]
    assert all(cell.info["trained"] > TRAINED for cell in mixtures), "the mixture guides few paths"
    return run


@pytest.mark.slow
@pytest.mark.timeout(PATIENCE * (EACH + 2))
@pytest.mark.parametrize("seed", range(-(-KILLS // EACH)))
def test_killed_runs_go_on_and_lose_nothing(undisturbed, tmp_path, seed):
    experiment = tmp_path / "killed.toml"
    experiment.write_text(TOML)
    expected, events, n = content(undisturbed.results), int(undisturbed.count.read_text()), min(EACH, KILLS - EACH * seed)
    rng, counts = random.Random(seed), Counter[str]()
    while counts["kills"] < n:
        results, survived, before = tmp_path / str(counts["folders"]), False, {}
        while not survived:
            kind = rng.choice(KINDS) if counts["kills"] < n else ""
            run = Run(experiment, results, at=rng.randint(1, events) if kind == "write" else 0)
            survived = not run.watch(cpu_seconds=rng.uniform(0, undisturbed.cpu_seconds) if kind == "CPU time" else math.inf,
                                     unfinished=rng.randint(1, 25) if kind == "unfinished file" else 0)
            after = complete(experiment, results)
            assert {name: after.get(name) for name in before} == before, "a complete cell was lost or done again"
            before = after
            if survived:
                assert run.process.returncode == 0, run.errors
            else:
                counts.update(["kills", kind, f"with {len(after)} of 4 cells complete"])
        counts["folders"] += 1
        assert content(results) == expected
    print(", ".join(f"{name}: {n}" for name, n in sorted(counts.items())))
    assert counts["kills"] == n
