"""A process that is given one request after another: its death and its silence are answers, too."""
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
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

SECONDS = 900.0             # without an answer


def command(module: str) -> list[str]:
    """Runs a module of ours, and imports nothing from the folder that one works in (``-P``)."""
    return [sys.executable, "-P", "-m", module]


class Process:
    """Started when first asked, and again after it has died; a context manager, which kills it.

    Args:
        command: of the process; it reads lines of JSON and answers each by one, as `serve` does.
        seconds: after which a silent one is killed.
        quiet: its standard error goes nowhere.
        environment: variables that it has besides those of this process, or in place of them.
    """

    def __init__(self, command: Sequence[str], seconds: float = SECONDS, quiet: bool = True,
                 environment: Mapping[str, str] | None = None) -> None:
        self.command, self.seconds, self.starts, self.environment = list(command), seconds, 0, environment or {}
        self.stderr = subprocess.DEVNULL if quiet else None
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
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, folders)), **self.environment}
            self.process = subprocess.Popen(self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                            stderr=self.stderr, env=environment)
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


def end(answer: dict[str, Any]) -> str | None:
    """How the process ended that was asked, "SIGSEGV" or "exit code 1"; None if it did not."""
    if (code := answer.get("died")) is None:
        return None
    return signal.Signals(-code).name if code < 0 else f"exit code {code}"


def serve(read: Callable[..., Any]) -> None:
    """Answer the requests on standard input by what `read` makes of them, a line each, until there are no more.

    An answer is {"ok": result}, {"refused": message of an expected error} or {"traceback": text}.
    """
    from olpm_bench.bench import environment
    from olpm_bench.transport.settings import InputError
    from representations import RepresentationError

    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)                   # what is printed is no answer, neither by libraries
    sys.stdout = sys.stderr         # nor by Python
    signal.signal(signal.SIGINT, signal.SIG_IGN)        # who asks has it, too, and kills this process
    warnings.simplefilter("ignore")
    environment.select_variant()
    for line in sys.stdin:
        try:
            answer = {"ok": read(*json.loads(line))}
        except (InputError, RepresentationError, OSError) as error:
            answer = {"refused": str(error)}
        except Exception:           # a bug
            answer = {"traceback": traceback.format_exc()}
        print(json.dumps(answer, default=lambda value: value.tolist()), file=answers)       # of NumPy
