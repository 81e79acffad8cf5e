"""An experiment on many machines: workers that share its results folder, started by submitit.

Cells are independent and each has its lock, so the folder is the queue: a worker runs its shard, then whatever is left, and
ends when all is complete.  One that is killed leaves its lock behind, and the cell is another's.  On Slurm workers are the
tasks of one array, each with a node of its own; the "local" executor runs the same workers on this machine.
"""
from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Any

import submitit
from submitit.helpers import Checkpointable

from olpm_bench.bench import environment, experiment_file
from olpm_bench.bench.clock import cores
from olpm_bench.bench.config import ConfigError, Experiment
from olpm_bench.bench.files import require_inside
from olpm_bench.bench.lock import LEASE, silence
from olpm_bench.bench.progress import Bar
from olpm_bench.bench.results import Results

CLUSTERS = ("slurm", "local")
POLL = 1.0                  # [s] between looks at local workers
GRACE = 60.0                # [s] that they have to notice that all is complete


class Worker(Checkpointable):
    """What runs on a machine: `olpm_bench.bench.run.run` with the others.  Slurm may preempt it: it goes on with what is left.

    Args:
        experiment, root: absolute paths of the TOML and of the `--results` folder.
        scenes, scale: as for `experiment_file.load`.
        threads: of this worker; all cores by default.
    """

    def __init__(self, experiment: Path, root: Path, scenes: dict[str, Path], scale: str | None,
                 threads: int | None = None) -> None:
        self.experiment, self.root, self.scenes, self.scale, self.threads = experiment, root, scenes, scale, threads

    def __call__(self, index: int, count: int) -> list[str]:
        """Run shard `index` of `count` and then what is left; one line for each cell that is not complete afterwards."""
        environment.select_variant(self.threads)
        from olpm_bench.bench import run
        from olpm_bench.bench.shard import Shard

        loaded = experiment_file.load(self.experiment, self.scenes, self.scale)
        return run.run(loaded, self.root, shard=Shard(index, count), together=True)


def submit(experiment: Experiment, root: Path, cluster: str, workers: int, minutes: int, scenes: dict[str, Path],
           scale: str | None = None, **slurm: Any) -> list[submitit.Job[list[str]]]:
    """Start the workers of an experiment; their logs go to the folder `jobs` of its results.

    Args:
        cluster: one of `CLUSTERS`.
        minutes: after which a worker is stopped; on Slurm it is started again then, three times.
        scenes, scale: as for `experiment_file.load`.
        slurm: further parameters of submitit's executor, as `partition` or `constraint`; None is left out.

    Raises:
        ConfigError: an unknown or absent cluster, or several workers on one machine for cells that are timed.
    """
    if cluster not in CLUSTERS:
        raise ConfigError(f"--cluster {cluster}: must be one of {', '.join(CLUSTERS)}")
    timed = any(spec.budget.seconds is not None for spec in experiment.cells())
    if cluster == "local" and workers > 1 and timed:
        raise ConfigError(f"--workers {workers}: the budget of {experiment.path.name} is in seconds, and two timed cells at once "
                          "would disturb each other; one worker a machine")
    folder = Results(root / experiment.stem).folder / "jobs"
    require_inside(folder, root)
    worker = Worker(experiment.path.resolve(), root.resolve(), {name: path.resolve() for name, path in scenes.items()},
                    scale, max(1, cores() // workers) if cluster == "local" else None)
    try:
        executor = submitit.AutoExecutor(folder.resolve(), cluster=cluster)
    except RuntimeError as error:
        raise ConfigError(f"--cluster {cluster}: {error}") from None
    executor.update_parameters(name=experiment.stem, timeout_min=minutes)
    if not environment.uses_llvm():
        executor.update_parameters(gpus_per_node=1)
    if cluster == "slurm":
        if timed and slurm.get("constraint") is None:
            print(f"olpm-bench: the budget of {experiment.path.name} is in seconds, and without --constraint its cells may land "
                  "on different CPU models, whose seconds do not compare", file=sys.stderr)
        # srun would bind its one task to one core, and give it the memory of one; the node is ours.
        executor.update_parameters(
            nodes=1, tasks_per_node=1, slurm_exclusive=True, slurm_additional_parameters={"mem": 0},
            slurm_srun_args=["--cpu-bind=none"], slurm_array_parallelism=workers,
            **{f"slurm_{name}": value for name, value in slurm.items() if value is not None})
    with executor.batch():
        jobs = [executor.submit(worker, index, workers) for index in range(1, workers + 1)]
    return jobs


def wait(jobs: list[submitit.Job[list[str]]], experiment: Experiment, root: Path) -> None:
    """Wait for local workers; if this is interrupted, so are they.

    Those that hang are stopped: all, if none gives a sign of life in half an hour, and who has not ended a minute after another
    has found that all is complete.
    """
    results = Results(root / experiment.stem)
    cells = [results.cell_folder(spec.scene.name, spec.method.name, spec.seed) for spec in experiment.cells()]
    complete, end, heard = 0, math.inf, time.monotonic()
    try:
        with Bar(len(cells)) as bar:
            while running := [job for job in jobs if not job.done()]:
                now, before, complete = time.monotonic(), complete, sum((cell / "cell.json").exists() for cell in cells)
                bar.at(complete, f"{complete} of {len(cells)} cells, {len(running)} workers")
                signs = [now - seconds for seconds in map(silence, cells) if seconds is not None]
                heard = now if complete > before else max([heard, *signs])
                if end == math.inf and any(_is_content(job) for job in jobs if job not in running):
                    end = now + GRACE
                if now > min(end, heard + LEASE):
                    bar.say(f"{len(running)} of {len(jobs)} workers hang and are stopped")
                    break
                time.sleep(POLL)
    finally:
        for job in jobs:
            if not job.done():
                job.cancel(check=False)


def _is_content(job: submitit.Job[list[str]]) -> bool:
    """Whether a worker that has ended found all cells complete."""
    return job.exception() is None and job.result() == []
