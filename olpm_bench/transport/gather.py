"""Bring particles to the records that learn from them.

Three ways, all deterministic:

* `binned`: a particle goes to the record that its own look-up finds; of more than `neighbours`, evenly spaced ones
  are kept and stand for the others.  One sort, O(1) a particle.
* `pooled`: so, too, but a record with few also learns from the particles of the records around it.  Many
  camera paths meet no light, and small records would each learn from hardly any.
* `nearest`: each record takes exactly the `neighbours` nearest particles within r_max, as in the paper [L], however small
  its validity radius.
  Exact to a 2^-24 part of the squared radius; equals are taken in a fixed order.
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from olpm_bench.transport import headroom
from olpm_bench.transport.cache import MOST_CELLS, Grid, RecordCache, nearest_points
from olpm_bench.transport.particles import Particles
from olpm_bench.transport.settings import InputError
from representations.interface import ParticleBatch, group, offsets
from representations.state import copied, join

MIN_ELEVATION = 1e-3        # dot(d, n): particles that graze the record's horizon are left out [L]
MIN_COSINE = 0.707          # dot(n', n): and those on surfaces that turn away from it [L]
DIGIT_BITS, DIGITS = 8, 3   # of the squared distances, for selection by radix
FARTHEST = 2 ** (DIGIT_BITS * DIGITS) - 1       # the largest of them, just within r_max
FINEST = 4                  # times that the edge of voxels is halved for records among many particles
FLAT = 0.35                 # of the particles of 27 voxels, those of a plane within one edge: pi / 9
ENOUGH = 250                # particles of a pass; a record with fewer learns from those of others, too
LENDERS = 9                 # records that one learns from, itself included, ...
FARTHEST_LENDER = 4.0       # ... and their distance / r_max, at most
AMPLE = 2.0                 # expected particles within an edge / those that a record takes


@dataclass(kw_only=True)
class Gathered(ParticleBatch):
    """What one gather brings to the records.

    extent: validity radius with which a record would get just `neighbours` particles, at most r_max [n_records, scene
        units]: R_ph.  Of `nearest`, the distance of the farthest [L]; of `binned`, R sqrt(neighbours / found).
    reach: radius of the disk that they were taken from [n_records, scene units].  Of `binned`, the record's own; of `nearest`,
        `extent`.
    """
    extent: mi.Float
    reach: mi.Float


def binned(cache: RecordCache, particles: Particles, neighbours: int, parallax: bool = False) -> Gathered:
    """The particles that fall to each record, at most `neighbours` a record."""
    if len(particles) == 0:
        return _nothing(cache)
    p, weight, d, _, n = particles.read(particles.place)
    record, normal, valid = cache.lookup(p, n, weight > 0)
    valid &= dr.dot(d, normal) >= MIN_ELEVATION
    order, record, offset = group(dr.select(valid, record, dr.opaque(mi.UInt32, len(cache))), len(cache))
    if len(order) == 0:
        return _nothing(cache)
    # Of the `found` particles of a record, `kept` evenly spaced ones: where rank * kept steps over a multiple of found.
    found = dr.maximum(dr.gather(mi.UInt32, offset, record + 1) - dr.gather(mi.UInt32, offset, record), 1)
    kept = dr.minimum(found, dr.opaque(mi.UInt32, neighbours))
    rank = mi.UInt64(dr.arange(mi.UInt32, len(order)) - dr.gather(mi.UInt32, offset, record))
    chosen = dr.compress(rank * kept % found < kept)
    stands_for = dr.gather(mi.Float, mi.Float(found) / mi.Float(kept), chosen)
    place = dr.gather(mi.UInt32, particles.place, dr.gather(mi.UInt32, order, chosen))
    i, wanted = dr.arange(mi.UInt32, len(cache)), dr.opaque(mi.Float, neighbours)
    found = dr.maximum(dr.gather(mi.UInt32, offset, i + 1) - dr.gather(mi.UInt32, offset, i), 1)
    reach = cache.row(i)[3]
    extent = reach * dr.sqrt(wanted / mi.Float(found))
    return _batch(cache, particles, place, dr.gather(mi.UInt32, record, chosen), stands_for, extent, reach, parallax)


def pooled(cache: RecordCache, particles: Particles, neighbours: int, parallax: bool = False) -> Gathered:
    """The particles that fall to each record; where these are fewer than `ENOUGH`, also those of records around it.

    The bandwidth follows the density of particles, as that of the k nearest does: where records are small and particles are
    few, each record would learn from hardly any.  Records lend in the order of their distance until there are enough.

    Args:
        neighbours: particles of a record, at most; also instead of `ENOUGH` where it is smaller.
    """
    if len(particles) == 0:
        return _nothing(cache)
    p, weight, _, _, n = particles.read(particles.place)
    record, _, valid = cache.lookup(p, n, weight > 0)
    order, _, offset = group(dr.select(valid, record, dr.opaque(mi.UInt32, len(cache))), len(cache))
    if len(order) == 0:
        return _nothing(cache)
    first = offset.numpy().astype(np.int64)
    found = np.diff(first)
    borrower, lender = _lenders(cache, found, min(ENOUGH, neighbours))
    # One entry for each particle of each lender, grouped by borrower
    lent = found[lender]
    entry = np.arange(lent.sum()) + np.repeat(first[lender] - (np.cumsum(lent) - lent), lent)
    by = np.repeat(borrower, lent)
    have = np.bincount(by, minlength=len(cache))
    rank = np.arange(len(by)) - np.repeat(np.cumsum(have) - have, have)
    kept = np.minimum(have, neighbours)
    chosen = rank * kept[by] % np.maximum(have[by], 1) < kept[by]           # evenly spaced ones
    entry, by = entry[chosen], by[chosen]
    place = dr.gather(mi.UInt32, particles.place, dr.gather(mi.UInt32, order, copied(mi.UInt32, entry.astype(np.uint32))))
    record = copied(mi.UInt32, by.astype(np.uint32))
    stands_for = copied(mi.Float, (have / np.maximum(kept, 1))[by].astype(np.float32))
    # Directions below the horizon of the borrower teach it nothing
    _, normal, _, _ = cache.row(record)
    _, _, d, _, _ = particles.read(place)
    above = dr.compress(dr.dot(d, normal) >= MIN_ELEVATION)
    if len(above) == 0:
        return _nothing(cache)
    place, record, stands_for = (dr.gather(type(x), x, above) for x in (place, record, stands_for))
    reach = cache.row(dr.arange(mi.UInt32, len(cache)))[3]
    return _batch(cache, particles, place, record, stands_for, reach, reach, parallax)


def _lenders(cache: RecordCache, found: np.ndarray, enough: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of records, of which the first learns from the particles of the second; ordered by the first, then by distance.

    Args:
        found: particles of each record [n_records].
        enough: from so many on a record borrows no more.
    """
    k = min(LENDERS, len(cache))
    index, distance, cosine = nearest_points(cache.points, cache.points, k, cache.radius)
    lent = found[index] * ((cosine >= MIN_COSINE) & (distance <= FARTHEST_LENDER * cache.radius))
    before = np.cumsum(lent, axis=1) - lent
    used = (lent > 0) & (before < enough)
    return np.nonzero(used)[0], index[used]


