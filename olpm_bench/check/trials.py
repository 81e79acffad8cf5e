"""Trainings of one representation on variations of the same particles, and comparisons of what was learnt."""
from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import representations
from olpm_bench.check.density import ROUNDING, direction
from olpm_bench.check.particles import Particles, batch, normalised, uniform_directions, vector
from olpm_bench.check.picture import of_density
from olpm_bench.check.population import population
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import Failure, Picture, Verdict, sidak, worst_of
from representations.interface import ParticleBatch
from representations.state import to_numpy

COPIES = 2                  # records in each condition
QUERIES = 256               # directions at which densities are compared, and samples that are, for each record
BESIDE = (0.05, -0.03, 0.01)        # where states with parallax are asked [scene units]; particles land within 0.1
FAINT = 1e-6                # densities [1/sr] and differences of densities that count as nothing
TINY = 1e-30                # so are numbers where bits are compared
ASTRAY = 1e-2               # share of samples that may differ where states differ by rounding: it may choose another lobe
FAR = 1e-3                  # length by which directions of samples differ at least, where they do


class Trials:
    """Trainings of the same representation on variations of the same particles.

    parallax: of states with parallax, which are asked from `BESIDE` the record and without a place.
    grows: declared so.
    """

    def __init__(self, specification: dict[str, Any], seed: int, parallax: bool = False, grows: bool = False) -> None:
        self.representation = representations.create(**specification)
        parameters = {name: value for name, value in specification.items() if name != "type"}
        self.another = type(self.representation)(**parameters)      # of the same class: `create` would load a file once more
        self.specification, self.seed, self.parallax, self.grows = specification, seed, parallax, grows
        self.records = population(seed, COPIES, long=False)
        self.batches, self.n = self.records.batches, len(self.records)
        self.places: tuple[tuple[float, ...] | None, ...] = (BESIDE, None) if parallax else (None,)
        rng, directions = self.records.rng(8), []
        for r in range(self.n):
            near = self.records.of(r)[0][:QUERIES // 2]
            near = normalised(near + 10 ** rng.uniform(-4, -1, (len(near), 1)) * rng.normal(size=near.shape))
            directions.append(np.concatenate([near, uniform_directions(QUERIES - len(near), rng)]))
        self.wo = np.stack(directions)                              # [n, QUERIES, 3]
        self.u = rng.random((self.n, QUERIES, 3), np.float32)       # sample1 and sample2
        self.like = self.another.init(2, 0, parallax)

    def train(self, batches: list[list[Particles]], seed: int | None = None, unit: np.ndarray | None = None) -> Any:
        """A state of all records; `unit` as in :meth:`update`."""
        seed = self.seed if seed is None else seed
        state = self.init(len(batches[0]), seed)
        for index, particles in enumerate(batches):
            state = self.update(state, particles, seed + index, unit)
            dr.eval(state)
        return state

    def init(self, n_records: int, seed: int) -> Any:
        return self.representation.init(n_records, seed, self.parallax)

    def update(self, state: Any, particles: list[Particles], seed: int, unit: np.ndarray | None = None) -> Any:
        """unit: what lengths are multiplied by [n_records]."""
        return self.representation.update(state, self.batch(particles, unit), seed)

    def batch(self, particles: list[Particles], unit: np.ndarray | None = None) -> ParticleBatch:
        return batch(particles, self.parallax, unit=unit)

    # ---- Densities and samples

    def density(self, state: Any, index: np.ndarray, wo: np.ndarray, place: Sequence[float] | None = None, by: Any = None,
                unit: np.ndarray | None = None) -> np.ndarray:
        """Of the state's records `index` [n] at directions [n, m, 3]."""
        record, at = _lanes(index, wo.shape[1], place, unit)
        pdf = (by or self.representation).pdf(state, record, vector(wo.reshape(-1, 3)), True, at)
        return as_numpy(pdf, len(record)).reshape(wo.shape[:2])

    def samples(self, state: Any, index: np.ndarray, u: np.ndarray, place: Sequence[float] | None = None, by: Any = None,
                unit: np.ndarray | None = None) -> np.ndarray:
        """Directions and densities of samples of the records `index` [n] by random numbers [n, m, 3]: [n, m, 4]."""
        record, at = _lanes(index, u.shape[1], place, unit)
        u1, u2, u3 = (mi.Float(np.ascontiguousarray(c)) for c in u.reshape(-1, 3).T)
        wo, pdf = (by or self.representation).sample(state, record, u1, mi.Point2f(u2, u3), True, at)
        dr.eval(wo, pdf)
        return np.stack([as_numpy(v, len(record)) for v in (*wo, pdf)], -1).reshape(*u.shape[:2], 4)

    def answers(self, state: Any, by: Any = None, backwards: bool = False) -> dict[str, bytes]:
        """All bits of the densities and samples of all records, by the name of the verb; as :func:`bits` has them.

        backwards: the last lane asks first, which changes no answer.
        """
        turn = slice(None, None, -1 if backwards else 1)
        index = np.arange(self.n)[turn]
        return {verb: b"".join(bits(ask(state, index, given[turn, turn], place, by)[turn, turn]) for place in self.places)
                for verb, ask, given in (("sample()", self.samples, self.u), ("pdf()", self.density, self.wo))}

    def differences(self, what: str, new: Any, old: Any, records: np.ndarray | None = None, new_at: int = 0, old_at: int = 0,
                    bits: bool = False, by: Any = None, unit: np.ndarray | None = None) -> list[Failure]:
        """Between two states, in the densities and samples of some records; record r has the index `new_at` + r in the new one.

        by: the instance that is asked for the new ones.
        unit: what lengths are multiplied by in the new state [n].
        """
        records = np.arange(self.n) if records is None else records
        unit = None if unit is None else unit[records]
        for place in self.places:
            words = what if place == self.places[0] else f"{what}, asked without a place"
            found = self._densities_apart(words, new, old, records, place, new_at, old_at, bits, by, unit)
            found += self._samples_apart(words, new, old, records, place, new_at, old_at, bits, by, unit)
            if found:
                return found
        return []

    def _densities_apart(self, what: str, new: Any, old: Any, records: np.ndarray, place: Any, new_at: int, old_at: int,
                         bits: bool, by: Any, unit: np.ndarray | None) -> list[Failure]:
        wo = self.wo[records]
        found = self.density(new, records + new_at, wo, place, by, unit)
        expected = self.density(old, records + old_at, wo, place)
        close = np.isclose(found, expected, rtol=0 if bits else ROUNDING, atol=0 if bits else FAINT)
        if close.all():
            return []
        r, i = (int(k[0]) for k in np.nonzero(~close))
        record = int(records[r])
        words = (f"{self.records.name(record)}: {what}: pdf {found[r, i]:.5g} instead of {expected[r, i]:.5g} 1/sr at "
                 f"{direction(wo[r, i])}; {(~close).sum()} of {close.size} densities differ")
        return [Failure((~close).sum(), words, self.beside((f"pdf of {self.records.name(record)}", old, record + old_at),
                                                           (what, new, record + new_at)))]

    def _samples_apart(self, what: str, new: Any, old: Any, records: np.ndarray, place: Any, new_at: int, old_at: int,
                       bits: bool, by: Any, unit: np.ndarray | None) -> list[Failure]:
        u = self.u[records]
        found = self.samples(new, records + new_at, u, place, by, unit)
        expected = self.samples(old, records + old_at, u, place)
        if bits:
            apart = ~np.isclose(found, expected, rtol=0, atol=0, equal_nan=True).all(-1)
        else:
            apart = ~(np.abs(found[..., :3] - expected[..., :3]).max(-1) < FAR)
        wrong = np.flatnonzero(apart.mean(1) > (0 if bits else ASTRAY))
        if len(wrong) == 0:
            return []
        r, i = int(wrong[0]), int(np.flatnonzero(apart[wrong[0]])[0])
        words = (f"{self.records.name(int(records[r]))}: {what}: by the same random numbers, sample() gives "
                 f"{direction(found[r, i])} with {found[r, i, 3]:.5g} 1/sr instead of {direction(expected[r, i])} with "
                 f"{expected[r, i, 3]:.5g} 1/sr; {apart.sum()} of {apart.size} samples differ")
        return [Failure(apart.sum(), words)]

    def beside(self, *shown: tuple[str, Any, int]) -> Picture:
        """Densities of records in states, each with a title."""
        return lambda: [of_density(title, lambda wo, s=state, i=index: self.density(  # type: ignore[misc]
            s, np.array([i]), wo[None], self.places[0])[0]) for title, state, index in shown]


def _lanes(index: np.ndarray, m: int, place: Sequence[float] | None, unit: np.ndarray | None) -> tuple[mi.UInt32, Any]:
    """Of m questions to each record: the record, and the point that asks."""
    record = mi.UInt32(np.repeat(index, m).astype(np.uint32))
    if place is None:
        return record, None
    return record, vector(np.array(place) * np.repeat(np.ones(len(index)) if unit is None else unit, m)[:, None])


def both(check: Callable[..., Verdict]) -> Callable[..., Verdict]:
    """The check of states without and with parallax, in one verdict, that of the worse ones."""
    @functools.wraps(check)
    def of_both(trials: Sequence[Trials], *level: float) -> Verdict:
        return worst_of({"with parallax" if one.parallax else "": check(one, *(sidak(a, len(trials)) for a in level))
                         for one in trials})
    return of_both


def bits(values: np.ndarray) -> bytes:
    """With 0 for numbers below `TINY`: Dr.Jit's worker threads flush subnormal numbers, its main thread doesn't."""
    return np.where(np.abs(values) < TINY, 0, values).tobytes() if values.dtype.kind == "f" else values.tobytes()


def differing(a: Any, b: Any) -> str:
    """Names of the fields in which two states differ, bit for bit."""
    x, y = to_numpy(a), to_numpy(b)
    return ", ".join(k for k in x if k not in y or x[k].tobytes() != y[k].tobytes())
