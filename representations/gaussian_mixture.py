"""Mixtures of bivariate Gaussians on the equal-area square, learnt on-line (Vorba et al. 2014).

    p(wo) = 1 / (2 pi) sum_j pi_j N(s(wo) | mu_j, Sigma_j),   s: hemisphere -> [0, 1]^2  (representations.square)

As in the paper the Gaussians are not cut at the square's border: a sample beyond it fails, about 1 % of them once a record
is trained, and the integral of the density over the hemisphere is below 1 by as much.  Our choice: until a record has
seen `first_fit` particles it keeps them and is the cosine lobe.  :mod:`representations.stepwise_em` does the learning.

Parallax (Ruppert et al. 2020): a component learns the harmonic mean t_j of its particles' distances, and from a point `at`
its mean direction d_j is that of t_j d_j - at; the covariance on the square stays.
"""
from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from representations import square
from representations.cosine import cosine_pdf, sample_cosine
from representations.interface import ParticleBatch
from representations.parallax import aim
from representations.state import join
from representations.stepwise_em import EXPONENT, Lobes, Particle, Statistics, StepwiseEM, exp2_negative

LOBE_FIELDS = 6             # arrays of Lobes
MOMENT_FIELDS = 4           # arrays of Statistics with an entry for every component, but for `near`
AIM_FIELDS = 4
GAUSSIAN = square.TO_SOLID_ANGLE / (2 * dr.pi * EXPONENT)      # density of one lobe at its mean, times 1 / |R| [1/sr]


@dataclass
class GaussianMixtureState:
    """Of each record: K lobes for queries, what EM remembers besides, the particles that wait for the first fit."""
    lobes: mi.Float         # [n_records * 6 * K] weight, mean_x, mean_y, r_xx, r_xy, r_yy, K of each; 0: untrained
    aims: mi.Float          # [n_records * 4 * K] direction of the mean x, y, z and 1 / distance, K of each; empty: no parallax
    moments: mi.Float       # [n_records * 4 * K] mass, d_xx, d_xy, d_yy, K of each
    mean_weight: mi.Float   # [n_records] running mean of the particles' weights
    squares: mi.Float       # [n_records] sum of the squared shares of particles in the moments
    visits: mi.UInt32       # [n_records] k of the step size; 0: untrained
    count: mi.UInt32        # [n_records] particles that wait
    waiting: mi.Float       # [n_records * first_fit * 3] their points on the square and weights; 4 with parallax: 1 / distances


