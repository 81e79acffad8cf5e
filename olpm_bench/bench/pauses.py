"""Time in which the process could not run at all: it was stopped (Ctrl-Z, SIGSTOP, a frozen container) or the machine slept.

No kernel books this time.  A thread that sleeps for a tenth of a second at a time notices it: its beat comes late
although the process has used next to no CPU time.  A thread that merely sleeps, waits for a GPU or reads a file lets the
others run, and a late beat during computation comes with CPU time; neither counts as a pause.
"""
from __future__ import annotations

import threading
import time
from collections.abc import Callable

INTERVAL = 0.1              # [s] between beats
MIN_PAUSE = 1.0             # [s] a shorter lateness may be the scheduler's
MAX_BUSY = 0.5              # share of a late beat's time that CPU time may fill; a process that computes fills all of it


class Pauses:
    """Sums the pauses of this process while `watch` runs.

    Args:
        wall, cpu: clocks [s]: one that goes on during a pause, and one that counts the CPU time of all threads.
    """

    def __init__(self, wall: Callable[[], float] = time.perf_counter,
                 cpu: Callable[[], float] = time.process_time) -> None:
        self._wall, self._cpu = wall, cpu
        self._lock = threading.Lock()
        self._last_wall, self._last_cpu = wall(), cpu()
        self._seconds = 0.0

    def seconds(self) -> float:
        """Seconds of pauses so far.  To ask is a beat, too: whoever wakes up first notices the pause."""
        with self._lock:
            wall, cpu = self._wall(), self._cpu()
            late, busy = wall - self._last_wall, cpu - self._last_cpu
            if late > MIN_PAUSE and busy < MAX_BUSY * late:
                self._seconds += late - busy        # it may have worked until it was stopped
            self._last_wall, self._last_cpu = wall, cpu
            return self._seconds

    def watch(self) -> None:
        """Beat for as long as the process lives."""
        never = threading.Event()

        def beat() -> None:
            while not never.wait(INTERVAL):
                self.seconds()
        threading.Thread(target=beat, name="pauses", daemon=True).start()


_of_process: Pauses | None = None


def paused() -> float:
    """Seconds for which this process has been paused since it was first asked."""
    global _of_process
    if _of_process is None:
        _of_process = Pauses()
        _of_process.watch()
    return _of_process.seconds()
