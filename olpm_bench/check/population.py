"""Records in every state of training, and where to ask for their densities: the same for all representations."""
from __future__ import annotations

import functools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.stats import qmc

from olpm_bench.check.particles import (
    CONDITIONS,
    LONG,
    Particles,
    batch,
    landing,
    normalised,
    nothing,
    uniform_directions,
    vector,
)
from olpm_bench.check.proposal import Proposals
from representations.interface import ParticleBatch
from representations.parallax import aim, inverse

COPIES = 3                          # records in each condition, with particles of their own
ASKED = {"beside": 0.08, "afar": 1.5}       # where a record with parallax is asked: deviation of each coordinate [scene units]
FEW, SAMPLES = 1 << 18, 1 << 14     # samples of a record around at most 10 distinct particles, and of others; half with parallax
WITHOUT_PLACE = 4                   # times fewer samples, where states with parallax are asked without a place
MESH = 1 << 14                      # points of the quadrature, for each record
PROBES = 1 << 10                    # directions of a record that are looked at one by one
ROTATED = 2.0**-22                  # by how much their lengths are off at most, as of directions that were rotated to a frame
SPECIAL = [(0, 0, 1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, -1), (0.6, 0, 0.8), (0, 0.6, 0.8), (0.8, 0, -0.6),
           (0.5, 0.5, 0.5**0.5), (-0.5, 0.5, 0.5**0.5), (1, 0, 1e-7), (1, 0, -1e-7), (0, 1, 1e-4), (-1, -1, 1e-4)]


@dataclass(frozen=True)
class Directions:
    """To ask about, a lane each, shuffled: no lane has its record's neighbours."""
    record: np.ndarray      # [n]
    wo: np.ndarray          # [n, 3]
    q: np.ndarray           # [n] density of the proposal that chose them [1/sr]; 0 where nothing did


