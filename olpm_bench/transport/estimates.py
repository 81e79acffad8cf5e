"""What a record knows beside its directional distribution: a few running means, the same for every representation.

* the mean weight of the particles of each source, photons (or importons) and camera paths: weights are divided by it, so
  that the sources, whose units differ, teach one distribution, each particle by its share of its own source;
* the fluence of its photons (importons): their weight per emitted particle and area, for the window of particles;
* the radiance that its surface returns on the average, next-event estimation left out, for the roulette, and with it, for the
  share of direct light that is learnt;
* the BSDF fraction: the probability with which the directions that bring that radiance were chosen by the BSDF.  As the
  weight of a mixture of two densities it is learnt by stepwise EM like the others, c' = sum w gamma_bsdf / sum w, which
  minimises the KL divergence of the mixture from the product f L cos.
"""
from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport.cache import MIN_COSINE, nearest_points
from representations.interface import ParticleBatch
from representations.state import copied

MEMORY = 0.7                # of what was learnt about the fraction, kept from one pass to the next: the guide changes
PRIOR = 20.0                # visits of mean weight that the initial fraction counts for
FLOOR = 0.1                 # of the fraction and of its complement
MOST = 20.0                 # heavier estimates from camera paths count as this many times the record's mean weight
ENOUGH = 30                 # visits; with fewer a record asks its neighbours
NEIGHBOURS = 8
MOST_VISITS = 1024          # of a pass that count: a lane sums them one by one


@dataclass
class Estimates:
    """Running means of each record; every field [n_records]."""
    particle_weight: mi.Float       # mean weight of photons or importons
    particle_count: mi.Float        # and their number
    fluence: mi.Float               # of photons or importons, mean over passes [per emitted particle and area]
    passes: mi.Float                # and their number
    camera_weight: mi.Float         # mean weight of estimates from camera paths
    camera_count: mi.Float
    visits: mi.Float                # of camera paths
    returned: mi.Float              # mean luminance that their continuations bring back
    reflected: mi.Float             # and with that of next-event estimation
    by_either: mi.Float             # of guided visits, decaying: sum of w, ...
    by_bsdf: mi.Float               # ... and of w gamma_bsdf

    @staticmethod
    def nothing(n_records: int) -> Estimates:
        """Of records that have seen nothing yet."""
        return Estimates(*(dr.zeros(mi.Float, n_records) for _ in dataclasses.fields(Estimates)))

    def __len__(self) -> int:
        return len(self.visits)

    def learn_fluence(self, batch: ParticleBatch, norm: mi.Float) -> None:
        """From the particles of one pass; `norm` is the area that each record took them from, times the particles emitted."""
        self.passes = self.passes + 1
        self.fluence = dr.lerp(self.fluence, batch.sums() / norm, dr.rcp(self.passes))
        dr.eval(self.passes, self.fluence)

    def normalise_particles(self, batch: ParticleBatch) -> ParticleBatch:
        """The batch with weights relative to the mean of the record's photons (importons) so far, these included."""
        self.particle_weight, self.particle_count = _advance(self.particle_weight, self.particle_count, batch)
        return _relative(batch, self.particle_weight, dr.inf)

    def normalise_camera(self, batch: ParticleBatch) -> ParticleBatch:
        """The same for estimates from camera paths, which are cut at `MOST` times the mean: their tails are heavy."""
        cut = dr.select(self.camera_count > 0, MOST * self.camera_weight, dr.inf)         # or one would make all others light
        batch = dataclasses.replace(batch, weight=dr.minimum(batch.weight, dr.gather(mi.Float, cut, batch.record)))
        self.camera_weight, self.camera_count = _advance(self.camera_weight, self.camera_count, batch)
        return _relative(batch, self.camera_weight, MOST)

    def learn(self, returned: mi.Float, chosen_by_bsdf: mi.Float, reflected: mi.Float, offset: mi.UInt32) -> None:
        """From visits of camera paths grouped by record: luminance returned, probability of the BSDF (-1: unguided)."""
        n, total = _visit_sums(returned, offset)
        self.visits = self.visits + n
        self.returned = _mean(self.returned, total, n, self.visits)
        n, total = _visit_sums(reflected, offset)
        self.reflected = _mean(self.reflected, total, n, self.visits)
        dr.eval(self.visits, self.returned, self.reflected)
        either, bsdf = _fraction_sums(returned, chosen_by_bsdf, offset, MOST * self.returned)
        self.by_either, self.by_bsdf = MEMORY * self.by_either + either, MEMORY * self.by_bsdf + bsdf
        dr.eval(self.by_either, self.by_bsdf)

    def fraction(self, initial: float) -> mi.Float:
        """The learnt BSDF fraction of each record."""
        prior = PRIOR * dr.maximum(self.returned, 1e-30)
        return dr.clip((self.by_bsdf + initial * prior) / (self.by_either + prior), FLOOR, 1 - FLOOR)

    def outgoing(self, points: np.ndarray, radius: float) -> mi.Float:
        """The radiance that each record returns; -1 where neither it nor its neighbours know.

        Who has only seen darkness does not know either: to end paths for that would keep the light from being found.

        Args:
            points: positions and normals of the records (n, 6); radius: their largest validity radius [scene units].
        """
        visits, returned = self.visits.numpy().astype(float), self.returned.numpy().astype(float)
        few = np.flatnonzero((visits < ENOUGH) & visits.any())              # nobody asks where no camera path has been
        result = np.where(returned > 0, returned, -1.0)
        if len(few) and len(points) >= NEIGHBOURS:
            near, _, cosine = nearest_points(points, points[few], NEIGHBOURS, radius)
            asked = visits[near] * (cosine >= MIN_COSINE)
            n, total = asked.sum(1), (asked * returned[near]).sum(1)
            result[few] = np.where((n >= ENOUGH) & (total > 0), total / np.maximum(n, 1), -1)
        return copied(mi.Float, result.astype(np.float32))


