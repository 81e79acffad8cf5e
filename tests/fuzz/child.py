"""A process that reads what is not experiment files, so that neither a crash nor a hang ends the test.

    with child() as process:
        answer = process.ask("guide", "guide.npz")      # {"ok": true}, {"refused": "one line"}, {"traceback": ...}, {"died": -11}
"""
from __future__ import annotations

import resource
import sys
from pathlib import Path

from olpm_bench.bench import probe

SECONDS = 400.0                 # without an answer a file hangs the process
GIGABYTES = 8                   # address space of the process: what would fill the machine's memory fails at once


def child() -> probe.Process:
    """Runs this file."""
    return probe.Process([sys.executable, __file__], SECONDS)


def read(kind: str, path: str) -> None:
    """Do with a file what the commands do with it."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    from olpm_bench.bench import compare, fit
    from olpm_bench.bench.reference_file import read_reference
    from olpm_bench.transport.guide import Guide

    if kind == "scene":
        probe.load(path, {})
    elif kind == "directions":
        fit._load(Path(path), "wo", "weight", "pdf")
    elif kind == "image":
        read_reference(Path(path), 8, 6)
        compare._read(Path(path))
    else:
        guide = Guide.load(path)
        points = np.random.default_rng(0).uniform(-1, 1, (3, 256)).astype(np.float32)
        point = guide.at(mi.Point3f(points), dr.normalize(mi.Normal3f(points[::-1])), mi.Bool(True))
        wo, _ = point.sample(mi.Float(0.3), mi.Point2f(0.2, 0.6), mi.Bool(True))
        dr.eval(point.pdf(wo))
        if guide.pixels is not None:
            dr.eval(guide.pixels.at(mi.Point2f(0.3, 0.4)))
        dr.sync_thread()


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (GIGABYTES << 30, GIGABYTES << 30))
    probe.serve(read)