class Population:
    """Records with particles to train on.

    conditions: name of each record's [n_records].
    batches: one list a batch, with the particles of each record.
    at: the points from which the records are asked, in their frames [n_records, 3]; None: they are asked without a place.
    parallax: particles have places.
    """

    def __init__(self, conditions: list[str], batches: list[list[Particles]], seed: int, at: np.ndarray | None = None,
                 parallax: bool = False) -> None:
        self.conditions, self.batches, self.seed, self.at, self.parallax = conditions, batches, seed, at, parallax

    def __len__(self) -> int:
        return len(self.conditions)

    def of(self, record: int) -> Particles:
        """All particles of a record."""
        wo, weight = (np.concatenate([b[record][i] for b in self.batches]) for i in (0, 1))
        return wo, weight

    def name(self, record: int) -> str:
        return f"record {record} ({self.conditions[record]})"

    def rng(self, *key: int) -> np.random.Generator:
        return np.random.default_rng([3, self.seed, *key])

    def without_place(self) -> Population:
        """The same, but asked without a place."""
        conditions = [f"{name.rpartition(', ')[0]}, without a place" for name in self.conditions]
        return Population(conditions, self.batches, self.seed, None, self.parallax)

    def arrays(self) -> list[ParticleBatch]:
        """The batches for Dr.Jit."""
        made = [batch(particles, self.parallax) for particles in self.batches]
        dr.eval(made)
        return made

    @functools.cached_property
    def proposals(self) -> Proposals:
        return Proposals(self._seen(), self.rng(1))

    def _seen(self) -> list[Particles]:
        """Each record's particles, from where it is asked."""
        particles = [self.of(record) for record in range(len(self))]
        if not self.parallax:
            return particles
        count = [len(weight) for _, weight in particles]
        landed = [landing(b[record][0]) for record in range(len(self)) for b in self.batches if len(b[record][1])]
        place, distance = (np.concatenate(values) for values in zip(*landed, strict=True))
        learnt = vector(np.concatenate([wo for wo, _ in particles]))
        *centred, near = aim(tuple(learnt), inverse(mi.Float(distance)), -vector(place))
        at = np.zeros((len(self), 3)) if self.at is None else self.at
        seen = np.array(aim(tuple(centred), near, vector(np.repeat(at, count, axis=0)))[:3]).T
        return list(zip(np.split(normalised(seen), np.cumsum(count)[:-1]), [weight for _, weight in particles], strict=True))

    @functools.cached_property
    def counts(self) -> np.ndarray:
        """Samples of each record."""
        fewer = 1 if not self.parallax else WITHOUT_PLACE if self.at is None else 2
        return np.where(self.proposals.count <= 10, FEW, SAMPLES) // fewer

    @functools.cached_property
    def complete(self) -> np.ndarray:
        """Records whose proposals look around every place of a narrow lobe [n_records].

        One that was learnt from several particles may be re-aimed to anywhere between the directions where they are seen.
        """
        return self.proposals.complete & ((self.at is None) | (self.proposals.count <= 1))

    @functools.cached_property
    def proposed(self) -> Directions:
        """As many directions of the proposals as there are samples, but for those below the horizon."""
        rng = self.rng(2)
        record = np.repeat(np.arange(len(self)), self.counts)
        return self._above(record, self.proposals.at(record, rng.random((len(record), 3))), rng)

    @functools.cached_property
    def mesh(self) -> Directions:
        """Points of a quadrature: an integral is the mean of pdf / q over `MESH` of them, 0 for those that are left out.

        Scrambled Sobol points, shifted for each record.
        """
        rng = self.rng(3)
        u = (qmc.Sobol(3, seed=rng).random(MESH) + rng.random((len(self), 1, 3))) % 1
        record = np.repeat(np.arange(len(self)), MESH)
        return self._above(record, self.proposals.at(record, u.reshape(-1, 3)), rng)

    def _above(self, record: np.ndarray, wo: np.ndarray, rng: np.random.Generator) -> Directions:
        order = rng.permutation(np.flatnonzero(wo[:, 2] > 0))
        record, wo = record[order], wo[order]
        return Directions(record, wo, self.proposals.pdf(record, wo))

    @functools.cached_property
    def probes(self) -> Directions:
        """All over the sphere, close to the particles, below the horizon, and on the seams of maps; z may be 1 + 2^-22."""
        rng, directions = self.rng(4), []
        for r in range(len(self)):
            around = self.proposals.around(r)
            near = around + 10 ** rng.uniform(-6, -1, (len(around), 1)) * rng.normal(size=around.shape)
            rest = uniform_directions(PROBES - len(SPECIAL) - len(near), rng)
            rest[rng.random(len(rest)) < 0.5, 2] *= -1
            length = 1 + ROTATED * rng.integers(-1, 2, (PROBES, 1))
            directions.append(np.float32(length) * normalised(np.concatenate([SPECIAL, near, rest])))
        n = len(self) * PROBES
        return Directions(np.repeat(np.arange(len(self)), PROBES), np.concatenate(directions), np.zeros(n))


@functools.lru_cache(2)
def population(seed: int, copies: int = COPIES, long: bool = True) -> Population:
    """Records in every condition; without the `LONG` ones, in few batches."""
    records = _records(copies, long)
    return Population([name for name, _ in records], _batches(records, np.random.default_rng([1, seed])), seed)


@functools.lru_cache(1)
def population_with_parallax(seed: int) -> Population:
    """Records in every condition, asked from beside the record, and from so far that light gets out of sight."""
    rng, records, asked = np.random.default_rng([2, seed]), _records(len(ASKED)), list(ASKED)
    at = np.stack([ASKED[asked[copy]] * rng.normal(size=3) for _, copy in records]).astype(np.float32)
    return Population([f"{name}, {asked[copy]}" for name, copy in records], _batches(records, rng), seed, at, True)


def _records(copies: int, long: bool = True) -> list[tuple[str, int]]:
    """Conditions and numbers of copies, in an order that puts neighbours into different conditions."""
    return [(name, copy) for copy in range(copies) for name in (CONDITIONS | LONG if long and copy == 0 else CONDITIONS)]


def _batches(records: list[tuple[str, int]], rng: np.random.Generator) -> list[list[Particles]]:
    """One list a batch.  Of conditions with fewer, some copies learn in the first batches, and others in the last."""
    batches = [(CONDITIONS | LONG)[name](rng, copy) for name, copy in records]
    n = max(map(len, batches))
    waits = [[nothing()] * (n - len(b)) for b in batches]
    padded = [wait + b if copy % 2 else b + wait for b, wait, (_, copy) in zip(batches, waits, records, strict=True)]
    return [list(particles) for particles in zip(*padded, strict=True)]
