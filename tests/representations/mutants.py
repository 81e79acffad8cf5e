"""Representations that are broken on purpose, each in one way, with the check that has to reject it.

Also from the command line: ``olpm-bench check tests/representations/mutants.py:PdfTimesTwoPercent``.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from representations import discrete
from representations.cosine import CosineLobe, cosine_pdf, sample_cosine
from representations.gaussian_mixture import GaussianMixture
from representations.hey import HeyCones
from representations.interface import ParticleBatch
from representations.jensen import JensenHistogram, JensenState
from representations.parallax import aim
from representations.square import TO_SOLID_ANGLE, to_hemisphere
from representations.state import join

# ---------------------------------------------------------------------------------------------- densities

class WrongJacobian(JensenHistogram):
    """The density of a map to the projected disk, for one that keeps solid angles."""
    def _density(self, state, record, wo, total, active):
        return super()._density(state, record, wo, total, active) * 2 * dr.maximum(wo.z, 0)


class PdfTimesTwoPercent(JensenHistogram):
    """2 % too much, in sample() and pdf() alike."""
    def _density(self, *args):
        return 1.02 * super()._density(*args)


class UntrainedTwoPercent(CosineLobe):
    """2 % too much, where nothing has been learnt."""
    def sample(self, *args, **kwargs):
        wo, pdf = super().sample(*args, **kwargs)
        return wo, 1.02 * pdf

    def pdf(self, *args, **kwargs):
        return 1.02 * super().pdf(*args, **kwargs)


class PdfTimesTen(CosineLobe):
    """Ten times too much."""
    def sample(self, *args, **kwargs):
        wo, pdf = super().sample(*args, **kwargs)
        return wo, 10 * pdf

    def pdf(self, *args, **kwargs):
        return 10 * super().pdf(*args, **kwargs)


class WeightsUnnormalised(GaussianMixture):
    """The weights of the mixture sum up to 1.05."""
    def _lobes(self, *args):
        lobes = super()._lobes(*args)
        lobes.weight *= 1.05
        return lobes


class HorizonForgotten(CosineLobe):
    """|cos| / pi."""
    def pdf(self, state, record, wo, active=True, at=None):
        return dr.abs(wo.z) * dr.inv_pi


class OneNaN(JensenHistogram):
    """NaN in one record in 10,000."""
    def _density(self, state, record, *args):
        return dr.select(record % 10_000 == 9_999, dr.nan, super()._density(state, record, *args))


@dataclass
class Counted(JensenState):
    updates: Any        # [n_records] that brought particles


class LateInflation(JensenHistogram):
    """Half too much from the eleventh update on, in sample() and pdf() alike."""
    FIRST = 11

    def init(self, n_records, seed=0, parallax=False):
        return Counted(**vars(super().init(n_records, seed, parallax)), updates=dr.zeros(mi.Float, n_records))

    def update(self, state, batch, seed=0):
        taught = mi.Float(dr.minimum(batch.count(), 1))
        return Counted(**vars(super().update(JensenState(state.mass, state.cumulative), batch, seed)),
                       updates=state.updates + taught)

    def _density(self, state, record, *args):
        return super()._density(state, record, *args) * self.factor(dr.gather(mi.Float, state.updates, record), record)

    def factor(self, updates, record):
        return dr.select(updates >= self.FIRST, mi.Float(1.5), 1)


class Drift(LateInflation):
    """A thousandth too much after one update, two after two, and so on."""
    def factor(self, updates, record):
        return 1 + 1e-3 * updates


class LateNaN(LateInflation):
    """NaN from the twelfth update on."""
    def factor(self, updates, record):
        return dr.select(updates >= 12, dr.nan, mi.Float(1))


class SecondNaN(LateInflation):
    """NaN in one record in 10,000, from its second update on."""
    def factor(self, updates, record):
        return dr.select((record % 10_000 == 9_999) & (updates > 1), dr.nan, mi.Float(1))


class NegativeAtTheRim(JensenHistogram):
    """Below 0 by rounding, close to the horizon."""
    def _density(self, state, record, wo, total, active):
        pdf = super()._density(state, record, wo, total, active)
        return dr.select((wo.z > 0) & (wo.z < 1e-3) & (pdf == 0), -1e-7, pdf)


class AboveOne(JensenHistogram):
    """NaN where rounding has brought z above 1."""
    def _density(self, state, record, wo, total, active):
        pdf = super()._density(state, record, wo, total, active)
        return dr.select(dr.isnan(dr.acos(wo.z)), dr.nan, pdf)


class UntrainedNaN(JensenHistogram):
    """NaN in one record in 10,000, as long as it has learnt nothing."""
    def _density(self, state, record, wo, total, active):
        pdf = super()._density(state, record, wo, total, active)
        return dr.select((record % 10_000 == 9_999) & (total <= 0), dr.nan, pdf)


class FloatIndex(JensenHistogram):
    """pdf() counts bins in float32, which is exact up to 2^24: to the 65,536th record."""
    def _density(self, state, record, wo, total, active):
        above = active & (wo.z > 0)
        i = mi.UInt32(dr.fma(mi.Float(record), float(self.bins), mi.Float(self._bin(wo))))
        mass = dr.gather(mi.Float, state.mass, dr.minimum(i, dr.opaque(mi.UInt32, len(state.mass) - 1)), above)
        return dr.select(total > 0, mass / total * (self.bins * TO_SOLID_ANGLE), cosine_pdf(wo))


# ---------------------------------------------------------------------------------------------- samples

class DiskForCone(HeyCones):
    """Uniform on the cone's projected disk, with the density of a cone uniform in solid angle (as the original has it)."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        total = discrete.total(state.cumulative, self.cones, record, active)
        chosen = discrete.choose(state.cumulative, self.cones, record, sample1 * total, active)
        cone = self._cone(state, record * self.cones + chosen, active, at)
        versine = 0.5 * cone.w                          # of the half angle
        sin_alpha = dr.safe_sqrt(versine * (2 - versine) * sample2.x)
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * sample2.y)
        local = mi.Vector3f(sin_alpha * cos_phi, sin_alpha * sin_phi, dr.safe_sqrt(1 - sin_alpha * sin_alpha))
        wo = dr.select(total > 0, mi.Frame3f(mi.Vector3f(cone.xyz)).to_world(local), sample_cosine(sample2)[0])
        return wo, self._density(state, record, wo, total, active, at)


