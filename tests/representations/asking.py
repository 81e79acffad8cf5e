"""A representation's density and samples, for NumPy; and which checks take long."""
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.check.particles import vector
from representations.state import to_numpy

RENDERS = ("furnace", "image")          # checks that are slow


def density(representation: Any, state: Any, record: int, wo: np.ndarray) -> np.ndarray:
    """pdf() of one record at directions [n, 3]."""
    return np.array(representation.pdf(state, dr.full(mi.UInt32, record, len(wo)), vector(wo)), np.float64) * np.ones(len(wo))


def draw(representation: Any, state: Any, record: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """n samples of one record: wo [n, 3], pdf [n]."""
    u = np.random.default_rng([3, record]).random((3, n), np.float32)
    wo, pdf = representation.sample(state, dr.full(mi.UInt32, record, n), mi.Float(u[0]), mi.Point2f(u[1], u[2]))
    return np.array(wo).T, np.array(pdf, np.float64) * np.ones(n)


def states_equal(a: Any, b: Any) -> bool:
    """Bit for bit."""
    a, b = to_numpy(a), to_numpy(b)
    return a.keys() == b.keys() and all(a[k].tobytes() == b[k].tobytes() for k in a)
