"""How far a long command is: a bar with the time left on a terminal, a line now and then elsewhere.

Drawn only when told to, between timed passes: a bar that redraws itself would run on the clock.
"""
from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from olpm_bench.bench.terminal import plain_console

QUIET_SECONDS = 30.0        # between lines where there is no terminal


def is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C, SIGTERM or a cluster's wish is behind an error: while Dr.Jit traces a loop they become a RuntimeError."""
    while error is not None and not isinstance(error, KeyboardInterrupt | SystemExit):
        error = error.__cause__ or error.__context__
    return error is not None


def reason(error: BaseException) -> str:
    """What an error of Mitsuba or Dr.Jit says, in one line, and what its causes say, which Dr.Jit leaves out."""
    found: list[str] = []
    cause: BaseException | None = error
    while cause is not None:
        found.append(" ".join(str(cause).split()) or type(cause).__name__)
        cause = cause.__cause__
    return ": ".join(dict.fromkeys(found))


class Bar:
    """Progress of work whose total is known; a context manager.

    Args:
        total: all of the work, in any unit.
    """

    def __init__(self, total: float) -> None:
        self.total, self.done, self.label = max(total, 1e-9), 0.0, ""
        self.console = plain_console(stderr=True)
        self.progress: Progress | None = None
        self.drawn = time.monotonic()

    def __enter__(self) -> Bar:
        if sys.stderr.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
                       TimeRemainingColumn())
            self.progress = Progress(*columns, console=self.console, auto_refresh=False, transient=True)
            self.progress.start()
            self.task = self.progress.add_task("", total=self.total)
        return self

    def __exit__(self, *_: object) -> None:
        if self.progress is not None:
            self.progress.stop()

    def at(self, done: float, label: str) -> None:
        """`done` of the total is finished; draw it."""
        self.done = min(done, self.total)
        if self.progress is not None:
            self.progress.update(self.task, completed=self.done, description=label)
            self.progress.refresh()
        elif time.monotonic() - self.drawn > QUIET_SECONDS:
            self.drawn = time.monotonic()
            self.say(f"{100 * self.done / self.total:3.0f} %  {label}")

    def say(self, line: str) -> None:
        """A line that stays."""
        self.console.print(line, soft_wrap=True)


@contextmanager
def activity(label: str) -> Iterator[None]:
    """Say what is going on in the body, of which nobody knows how far it is.

    On a terminal there is the time that it has taken so far, elsewhere a line if it takes long.  Not for what is on the clock:
    it redraws itself, though seldom.
    """
    console = plain_console(stderr=True)
    if not sys.stderr.isatty():
        timer = threading.Timer(QUIET_SECONDS, lambda: console.print(f"olpm-bench: {label}", soft_wrap=True))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
        return
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True, refresh_per_second=2) as progress:
        progress.add_task(label, total=None)
        yield