def _advance(mean: mi.Float, count: mi.Float, batch: ParticleBatch) -> tuple[mi.Float, mi.Float]:
    """Running mean and count of a batch's weights."""
    n, total = _visit_sums(batch.weight, batch.offset)
    count = count + n
    mean = _mean(mean, total, n, count)
    dr.eval(mean, count)
    return mean, count


def _relative(batch: ParticleBatch, mean: mi.Float, most: float) -> ParticleBatch:
    """The batch with weights in units of the record's `mean`, at most `most`."""
    scale = dr.gather(mi.Float, dr.select(mean > 0, dr.rcp(mean), 0), batch.record)
    return dataclasses.replace(batch, weight=dr.minimum(batch.weight * scale, most))


def _mean(mean: mi.Float, total: mi.Float, n: mi.Float, all_n: mi.Float) -> mi.Float:
    """A running mean after `n` more values of sum `total`, which make `all_n`."""
    return mean + (total - n * mean) / dr.maximum(all_n, 1)


def _visits(offset: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
    """First entry, end and stride of each record, so that at most `MOST_VISITS` are visited in even spacing."""
    record = dr.arange(mi.UInt32, len(offset) - 1)
    begin, end = dr.gather(mi.UInt32, offset, record), dr.gather(mi.UInt32, offset, record + 1)
    return begin, end, dr.maximum((end - begin + MOST_VISITS - 1) // MOST_VISITS, 1)


@dr.syntax
def _visit_sums(values: mi.Float, offset: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Number and sum of the visited entries of each record, in their order; a lane a record."""
    i, end, stride = _visits(offset)
    n, total = mi.Float(0), mi.Float(0)
    while i < end:
        total += dr.gather(mi.Float, values, i)
        n += 1
        i += stride
    dr.eval(n, total)
    return n, total


@dr.syntax
def _fraction_sums(weight: mi.Float, gamma: mi.Float, offset: mi.UInt32, most: mi.Float) -> tuple[mi.Float, mi.Float]:
    """Of the visited entries with gamma >= 0, sums of the weights, cut at `most`, and of weight times gamma."""
    i, end, stride = _visits(offset)
    either, bsdf = mi.Float(0), mi.Float(0)
    while i < end:
        g = dr.gather(mi.Float, gamma, i)
        w = dr.select(g >= 0, dr.minimum(dr.gather(mi.Float, weight, i), most), 0)
        either += w
        bsdf += dr.select(g >= 0, w * g, 0)
        i += stride
    dr.eval(either, bsdf)
    return either, bsdf
