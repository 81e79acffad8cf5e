"""The contract of a representation: *the interface is a promise about probability*.

A representation is a family of probability densities over the upper hemisphere, one density for each *record*
of a spatial cache, all held in one structure of arrays.  Hyper-parameters are attributes of an ordinary class;
what is learnt is a separate *state*: a plain dataclass whose fields are flat Dr.Jit arrays of
``n_records * stride`` entries, record-major, with a stride that never changes.  So the owner of the records
can append new ones, begin them as copies of others, save, load and count the bytes of any state without
knowing what it means (:mod:`representations.state`); a state may hold no index of a record.

Sign convention (the only place it is stated): a direction ``wo`` is a unit vector in the record's own frame
(s, t, n), n = (0, 0, 1), and points *away from the surface*, to where light comes from or importance comes
from.  Densities are per solid angle [1/sr] and zero for ``wo.z <= 0``.  Lengths are 1 up to rounding:
``wo.z`` may be 1 + 2^-22.

Parallax: a record is asked about points around its own.  Those who know where say it by ``at``, the point in the record's
frame, whose origin is the record's position; a representation that knows how far away its light is re-aims it from there
(Ruppert et al. 2020), others may ignore ``at``.  Without it, all points see what the record sees.  Only states made for
parallax are asked at points, and taught batches that have them.  Records are made where particles land: ``at`` may be 0.

Lanes that are not ``active`` may ask for records that don't exist: nothing may be read there, and nothing is made of what
they return.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from representations import RepresentationError
from representations.parallax import aim, inverse

State = TypeVar("State")


@dataclass
class ParticleBatch:
    """Particles grouped by record, in compressed rows: those of record r are ``offset[r] .. offset[r + 1] - 1``.

    The order does not depend on the scheduling of threads, so that training repeats bit for bit.
    """
    wo: mi.Vector3f         # [n] direction the particle came from, in the record's frame
    weight: mi.Float        # [n] luminance of flux or importance; only ratios within a record matter
    distance: mi.Float      # [n] length of the particle's last segment [scene units]
    record: mi.UInt32       # [n] ascending
    offset: mi.UInt32       # [n_records + 1]
    at: mi.Vector3f | None = None       # [n] where it landed, in the record's frame [scene units]; None: at the record itself

    @property
    def n_records(self) -> int:
        return len(self.offset) - 1

    def __len__(self) -> int:
        return len(self.weight)

    def count(self) -> mi.UInt32:
        """Particles of each record [n_records]."""
        record = dr.arange(mi.UInt32, self.n_records)
        return dr.gather(mi.UInt32, self.offset, record + 1) - dr.gather(mi.UInt32, self.offset, record)

    @dr.syntax
    def sums(self) -> mi.Float:
        """Sum of the weights of each record's particles, in their order [n_records]."""
        record = dr.arange(mi.UInt32, self.n_records)
        i, end = dr.gather(mi.UInt32, self.offset, record), dr.gather(mi.UInt32, self.offset, record + 1)
        total = dr.zeros(mi.Float, self.n_records)
        while i < end:
            total += dr.gather(mi.Float, self.weight, i)
            i += 1
        return total

    def aimed(self) -> tuple[mi.Vector3f, mi.Float]:
        """As seen from the record's position: directions to where the particles came from, and 1 / their distance."""
        if self.at is None:
            return self.wo, inverse(self.distance)
        x, y, z, inverse_distance = aim(self.wo, inverse(self.distance), -self.at)
        return mi.Vector3f(x, y, z), inverse_distance

    @staticmethod
    def empty(n_records: int) -> ParticleBatch:
        """No particles at all."""
        return ParticleBatch(mi.Vector3f(), mi.Float(), mi.Float(), mi.UInt32(), dr.zeros(mi.UInt32, n_records + 1))

    @staticmethod
    def from_arrays(wo: mi.Vector3f, weight: mi.Float, record: mi.UInt32, n_records: int,
                    distance: mi.Float | None = None, at: mi.Vector3f | None = None) -> ParticleBatch:
        """Group particles by record with a stable sort; entries with ``record >= n_records`` are left out.

        Raises:
            RepresentationError: a direction or weight is not finite, or a weight is negative.
        """
        if len(weight) and not dr.all(dr.isfinite(weight) & (weight >= 0) & dr.all(dr.isfinite(wo))):
            raise RepresentationError("particles with a NaN, infinite or negative weight or direction")
        order, record, offset = group(record, n_records)
        batch = ParticleBatch(
            wo=dr.gather(mi.Vector3f, wo, order), weight=dr.gather(mi.Float, weight, order),
            distance=dr.gather(mi.Float, distance, order) if distance is not None else dr.full(mi.Float, dr.inf, len(order)),
            record=record, offset=offset, at=dr.gather(mi.Vector3f, at, order) if at is not None else None)
        dr.eval(batch)
        return batch


