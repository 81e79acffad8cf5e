"""What every representation must pass: functions that take a representation and a case, and assert one sentence of
the contract in `representations.interface` each.  Use them for your own: see test_conformance.py.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from representations.interface import ParticleBatch
from representations.parallax import aim, inverse
from representations.square import from_hemisphere
from representations.state import append, bytes_of, from_numpy, to_numpy

SIGNIFICANCE = 1e-3         # of one test function on one case, shared by the records of that case
RECORDS = 6                 # records in a case
SMALLEST, LARGEST = 2e-5, 2.0       # chords at which `Proposal` looks around each particle
BINS = 16                   # bins along each side of the square in the chi-square test


# ---------------------------------------------------------------------------------------------- particles

def normalised(v: np.ndarray) -> np.ndarray:
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(np.float32)


def uniform_directions(n: int, rng: np.random.Generator) -> np.ndarray:
    """Uniform over the hemisphere [n, 3]."""
    z, phi = 1 - rng.random(n), 2 * np.pi * rng.random(n)
    r = np.sqrt(1 - z * z)
    return normalised(np.stack([r * np.cos(phi), r * np.sin(phi), z], -1))


def lobes(n: int, rng: np.random.Generator, modes: int = 12) -> np.ndarray:
    """A few lobes of about 1 to 20 degrees around random directions [n, 3]."""
    axis, width = uniform_directions(modes, rng), 10 ** rng.uniform(-1.8, -0.5, modes)
    j = rng.integers(0, modes, n)
    v = axis[j] + width[j, None] * rng.normal(size=(n, 3))
    v[:, 2] = np.abs(v[:, 2]) + 1e-3
    return normalised(v)


def vector(wo: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(*(mi.Float(np.ascontiguousarray(wo[:, i])) for i in range(3)))


Particles = list[tuple[np.ndarray, np.ndarray]]         # for each record: wo [n, 3], weight [n]


def landing(wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where on a disk of radius 0.1 around the record each particle has landed [n, 3], and its distance [n], some infinite."""
    rng = np.random.default_rng([11, len(wo)])
    phi, r = 2 * np.pi * rng.random(len(wo)), 0.1 * np.sqrt(rng.random(len(wo)))
    distance = np.where(rng.random(len(wo)) < 0.8, 10 ** rng.uniform(-1.5, 1.5, len(wo)), np.inf)
    return np.stack([r * np.cos(phi), r * np.sin(phi), 0.01 * rng.normal(size=len(wo))], -1), distance


def batch(particles: Particles, parallax: bool = False) -> ParticleBatch:
    """The particles of all records as Dr.Jit arrays; for `parallax` with places and distances."""
    if not any(len(weight) for _, weight in particles):
        return ParticleBatch(wo=dr.zeros(mi.Vector3f, 0), weight=mi.Float(), distance=mi.Float(), record=mi.UInt32(),
                             offset=dr.zeros(mi.UInt32, len(particles) + 1))
    wo, weight = (np.concatenate([p[i] for p in particles]).astype(np.float32) for i in (0, 1))
    record = np.repeat(np.arange(len(particles), dtype=np.uint32), [len(p[1]) for p in particles])
    if not parallax:
        return ParticleBatch.from_arrays(vector(wo), mi.Float(weight), mi.UInt32(record), len(particles))
    at, distance = (np.concatenate([landing(p[0])[i] for p in particles]).astype(np.float32) for i in (0, 1))
    return ParticleBatch.from_arrays(vector(wo), mi.Float(weight), mi.UInt32(record), len(particles), mi.Float(distance),
                                     vector(at))


@dataclass
class Case:
    """Batches of particles to train on, and the directions around which the density may be narrow.

    at: the point from which the records are asked, in their frames; then the particles have places and distances too.
    """
    name: str
    batches: list[Particles]
    at: tuple[float, float, float] | None = None

    def directions(self, record: int) -> np.ndarray:
        particles = [p[record][0] for p in self.batches]
        if self.at is not None:         # re-aimed to the record, and from there to `at`
            for i, wo in enumerate(particles):
                place, distance = landing(wo)
                x, y, z, near = aim(tuple(vector(wo)), inverse(mi.Float(distance)), -vector(place))
                particles[i] = normalised(np.stack(aim((x, y, z), near, mi.Vector3f(self.at))[:3], -1))
        return np.concatenate([np.zeros((0, 3), np.float32), *particles])

    def train(self, representation: Any, scale: float = 1) -> Any:
        state = representation.init(RECORDS, 1, self.at is not None)
        for seed, particles in enumerate(self.batches):
            scaled = [(wo, weight * np.float32(scale)) for wo, weight in particles]
            state = representation.update(state, batch(scaled, self.at is not None), seed)
        dr.eval(state)
        return state


