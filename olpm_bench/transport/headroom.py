"""Memory, asked for before it is taken: a clear refusal in place of a machine that swaps, or a process that is killed."""
from __future__ import annotations

from pathlib import Path

import drjit as dr
import psutil

from olpm_bench.transport.settings import InputError

CGROUP = Path("/sys/fs/cgroup")         # of a container


def free() -> float:
    """Bytes that can be had without swapping, on the machine and in its container."""
    found = float(psutil.virtual_memory().available)
    try:
        most, used = (float((CGROUP / name).read_text()) for name in ("memory.max", "memory.current"))
        statistics = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())
        return min(found, most - used + float(statistics["inactive_file"]))     # a cache, which gives way
    except (OSError, ValueError, KeyError):     # no container, or one without limit: "max"
        return found


def require(needed: float, what: str, remedy: str) -> None:
    """
    Args:
        needed: estimate [bytes].

    Raises:
        InputError: there is less.
    """
    if needed > free():
        dr.flush_malloc_cache()         # Dr.Jit keeps what arrays have left, for others
    if needed > (there := free()):
        raise InputError(f"{what} take about {needed / 1e9:.2g} GB, and {there / 1e9:.2g} GB are free: {remedy}")