def group(key: mi.UInt32, n_keys: int) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """Stable grouping by key: ``(order, key[order], offset)``; entries with ``key >= n_keys`` are left out.

    The entries of key k are ``order[offset[k]] .. order[offset[k + 1] - 1]``, in their original order.
    """
    if len(key) == 0:
        return mi.UInt32(), mi.UInt32(), dr.zeros(mi.UInt32, n_keys + 1)
    order = dr.argsort(key)
    key = dr.gather(mi.UInt32, key, order)
    offset = offsets(key, n_keys)
    inside = dr.arange(mi.UInt32, int(dr.max(offset)[0]))   # the keys left out are at the end
    return dr.gather(mi.UInt32, order, inside), dr.gather(mi.UInt32, key, inside), offset


def offsets(key: mi.UInt32, n_keys: int) -> mi.UInt32:
    """Where each key begins in an ascending array [n_keys + 1]; entries with ``key >= n_keys`` do not count.

    Each run of equal keys writes where it begins and ends; counting by `scatter_add` would compile n_keys into a kernel.
    """
    i, last = dr.arange(mi.UInt32, len(key)), dr.opaque(mi.UInt32, len(key) - 1)
    before = dr.gather(mi.UInt32, key, dr.maximum(i, 1) - 1)
    after = dr.gather(mi.UInt32, key, dr.minimum(i + 1, last))
    inside = key < dr.opaque(mi.UInt32, n_keys)
    begin, end = dr.zeros(mi.UInt32, n_keys + 1), dr.zeros(mi.UInt32, n_keys + 1)
    dr.scatter(begin, i, key, inside & ((i == 0) | (before != key)))
    dr.scatter(end, i + 1, key, inside & ((i == last) | (after != key)))
    return dr.prefix_sum(end - begin)


class DirectionalPdf(Protocol[State]):
    """Four verbs.  ``olpm-bench check path/to/file.py:ClassName`` checks that `sample` and `pdf` are one distribution, and more.
    """

    def init(self, n_records: int, seed: int = 0, parallax: bool = False) -> State:
        """A state that already is a valid density for every record, before any particle.

        With `parallax` it learns what it needs to be asked ``at`` points; without, it need spend no memory and time on that.
        """
        ...

    def update(self, state: State, batch: ParticleBatch, seed: int = 0) -> State:
        """Learn from one batch (``batch.n_records`` records, as many as the state); return the new state.

        First fit and on-line update are this one verb.  Pure: the argument is left alone and the result depends
        on nothing but the arguments.  A record without particles in the batch keeps its density.  Zero weights
        teach nothing.  A batch may be empty (return early: Dr.Jit doesn't combine arrays of 0 and 1 entries); its
        directions lie above the horizon; it is never seen again.  Sums over particles must be taken in their order (as
        `jensen` does, a lane a record), not by `scatter_add`, whose rounding depends on threads.
        """
        ...

    def sample(self, state: State, record: mi.UInt32, sample1: mi.Float, sample2: mi.Point2f,
               active: mi.Bool = True, at: mi.Vector3f | None = None) -> tuple[mi.Vector3f, mi.Float]:
        """Map uniform numbers in [0, 1) to ``(wo, pdf)``, with the very density that :meth:`pdf` returns for ``wo`` and ``at``.

        A sample may fail (land outside the hemisphere): its pdf is then 0 and its ``wo`` lies below the horizon, and
        the integral of `pdf` is below 1 by the probability of that.
        """
        ...

    def pdf(self, state: State, record: mi.UInt32, wo: mi.Vector3f, active: mi.Bool = True,
            at: mi.Vector3f | None = None) -> mi.Float:
        """The density realised by :meth:`sample` [1/sr]: finite, >= 0, 0 for ``wo.z <= 0``, integral <= 1."""
        ...
