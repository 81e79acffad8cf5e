"""The clock charges work, and neither waiting for neighbours nor compilation."""
from __future__ import annotations

import pytest

from olpm_bench.bench.clock import Clock, Lap, charge, thread_times


def test_two_busy_threads_share_what_they_waited():
    before = {"1": (1.0, 0.0), "2": (2.0, 0.5)}
    after = {"1": (5.0, 1.0), "2": (6.0, 1.5)}
    lap = charge(5.0, 8.0, before, after, n_cores=2)
    assert lap.wait == pytest.approx(1.0) and lap.charged == pytest.approx(4.0)


def test_idle_threads_do_not_dilute_the_wait_of_serial_code():
    before = {"main": (0.0, 0.0), "pool": (9.0, 3.0)}
    after = {"main": (3.0, 1.0), "pool": (9.001, 3.0)}
    assert charge(4.0, 3.001, before, after, n_cores=2).charged == pytest.approx(3.0)


def test_a_thread_born_in_the_lap_counts_from_zero():
    before, after = {"1": (0.0, 0.0)}, {"1": (1.0, 1.0), "2": (1.0, 1.0)}
    assert charge(2.0, 2.0, before, after, n_cores=2).charged == pytest.approx(1.0)


def test_threads_that_wait_for_each_other_are_charged():
    """Four threads on one core, alone on the machine: the whole wall time is the method's."""
    before = {str(i): (0.0, 0.0) for i in range(4)}
    after = {str(i): (1.0, 3.0) for i in range(4)}
    assert charge(4.0, 4.0, before, after, n_cores=1).charged == pytest.approx(4.0)


@pytest.mark.parametrize("before, after", [(None, None), (None, {"1": (1.0, 1.0)})])
def test_without_schedstat_wall_is_charged(before, after):
    assert charge(3.0, 1.0, before, after, n_cores=2).charged == 3.0


def test_thread_times_without_the_kernels_books(tmp_path):
    assert thread_times(tmp_path / "missing") is None
    (tmp_path / "1").mkdir()
    assert thread_times(tmp_path) is None
    (tmp_path / "1" / "schedstat").write_text("2000000000 500000000 7\n")
    assert thread_times(tmp_path) == {"1": (2.0, 0.5)}


def test_laps_add_up_by_label_and_time_between_them_is_free():
    clock = Clock()
    for label in ("train", "render", "render"):
        with clock.lap(label):
            sum(range(10_000))
    assert set(clock.laps) == {"train", "render"}
    assert clock.charged == pytest.approx(clock["train"].charged + clock["render"].charged)
    assert 0 < clock.total.charged <= clock.total.wall
    assert clock["never"].wall == 0


def test_a_share_of_a_label_is_moved_to_another():
    train, render = Lap(wall=4.0, cpu=6.0, wait=1.0, compile=0.4, charged=3.0), Lap(wall=1.0, charged=1.0)
    clock = Clock(laps={"train": train, "render": render})
    before = clock.total
    clock.move(0.25, "train", "render")
    assert clock["train"] == Lap(wall=3.0, cpu=4.5, wait=0.75, compile=pytest.approx(0.3), charged=2.25)
    assert clock["render"] == Lap(wall=2.0, cpu=1.5, wait=0.25, compile=pytest.approx(0.1), charged=1.75)
    assert clock.total == before
    clock.move(1.0, "train", "other")
    assert clock["train"] == Lap() and clock["other"].charged == 2.25 and clock.charged == 4.0


def test_a_lap_that_raises_is_not_counted():
    clock = Clock()
    with pytest.raises(KeyError), clock.lap("train"):
        raise KeyError
    assert clock.charged == 0


def test_compilation_is_not_charged():
    clock = Clock(count_wait=False)
    with clock.lap("train", lambda: 1e-6):
        sum(range(100_000))
    assert clock["train"].compile == 1e-6
    assert clock["train"].charged == pytest.approx(clock["train"].wall - 1e-6)
    with clock.lap("render", lambda: 1e9):
        sum(range(100_000))
    assert clock["render"].charged == 0
