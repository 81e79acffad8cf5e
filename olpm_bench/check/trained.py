"""A representation in many states of training at once: its samples, and its density where it matters."""
from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.check.particles import vector
from olpm_bench.check.population import Directions, Population

ONE = 1 - 2.0**-24                  # the largest float32 below 1
CORNERS = "by numbers of 0 and 1 - 2^-24"


@dataclass(frozen=True)
class Samples:
    """A lane each."""
    record: np.ndarray      # [n]
    wo: np.ndarray          # [n, 3]
    reported: np.ndarray    # [n] density by sample() [1/sr]
    pdf: np.ndarray         # [n] density by pdf() [1/sr]

    @property
    def alive(self) -> np.ndarray:
        """Those that don't fail."""
        return self.reported > 0


def as_numpy(value: Any, n: int) -> np.ndarray:
    """A Dr.Jit array of n or 1 entries, or a number [n]."""
    return np.array(value, np.float64) * np.ones(n)


def taught(representation: Any, records: Population) -> Any:
    """A state of all records of a population, after all of its batches."""
    state = representation.init(len(records), records.seed, records.parallax)
    for index, batch in enumerate(records.arrays()):
        state = representation.update(state, batch, records.seed + index)
        dr.eval(state)
    return state


class Trained:
    """A state of all records of a population, after all of its batches unless it is given."""

    def __init__(self, representation: Any, records: Population, state: Any = None) -> None:
        self.representation, self.records = representation, records
        self.state = taught(representation, records) if state is None else state

    def without_place(self) -> Trained:
        """The same state, but asked without a place."""
        return Trained(self.representation, self.records.without_place(), self.state)

    def at(self, record: np.ndarray) -> mi.Vector3f | None:
        return None if self.records.at is None else vector(self.records.at[record])

    def density(self, record: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """pdf() at directions [n, 3], each of its record."""
        pdf = self.representation.pdf(self.state, mi.UInt32(record.astype(np.uint32)), vector(wo), True, self.at(record))
        return as_numpy(pdf, len(wo))

    def draw(self, record: np.ndarray, rng: np.random.Generator) -> Samples:
        """A sample of each record."""
        return self._draw(record, rng.integers(0, 1 << 24, (3, len(record))) / (1 << 24))

    def _draw(self, record: np.ndarray, u: np.ndarray) -> Samples:
        """By the random numbers u [3, n]."""
        n, u = len(record), u.astype(np.float32)
        wo, pdf = self.representation.sample(self.state, mi.UInt32(record.astype(np.uint32)), mi.Float(u[0]),
                                             mi.Point2f(u[1], u[2]), True, self.at(record))
        dr.eval(wo, pdf)
        wo = np.stack([as_numpy(c, n) for c in wo], -1)
        return Samples(record, wo, as_numpy(pdf, n), self.density(record, wo))

    # ---- Asked once, read by several checks

    @cached_property
    def drawn(self) -> Samples:
        """Samples of all records, shuffled."""
        rng = self.records.rng(5)
        return self.draw(rng.permutation(np.repeat(np.arange(len(self.records)), self.records.counts)), rng)

    @cached_property
    def corners(self) -> Samples:
        """Eight samples of every record, by the smallest and largest random numbers."""
        n = len(self.records)
        return self._draw(np.repeat(np.arange(n), 8), np.tile(np.array(list(itertools.product((0, ONE), repeat=3))).T, n))

    @cached_property
    def proposed(self) -> np.ndarray:
        """pdf() at the population's `proposed`."""
        return self._at(self.records.proposed)

    @cached_property
    def mesh(self) -> np.ndarray:
        """pdf() at the population's `mesh`."""
        return self._at(self.records.mesh)

    @cached_property
    def probes(self) -> np.ndarray:
        """pdf() at the population's `probes`."""
        return self._at(self.records.probes)

    def _at(self, directions: Directions) -> np.ndarray:
        return self.density(directions.record, directions.wo)