class GaussianMixture:
    """K Gaussians a record by weighted stepwise MAP EM.

    Args:
        components: K, Gaussians in a mixture.
        alpha: step size (k + 1)^-alpha of on-line EM, in (0.5, 1].
        a, b: inverse Wishart prior of the covariances, a > 2, b > 0 [square^2].  Our b is a tenth of the library's: with
            its 5e-4, 1,000 particles leave the sun's disk at twice its variance (mean ln pdf 3.99 instead of 4.16).
        v: Dirichlet prior of the weights, >= 1.
        eigenvalue_floor: smallest eigenvalue of a covariance [square^2]; the sun's disk has 8e-7.
        first_fit: particles that a record collects before its first fit; 10 K if None.
        max_sweeps: most sweeps of the first fit.
        tolerance: relative change of the mean log likelihood at which the first fit ends.
        weight_clamp: heavier particles count as this many times the running mean weight; infinity switches it off.  So
            no group of equal particles that is a 1 / `weight_clamp` of all is ever clamped.
        start_variance: of the components that start at particles [square^2].

    Raises:
        ValueError: a value out of its range.
    """

    def __init__(self, components: int = 8, alpha: float = 0.7, a: float = 2.01, b: float = 5e-5, v: float = 1.01,
                 eigenvalue_floor: float = 1e-7, first_fit: int | None = None, max_sweeps: int = 20,
                 tolerance: float = 1e-3, weight_clamp: float = 10.0, start_variance: float = 0.01) -> None:
        first_fit = 10 * components if first_fit is None else first_fit
        for name, value, ok, allowed in (
                ("components", components, 1 <= components <= 64, "in 1 .. 64"),
                ("alpha", alpha, 0.5 < alpha <= 1, "in (0.5, 1]"),
                ("a", a, 2 < a < math.inf, "> 2"),
                ("b", b, 0 < b < math.inf, "> 0"),
                ("v", v, 1 <= v < math.inf, ">= 1"),
                ("eigenvalue_floor", eigenvalue_floor, 1e-10 <= eigenvalue_floor <= 0.1, "in [1e-10, 0.1]"),
                ("first_fit", first_fit, isinstance(first_fit, int) and first_fit >= 1, "a whole number >= 1"),
                ("max_sweeps", max_sweeps, max_sweeps >= 1, ">= 1"),
                ("tolerance", tolerance, 0 <= tolerance < 1, "in [0, 1)"),
                ("weight_clamp", weight_clamp, weight_clamp > 1, "> 1"),
                ("start_variance", start_variance, 0 < start_variance <= 1, "in (0, 1]")):
            if not ok:
                raise ValueError(f"{name} = {value!r}: must be {allowed}")
        self.components = components
        self.first_fit = first_fit
        self.em = StepwiseEM(components, alpha, a, b, v, eigenvalue_floor, max_sweeps, tolerance, weight_clamp, start_variance)

    # ---- State

    def init(self, n_records: int, seed: int = 0, parallax: bool = False) -> GaussianMixtureState:
        state = GaussianMixtureState(
            lobes=dr.zeros(mi.Float, n_records * LOBE_FIELDS * self.components),
            aims=dr.zeros(mi.Float, n_records * AIM_FIELDS * self.components if parallax else 0),
            moments=dr.zeros(mi.Float, n_records * MOMENT_FIELDS * self.components),
            mean_weight=dr.zeros(mi.Float, n_records), squares=dr.zeros(mi.Float, n_records),
            visits=dr.zeros(mi.UInt32, n_records), count=dr.zeros(mi.UInt32, n_records),
            waiting=dr.zeros(mi.Float, n_records * self.first_fit * (4 if parallax else 3)))
        dr.make_opaque(state)
        return state

    def update(self, state: GaussianMixtureState, batch: ParticleBatch, seed: int = 0) -> GaussianMixtureState:
        """Sweep the batch once for trained records; fit those that have enough particles now; keep those of the others.

        Raises:
            ValueError: the batch and the state have not as many records.
        """
        n = len(state.visits)
        if batch.n_records != n:
            raise ValueError(f"a batch of {batch.n_records} records for a state of {n}")
        if n == 0 or len(batch) == 0:
            return replace(state)
        record = dr.arange(mi.UInt32, n)
        begin = dr.gather(mi.UInt32, batch.offset, record)
        count = dr.gather(mi.UInt32, batch.offset, record + 1) - begin
        trained = state.visits > 0
        # Side by side: one load a particle instead of four gathers
        wo, inverse_distance = batch.aimed() if len(state.aims) else (batch.wo, mi.Float(0))
        s = square.from_hemisphere(wo)
        points = dr.ravel(mi.Vector4f(s.x, s.y, batch.weight, inverse_distance))
        dr.eval(points)

        def particle(i: mi.UInt32) -> Particle:
            p = dr.gather(mi.Vector4f, points, begin + i)
            return p.x, p.y, p.z, p.w

        new = replace(state, lobes=dr.empty(mi.Float, len(state.lobes)), aims=dr.empty(mi.Float, len(state.aims)),
                      moments=dr.empty(mi.Float, len(state.moments)),
                      mean_weight=dr.empty(mi.Float, n), squares=dr.empty(mi.Float, n), visits=dr.empty(mi.UInt32, n))
        self._store(new, record, *self.em.online(particle, dr.select(trained, count, 0), *self._load(state, record)))
        untrained = ~trained & (count > 0)
        return self._begin(new, batch, points, begin, count, untrained, seed) if dr.any(untrained) else new

    def _begin(self, state: GaussianMixtureState, batch: ParticleBatch, points: mi.Float, begin: mi.UInt32,
               count: mi.UInt32, untrained: mi.Bool, seed: int) -> GaussianMixtureState:
        """First fits, for the records that have enough particles by now; the others' particles join those that wait."""
        heavy = batch.weight > 0
        rank = dr.prefix_sum(join(dr.select(heavy, mi.UInt32(1), 0), dr.zeros(mi.UInt32, 1)))
        dr.eval(heavy, rank)
        rank_begin = dr.gather(mi.UInt32, rank, begin)
        seen = state.count + dr.gather(mi.UInt32, rank, begin + count) - rank_begin
        ready = untrained & (seen >= self.first_fit)
        keep = untrained & ~ready
        new = replace(state, count=dr.select(keep, seen, dr.select(ready, 0, state.count)))

        waiting = mi.Float(state.waiting)
        slot = dr.gather(mi.UInt32, state.count, batch.record) + (
            dr.gather(mi.UInt32, rank, dr.arange(mi.UInt32, len(batch))) - dr.gather(mi.UInt32, rank_begin, batch.record))
        entry = mi.Vector4f if len(state.aims) else mi.Vector3f
        fresh = dr.gather(mi.Vector4f, points, dr.arange(mi.UInt32, len(batch)))
        dr.scatter(waiting, entry(*list(fresh)[:dr.size_v(entry)]), batch.record * self.first_fit + slot,
                   heavy & dr.gather(mi.Bool, keep, batch.record))
        new.waiting = waiting
        dr.eval(new)

        record = dr.compress(ready)
        if len(record) == 0:
            return new
        if len(record) == 1:                    # arrays of one entry are compiled as constants: keep to one kernel
            record = dr.concat([record, record])
        first, stored = dr.gather(mi.UInt32, begin, record), dr.gather(mi.UInt32, state.count, record)

        def particle(i: mi.UInt32) -> Particle:
            old, slot = i < stored, record * self.first_fit + i
            p = dr.gather(mi.Vector4f, points, first + i - stored, ~old)
            w = dr.gather(entry, state.waiting, slot, old)
            return (dr.select(old, w.x, p.x), dr.select(old, w.y, p.y), dr.select(old, w.z, p.z),
                    dr.select(old, w.w, p.w) if len(state.aims) else p.w)

        state_bits, stream_bits = mi.sample_tea_32(record, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), rounds=8)
        rng = mi.PCG32(initstate=mi.UInt64(state_bits), initseq=mi.UInt64(stream_bits))
        fit = self.em.first_fit(particle, stored + dr.gather(mi.UInt32, count, record),
                                mi.Float(dr.gather(mi.UInt32, seen, record)), rng, len(state.aims) > 0)
        new = replace(new, lobes=mi.Float(new.lobes), aims=mi.Float(new.aims), moments=mi.Float(new.moments),
                      mean_weight=mi.Float(new.mean_weight), squares=mi.Float(new.squares), visits=mi.UInt32(new.visits))
        self._store(new, record, *fit)
        return new

    def _load(self, state: GaussianMixtureState, record: mi.UInt32) -> tuple[Lobes, Statistics]:
        shape = (MOMENT_FIELDS * self.components, dr.width(record))
        mass, d_xx, d_xy, d_yy = self._fields(dr.gather(mi.ArrayXf, state.moments, record, shape=shape))
        near = None
        if len(state.aims):
            *_, inverse_distance = self._aims(state, record, True)
            near = mass * inverse_distance
        return self._lobes(state, record, True, None), Statistics(
            mass, d_xx, d_xy, d_yy, near, dr.gather(mi.Float, state.mean_weight, record),
            dr.gather(mi.Float, state.squares, record), dr.gather(mi.UInt32, state.visits, record))

    def _store(self, state: GaussianMixtureState, record: mi.UInt32, lobes: Lobes, statistics: Statistics) -> None:
        """Write to the arrays of `state`, which must be our own.  One evaluation: the loop behind the values runs once."""
        l, s = lobes, statistics
        dr.scatter(state.lobes, _concatenate(l.weight, l.mean_x, l.mean_y, l.r_xx, l.r_xy, l.r_yy), record)
        if s.near is not None:
            d = [square.to_hemisphere(dr.clip(mi.Point2f(mean), 0, 1)) for mean in zip(l.mean_x, l.mean_y, strict=True)]
            dr.scatter(state.aims, _concatenate(*zip(*d, strict=True), s.near / dr.maximum(s.mass, 1e-30)), record)
        dr.scatter(state.moments, _concatenate(s.mass, s.d_xx, s.d_xy, s.d_yy), record)
        dr.scatter(state.mean_weight, s.mean_weight, record)
        dr.scatter(state.squares, s.squares, record)
        dr.scatter(state.visits, s.visits, record)
        dr.eval(state)

    def _lobes(self, state: GaussianMixtureState, record: mi.UInt32, active: mi.Bool, at: mi.Vector3f | None) -> Lobes:
        """All lobes of a record in one packet gather, as seen from `at`; r = 0 where it is untrained."""
        shape = (LOBE_FIELDS * self.components, dr.width(record))
        lobes = Lobes(*self._fields(dr.gather(mi.ArrayXf, state.lobes, record, active, shape=shape)))
        if at is not None and len(state.aims):
            x, y, z, inverse_distance = self._aims(state, record, active)
            x, y, z, _ = aim((x, y, z), inverse_distance, at)
            lobes.mean_x, lobes.mean_y = square.components_from_hemisphere(x, y, z)
        return lobes

    def _aims(self, state: GaussianMixtureState, record: mi.UInt32, active: mi.Bool) -> Iterator[mi.ArrayXf]:
        """Directions of the means, and 1 / their distances."""
        shape = (AIM_FIELDS * self.components, dr.width(record))
        return self._fields(dr.gather(mi.ArrayXf, state.aims, record, active, shape=shape))

    def _fields(self, packet: mi.ArrayXf) -> Iterator[mi.ArrayXf]:
        k = self.components
        return (mi.ArrayXf([packet[i + j] for j in range(k)]) for i in range(0, len(packet), k))

    # ---- Density

    def sample(self, state: GaussianMixtureState, record: mi.UInt32, sample1: mi.Float, sample2: mi.Point2f,
               active: mi.Bool = True, at: mi.Vector3f | None = None) -> tuple[mi.Vector3f, mi.Float]:
        lobes = self._lobes(state, record, active, at)
        trained = lobes.r_xx[0] > 0
        # Choose a component by sample1, then solve R (s - mean) = z for a standard normal z
        chosen = [field[0] for field in (lobes.mean_x, lobes.mean_y, lobes.r_xx, lobes.r_xy, lobes.r_yy)]
        cdf = mi.Float(0)
        for j in range(1, self.components):
            cdf = cdf + lobes.weight[j - 1]
            beyond = sample1 >= cdf
            chosen = [dr.select(beyond, field[j], value) for field, value in zip(
                (lobes.mean_x, lobes.mean_y, lobes.r_xx, lobes.r_xy, lobes.r_yy), chosen, strict=True)]
        mean_x, mean_y, r_xx, r_xy, r_yy = chosen
        z = mi.warp.square_to_std_normal(sample2) * math.sqrt(EXPONENT)
        y = z.y / r_yy
        s = mi.Point2f(mean_x + (z.x - r_xy * y) / r_xx, mean_y + y)
        inside = (s.x >= 0) & (s.x <= 1) & (s.y >= 0) & (s.y <= 1)
        wo = dr.select(inside, square.to_hemisphere(s), mi.Vector3f(0, 0, -1))
        pdf = dr.select(wo.z > 0, _density(lobes, s), 0)
        wo_cosine, pdf_cosine = sample_cosine(sample2)
        return dr.select(trained, wo, wo_cosine), dr.select(trained, pdf, pdf_cosine)

    def pdf(self, state: GaussianMixtureState, record: mi.UInt32, wo: mi.Vector3f, active: mi.Bool = True,
            at: mi.Vector3f | None = None) -> mi.Float:
        lobes = self._lobes(state, record, active, at)
        pdf = dr.select(lobes.r_xx[0] > 0, _density(lobes, square.from_hemisphere(wo)), cosine_pdf(wo))
        return dr.select(wo.z > 0, pdf, 0)


def _density(lobes: Lobes, s: mi.Point2f) -> mi.Float:
    """Density of the mixture at points of the square [1/sr]."""
    d_x, d_y = s.x - lobes.mean_x, s.y - lobes.mean_y
    q_x, q_y = dr.fma(lobes.r_xx, d_x, lobes.r_xy * d_y), lobes.r_yy * d_y
    return GAUSSIAN * dr.sum(lobes.weight * lobes.r_xx * lobes.r_yy * exp2_negative(dr.fma(-q_x, q_x, -q_y * q_y)), axis=0)


def _concatenate(*fields: mi.ArrayXf) -> mi.ArrayXf:
    return mi.ArrayXf([component for field in fields for component in field])
