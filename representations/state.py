"""What can be done with any representation's state without knowing what it means.

A state is a dataclass of flat, record-major Dr.Jit arrays (see :mod:`representations.interface`).
"""
from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

import drjit as dr
import numpy as np

State = TypeVar("State")

ALIGNMENT = 64              # [bytes] of the widest vectors that LLVM loads: 16 floats


def join(a: Any, b: Any) -> Any:
    """Two arrays one after the other: `dr.concat`, but it takes empty ones and compiles no kernel for each size."""
    result, tp = dr.empty(type(a), len(a) + len(b)), dr.uint32_array_t(type(a))
    for part, start in ((a, 0), (b, len(a))):
        if len(part):
            dr.scatter(result, part, dr.arange(tp, len(part)) + dr.opaque(tp, start))
    return result


def copied(dtype: Any, array: np.ndarray) -> Any:
    """A copy of a one-dimensional NumPy array, in memory that is always aligned in the same way.

    Dr.Jit's LLVM backend works on NumPy's memory itself, without a copy.  That memory is aligned now this way, now that, and
    Dr.Jit compiles other kernels for each.
    """
    values = np.asarray(array)
    room = np.empty(values.nbytes + ALIGNMENT, np.uint8)
    start = -room.ctypes.data % ALIGNMENT
    own = room[start:start + values.nbytes].view(values.dtype)
    own[:] = values
    return dtype(own)


def append(state: State, more: State) -> State:
    """A state with the records of `state`, then those of `more`."""
    fields = {f.name: join(getattr(state, f.name), getattr(more, f.name)) for f in dataclasses.fields(state)}  # type: ignore[arg-type]
    return dataclasses.replace(state, **fields)  # type: ignore[type-var]


def copy_records(array: Any, n_records: int, source: Any, target: Any) -> Any:
    """An array in which the records `target` are copies of the records `source` (UInt32 [k], k > 1)."""
    tp, stride = dr.uint32_array_t(type(array)), len(array) // n_records
    if stride == 0:                         # a field that is not in use
        return array
    i, stride = dr.arange(tp, len(source) * stride), dr.opaque(tp, stride)
    k, within = i // stride, i % stride
    values = dr.gather(type(array), array, dr.gather(tp, source, k) * stride + within)
    dr.eval(values)
    result = type(array)(array)
    dr.scatter(result, values, dr.gather(tp, target, k) * stride + within)
    return result


def bytes_of(state: Any) -> int:
    """Bytes held by all arrays of a state."""
    return sum(len(getattr(state, f.name)) * dr.itemsize_v(getattr(state, f.name))
               for f in dataclasses.fields(state))


def to_numpy(state: Any) -> dict[str, np.ndarray]:
    """Field name -> array, for files."""
    return {f.name: getattr(state, f.name).numpy() for f in dataclasses.fields(state)}


def from_numpy(like: State, arrays: dict[str, np.ndarray]) -> State:
    """The state that `to_numpy` described; `like` (any state of the same representation) gives the types.

    Raises:
        KeyError: a field is missing.
    """
    return dataclasses.replace(like, **{f.name: copied(type(getattr(like, f.name)), arrays[f.name])  # type: ignore[type-var]
                                        for f in dataclasses.fields(like)})  # type: ignore[arg-type]
