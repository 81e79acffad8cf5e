"""A process that reads files, so that neither a crash nor a hang ends the test.

    with child() as process:
        answer = process.ask("guide", "guide.npz")      # {"ok": null}, {"refused": "one line"}, {"traceback": ...}, {"died": -11}

Whatever Python opens for writing, makes, renames or removes must be below `results` beside the file, or in a cache of libraries:
else there is a traceback that tells.
"""
from __future__ import annotations

import os
import resource
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from olpm_bench.bench import other_process, probe
from olpm_bench.transport.settings import InputError

SECONDS = 400.0                 # without an answer a file hangs the process
GIGABYTES = 8                   # address space of the process: what would fill the machine's memory fails at once
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Audit event -> how many of its arguments are paths
PATHS = {"os.rename": 2, "os.link": 2, "os.symlink": 2, "os.mkdir": 1, "os.truncate": 1, "os.chmod": 1, "shutil.rmtree": 1}
touched: list[str] = []         # what the file that is being read makes us write, make, rename or remove


class Child(other_process.Process):
    """Counts what it answers, so that a campaign can say how many files were read, and how many refused."""

    def __init__(self) -> None:
        super().__init__([sys.executable, __file__], SECONDS)
        self.answers: Counter[str] = Counter()

    def __enter__(self) -> Child:
        return self

    def ask(self, *request: Any) -> dict[str, Any]:
        answer = super().ask(*request)
        self.answers[next(iter(answer))] += 1
        return answer

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {answer}" for answer, count in self.answers.most_common())
        return f"{self.answers.total()} files: {counts}; started {self.starts} times"


def child() -> Child:
    """Runs this file."""
    return Child()


def note(event: str, arguments: tuple[Any, ...]) -> None:
    """An audit hook."""
    number = PATHS.get(event, 0)
    if event == "open":
        number = 1 if (arguments[2] or 0) & WRITING else 0
    elif event in ("os.remove", "os.rmdir"):
        number = 1 if arguments[1] == -1 else 0         # or it is below what rmtree was told
    touched.extend(os.path.realpath(os.fsdecode(path)) for path in arguments[:number] if not isinstance(path, int))


def strays(results: Path) -> list[str]:
    """What was touched and is neither below the results nor in a cache of bytecode or of fonts."""
    import matplotlib

    own = [os.path.realpath(folder) for folder in (results, os.devnull, matplotlib.get_configdir(), matplotlib.get_cachedir())]
    return [path for path in touched
            if not any(Path(path).is_relative_to(folder) for folder in own) and "__pycache__" not in Path(path).parts]


def read(kind: str, path: str) -> None:
    """Do with a file what the commands do with it; `run` and `render` are these commands."""
    touched.clear()
    results = Path(path).with_name("results")
    try:
        if kind == "run":
            command("run", path, "--results", results)
        elif kind == "render":
            size = "--width", 4, "--height", 4, "--spp", 1
            command("render", path, "--method", "unguided", *size, "--out", results / "image.exr")
        else:
            load(kind, path)
    finally:
        assert not (found := strays(results)), found


def command(*arguments: object) -> None:
    """
    Raises:
        InputError: its exit code is that of a failure or of bad input.
    """
    from typer.main import get_command

    from olpm_bench.cli import app
    from olpm_bench.scenes.load import Parsed

    probe.check = lambda path, overrides: Parsed(path, overrides).stated        # this process is shield enough
    code = get_command(app).main([str(argument) for argument in arguments], standalone_mode=False) or 0
    assert code in (0, 1, 2), code
    if code:
        raise InputError(f"exit code {code}")


def load(kind: str, path: str) -> None:
    """What the commands do with it first."""
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
        assert read_reference(Path(path), 8, 6).mean.shape == (6, 8, 3)
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
    sys.addaudithook(note)
    other_process.serve(read)