def cases() -> list[Case]:
    """The states in which a representation is tested."""
    rng = np.random.default_rng(1)

    def each(draw: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> Particles:
        return [draw(record) for record in range(RECORDS)]

    def ones(wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return wo, np.ones(len(wo), np.float32)

    def grazing(n: int) -> np.ndarray:
        wo = uniform_directions(n, rng)
        wo[:, 2] = 10 ** rng.uniform(-4, -2, n)
        return normalised(wo)

    def many(n: int) -> tuple[np.ndarray, np.ndarray]:
        return lobes(n, rng), rng.lognormal(size=n).astype(np.float32)

    return [
        Case("untrained", []),
        Case("one particle", [each(lambda r: ones(uniform_directions(1, rng)))]),
        Case("ten identical", [each(lambda r: ones(np.repeat(uniform_directions(1, rng), 10, axis=0)))]),
        Case("many modes", [each(lambda r: many(200))]),
        Case("grazing", [each(lambda r: ones(grazing(150 if r else 1)))]),
        Case("heavy tails", [each(lambda r: (lobes(150, rng), 10 ** rng.uniform(-6, 6, 150)))]),
        Case("zero weights", [each(lambda r: (lobes(100, rng), (rng.random(100) < 0.5) * (r % 2.0)))]),
        Case("on-line", [each(lambda r: many(60)) for _ in range(4)]),
        Case("uneven", [[many(n) for n in counts] for counts in (
            [0, 1, 0, 400, 3, 0], [0, 0, 5, 90, 90, 0], [0, 9, 0, 60, 0, 0])]),
    ]


def cases_with_parallax() -> list[Case]:
    """Asked from beside the record, and from so far that light gets out of sight."""
    rng = np.random.default_rng(12)

    def each(n: int) -> Particles:
        return [(lobes(n, rng), rng.lognormal(size=n).astype(np.float32)) for _ in range(RECORDS)]

    beside, afar = (0.05, -0.08, 0.01), (-1.0, 2.0, 0.5)
    return [Case("untrained from beside", [], beside), Case("one particle from beside", [each(1)], beside),
            Case("from beside", [each(120), each(60)], beside), Case("from afar", [each(150)], afar)]


# ---------------------------------------------------------------------------------------------- the density

def queries(case: Case, n: int = 4096) -> np.ndarray:
    """Directions to ask about: everywhere, close to the particles, below the horizon, and on the map's seams."""
    rng = np.random.default_rng(2)
    special = [(0, 0, 1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, -1), (0.6, 0, 0.8), (0, 0.6, 0.8),
               (0.5, 0.5, 0.5**0.5), (-0.5, 0.5, 0.5**0.5), (1, 0, 1e-7), (1, 0, -1e-7), (0.8, 0, -0.6)]
    near = np.concatenate([case.directions(r) for r in range(RECORDS)] or [np.zeros((0, 3))])[:n]
    near = near + 10 ** rng.uniform(-6, -1, (len(near), 1)) * rng.normal(size=near.shape)
    sphere = rng.normal(size=(n, 3))
    return normalised(np.concatenate([special, uniform_directions(n, rng), near, sphere]))


def density(representation: Any, state: Any, record: int, wo: np.ndarray,
            at: tuple[float, float, float] | None = None) -> np.ndarray:
    """pdf() of one record at directions [n, 3], asked from a point."""
    if len(wo) == 0:
        return np.zeros(0)
    pdf = representation.pdf(state, dr.full(mi.UInt32, record, len(wo)), vector(wo), True, place(at))
    return np.array(pdf, np.float64) * np.ones(len(wo))


def place(at: tuple[float, float, float] | None) -> mi.Vector3f | None:
    return None if at is None else mi.Vector3f(*at)


def draw(representation: Any, state: Any, record: int, n: int,
         at: tuple[float, float, float] | None = None) -> tuple[np.ndarray, np.ndarray]:
    """n samples of one record: wo [n, 3], pdf [n]."""
    rng = np.random.default_rng([3, record])
    u = (rng.integers(0, 1 << 24, (3, n)) / (1 << 24)).astype(np.float32)           # 0 and 1 - 2^-24 included
    u[:, :8] = np.array([[0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 1, 1, 0, 0, 1, 1], [0, 1, 0, 1, 0, 1, 0, 1]]) * (1 - 2**-24)
    wo, pdf = representation.sample(state, dr.full(mi.UInt32, record, n), mi.Float(u[0]), mi.Point2f(u[1], u[2]),
                                    True, place(at))
    return np.array(wo).T, np.array(pdf, np.float64) * np.ones(n)


def density_is_valid(representation: Any, case: Case) -> None:
    """Finite, >= 0, and 0 below the horizon."""
    state, wo = case.train(representation), queries(case)
    for record in range(RECORDS):
        pdf = density(representation, state, record, wo, case.at)
        assert np.isfinite(pdf).all(), f"record {record}: pdf {pdf[~np.isfinite(pdf)][0]} at {wo[~np.isfinite(pdf)][0]}"
        assert (pdf >= 0).all(), f"record {record}: pdf {pdf.min()} at {wo[pdf.argmin()]}"
        assert (pdf[wo[:, 2] <= 0] == 0).all(), f"record {record}: light from below the horizon"


def sample_reports_pdf(representation: Any, case: Case, n: int = 1 << 16) -> None:
    """The density that sample() returns is the one that pdf() gives for the direction; directions have unit length."""
    state = case.train(representation)
    for record in range(RECORDS):
        wo, pdf = draw(representation, state, record, n, case.at)
        again = density(representation, state, record, wo, case.at)
        assert np.isfinite(wo).all() and np.isfinite(pdf).all() and (pdf >= 0).all(), f"record {record}: not finite"
        alive = pdf > 0
        assert (wo[alive, 2] > 0).all(), f"record {record}: sample below the horizon with pdf > 0"
        assert np.allclose(np.linalg.norm(wo[alive], axis=1), 1, atol=1e-5), f"record {record}: not a unit vector"
        wrong = alive & ~np.isclose(pdf, again, rtol=1e-3, atol=0)
        assert not wrong.any(), (f"record {record}: {wrong.sum()} of {n} samples report another pdf, e.g. "
                                 f"{pdf[wrong][0]} instead of {again[wrong][0]} at {wo[wrong][0]}")


# ---------------------------------------------------------------------------------------------- chi-square

class Proposal:
    """A density q with which any narrow density can be compared: half uniform, half around the particles at all scales.

    Around a particle the chord c is log-uniform: per solid angle 1 / (2 pi c^2 ln(LARGEST / SMALLEST)), since a cap
    within the chord c has the area pi c^2.
    """

    def __init__(self, around: np.ndarray) -> None:
        self.around = np.unique(around, axis=0)
        self.share = 0.5 if len(around) else 0.0

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Directions [n, 3], some below the horizon."""
        wo, near = uniform_directions(n, rng), rng.random(n) < self.share
        if not near.any():
            return wo
        n = near.sum()
        axis = self.around[rng.integers(0, len(self.around), n)].astype(np.float64)
        c, phi = SMALLEST * (LARGEST / SMALLEST) ** rng.random(n), 2 * np.pi * rng.random(n)
        s = np.cross(axis, np.where(np.abs(axis[:, :1]) < 0.6, [[1, 0, 0]], [[0, 1, 0]]))
        s /= np.linalg.norm(s, axis=-1, keepdims=True)
        tangent = s * np.cos(phi)[:, None] + np.cross(axis, s) * np.sin(phi)[:, None]
        wo[near] = axis * (1 - c * c / 2)[:, None] + tangent * (c * np.sqrt(1 - c * c / 4))[:, None]
        return wo

    def pdf(self, wo: np.ndarray) -> np.ndarray:
        """q [1/sr] at directions above the horizon."""
        q = np.full(len(wo), (1 - self.share) / (2 * np.pi))
        for axis in self.around:
            c2 = np.sum((wo - axis) ** 2, -1)
            inside = (c2 > SMALLEST**2) & (c2 < LARGEST**2)
            q[inside] += self.share / len(self.around) / (2 * np.pi * np.log(LARGEST / SMALLEST) * c2[inside])
        return q


def samples_follow_pdf(representation: Any, case: Case) -> None:
    """Chi-square of samples against pdf() over the bins of the square; integral of pdf() = share of samples alive.

    Grids miss narrow lobes and plain Monte Carlo integrals of pdf() are heavy-tailed.  So with x from sample(), y from
    a proposal q and f = pdf(), compare in each bin B the means of 1_B q / (q + f) over x and 1_B f / (q + f) over y:
    both estimate the integral of f q / (q + f) over B if x follows f, and neither has terms above 1.
    """
    state = case.train(representation)
    level = 1 - (1 - SIGNIFICANCE) ** (1 / (2 * RECORDS))                   # Sidak
    for record in range(RECORDS):
        proposal = Proposal(case.directions(record))
        n = 1 << (17 if len(proposal.around) <= 10 else 15)
        x, pdf = draw(representation, state, record, n, case.at)
        y = proposal.draw(n, np.random.default_rng([4, record]))
        x, y = x[pdf > 0], y[y[:, 2] > 0]
        (f_x, q_x), (f_y, q_y) = ((density(representation, state, record, wo, case.at), proposal.pdf(wo)) for wo in (x, y))
        sampled, variance_x = _binned(q_x / (q_x + f_x), x, n)
        expected, variance_y = _binned(f_y / (q_y + f_y), y, n)
        variance = variance_x + variance_y
        z = (sampled.sum() - expected.sum()) / np.sqrt(variance.sum())
        assert abs(z) < stats.norm.isf(level / 2), (f"record {record}: integral of pdf and share of samples alive "
                                                    f"differ by {z:.1f} sd")
        # Bins with few terms are pooled, so that sums are close to normal and their variances known.
        group = np.where((sampled + expected) * n < 50, 0, np.arange(1, BINS**2 + 1))
        group = np.unique(group, return_inverse=True)[1]
        sampled, expected, variance = (np.bincount(group, a) for a in (sampled, expected, variance))
        z2 = (sampled - expected) ** 2 / np.maximum(variance, 1e-30)
        p_value, worst = stats.chi2.sf(z2.sum(), len(z2)), np.argmax(z2)
        assert p_value > level, (f"record {record}: samples don't follow the pdf: chi-square {z2.sum():.0f} for "
                                 f"{len(z2)} bins, p = {p_value:.1e}; worst bin {sampled[worst]:.2e} instead of "
                                 f"{expected[worst]:.2e}")


def _binned(terms: np.ndarray, wo: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Means over n trials of the terms in each bin of the square, and the variances of these means [BINS^2]."""
    s = np.array(from_hemisphere(vector(wo))) if len(wo) else np.zeros((2, 0))
    x, y = np.clip((s * BINS).astype(int), 0, BINS - 1)
    mean, square = (np.bincount(y * BINS + x, t, BINS**2) / n for t in (terms, terms**2))
    return mean, (square - mean**2) / n


# ---------------------------------------------------------------------------------------------- learning

def states_equal(a: Any, b: Any) -> bool:
    """Bit for bit."""
    a, b = to_numpy(a), to_numpy(b)
    return a.keys() == b.keys() and all(a[k].tobytes() == b[k].tobytes() for k in a)


def records_of(state: Any, records: Any) -> Any:
    """The state that consists of some records of `state`, in that order."""
    rows = {k: v.reshape(RECORDS, -1)[records] for k, v in to_numpy(state).items()}
    return from_numpy(state, {k: np.ascontiguousarray(v).ravel() for k, v in rows.items()})


def weight_scale_is_irrelevant(representation: Any, case: Case) -> None:
    """Weights times a constant give the same density."""
    wo = queries(case)
    states = [case.train(representation, scale) for scale in (1, 2.0**-20, 2.0**20)]
    for record in range(RECORDS):
        pdf = [density(representation, state, record, wo) for state in states]
        for scaled in pdf[1:]:
            close = np.isclose(scaled, pdf[0], rtol=1e-3, atol=1e-6)
            assert close.all(), f"record {record}: pdf {scaled[~close][0]} instead of {pdf[0][~close][0]}"


def update_is_pure(representation: Any, case: Case) -> None:
    """The argument is left alone, the same arguments give the same bits, and the size doesn't change."""
    state = representation.init(RECORDS, seed=1)
    assert states_equal(state, representation.init(RECORDS, seed=1))
    size = bytes_of(state)
    for seed, particles in enumerate(case.batches):
        dr.eval(state)
        before = {k: v.copy() for k, v in to_numpy(state).items()}
        new = representation.update(state, batch(particles), seed)
        dr.eval(new)
        again = representation.update(state, batch(particles), seed)
        assert states_equal(new, again), "the same update gave another result"
        assert all(before[k].tobytes() == v.tobytes() for k, v in to_numpy(state).items()), "the argument changed"
        assert bytes_of(new) == size, f"a state of {size} bytes grew to {bytes_of(new)}"
        state = new


def records_are_independent(representation: Any, case: Case) -> None:
    """What a record learns doesn't depend on the particles of other records."""
    for kept in range(0, RECORDS, 2):
        state = other = representation.init(RECORDS, seed=1)
        rng = np.random.default_rng([5, kept])
        for seed, particles in enumerate(case.batches):
            others = [(lobes(n, rng), np.ones(n, np.float32)) for n in rng.integers(0, 100, RECORDS)]
            state = representation.update(state, batch(particles), seed)
            others[kept] = particles[kept]
            other = representation.update(other, batch(others), seed)
        dr.eval(state, other)
        assert states_equal(records_of(state, [kept]), records_of(other, [kept])), f"record {kept} noticed the others"


def order_of_records_is_irrelevant(representation: Any, case: Case) -> None:
    """Permuted records give permuted results: for those whose random numbers don't depend on the record's index."""
    order = np.random.default_rng(5).permutation(RECORDS)
    state = representation.init(RECORDS, seed=1)
    other = records_of(state, order)
    for seed, particles in enumerate(case.batches):
        state = representation.update(state, batch(particles), seed)
        other = representation.update(other, batch([particles[r] for r in order]), seed)
    dr.eval(state, other)
    assert states_equal(records_of(state, order), other)


def nothing_new_changes_nothing(representation: Any, case: Case) -> None:
    """A batch without particles, or with zero weights only, keeps every density."""
    state, wo = case.train(representation), queries(case)
    empty: Particles = [(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))] * RECORDS
    zeros: Particles = [(lobes(50, np.random.default_rng(6)), np.zeros(50, np.float32))] * RECORDS
    for name, particles in (("no particles", empty), ("zero weights", zeros)):
        after = representation.update(state, batch(particles), 7)
        for record in range(RECORDS):
            pdf, kept = (density(representation, s, record, wo) for s in (after, state))
            assert np.allclose(pdf, kept, rtol=1e-3, atol=1e-6), f"record {record}: {name} changed the density"


def records_can_be_appended(representation: Any, case: Case) -> None:
    """New records begin as init() makes them, leave the old ones alone, and learn."""
    state, fresh, wo = case.train(representation), representation.init(2, seed=8), queries(case)
    longer = append(state, fresh)
    for record in range(RECORDS):
        assert (density(representation, longer, record, wo) == density(representation, state, record, wo)).all()
    for record in range(2):
        new = density(representation, longer, RECORDS + record, wo)
        assert (new == density(representation, fresh, record, wo)).all()
    particles = [(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))] * RECORDS
    particles += [(lobes(200, np.random.default_rng(9)), np.ones(200, np.float32))] * 2
    longer = representation.update(longer, batch(particles), 9)
    for record in range(RECORDS):
        pdf, kept = (density(representation, s, record, wo) for s in (longer, state))
        assert np.allclose(pdf, kept, rtol=1e-3, atol=1e-6), f"record {record} changed with the new ones"


def inactive_lanes_are_harmless(representation: Any, case: Case) -> None:
    """Lanes that are switched off may hold any record; the others don't notice."""
    state, n = case.train(representation), 256
    active = dr.arange(mi.UInt32, n) % 2 == 0
    record = dr.select(active, mi.UInt32(0), mi.UInt32(0xFFFFFFFF))
    rng = np.random.default_rng(10)
    u, v = mi.Float(rng.random(n).astype(np.float32)), mi.Point2f(rng.random((2, n)).astype(np.float32))
    wo, pdf = representation.sample(state, record, u, v, active)
    expected, expected_pdf = representation.sample(state, dr.zeros(mi.UInt32, n), u, v)
    again = representation.pdf(state, record, wo, active)
    pairs = {"pdf of sample": (pdf, expected_pdf), "wo of sample": (wo.z, expected.z), "pdf": (again, expected_pdf)}
    for name, (a, b) in pairs.items():
        a, b = np.array(a)[::2], np.array(b)[::2]
        assert np.allclose(a, b, rtol=1e-3), f"{name} differs by up to {np.abs(a - b).max():.1e}"
