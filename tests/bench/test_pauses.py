"""A process that was stopped is not charged for the pause; one that sleeps, waits or computes is."""
from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

from olpm_bench.bench.pauses import MIN_PAUSE, Pauses

STOPPED = 2.0           # [s]
CHILD = """
import time
from olpm_bench.bench.clock import Clock
clock = Clock()
with clock.lap("render"):
    print("started", flush=True)
    while time.process_time() < 1.0:
        pass
    input()
print(clock.total.paused, clock.total.wall, clock.charged, flush=True)
"""


class Times:
    """A wall clock and a CPU clock that are set by hand."""

    def __init__(self) -> None:
        self.wall, self.cpu = 100.0, 5.0
        self.pauses = Pauses(lambda: self.wall, lambda: self.cpu)

    def after(self, wall: float, cpu: float) -> float:
        self.wall += wall
        self.cpu += cpu
        return self.pauses.seconds()


def test_a_late_beat_without_cpu_time_is_a_pause():
    times = Times()
    assert times.after(0.1, 0.1) == 0
    assert times.after(60.1, 0.1) == pytest.approx(60.0)
    assert times.after(0.1, 0.2) == pytest.approx(60.0)         # it is told once
    assert times.after(30.0, 0.0) == pytest.approx(90.0)


def test_a_late_beat_during_computation_is_none():
    times = Times()
    assert times.after(20.0, 38.0) == 0
    assert times.after(20.0, 19.0) == 0


def test_a_short_lateness_is_none():
    assert Times().after(0.9 * MIN_PAUSE, 0.0) == 0


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="the system can't stop processes")
def test_a_stopped_process_is_not_charged():
    with subprocess.Popen([sys.executable, "-c", CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                          text=True) as child:
        assert child.stdout.readline() == "started\n"
        child.send_signal(signal.SIGSTOP)
        time.sleep(STOPPED)
        child.send_signal(signal.SIGCONT)
        said, _ = child.communicate("\n")
    paused, wall, charged = map(float, said.split())
    assert paused > 0.75 * STOPPED
    assert charged <= wall          # which does not count the pause
