"""More representations that are broken on purpose: where a state is, when and where it is asked, and for how long it has learnt.

Each is right in all that a few batches, coarse bins, one process and one unit of length show.
"""
from __future__ import annotations

import datetime
import itertools
import os
import time
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from representations import discrete
from representations.cosine import sample_cosine
from representations.hey import HeyCones
from representations.jensen import JensenHistogram, JensenState
from representations.square import to_hemisphere


class OwnSamples(JensenHistogram):
    """Samples by masses, and at places, that a mutant may choose; pdf() and what sample() reports stay right."""
    def cumulative(self, state, record):
        """Sums to choose bins by, and the record in them."""
        return state.cumulative, record

    def place(self, sample1, sample2):
        """Within a bin, in [0, 1)^2."""
        return sample2

    def sample(self, state, record, sample1, sample2, active=True, at=None):
        cumulative, entry = self.cumulative(state, record)
        total = discrete.total(state.cumulative, self.bins, record, active)
        target = sample1 * discrete.total(cumulative, self.bins, entry, active)
        chosen = discrete.choose(cumulative, self.bins, entry, target, active)
        corner = mi.Point2f(mi.Float(chosen % self.resolution), mi.Float(chosen // self.resolution))
        wo = to_hemisphere((corner + self.place(sample1, sample2)) / self.resolution)
        wo = dr.select(total > 0, wo, sample_cosine(sample2)[0])
        return wo, self._density(state, record, wo, total, active)


# ---------------------------------------------------------------------------------------------- where a state is

class SamplesLostWhenStored(OwnSamples):
    """Samples by a table that is no field of the state, or else by what the first record knows."""
    def update(self, state, batch, seed=0):
        new = replace(super().update(state, batch, seed))
        new.table = new.cumulative
        return new

    def cumulative(self, state, record):
        return (state.table, record) if hasattr(state, "table") else (state.cumulative, 0 * record)


TABLES: dict[int, Any] = {}


class SamplesByIdentity(OwnSamples):
    """Finds what it samples by under the identity of the state that it has trained, or else knows the first record only."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        TABLES[id(new)] = new.cumulative
        return new

    def cumulative(self, state, record):
        found = TABLES.get(id(state))
        return (found, record) if found is not None and len(found) == len(state.mass) else (state.cumulative, 0 * record)


def remembered(key):
    """A table of each state that is asked for samples, found by its `key` for ever after."""
    tables: dict[Any, Any] = {}

    def cumulative(self, state, record):
        return tables.setdefault((key(state), len(state.mass)), state.cumulative), record
    return cumulative


class TablesByAddress(OwnSamples):
    """Tables by the address of a state, which another one gets later."""
    cumulative = remembered(id)


class TablesByIndex(OwnSamples):
    """Tables by the index of an array in Dr.Jit, which another one gets later."""
    cumulative = remembered(lambda state: state.mass.index)


@dataclass
class Origin(JensenState):
    first: Any              # 1 + the record's index when it first learnt something; 0: it has not


class SamplesOfTheOriginal(OwnSamples):
    """A copy of a record is sampled by what the original knows."""
    def init(self, n_records, seed=0, parallax=False):
        return Origin(**vars(super().init(n_records, seed, parallax)), first=dr.zeros(mi.UInt32, n_records))

    def update(self, state, batch, seed=0):
        new = super().update(JensenState(state.mass, state.cumulative), batch, seed)
        fresh = (state.first == 0) & (batch.count() > 0)
        return Origin(new.mass, new.cumulative, dr.select(fresh, dr.arange(mi.UInt32, batch.n_records) + 1, state.first))

    def cumulative(self, state, record):
        first = dr.gather(mi.UInt32, state.first, record)
        return state.cumulative, dr.select((first > 0) & (first <= len(state.first)), first - 1, record)


class FirstSamplesOnly(OwnSamples):
    """Remembers how many records it had at first: those appended are sampled as the first one."""
    first = 0

    def init(self, n_records, seed=0, parallax=False):
        self.first = self.first or n_records
        return super().init(n_records, seed, parallax)

    def cumulative(self, state, record):
        return state.cumulative, dr.select(record < dr.opaque(mi.UInt32, self.first), record, 0)


# ---------------------------------------------------------------------------------------------- samples

class PlaceByTheChoice(OwnSamples):
    """The number that has chosen the bin gives the place in it, too: slivers of bins of little mass are never sampled."""
    def place(self, sample1, sample2):
        x = sample1 * self.bins
        return mi.Point2f(x - dr.floor(x), sample2.y)


class PlaceOfSevenBits(OwnSamples):
    """128 places along a bin's edge."""
    def place(self, sample1, sample2):
        return (dr.floor(sample2 * 128) + 0.5) / 128


class ColumnsOfFewPlaces(OwnSamples):
    """The two random numbers of the place depend on each other: a sixteenth of each bin is sampled."""
    def place(self, sample1, sample2):
        y = sample2.y * 64
        y = (dr.floor(sample2.x * 16) + (y - dr.floor(y))) / 16
        return mi.Point2f(sample2.x, y)


# ---------------------------------------------------------------------------------------------- parallax

class ParallaxInMetres(HeyCones):
    """What is asked from farther than 20 units is asked from there."""
    def _cone(self, state, i, active, at):
        return super()._cone(state, i, active, None if at is None else dr.clip(at, -20, 20))


class ParallaxOfMillimetres(HeyCones):
    """Ignores places nearer than a thousandth."""
    def _cone(self, state, i, active, at):
        return super()._cone(state, i, active, None if at is None else dr.select(dr.norm(at) > 1e-3, at, 0))


class DistancesCapped(HeyCones):
    """Light is at most 1,000 units away."""
    def update(self, state, batch, seed=0):
        capped = dr.select(dr.isfinite(batch.distance), dr.minimum(batch.distance, 1000), batch.distance)
        return super().update(state, replace(batch, distance=capped), seed)


class OneParticleWithoutPlace(HeyCones):
    """Half too much for records of one particle, where a state with parallax is asked without a place."""
    def _density(self, state, record, wo, total, active, at):
        pdf = super()._density(state, record, wo, total, active, at)
        one = dr.gather(mi.UInt32, state.seen, record, active) == 1
        return dr.select(one, 1.5 * pdf, pdf) if at is None and len(state.near) else pdf


class SamplesWithoutPlace(HeyCones):
    """Of trained records, asked without a place, directions are those of a half of each cone."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        if at is None and len(state.near):
            sample2 = mi.Point2f(sample2.x, 0.5 * sample2.y)
        return super().sample(state, record, sample1, sample2, active, at)


class PdfWithoutPlace(JensenHistogram):
    """Without a place, pdf() is 10 % too large for records that have learnt something; sample() reports the right density."""
    def pdf(self, state, record, wo, active=True, at=None):
        learnt = discrete.total(state.cumulative, self.bins, record, active) > 0
        return super().pdf(state, record, wo, active, at) * dr.select((at is None) & learnt, 1.1, 1)


class OneSideWithoutPlace(JensenHistogram):
    """Without a place, only directions with x > 0 are sampled of trained records; all have their density."""
    def sample(self, state, record, sample1, sample2, active=True, at=None):
        wo, pdf = super().sample(state, record, sample1, sample2, active, at)
        if at is not None:
            return wo, pdf
        wo.x = dr.select(discrete.total(state.cumulative, self.bins, record, active) > 0, dr.abs(wo.x), wo.x)
        return wo, super().pdf(state, record, wo, active, at)


class NearbyTwice(JensenHistogram):
    """Without parallax, pdf() counts particles from less than infinitely far twice."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        if len(batch) == 0 or batch.at is not None:
            return new
        near = replace(batch, weight=dr.select(dr.isfinite(batch.distance), 2, 1) * batch.weight)
        return JensenState(super().update(state, near, seed).mass, new.cumulative)


# ---------------------------------------------------------------------------------------------- particles

@dataclass
class Cut(JensenState):
    cut: Any                # [n_records * bins] weight of the particles in a bin that are believed
    sampled: Any            # inclusive sum of them over the bins of a record


class RunsCutShort(OwnSamples):
    """Samples as if no direction had come more than 1,000 times in a row, to be safe from fireflies."""
    def init(self, n_records, seed=0, parallax=False):
        n = n_records * self.bins
        return Cut(**vars(super().init(n_records, seed, parallax)), cut=dr.zeros(mi.Float, n), sampled=dr.zeros(mi.Float, n))

    def update(self, state, batch, seed=0):
        n = len(batch)
        if n == 0:
            return state
        new = super().update(JensenState(state.mass, state.cumulative), batch, seed)
        i = dr.arange(mi.UInt32, n)
        there = dr.gather(mi.Vector3f, batch.wo, dr.maximum(i, 1000) - 1000)
        same = (dr.squared_norm(there - batch.wo) == 0) & (i >= 1000)
        few = replace(batch, weight=dr.select(same, 0, batch.weight))
        cut = super().update(JensenState(state.cut, state.sampled), few, seed)
        return Cut(new.mass, new.cumulative, cut.mass, cut.cumulative)

    def cumulative(self, state, record):
        return state.sampled, record


@dataclass
class Wide(JensenState):
    width: Any              # [n_records] range of the directions' x in the last large batch; 1 before


class NoWidth(JensenHistogram):
    """Divides by the range of the directions of a record's particles, where there are enough to tell."""
    def init(self, n_records, seed=0, parallax=False):
        return Wide(**vars(super().init(n_records, seed, parallax)), width=dr.full(mi.Float, 1, n_records))

    def update(self, state, batch, seed=0):
        new, n = super().update(JensenState(state.mass, state.cumulative), batch, seed), batch.n_records
        low, high = dr.full(mi.Float, 2, n), dr.full(mi.Float, -2, n)
        if len(batch):
            dr.scatter_reduce(dr.ReduceOp.Min, low, batch.wo.x, batch.record)
            dr.scatter_reduce(dr.ReduceOp.Max, high, batch.wo.x, batch.record)
        return Wide(new.mass, new.cumulative, dr.select(batch.count() > 1000, high - low, state.width))

    def _density(self, state, record, wo, total, active):
        width = dr.gather(mi.Float, state.width, record, active)
        return super()._density(state, record, wo, total, active) * (width / width)


# ---------------------------------------------------------------------------------------------- where randomness comes from

class Salted(HeyCones):
    """Random numbers depend on more than the seed."""
    def salt(self) -> int:
        raise NotImplementedError

    def update(self, state, batch, seed=0):
        return super().update(state, batch, (seed + self.salt()) & 0xFFFFFFFF)


class SaltOfHash(Salted):
    """On the hash of a string, which is another one in each process."""
    def salt(self):
        return hash("hey")


class SaltOfClock(Salted):
    """On the hour."""
    def salt(self):
        return int(time.time()) // 3600


class SaltOfCalendar(Salted):
    """On the day of the month."""
    def salt(self):
        return datetime.datetime.now().day


class SaltOfProcess(Salted):
    """On the number of the process."""
    def salt(self):
        return os.getpid()


SALT = int(np.random.default_rng().integers(1 << 32))
NUMBERS = itertools.count()


class SaltOfImport(Salted):
    """On a number that was drawn when the module was loaded."""
    def salt(self):
        return SALT


class SaltOfInstance(Salted):
    """On how many instances there were before."""
    def __init__(self, cones: int = 250) -> None:
        super().__init__(cones)
        self.number = next(NUMBERS)

    def salt(self):
        return self.number


class SamplesOfInstance(OwnSamples):
    """Every second instance turns the place in a bin around."""
    def __init__(self, resolution: int = 16) -> None:
        super().__init__(resolution)
        self.odd = next(NUMBERS) % 2 == 1

    def place(self, sample1, sample2):
        return mi.Point2f(dr.minimum(1 - sample2.x, 1 - 2**-24), sample2.y) if self.odd else sample2


class NumberOfLane(OwnSamples):
    """Shifts the place within a bin by what belongs to the lane."""
    def place(self, sample1, sample2):
        x = sample2.x + 0.6180340 * mi.Float(dr.arange(mi.UInt32, dr.width(sample2)) % 1024)
        return mi.Point2f(x - dr.floor(x), sample2.y)


class OnlyRecord(JensenHistogram):
    """Of a state of one record, it takes the first bin for all."""
    def update(self, state, batch, seed=0):
        new = super().update(state, batch, seed)
        if batch.n_records > 1:
            return new
        mass = dr.select(dr.arange(mi.UInt32, self.bins) == 0, new.mass, 0)
        return JensenState(mass, discrete.accumulate(mass, self.bins))


# ---------------------------------------------------------------------------------------------- hundreds of batches

@dataclass
class Counted(JensenState):
    updates: Any            # [n_records] that brought particles


class Growth(JensenHistogram):
    """A ten-thousandth too much with each update that brings something, in sample() and pdf() alike."""
    def init(self, n_records, seed=0, parallax=False):
        return Counted(**vars(super().init(n_records, seed, parallax)), updates=dr.zeros(mi.Float, n_records))

    def update(self, state, batch, seed=0):
        new = super().update(JensenState(state.mass, state.cumulative), batch, seed)
        return Counted(new.mass, new.cumulative, state.updates + mi.Float(dr.minimum(batch.count(), 1)))

    def _density(self, state, record, *args):
        return super()._density(state, record, *args) * self.factor(dr.gather(mi.Float, state.updates, record))

    def factor(self, updates):
        return 1 + 1e-4 * updates


class Decay(Growth):
    """A ten-thousandth is lost with each of them."""
    def factor(self, updates):
        return 1 - 1e-4 * updates


class EightBits(Growth):
    """Wrong from the 256th on."""
    def factor(self, updates):
        return dr.select(updates >= 256, 1.1, mi.Float(1))


class Blur(JensenHistogram):
    """With each of them, all bins get a thousandth of the mass."""
    def update(self, state, batch, seed=0):
        mass = super().update(state, batch, seed).mass
        learns = dr.repeat(mi.Float(dr.minimum(batch.count(), 1)), self.bins)
        mass = mass + learns * dr.repeat(dr.block_sum(mass, self.bins), self.bins) * (1e-3 / self.bins)
        return JensenState(mass, discrete.accumulate(mass, self.bins))


class IdleDecay(JensenHistogram):
    """A record that is taught nothing mixes what it knows with a hundred-thousandth of its first bin."""
    def update(self, state, batch, seed=0):
        mass = super().update(state, batch, seed).mass
        idle = dr.repeat(mi.Float(1 - dr.minimum(batch.count(), 1)), self.bins)
        first = dr.arange(mi.UInt32, len(mass)) % self.bins == 0
        share = dr.repeat(dr.block_sum(mass, self.bins), self.bins) * 1e-4
        mass = mass + idle * dr.select(first, share, 0)
        return JensenState(mass, discrete.accumulate(mass, self.bins))


CAUGHT_BY = {
    SamplesLostWhenStored: "new-records", SamplesByIdentity: "new-records", TablesByAddress: "new-records",
    TablesByIndex: "new-records", SamplesOfTheOriginal: "new-records", FirstSamplesOnly: "new-records",
    PlaceByTheChoice: "samples", PlaceOfSevenBits: "samples", ColumnsOfFewPlaces: "samples",
    ParallaxInMetres: "scale", ParallaxOfMillimetres: "scale", DistancesCapped: "scale",
    OneParticleWithoutPlace: "parallax-integral", SamplesWithoutPlace: "parallax-samples", PdfWithoutPlace: "furnace",
    OneSideWithoutPlace: "image", NearbyTwice: "samples",
    RunsCutShort: "samples", NoWidth: "density",
    SaltOfHash: "purity", SaltOfClock: "purity", SaltOfCalendar: "purity", SaltOfProcess: "purity", SaltOfImport: "purity",
    SaltOfInstance: "purity", SamplesOfInstance: "purity",
    NumberOfLane: "purity", OnlyRecord: "independence",
    Growth: "long-run", Decay: "long-run", EightBits: "long-run", Blur: "long-run", IdleDecay: "long-run",
}