def nearest(cache: RecordCache, particles: Particles, neighbours: int, parallax: bool = False) -> Gathered:
    """Exactly the `neighbours` nearest particles of each record within r_max.

    A record reads all particles of the 27 voxels around it: among many, those of small voxels, if they hold enough.
    """
    hit, record, last = mi.UInt32(), mi.UInt32(), dr.full(mi.UInt32, FARTHEST, len(cache))
    level, around = _levels(cache, particles, neighbours)
    for i in range(level.max(initial=0), -1, -1):
        here = np.flatnonzero(level == i)
        if len(here) == 0:
            continue
        if i > 0 and around[here].sum() < len(particles):       # to sort the particles would cost more than it saves
            level[here] -= 1
            continue
        if level.any():
            dr.flush_malloc_cache()         # of many particles, each array is a part of the machine's memory
        served = copied(mi.UInt32, here.astype(np.uint32))
        taken, by, farthest = _Candidates(cache, particles, i, served).nearest(neighbours)
        hit, record = join(hit, taken), join(record, by)
        dr.scatter(last, farthest, served)
        level[here[farthest.numpy() == FARTHEST]] -= 1          # too few within this edge; none are taken
    if len(hit) == 0:
        return _nothing(cache)
    extent = dr.sqrt((mi.Float(last) + 1) / _to_key(cache))             # r_max where there are not as many
    by_path = dr.argsort(hit)               # not by voxel: see Particles
    order, record, _ = group(dr.gather(mi.UInt32, record, by_path), len(cache))
    place = dr.gather(mi.UInt32, particles.place, dr.gather(mi.UInt32, hit, dr.gather(mi.UInt32, by_path, order)))
    return _batch(cache, particles, place, record, mi.Float(1), extent, extent, parallax)


