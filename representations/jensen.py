"""A histogram on the square: 16 x 16 bins of equal solid angle.

Jensen 1995, "Importance driven path tracing using the photon map"; resolution and map of Vorba et al. 2014.
Empty bins stay empty: in the path tracer the BSDF half of the mixture covers them.

Bins are not re-aimed for parallax: they would overlap, and the density at a point would be a sum over all of them.
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from representations import discrete
from representations.cosine import cosine_pdf, sample_cosine
from representations.interface import ParticleBatch
from representations.square import TO_SOLID_ANGLE, from_hemisphere, to_hemisphere

# Weights of one batch are summed as integers, in units of 2^-40 of the record's heaviest particle, because integer
# sums don't depend on the scheduling of threads.  Room for 12 decades of weights and 2^24 particles a bin and batch.
UNITS = 2.0**40


@dataclass
class JensenState:
    """Masses are in the particles' unit of weight; a record of total mass 0 is the cosine lobe."""
    mass: mi.Float          # [n_records * bins] weight of the particles in a bin, over all batches
    cumulative: mi.Float    # [n_records * bins] inclusive sum of `mass` over the bins of a record


class JensenHistogram:
    """p(wo) = mass of the bin / mass of all bins * bins / 2 pi; goes on adding batches.

    A record without particles, or with none but those of weight zero, is the cosine lobe.

    resolution: bins along each side of the square, 1 to 256 [16 in Vorba et al. 2014].
    """

    def __init__(self, resolution: int = 16) -> None:
        if not 1 <= resolution <= 256:
            raise ValueError(f"resolution = {resolution!r}: must be in 1 .. 256")
        self.resolution = resolution
        self.bins = resolution**2

    def init(self, n_records: int, seed: int = 0, parallax: bool = False) -> JensenState:
        n = n_records * self.bins
        return JensenState(mass=dr.zeros(mi.Float, n), cumulative=dr.zeros(mi.Float, n))

    def update(self, state: JensenState, batch: ParticleBatch, seed: int = 0) -> JensenState:
        """Add a batch.

        Raises:
            ValueError: the batch and the state have not as many records.
        """
        n_records = len(state.mass) // self.bins
        if batch.n_records != n_records:
            raise ValueError(f"a batch of {batch.n_records} records for a state of {n_records}")
        if len(batch) == 0:
            return state
        useful = (batch.weight > 0) & (batch.wo.z > 0)
        heaviest = dr.zeros(mi.Float, n_records)
        dr.scatter_reduce(dr.ReduceOp.Max, heaviest, batch.weight, batch.record, useful)
        units = mi.UInt64(batch.weight / dr.gather(mi.Float, heaviest, batch.record) * UNITS)
        mass = dr.zeros(mi.UInt64, n_records * self.bins)
        dr.scatter_add(mass, units, batch.record * self.bins + self._bin(batch.wo), useful)
        mass = state.mass + mi.Float(mass) / UNITS * dr.repeat(heaviest, self.bins)
        return JensenState(mass=mass, cumulative=discrete.accumulate(mass, self.bins))

    def sample(self, state: JensenState, record: mi.UInt32, sample1: mi.Float, sample2: mi.Point2f,
               active: mi.Bool = True, at: mi.Vector3f | None = None) -> tuple[mi.Vector3f, mi.Float]:
        total = discrete.total(state.cumulative, self.bins, record, active)
        chosen = discrete.choose(state.cumulative, self.bins, record, sample1 * total, active)
        corner = mi.Point2f(mi.Float(chosen % self.resolution), mi.Float(chosen // self.resolution))
        wo = dr.select(total > 0, to_hemisphere((corner + sample2) / self.resolution), sample_cosine(sample2)[0])
        # Rounding may carry `wo` over an edge of its bin, so the density is looked up anew.
        return wo, self._density(state, record, wo, total, active)

    def pdf(self, state: JensenState, record: mi.UInt32, wo: mi.Vector3f, active: mi.Bool = True,
            at: mi.Vector3f | None = None) -> mi.Float:
        return self._density(state, record, wo, discrete.total(state.cumulative, self.bins, record, active), active)

    def _density(self, state: JensenState, record: mi.UInt32, wo: mi.Vector3f, total: mi.Float,
                 active: mi.Bool) -> mi.Float:
        """Density [1/sr] at `wo` of a record whose mass is `total`."""
        above = active & (wo.z > 0)
        mass = dr.gather(mi.Float, state.mass, record * self.bins + self._bin(wo), above)       # 0 where not `above`
        return dr.select(total > 0, mass / total * (self.bins * TO_SOLID_ANGLE), cosine_pdf(wo))

    def _bin(self, wo: mi.Vector3f) -> mi.UInt32:
        """Bin of a direction; the far edges of the square belong to the last column and row."""
        s = from_hemisphere(wo) * self.resolution
        x, y = (dr.clip(mi.Int32(v), 0, self.resolution - 1) for v in (s.x, s.y))
        return mi.UInt32(y * self.resolution + x)
