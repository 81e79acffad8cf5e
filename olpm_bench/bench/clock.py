"""Charged seconds: what a method is billed for, in the presence of neighbours.

    charged = wall - paused - waiting / threads

where `paused` is the time in which the process was stopped or the machine slept (:mod:`olpm_bench.bench.pauses`),
`waiting` is the time the process's threads were ready to run and found no core free, summed over threads
(field 2 of ``/proc/self/task/*/schedstat``), and `threads` counts those that worked in the lap.  So serial code is
charged in full and a neighbour's load is not.  Never less than CPU time / cores: more threads than cores wait for each
other, which is the method's own doing.  Where the kernel keeps no such books, and on a GPU, charged = wall - paused.
"""
from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path

from olpm_bench.bench.pauses import paused

TASKS = Path("/proc/self/task")
MAX_WAITED = 0.05   # share of its time spent waiting for cores above which a table says that the machine was busy, ...
UNRELIABLE = 0.3    # ... and above which its timings are called unreliable, and a budget in seconds gets a second try
WORKED = 0.01       # a thread worked in a lap if it ran at least this share of the busiest thread's time


def thread_times(tasks: Path = TASKS) -> dict[str, tuple[float, float]] | None:
    """Thread id -> (seconds run, seconds waited for a core); None where the kernel does not tell."""
    times = {}
    try:
        for task in os.scandir(tasks):
            try:
                run, wait, _ = (Path(task.path) / "schedstat").read_text().split()
            except (FileNotFoundError, ProcessLookupError):     # the thread ended meanwhile, or no schedstat at all
                continue
            times[task.name] = (int(run) * 1e-9, int(wait) * 1e-9)
    except (OSError, ValueError):
        return None
    return times or None


def cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass
class Lap:
    """Totals of one label [s]."""
    wall: float = 0.0           # without pauses
    cpu: float = 0.0            # summed over threads
    wait: float = 0.0           # share of `wall` spent waiting for a busy core
    compile: float = 0.0        # share of `wall` spent compiling
    charged: float = 0.0
    paused: float = 0.0         # not in `wall`

    def __add__(self, other: Lap) -> Lap:
        return Lap(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})


def charge(wall: float, cpu: float, before: dict[str, tuple[float, float]] | None,
           after: dict[str, tuple[float, float]] | None, n_cores: int) -> Lap:
    """The lap between two readings of :func:`thread_times`."""
    if not before or not after:
        return Lap(wall, cpu, 0.0, 0.0, wall)
    run, wait = [], []
    for thread, (ran, waited) in after.items():
        ran_before, waited_before = before.get(thread, (0.0, 0.0))
        run.append(ran - ran_before)
        wait.append(waited - waited_before)
    busiest = max(run)
    worked = [w for r, w in zip(run, wait, strict=True) if r > 0 and r >= WORKED * busiest]
    waited = sum(worked) / len(worked) if worked else 0.0
    charged = min(wall, max(wall - waited, cpu / n_cores))
    return Lap(wall, cpu, wall - charged, 0.0, charged)


@dataclass
class Clock:
    """Accumulates laps by label; it stands still between them, and while the process is paused.

    Stop it only after ``dr.eval`` and ``dr.sync_thread``: Dr.Jit works asynchronously.

    Args:
        count_wait: subtract waiting for busy cores; False for a GPU, where that is no part of the work.
    """
    count_wait: bool = True
    laps: dict[str, Lap] = field(default_factory=dict)

    @contextmanager
    def lap(self, label: str, compiled: Callable[[], float] = float) -> Iterator[None]:
        """Time the body and add it to `label`; a body that raises is not counted.

        Args:
            compiled: asked after the body how many seconds of it went into compilation, which is not charged.
        """
        before = thread_times() if self.count_wait else None
        paused_before = paused()
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        pause = min(paused() - paused_before, wall)
        wall -= pause
        after = thread_times() if self.count_wait else None
        lap = charge(wall, cpu, before, after, cores())
        lap.paused = pause
        lap.compile = min(compiled(), wall)
        lap.charged *= 1 - lap.compile / wall if wall else 0.0      # the compiler waited for cores like everybody else
        self.laps[label] = self[label] + lap

    def move(self, share: float, source: str, target: str) -> None:
        """Book a share of a label's totals under another one."""
        part = Lap(**{f.name: share * getattr(self[source], f.name) for f in fields(Lap)})
        rest = Lap(**{f.name: getattr(self[source], f.name) - getattr(part, f.name) for f in fields(Lap)})
        self.laps[source], self.laps[target] = rest, self[target] + part

    def __getitem__(self, label: str) -> Lap:
        return self.laps.get(label, Lap())

    @property
    def total(self) -> Lap:
        return sum(self.laps.values(), Lap())

    @property
    def charged(self) -> float:
        return self.total.charged