def by_record(cache: RecordCache, particles: Particles) -> tuple[mi.UInt32, mi.UInt32]:
    """All hits grouped by the record that their look-up gives: their places, and the offset of each record."""
    p, _, _, _, n = particles.read(particles.place)
    record, _, valid = cache.lookup(p, n, mi.Bool(True))
    order, _, offset = group(dr.select(valid, record, dr.opaque(mi.UInt32, len(cache))), len(cache))
    return dr.gather(mi.UInt32, particles.place, order), offset


GATHERS = {"binned": binned, "nearest": nearest}


def _nothing(cache: RecordCache) -> Gathered:
    radius = dr.full(mi.Float, cache.radius, len(cache))
    return Gathered(**vars(ParticleBatch.empty(len(cache))), extent=radius, reach=radius)


def _batch(cache: RecordCache, particles: Particles, place: mi.UInt32, record: mi.UInt32, stands_for: mi.Float,
           extent: mi.Float, reach: mi.Float, parallax: bool) -> Gathered:
    """A batch of chosen particles, already grouped by record, with directions (and for `parallax` positions) in their frames.

    Raises:
        InputError: a weight is infinite.
    """
    p, weight, d, distance, _ = particles.read(place)
    position, normal, _, _ = cache.row(record)
    frame = mi.Frame3f(normal)
    batch = Gathered(frame.to_local(d), weight * stands_for, distance, record, offsets(record, len(cache)),
                     frame.to_local(p - position) if parallax else None,
                     extent=dr.minimum(extent, dr.opaque(mi.Float, cache.radius)),
                     reach=dr.minimum(reach, dr.opaque(mi.Float, cache.radius)))
    finite = dr.all(dr.isfinite(batch.weight))
    dr.eval(batch, finite)
    if not finite:
        raise InputError("particles of infinite weight: check the scene's emitters, and the reflectances of its surfaces")
    return batch


