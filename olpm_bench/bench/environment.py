"""The machine and the software that made a result."""
from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import socket
import subprocess
from pathlib import Path
from typing import Any

from olpm_bench.bench.clock import cores
from olpm_bench.bench.files import SCHEMA_VERSION
from olpm_bench.transport.settings import InputError

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
VARIANT_VARIABLE = "OLPM_BENCH_VARIANT"


def select_variant(threads: int | None = None) -> str:
    """Set the Mitsuba variant that `OLPM_BENCH_VARIANT` names (llvm_ad_rgb by default), and the number of threads.

    Raises:
        InputError: a variant in which the guided path tracer does not work; a thread count below 1.
        LLVMError: no usable libLLVM.
    """
    variant = wanted_variant()
    if threads is not None and threads < 1:
        raise InputError(f"--threads {threads}: must be >= 1")
    if variant.startswith("llvm"):
        from representations import _llvm
        _llvm.require()
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Warn)
    if threads is not None:
        dr.set_thread_count(threads)
    return variant


def wanted_variant() -> str:
    """What `OLPM_BENCH_VARIANT` names, llvm_ad_rgb by default.

    Raises:
        InputError: a variant in which the guided path tracer does not work.
    """
    variant = os.environ.get(VARIANT_VARIABLE, VARIANTS[0])
    if variant not in VARIANTS:
        raise InputError(f"{VARIANT_VARIABLE}={variant}: the guided path tracer works on unpolarised RGB, vectorised; "
                         f"must be one of {', '.join(VARIANTS)}")
    return variant


def uses_llvm() -> bool:
    """Whether the variant runs on the CPU.  Needs a variant."""
    import mitsuba as mi
    return (mi.variant() or "").startswith("llvm")


def versions() -> dict[str, str]:
    """Versions of what computes."""
    found = {name: importlib.metadata.version(name) for name in ("mitsuba", "drjit", "numpy")}
    return {"olpm_bench": package_version(), **found, "python": platform.python_version()}


def package_version() -> str:
    try:
        return importlib.metadata.version("olpm-bench")
    except importlib.metadata.PackageNotFoundError:         # run from a source tree
        return "source"


def commit() -> str | None:
    """The git commit of this software, with "+" if the tree has changes; None where it is not known: installed from a folder.

    No other folder is asked, also not the current one: git runs what a folder's .git/config names.
    """
    folder = Path(__file__).resolve().parents[2]
    try:
        if not (folder / ".git").exists():              # PEP 610: what `pip install git+https://...` has noted
            noted = importlib.metadata.distribution("olpm-bench").read_text("direct_url.json")
            return json.loads(noted or "{}").get("vcs_info", {}).get("commit_id")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
        return _git(folder, "rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, ValueError, subprocess.SubprocessError, importlib.metadata.PackageNotFoundError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True, timeout=10)
    return done.stdout.strip()


def describe() -> dict[str, Any]:
    """What goes into env.json.  Needs a variant."""
    import drjit as dr
    import mitsuba as mi
    import psutil

    llvm = uses_llvm()
    return {
        "schema_version": SCHEMA_VERSION,
        "commit": commit(),
        "versions": versions(),
        "variant": mi.variant(),
        "llvm": {"version": ".".join(map(str, dr.detail.llvm_version())),
                 "library": os.environ.get("DRJIT_LIBLLVM_PATH")} if llvm else None,
        "simd_width": _simd_width(dr.detail.llvm_version() if llvm else None),
        "cpu": _cpu(),
        "cores": cores(),
        "threads": dr.thread_count(),
        "memory_gb": round(psutil.virtual_memory().total / 2**30, 1),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
    }


def machine() -> dict[str, Any]:
    """What goes into cell.json, where several machines make an experiment.  Needs a variant."""
    import drjit as dr
    import mitsuba as mi

    return {"host": socket.gethostname(), "cpu": _cpu(), "cores": cores(), "threads": dr.thread_count(), "variant": mi.variant()}


def _cpu() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _simd_width(llvm: Any) -> int | None:
    """Lanes of a Dr.Jit packet: float32 in the CPU's widest vector register; None where it cannot be told."""
    if llvm is None:
        return None
    try:
        flags = Path("/proc/cpuinfo").read_text().split()
    except OSError:
        return None
    widths = (("avx512vl", 16), ("avx", 8), ("sse4_2", 4), ("asimd", 4))
    return next((width for flag, width in widths if flag in flags), None)
