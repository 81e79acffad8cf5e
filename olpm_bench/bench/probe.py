"""Scene files are loaded by another process first: where that makes Mitsuba crash or hang, it is one line and not our end.

Mitsuba 3.9.1 is killed by a PLY whose faces name vertices that it has not, for one.
"""
from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from olpm_bench.scenes import SceneError, read_xml

COMMAND = (sys.executable, "-P", "-m", "olpm_bench.bench.probe")     # -P: imports nothing from the folder that one works in
SECONDS = 900.0             # that a scene may take


class Process:
    """A process that is given one request after another; started when first asked, and again after it has died.

    Args:
        command: of the process; it reads lines of JSON and answers each by one.
    """

    def __init__(self, command: Sequence[str] = COMMAND, seconds: float = SECONDS) -> None:
        self.command, self.seconds, self.starts = list(command), seconds, 0
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process is not None:
            self.process.kill()
            with contextlib.suppress(BrokenPipeError):
                self.process.communicate()
            self.process = None

    def ask(self, *request: Any) -> dict[str, Any]:
        """Its answer; {"died": exit code} or {"hung": seconds} without one."""
        if self.process is None:
            folders = [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH")]
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, folders))}
            self.process = subprocess.Popen(self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                            stderr=subprocess.DEVNULL, env=environment)
            self.starts += 1
        process, late = self.process, threading.Event()
        assert process.stdin is not None and process.stdout is not None

        def end() -> None:
            late.set()
            process.kill()

        timer = threading.Timer(self.seconds, end)
        timer.start()
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
            if line := process.stdout.readline():
                return json.loads(line)
        except BrokenPipeError:
            pass
        finally:
            timer.cancel()
        code = process.wait()
        self.__exit__()
        return {"hung": self.seconds} if late.is_set() else {"died": code}


def check(path: Path, overrides: dict[str, Any]) -> None:
    """
    Raises:
        SceneError: the file can't be loaded, or Mitsuba crashes or hangs when it loads it.
    """
    read_xml(path)                  # what is no XML at all needs no other process
    with Process() as process:
        answer = process.ask(str(path), overrides)
    if "refused" in answer:
        raise SceneError(answer["refused"])
    if "hung" in answer:
        raise SceneError(f"scene file {path}: Mitsuba has not loaded it after {SECONDS:.0f} s")
    if "died" in answer:
        name = signal.Signals(-answer["died"]).name if answer["died"] < 0 else f"exit code {answer['died']}"
        raise SceneError(f"scene file {path}: Mitsuba crashes when it loads it ({name}): "
                         "one of its meshes or images may be broken")


def serve(read: Any) -> None:
    """Answer the requests on standard input by what `read` makes of them, a line each, until there are no more."""
    from olpm_bench.bench import environment
    from olpm_bench.transport.settings import InputError
    from representations import RepresentationError

    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)                   # what libraries print is no answer
    warnings.simplefilter("ignore")
    environment.select_variant()
    for line in sys.stdin:
        try:
            read(*json.loads(line))
            answer: dict[str, Any] = {"ok": True}
        except (InputError, RepresentationError, OSError) as error:
            answer = {"refused": str(error)}
        except Exception:           # a bug, which `check` leaves to the load that follows it: that shows it in full
            answer = {"traceback": traceback.format_exc()}
        print(json.dumps(answer), file=answers)


def load(path: str, overrides: dict[str, Any]) -> None:
    """Load a scene file with a small film."""
    from olpm_bench.scenes import load as scene_load

    scene_load.load(Path(path), overrides, 8, 6)


if __name__ == "__main__":
    serve(load)