class SamplesBelowHorizon(CosineLobe):
    """One sample in a hundred points into the surface, and reports a density."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        wo, pdf = sample_cosine(sample2)
        wo.z = dr.select(sample1 < 0.01, -wo.z, wo.z)
        return wo, pdf


class NumbersIgnored(CosineLobe):
    """The same samples, whatever the random numbers."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        return sample_cosine(mi.Point2f(0.3, 0.7) + 0 * sample2)


class NumbersShared(CosineLobe):
    """One random number for two."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        return sample_cosine(mi.Point2f(sample2.x, sample2.x))


class LastBinLost(JensenHistogram):
    """The last bin is never chosen: the mass is searched in one bin too few."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        total = discrete.total(state.cumulative, self.bins, record, active)
        chosen = dr.minimum(discrete.choose(state.cumulative, self.bins, record, sample1 * total, active), self.bins - 2)
        corner = mi.Point2f(mi.Float(chosen % self.resolution), mi.Float(chosen // self.resolution))
        wo = dr.select(total > 0, to_hemisphere((corner + sample2) / self.resolution), sample_cosine(sample2)[0])
        return wo, self._density(state, record, wo, total, active)


class NextBin(JensenHistogram):
    """pdf() and sample() look into the neighbour's bin."""
    def _bin(self, wo):
        return super()._bin(wo) ^ 1


class NeighboursPdf(JensenHistogram):
    """pdf() answers for the record beside."""
    def pdf(self, state, record, wo, active=True, at=None):
        return super().pdf(state, (record + 1) % (dr.width(state.mass) // self.bins), wo, active, at)


class StaleSamples(JensenHistogram):
    """Samples follow the state before the last update."""
    def update(self, state, batch, seed=0):
        return replace(super().update(state, batch, seed), cumulative=discrete.accumulate(state.mass, self.bins))


class ReportsAnother(JensenHistogram):
    """sample() reports 1 % too much for one sample in a hundred."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        wo, pdf = super().sample(state, record, sample1, sample2, active, at)
        return wo, dr.select(sample1 > 0.99, 1.01 * pdf, pdf)


class FailsAboveHorizon(CosineLobe):
    """Samples that fail, with directions that look like good ones."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        wo, pdf = sample_cosine(sample2)
        return wo, dr.select(sample1 < 0.05, 0, 0.95 * pdf)

    def pdf(self, state, record, wo, active=True, at=None):
        return 0.95 * cosine_pdf(wo)


class LanesCounted(CosineLobe):
    """Lanes that are switched off count."""
    def pdf(self, state, record, wo, active=True, at=None):
        some = dr.mean(dr.select(active, mi.Float(1), 0)) if dr.width(active) > 1 else mi.Float(1)
        return cosine_pdf(wo) * some


class ActiveForgotten(JensenHistogram):
    """Lanes that are switched off read the state all the same."""
    def pdf(self, state, record, wo, active=True, at=None):
        return super().pdf(state, record, wo, True, at)


class DividesByZero(JensenHistogram):
    """An infinite direction where a random number is exactly 0 and something has been learnt."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        wo, pdf = super().sample(state, record, sample1, sample2, active, at)
        learnt = discrete.total(state.cumulative, self.bins, record, active) > 0
        wo.x += dr.select(learnt, 1e-30 / sample2.x, 0)
        return wo, pdf


class ParallaxInSamplesOnly(HeyCones):
    """pdf() doesn't mind from where it is asked."""
    def pdf(self, state, record, wo, active=True, at=None):
        return super().pdf(state, record, wo, active)


class ParallaxBelowTheHorizon(CosineLobe):
    """Asked from beside the record, pdf() forgets the horizon."""
    def pdf(self, state, record, wo, active=True, at=None):
        return cosine_pdf(wo) if at is None else dr.abs(wo.z) * dr.inv_pi


class ParallaxTenPercent(HeyCones):
    """10 % too much where it is asked from beside the record, in sample() and pdf() alike."""
    def _density(self, state, record, wo, total, active, at):
        return super()._density(state, record, wo, total, active, at) * (1 if at is None else 1.1)


class ParallaxNaN(HeyCones):
    """NaN in one record in 1,000, where it is asked from beside."""
    def _density(self, state, record, wo, total, active, at):
        pdf = super()._density(state, record, wo, total, active, at)
        return pdf if at is None else dr.select(record % 1000 == 999, dr.nan, pdf)


class NoPlaceAsked(HeyCones):
    """Half too much where a state with parallax is asked without a place."""
    def _density(self, state, record, wo, total, active, at):
        return (1.5 if at is None and len(state.near) else 1.0) * super()._density(state, record, wo, total, active, at)


class ParallaxNotReported(HeyCones):
    """sample() reports the density as it is at the record."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        wo, _ = super().sample(state, record, sample1, sample2, active, at)
        return wo, super().pdf(state, record, wo, active)


class NaNAtTheRecord(HeyCones):
    """Normalises the vector to the point from which it is asked, which may be 0."""
    def _density(self, state, record, wo, total, active, at):
        pdf = super()._density(state, record, wo, total, active, at)
        return pdf if at is None else dr.select(dr.isnan(dr.normalize(at).z), dr.nan, pdf)


class ParallaxActiveForgotten(HeyCones):
    """Reads distances in lanes that are switched off."""
    def _cone(self, state, i, active, at):
        cone = dr.gather(mi.Vector4f, state.cone, i, active)
        if at is not None and len(state.near):
            x, y, z, _ = aim((cone.x, cone.y, cone.z), dr.gather(mi.Float, state.near, i), at)
            cone = mi.Vector4f(x, y, z, cone.w)
        return cone


class ParallaxWrongWay(GaussianMixture):
    """Aims from the record's other side, in sample() and pdf() alike."""
    def _lobes(self, state, record, active, at):
        return super()._lobes(state, record, active, None if at is None else -at)


# ---------------------------------------------------------------------------------------------- images

class PdfTenPercentOfTrained(JensenHistogram):
    """pdf() is 10 % too large for records that have learnt something; sample() reports the right density."""
    def pdf(self, state, record, wo, active=True, at=None):
        learnt = discrete.total(state.cumulative, self.bins, record, active) > 0
        return super().pdf(state, record, wo, active, at) * dr.select(learnt, 1.1, 1)


class OneSideNeverSampled(JensenHistogram):
    """Of trained records only directions with x > 0 are sampled; all have their density."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        wo, _ = super().sample(state, record, sample1, sample2, active, at)
        wo.x = dr.select(discrete.total(state.cumulative, self.bins, record, active) > 0, dr.abs(wo.x), wo.x)
        return wo, super().pdf(state, record, wo, active, at)


# ---------------------------------------------------------------------------------------------- updates

class InPlace(JensenHistogram):
    """update() writes to the state that it was given."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        dr.eval(new)
        state.mass, state.cumulative = new.mass, new.cumulative
        return new


class Unseeded(HeyCones):
    """Random numbers of a generator that nobody seeds."""
    generator = np.random.default_rng()

    def update(self, state, batch, seed=0):
        return super().update(state, batch, int(self.generator.integers(2**32)))


class UnseededWhenFull(JensenHistogram):
    """Of more than 1,000 particles in a batch, learns from a half that no seed determines."""
    random = np.random.default_rng()

    def update(self, state, batch, seed=0):
        if len(batch) == 0:
            return state
        full = dr.gather(mi.UInt32, batch.count(), batch.record) > 1000
        dropped = full & (mi.Float(self.random.random(len(batch), np.float32)) < 0.5)
        return super().update(state, replace(batch, weight=dr.select(dropped, 0, batch.weight)), seed)


class KeepsBatches(JensenHistogram):
    """Keeps all particles, but not in its state."""
    def __init__(self, resolution: int = 16) -> None:
        super().__init__(resolution)
        self.kept: list[ParticleBatch] = []

    def update(self, state, batch, seed=0):
        self.kept.append(batch)
        return super().update(state, batch, seed)


class ParallaxInPlace(HeyCones):
    """Of the state that update() was given, it keeps all but the distances."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        state.near = new.near
        return new


class ParallaxOfNeighbours(HeyCones):
    """Distances are those of the next record."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        n = len(new.near)
        return replace(new, near=dr.gather(mi.Float, new.near, (dr.arange(mi.UInt32, n) + self.cones) % n)) if n else new


class ParallaxGrows(HeyCones):
    """Keeps all distances."""
    def update(self, state, batch, seed=0):
        if len(state.near) == 0:
            return super().update(state, batch, seed)
        known = dr.gather(mi.Float, state.near, dr.arange(mi.UInt32, len(state.weight)))
        new = super().update(replace(state, near=known), batch, seed)
        return replace(new, near=join(new.near, batch.distance))


class ScaleMatters(JensenHistogram):
    """A prior in the unit of the weights."""
    def update(self, state, batch, seed=0):
        mass = super().update(state, batch, seed).mass + 1e-3
        return JensenState(mass, discrete.accumulate(mass, self.bins))


class OrderMatters(JensenHistogram):
    """Records of odd numbers learn from one half of their particles."""
    def update(self, state, batch, seed=0):
        weight = dr.select((batch.record % 2 == 0) | (batch.wo.x > 0), batch.weight, 0)
        return super().update(state, replace(batch, weight=weight), seed)


class NeighboursListen(JensenHistogram):
    """A hundredth of each particle is learnt by the next record."""
    def update(self, state, batch, seed=0):
        n = batch.n_records
        both = ParticleBatch.from_arrays(
            mi.Vector3f(*(join(c, c) for c in batch.wo)), join(batch.weight, 0.01 * batch.weight),
            join(batch.record, (batch.record + 1) % n), n) if len(batch) else batch
        return super().update(state, both, seed)


class NothingIsNews(JensenHistogram):
    """Half is forgotten with each batch, of whatever, and a little is learnt from nothing."""
    def update(self, state, batch, seed=0):
        mass = super().update(state, batch, seed).mass
        mass = mass + 0.01 * dr.repeat(dr.block_sum(mass, self.bins), self.bins)
        return JensenState(mass, discrete.accumulate(mass, self.bins))


class FirstRecordsOnly(JensenHistogram):
    """Remembers how many records it had at first: those appended get nothing."""
    first = 0

    def init(self, n_records, seed=0, parallax=False):
        self.first = self.first or n_records
        return super().init(n_records, seed, parallax)

    def _density(self, state, record, *args):
        return dr.select(record < dr.opaque(mi.UInt32, self.first), super()._density(state, record, *args), 0)


@dataclass
class Summed(JensenState):
    total: Any              # of all records


class NumberOfAll(JensenHistogram):
    """The state has a number that belongs to no record."""
    def init(self, n_records, seed=0, parallax=False):
        return Summed(**vars(super().init(n_records, seed, parallax)), total=dr.zeros(mi.Float, 1))

    def update(self, state, batch, seed=0):
        return Summed(**vars(super().update(JensenState(state.mass, state.cumulative), batch, seed)), total=state.total + 1)


class NotAField(JensenHistogram):
    """What is no field of the state is lost when that is stored."""
    def update(self, state, batch, seed=0):
        new = replace(super().update(state, batch, seed))
        new.known = True
        return new

    def _density(self, state, record, wo, total, active):
        return super()._density(state, record, wo, total if hasattr(state, "known") else 0 * total, active)


class LearnsNothing(JensenHistogram):
    """update() returns what it was given."""
    def update(self, state, batch, seed=0):
        return replace(state)


class Unlearns(JensenHistogram):
    """The more particles, the wider: each batch adds the square of its size to every bin."""
    def update(self, state, batch, seed=0):
        mass = super().update(state, batch, seed).mass
        blur = dr.repeat(mi.Float(batch.count()) * 1e-4 * dr.block_sum(mass, self.bins), self.bins)
        mass = mass + blur
        return JensenState(mass, discrete.accumulate(mass, self.bins))


class FirstBatchOnly(JensenHistogram):
    """A record that has learnt something learns no more."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        mass = dr.select(self._of_bins(state) > 0, state.mass, new.mass)
        return JensenState(mass, discrete.accumulate(mass, self.bins))

    def _of_bins(self, state):
        """Mass of each bin's record."""
        return discrete.total(state.cumulative, self.bins, dr.arange(mi.UInt32, len(state.mass)) // self.bins)


class LastBatchOnly(FirstBatchOnly):
    """A record forgets what it knew with each batch that teaches it something."""
    def update(self, state, batch, seed=0):
        new = JensenHistogram.update(self, self.init(batch.n_records), batch, seed)
        mass = dr.select(self._of_bins(new) > 0, new.mass, state.mass)
        return JensenState(mass, discrete.accumulate(mass, self.bins))


class FirstHundredOnly(JensenHistogram):
    """Of each batch a record learns from its first 100 particles."""
    def update(self, state, batch, seed=0):
        rank = dr.arange(mi.UInt32, len(batch)) - dr.gather(mi.UInt32, batch.offset, batch.record)
        return super().update(state, replace(batch, weight=dr.select(rank < 100, batch.weight, 0)), seed)


class WeightsIgnored(JensenHistogram):
    """A particle is a particle, unless it weighs nothing."""
    def update(self, state, batch, seed=0):
        return super().update(state, replace(batch, weight=dr.select(batch.weight > 0, mi.Float(1), 0)), seed)


class RootsOfWeights(JensenHistogram):
    """Learns from square roots."""
    def update(self, state, batch, seed=0):
        return super().update(state, replace(batch, weight=dr.sqrt(batch.weight)), seed)


class ParallaxMirrored(GaussianMixture):
    """Learns the other side, where particles say where they landed."""
    def update(self, state, batch, seed=0):
        if batch.at is not None:
            batch = replace(batch, wo=mi.Vector3f(-batch.wo.x, -batch.wo.y, batch.wo.z))
        return super().update(state, batch, seed)


class LandingsIgnored(GaussianMixture):
    """Learns directions as if they had been seen from the record."""
    def update(self, state, batch, seed=0):
        return super().update(state, replace(batch, at=None), seed)


class CosineTwice(JensenHistogram):
    """Weights times the cosine, which they contain already."""
    def update(self, state, batch, seed=0):
        return super().update(state, replace(batch, weight=batch.weight * batch.wo.z), seed) if len(batch) else state


class SquaresOverflow(JensenHistogram):
    """Divides by the sum of squared weights, which float32 can't hold for all."""
    def update(self, state, batch, seed=0):
        if len(batch) == 0:
            return state
        squares = dr.gather(mi.Float, replace(batch, weight=dr.square(batch.weight)).sums(), batch.record)
        return super().update(state, replace(batch, weight=dr.select(squares > 0, batch.weight, 0)), seed)


class ForgetsAll(JensenHistogram):
    """Halves what all records know with each batch, until nothing is left of those that learn no more."""
    def update(self, state, batch, seed=0):
        return super().update(JensenState(state.mass / 2, state.cumulative / 2), batch, seed) if len(batch) else state


class SeedIgnored(GaussianMixture):
    """Always draws the same particles."""
    def init(self, n_records, seed=0, parallax=False):
        return super().init(n_records, 0, parallax)

    def update(self, state, batch, seed=0):
        return super().update(state, batch, 0)


class StaleRemainder(JensenHistogram):
    """Updates the sums that it samples from in chunks of 1,024 records, and leaves out the last, after the first time."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        record = dr.arange(mi.UInt32, len(new.mass)) // self.bins
        chunks = dr.opaque(mi.UInt32, batch.n_records // 1024 * 1024)
        fresh = dr.gather(mi.Float, state.cumulative, record * self.bins + self.bins - 1) == 0
        return replace(new, cumulative=dr.select(fresh | (record < chunks) | (chunks == 0), new.cumulative, state.cumulative))


class RemainderLost(JensenHistogram):
    """Learns in chunks of 1,024 records, and leaves out the last."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        learnt = dr.arange(mi.UInt32, len(new.mass)) // self.bins < dr.opaque(mi.UInt32, max(1, batch.n_records // 1024) * 1024)
        return JensenState(dr.select(learnt, new.mass, state.mass), dr.select(learnt, new.cumulative, state.cumulative))


@dataclass
class Visited(JensenState):
    seen: Any               # particles of each record


class RarelyRebuilt(JensenHistogram):
    """Updates the sums that it samples from only for a hundredth of new particles."""
    def init(self, n_records, seed=0, parallax=False):
        return Visited(**vars(super().init(n_records, seed, parallax)), seen=dr.zeros(mi.UInt32, n_records))

    def update(self, state, batch, seed=0):
        new, seen = super().update(JensenState(state.mass, state.cumulative), batch, seed), state.seen + batch.count()
        many = dr.gather(mi.Bool, batch.count() * 100 >= seen, dr.arange(mi.UInt32, len(new.mass)) // self.bins)
        return Visited(new.mass, dr.select(many, new.cumulative, state.cumulative), seen)


@dataclass
class Pointed(JensenState):
    first: Any              # where the masses of each record begin, once it has any


class Pointers(JensenHistogram):
    """Finds masses by an index into the whole array: those of the original, in a copy."""
    def init(self, n_records, seed=0, parallax=False):
        return Pointed(**vars(super().init(n_records, seed, parallax)), first=dr.zeros(mi.UInt32, n_records))

    def update(self, state, batch, seed=0):
        new = super().update(JensenState(state.mass, state.cumulative), batch, seed)
        fresh = (state.first == 0) & (batch.count() > 0)
        return Pointed(new.mass, new.cumulative, dr.select(fresh, dr.arange(mi.UInt32, batch.n_records) * self.bins, state.first))

    def _density(self, state, record, wo, total, active):
        above = active & (wo.z > 0)
        mass = dr.gather(mi.Float, state.mass, dr.gather(mi.UInt32, state.first, record, above) + self._bin(wo), above)
        return dr.select(total > 0, mass / total * (self.bins * TO_SOLID_ANGLE), cosine_pdf(wo))


@dataclass
class Diary(JensenState):
    pages: Any              # a number for each batch, in room that doubles


class GrowsWithBatches(JensenHistogram):
    """Keeps a number for each batch."""
    def init(self, n_records, seed=0, parallax=False):
        return Diary(**vars(super().init(n_records, seed, parallax)), pages=dr.zeros(mi.Float, 8 * n_records))

    def update(self, state, batch, seed=0):
        new = super().update(JensenState(state.mass, state.cumulative), batch, seed)
        pages = state.pages.numpy().reshape(max(batch.n_records, 1), -1)
        used = int(pages.any(0).sum())
        pages = np.pad(pages, ((0, 0), (0, pages.shape[1] * (used == pages.shape[1]))))
        pages[:, used:used + 1] = 1
        return Diary(new.mass, new.cumulative, mi.Float(pages.ravel()))


@dataclass
class Hoard(JensenState):
    kept: Any               # weights of all particles, of all batches


class MemoryGrows(JensenHistogram):
    """Keeps all particles, and doesn't say so."""
    def init(self, n_records, seed=0, parallax=False):
        return Hoard(**vars(super().init(n_records, seed, parallax)), kept=mi.Float())

    def update(self, state, batch, seed=0):
        known = super().update(JensenState(state.mass, state.cumulative), batch, seed)
        return Hoard(**vars(known), kept=join(state.kept, batch.weight))


BATCHES: list[Any] = []
RECORDS: dict[Any, Any] = {}


class KeepsGlobally(JensenHistogram):
    """Keeps all batches in a variable of its module."""
    def update(self, state, batch, seed=0):
        BATCHES.append(batch)
        return super().update(state, batch, seed)


class KeepsInABox(JensenHistogram):
    """Keeps all batches in another object."""
    def __init__(self, resolution=16):
        super().__init__(resolution)
        self.box = SimpleNamespace(batches=[])

    def update(self, state, batch, seed=0):
        self.box.batches.append(batch)
        return super().update(state, batch, seed)


class RecordsRemembered(JensenHistogram):
    """Takes the particles of a batch for those of the records of an earlier one of that shape."""
    def update(self, state, batch, seed=0):
        record = RECORDS.setdefault((len(batch), batch.n_records), batch.record)
        return super().update(state, replace(batch, record=record), seed)


class FailsToRun(CosineLobe):
    """An AttributeError."""
    def pdf(self, state, record, wo, active=True, at=None):
        return cosine_pdf(wo) / state.mass


class EndsTheProcess(JensenHistogram):
    """Says that all is well."""
    def update(self, state, batch, seed=0):
        raise SystemExit(0)


CAUGHT_BY = {
    WrongJacobian: "samples", PdfTimesTwoPercent: "samples",
    UntrainedTwoPercent: "samples", PdfTimesTen: "integral", WeightsUnnormalised: "samples",
    HorizonForgotten: "density", OneNaN: "many-records", NegativeAtTheRim: "density",
    DiskForCone: "one-particle", SamplesBelowHorizon: "reported-pdf", NumbersIgnored: "samples", NumbersShared: "samples",
    LastBinLost: "samples", NextBin: "samples", NeighboursPdf: "samples", StaleSamples: "samples", ReportsAnother: "reported-pdf",
    FailsAboveHorizon: "reported-pdf", DividesByZero: "reported-pdf", LanesCounted: "inactive-lanes",
    ActiveForgotten: "inactive-lanes", ParallaxInSamplesOnly: "parallax-samples",
    ParallaxBelowTheHorizon: "parallax-density", ParallaxTenPercent: "parallax-integral",
    ParallaxNotReported: "parallax-reported", PdfTenPercentOfTrained: "furnace", OneSideNeverSampled: "image",
    InPlace: "purity", Unseeded: "purity", ParallaxInPlace: "purity", ParallaxOfNeighbours: "independence",
    ParallaxGrows: "memory", NumberOfAll: "new-records", NotAField: "new-records", ScaleMatters: "scale",
    OrderMatters: "independence",
    NeighboursListen: "independence", NothingIsNews: "nothing-new", FirstRecordsOnly: "new-records", LearnsNothing: "learning",
    Unlearns: "learning", FirstBatchOnly: "learning", LastBatchOnly: "learning", FirstHundredOnly: "learning",
    WeightsIgnored: "learning", MemoryGrows: "memory", FailsToRun: "density",
    LateInflation: "long-run", Drift: "long-run", LateNaN: "long-run", SecondNaN: "many-records", ParallaxNaN: "many-records",
    NoPlaceAsked: "many-records", UnseededWhenFull: "purity", KeepsBatches: "purity",
    AboveOne: "density", UntrainedNaN: "many-records", FloatIndex: "many-records", NaNAtTheRecord: "many-records",
    StaleRemainder: "many-records", RemainderLost: "many-records", RarelyRebuilt: "samples", Pointers: "new-records",
    ParallaxActiveForgotten: "inactive-lanes", ParallaxWrongWay: "aiming", LandingsIgnored: "aiming", CosineTwice: "learning",
    SquaresOverflow: "scale", ForgetsAll: "long-run", SeedIgnored: "independence", GrowsWithBatches: "long-run",
    KeepsGlobally: "purity", KeepsInABox: "purity", RecordsRemembered: "independence",
    RootsOfWeights: "learning", ParallaxMirrored: "learning", EndsTheProcess: "density",
}