def _levels(cache: RecordCache, particles: Particles, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """For each record, how often to halve voxels of r_max so that enough particles are expected within an edge, and how
    many there are in the 27 around it before [n_records each]."""
    grid = Grid.over(cache.bbox, cache.radius)
    count = np.bincount(grid.voxel(particles.read(particles.place)[0]).numpy(), minlength=grid.n_cells // 6)
    around = ndimage.convolve(count.reshape(grid.size.numpy().ravel()[::-1]), np.ones((3, 3, 3), int), mode="constant").ravel()
    around = around[grid.voxel(cache.row(dr.arange(mi.UInt32, len(cache)))[0]).numpy()]
    most = min(len(particles), MOST_CELLS // 6)         # voxels
    deepest = np.log2(max(most / len(count), 1)) / 3
    level = 0.5 * np.log2(np.maximum(around * FLAT / (AMPLE * neighbours), 1))
    return np.minimum(level, min(deepest, FINEST)).astype(int), around


def _to_key(cache: RecordCache) -> mi.Float:
    """What squared distances [scene units squared] are multiplied by and rounded down."""
    return dr.opaque(mi.Float, (FARTHEST + 1) / cache.radius ** 2)


class _Candidates:
    """Particles sorted by voxel, and the records that look for theirs in the 27 voxels around them, not farther than an edge.

    Three voxels that follow one another along x hold one run of particles: nine runs a record.

    Args:
        level: the edge of the voxels is r_max / 2^level.
        record: which records look.
    """

    def __init__(self, cache: RecordCache, particles: Particles, level: int, record: mi.UInt32) -> None:
        p, weight, d, _, n = particles.read(particles.place)
        grid = Grid.over(cache.bbox, cache.radius / 2 ** level)
        n_voxels = grid.n_cells // 6
        used = (weight > 0) & grid.covers(p)
        order, _, self.offset = group(dr.select(used, grid.voxel(p), dr.opaque(mi.UInt32, n_voxels)), n_voxels)
        self.hit = order
        self.p, self.d, self.n = (dr.gather(type(v), v, order) for v in (p, d, n))
        self.grid, self.record, self.n_records = grid, record, len(record)
        self.record_p, self.record_n, _, _ = cache.row(record)
        self.to_key = _to_key(cache)
        self.edge = dr.opaque(mi.Float, (FARTHEST + 1) / 4 ** level)        # squared, as a key
        self.whole = level == 0
        dr.eval(self.offset, self.hit, self.p, self.d, self.n, self.record_p, self.record_n)

    def nearest(self, neighbours: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The `neighbours` nearest particles of each record: hits, their records, and per record the key of the farthest.

        Records with fewer have `FARTHEST`, and take them all within r_max, but none within a smaller edge.
        """
        # The squared distance of the last neighbour, digit by digit from the highest: counters tell which digit holds it.
        last, wanted = dr.zeros(mi.UInt32, self.n_records), dr.full(mi.UInt32, neighbours, self.n_records)
        for digit in reversed(range(DIGITS)):
            shift = dr.opaque(mi.UInt32, digit * DIGIT_BITS)
            value, wanted = _select_digit(self.count_digits(last, shift), wanted)
            last |= value << shift
            dr.eval(last, wanted)
        enough = mi.Bool(True) if self.whole else last < FARTHEST
        return *self.take(dr.select(enough, last, 0), dr.select(enough, wanted, 0), neighbours), last

    def run(self, i: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """First and last + 1 particle of the i-th of the nine runs around each record."""
        size = mi.Vector3i(self.grid.size)
        x = mi.Vector3i(self.grid.coordinates(self.record_p))
        y, z = x.y + mi.Int32(i % 3) - 1, x.z + mi.Int32(i // 3) - 1
        inside = (y >= 0) & (y < size.y) & (z >= 0) & (z < size.z)
        row = size.x * (y + size.y * z)
        first = mi.UInt32(row + dr.maximum(x.x - 1, 0))
        last = mi.UInt32(row + dr.minimum(x.x + 1, size.x - 1))
        return dr.gather(mi.UInt32, self.offset, first, inside), dr.gather(mi.UInt32, self.offset, last + 1, inside)

    def key(self, i: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.Bool]:
        """Squared distance of particle i from the record, as an integer, and whether the record may use it."""
        d2 = dr.squared_norm(dr.gather(mi.Point3f, self.p, i, active) - self.record_p) * self.to_key
        ok = active & (d2 < self.edge)
        ok &= dr.dot(dr.gather(mi.Vector3f, self.d, i, ok), self.record_n) >= MIN_ELEVATION
        ok &= dr.dot(dr.gather(mi.Normal3f, self.n, i, ok), self.record_n) >= MIN_COSINE
        return mi.UInt32(d2), ok

    @dr.syntax
    def count_digits(self, last: mi.UInt32, shift: mi.UInt32) -> mi.UInt32:
        """How often each digit occurs among a record's keys that agree with `last` above it [n_records << DIGIT_BITS]."""
        counters = dr.zeros(mi.UInt32, self.n_records << DIGIT_BITS)
        record = dr.arange(mi.UInt32, self.n_records)
        run = mi.UInt32(0)
        while run < 9:
            i, end = self.run(run)
            while i < end:
                key, ok = self.key(i, True)
                above = ((key ^ last) >> shift) >> DIGIT_BITS == 0
                digit = (key >> shift) & ((1 << DIGIT_BITS) - 1)
                dr.scatter_add(counters, mi.UInt32(1), (record << DIGIT_BITS) + digit, ok & above, dr.ReduceMode.Direct)
                i += 1
            run += 1
        dr.eval(counters)
        return counters

    @dr.syntax
    def take(self, last: mi.UInt32, wanted: mi.UInt32, neighbours: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Hits and records of the particles nearer than `last`, and of the first `wanted` at that very distance."""
        headroom.require(16 * self.n_records * neighbours, f"{neighbours} particles for each of {self.n_records} records",
                         "fewer neighbours, or a larger record_radius")
        slots = dr.full(mi.UInt32, 0xFFFFFFFF, self.n_records * neighbours)
        first = dr.arange(mi.UInt32, self.n_records) * dr.opaque(mi.UInt32, neighbours)
        taken, run = mi.UInt32(0), mi.UInt32(0)
        while run < 9:
            i, end = self.run(run)
            while i < end:
                key, ok = self.key(i, True)
                equal = ok & (key == last) & (wanted > 0)
                ok &= (key < last) | equal
                wanted[equal] -= 1
                dr.scatter(slots, i, first + taken, ok)
                taken[ok] += 1
                i += 1
            run += 1
        dr.eval(slots)
        used = dr.compress(slots != 0xFFFFFFFF)
        by = dr.gather(mi.UInt32, self.record, used // dr.opaque(mi.UInt32, neighbours))
        return dr.gather(mi.UInt32, self.hit, dr.gather(mi.UInt32, slots, used)), by


@dr.syntax
def _select_digit(counters: mi.UInt32, wanted: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
    """Per record, the digit in which the `wanted`-th smallest key lies, and how many are still wanted in it.

    A record with fewer keys than wanted gets the highest digit, and takes them all.
    """
    digit, below = mi.UInt32(0), mi.UInt32(0)
    record = dr.arange(mi.UInt32, dr.width(wanted))
    count = dr.gather(mi.UInt32, counters, record << DIGIT_BITS)
    while (digit < (1 << DIGIT_BITS) - 1) & (below + count < wanted):
        below += count
        digit += 1
        count = dr.gather(mi.UInt32, counters, (record << DIGIT_BITS) + digit)
    return digit, wanted - below
