"""A representation: a coarse histogram of where light comes from, beside a cosine lobe.

    olpm-bench check NAME.py:Example            # examines it: is it the distribution that it says it is, does it learn?
    olpm-bench render door_ajar --method NAME.py:Example --seconds 10 --out image.exr

and in an experiment: representation = { type = "NAME.py:Example", resolution = 6 }.  The contract, which says what each of
the four verbs has to keep, is representations/interface.py.
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from representations import RepresentationError, discrete
from representations.cosine import cosine_pdf
from representations.interface import ParticleBatch
from representations.square import TO_SOLID_ANGLE, from_hemisphere, to_hemisphere


@dataclass
class ExampleState:
    """What is learnt, of all records at once: flat arrays whose lengths are multiples of the number of records."""
    share: mi.Float             # [n_records * bins] of what a record's particles carry, that of each bin
    cumulative: mi.Float        # [n_records * bins] sums of `share` up to each bin
    count: mi.Float             # [n_records] particles so far


class Example:
    """p(wo) = cosine * cos(theta) / pi + (1 - cosine) * share of wo's bin / solid angle of a bin.

    Args:
        resolution: bins along each side of the square that the hemisphere is mapped to, all of one solid angle.
        cosine: share of the cosine lobe, which keeps the density above zero wherever light may yet be found.
    """

    # The hyper-parameters: a TOML and --set give them, and their defaults say of which type they are.
    def __init__(self, resolution: int = 8, cosine: float = 0.1) -> None:
        if not 1 <= resolution <= 64:
            raise RepresentationError(f"resolution = {resolution!r}: must be in 1 .. 64")
        if not 0 <= cosine <= 1:
            raise RepresentationError(f"cosine = {cosine!r}: must be in [0, 1]")
        self.resolution, self.bins, self.cosine = resolution, resolution**2, cosine

    def init(self, n_records: int, seed: int = 0, parallax: bool = False) -> ExampleState:
        """Before any particle, when `pdf` is the cosine lobe: a state is a valid density from the beginning."""
        return ExampleState(dr.zeros(mi.Float, n_records * self.bins), dr.zeros(mi.Float, n_records * self.bins),
                            dr.zeros(mi.Float, n_records))

    def update(self, state: ExampleState, batch: ParticleBatch, seed: int = 0) -> ExampleState:
        """Learn from a batch: the new state.  The old one is left alone, and records without particles stay as they are."""
        if len(batch) == 0:
            return state
        # Sums by bin, in the order of the particles: a sum whose order depends on threads would not repeat bit for bit.
        by_bin = ParticleBatch.from_arrays(batch.wo, batch.weight, batch.record * self.bins + self._bin(batch.wo),
                                           batch.n_records * self.bins)
        total = batch.sums()
        seen = total > 0                                        # zero weights teach nothing
        count = state.count + dr.select(seen, mi.Float(batch.count()), 0)
        # The batch counts by its particles, not by their weights: only ratios of weights inside a record mean anything.
        new = by_bin.sums() / dr.repeat(dr.select(seen, total, 1), self.bins)
        step = dr.repeat(dr.select(seen, 1 - state.count / dr.maximum(count, 1), 0), self.bins)
        share = state.share + step * (new - state.share)
        return ExampleState(share, discrete.accumulate(share, self.bins), count)

    def sample(self, state: ExampleState, record: mi.UInt32, sample1: mi.Float, sample2: mi.Point2f,
               active: mi.Bool = True, at: mi.Vector3f | None = None) -> tuple[mi.Vector3f, mi.Float]:
        """A direction and its density: `sample1` chooses the lobe and the bin, `sample2` the place in it."""
        total = discrete.total(state.cumulative, self.bins, record, active)
        from_cosine = (sample1 < self.cosine) | (total == 0)
        rest = dr.clip((sample1 - self.cosine) / max(1 - self.cosine, 1e-6), 0, dr.one_minus_epsilon(mi.Float))
        chosen = discrete.choose(state.cumulative, self.bins, record, rest * total, active & ~from_cosine)
        corner = mi.Point2f(mi.Float(chosen % self.resolution), mi.Float(chosen // self.resolution))
        wo = dr.select(from_cosine, mi.warp.square_to_cosine_hemisphere(sample2),
                       to_hemisphere((corner + sample2) / self.resolution))
        return wo, self.pdf(state, record, wo, active, at)      # the very density that `pdf` returns

    def pdf(self, state: ExampleState, record: mi.UInt32, wo: mi.Vector3f, active: mi.Bool = True,
            at: mi.Vector3f | None = None) -> mi.Float:
        """The density of that [1/sr]; zero below the horizon.  Lanes that are not active may read nothing."""
        above = active & (wo.z > 0)
        total = discrete.total(state.cumulative, self.bins, record, active)
        share = dr.gather(mi.Float, state.share, record * self.bins + self._bin(wo), above) / dr.select(total > 0, total, 1)
        cosine = dr.select(total > 0, self.cosine, 1)
        return dr.select(above, cosine * cosine_pdf(wo) + (1 - cosine) * share * (self.bins * TO_SOLID_ANGLE), 0)

    def _bin(self, wo: mi.Vector3f) -> mi.UInt32:
        """The bin of a direction; the far edges of the square belong to its last column and row."""
        s = from_hemisphere(wo) * self.resolution
        x, y = (dr.clip(mi.Int32(v), 0, self.resolution - 1) for v in (s.x, s.y))
        return mi.UInt32(y * self.resolution + x)
