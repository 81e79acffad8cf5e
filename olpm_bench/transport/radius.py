"""The validity radius that a record's particles ask for.

    R = max(R_ph / 2, min(R_near, R_ph, R_alpha)),    and R >= R_ph with too few particles        [L]

R_ph, the radius that holds `neighbours` particles (`Gathered.extent`), makes records small where particles are dense; R_near
keeps neighbours alike (`RecordCache.clamped`).  R_alpha makes them small near sources and where lobes are sharp: with a
source at the mean distance D of the particles' last segments, a step of R to the side turns its direction by the
angle alpha, tan alpha = R / D, and alpha may be what shifts the density by a Kullback-Leibler divergence of 5.

The paper takes that angle from the Gaussians of its mixture.  Ours comes from the particles, so that every representation
gets the same records from the same particles and needs no verb for it: a Gaussian lobe of standard deviation
sigma diverges by alpha^2 / (2 sigma^2) from itself turned by alpha, and the distances between particles tell sigma.  Unlike
the mean over components this calls a smooth density smooth even if it is put together from many narrow Gaussians.
"""
from __future__ import annotations

import math
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from olpm_bench.transport.cache import RecordCache
    from olpm_bench.transport.gather import Gathered
    from representations.interface import ParticleBatch

DIVERGENCE = 5.0            # Kullback-Leibler divergence [nat] that a shift of the lobes may cause [L]
UNDERSAMPLED = 40           # particles: with fewer the radius is at least R_ph [L]
PROBES, OTHERS = 64, 8      # particles of a record that are compared with others, and with how many
CLOSEST = 2.40              # E[1 / least distance] * sigma for a point and `OTHERS` more of a Gaussian, by Monte Carlo
SHARPEST = 1e-4             # least distance that counts [radians]


def wanted(cache: RecordCache, batch: Gathered) -> np.ndarray:
    """Radius of each record after a batch [n, scene units]; as it was for records without particles."""
    count, extent, distance, sigma = (x.numpy() for x in (batch.count(), batch.extent, mean_distance(batch), width(batch)))
    angle = math.sqrt(2 * DIVERGENCE) * sigma
    r_alpha = np.where(angle < math.pi / 2, distance * np.tan(np.minimum(angle, math.pi / 2)), np.inf)
    radius = np.minimum(np.minimum(cache.clamped(cache.points, own=True), extent), r_alpha)
    radius = np.maximum(radius, np.where(count < UNDERSAMPLED, extent, 0.5 * extent))
    return np.where(count > 0, radius, cache.radii)


@dr.syntax
def width(batch: ParticleBatch) -> mi.Float:
    """Standard deviation of the Gaussian lobe whose particles would be as close to one another [n, radians].

    Of evenly spaced particles, the mean reciprocal distance to the closest of `OTHERS`, by weight; pi with too few.
    """
    record = dr.arange(mi.UInt32, batch.n_records)
    first = dr.gather(mi.UInt32, batch.offset, record)
    count = dr.gather(mi.UInt32, batch.offset, record + 1) - first
    probes = dr.select(count > OTHERS, dr.minimum(count, PROBES), 0)
    one, some = dr.maximum(count, 1), dr.maximum(probes, 1)             # padded lanes divide, too
    i, reciprocal, total = mi.UInt32(0), mi.Float(0), mi.Float(0)
    while dr.hint(i < probes, mode="symbolic"):
        at = i * count // some
        wo, closest = dr.gather(mi.Vector3f, batch.wo, first + at), mi.Float(2)
        for j in range(1, OTHERS + 1):
            other = dr.gather(mi.Vector3f, batch.wo, first + (at + j * count // (OTHERS + 1)) % one)
            closest = dr.minimum(closest, dr.norm(wo - other))
        weight = dr.gather(mi.Float, batch.weight, first + at)
        reciprocal += weight / dr.maximum(closest, SHARPEST)
        total += weight
        i += 1
    return dr.select(total > 0, CLOSEST * total / reciprocal, dr.pi)


@dr.syntax
def mean_distance(batch: ParticleBatch) -> mi.Float:
    """Mean length of the last segment of each record's particles [n, scene units]; 0 without any."""
    record = dr.arange(mi.UInt32, batch.n_records)
    i = dr.gather(mi.UInt32, batch.offset, record)
    end = dr.gather(mi.UInt32, batch.offset, record + 1)
    count, total = mi.Float(end - i), mi.Float(0)
    while dr.hint(i < end, mode="symbolic"):
        total += dr.gather(mi.Float, batch.distance, i)
        i += 1
    return total / dr.maximum(count, 1)
