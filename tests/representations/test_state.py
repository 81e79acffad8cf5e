"""What can be done with a state whose meaning is unknown."""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from asking import states_equal

import representations
from olpm_bench.check.particles import batch, lobes
from representations.state import append, bytes_of, copied, copy_records, from_numpy, to_numpy


@dataclass
class Toy:
    mean: mi.Float          # [n_records * 2]
    count: mi.UInt32        # [n_records]


def toy(first: int, n: int) -> Toy:
    return Toy(mean=dr.arange(mi.Float, 2 * n) + first, count=dr.arange(mi.UInt32, n) + first)


def test_append() -> None:
    a, b = toy(0, 2), toy(10, 1)
    both = append(a, b)
    assert np.array_equal(both.mean, [0, 1, 2, 3, 10, 11]) and np.array_equal(both.count, [0, 1, 10])
    assert len(a.count) == 2 and len(b.count) == 1


def test_bytes() -> None:
    assert bytes_of(toy(0, 3)) == 3 * (2 * 4 + 4)


def test_numpy_round_trip() -> None:
    state = toy(5, 4)
    arrays = to_numpy(state)
    assert arrays["mean"].dtype == np.float32 and arrays["count"].dtype == np.uint32
    assert states_equal(from_numpy(toy(0, 1), arrays), state)


def test_missing_field() -> None:
    with pytest.raises(KeyError, match="count"):
        from_numpy(toy(0, 1), {"mean": np.zeros(2, np.float32)})


@pytest.mark.parametrize("name", ["cosine", "gaussian_mixture", "hey", "jensen"])
def test_every_representation_has_such_a_state(name: str) -> None:
    """Flat arrays whose length is a multiple of the number of records, and that survive a file."""
    representation = representations.create(name)
    rng = np.random.default_rng(0)
    state = representation.update(representation.init(3), batch([(lobes(n, rng), np.ones(n)) for n in (200, 0, 20)]))
    arrays = to_numpy(state)
    assert all(a.ndim == 1 and len(a) % 3 == 0 for a in arrays.values())
    assert states_equal(from_numpy(representation.init(1), {k: a.copy() for k, a in arrays.items()}), state)


def test_records_are_copied():
    array = mi.Float(np.arange(12, dtype=np.float32))           # four records of three
    new = copy_records(array, 4, mi.UInt32([0, 0]), mi.UInt32([1, 3]))
    np.testing.assert_array_equal(new.numpy(), [0, 1, 2, 0, 1, 2, 6, 7, 8, 0, 1, 2])
    np.testing.assert_array_equal(array.numpy(), np.arange(12))
    assert len(copy_records(mi.Float(), 4, mi.UInt32([0, 0]), mi.UInt32([1, 3]))) == 0


def test_a_copy_has_memory_of_its_own():
    array = np.arange(5, dtype=np.float32)
    copy = copied(mi.Float, array)
    array[:] = -1
    np.testing.assert_array_equal(copy.numpy(), [0, 1, 2, 3, 4])


def test_copies_compile_one_kernel_however_numpy_aligns_its_memory():
    room = np.arange(200, dtype=np.float32)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for first in range(4):
            doubled = 2 * copied(mi.Float, room[first:first + 100])
            dr.eval(doubled)
            assert doubled[0] == 2 * first
        kernels = {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}
    assert len(kernels) == 1
