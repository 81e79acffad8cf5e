"""Around a single particle: the shape of what a representation makes of it, to fractions of a per cent."""
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.crowd import records_that_fit
from olpm_bench.check.particles import uniform_directions, vector
from olpm_bench.check.samples import FEWEST, chi_square, of_sums
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import PValues, Verdict
from representations.interface import ParticleBatch

RECORDS = 1 << 12           # with one particle each
LANES = 1 << 22             # samples of all records
FARTHEST = 8.0              # a step multiplies or divides the area within a sample's distance from the particle by up to this
OCTAVES = 40                # of that area


def keep_balance(representation: Any, seed: int, level: float) -> Verdict:
    """A step of the Metropolis algorithm for pdf() leaves samples distributed as they are (Gandy & Scott 2020 test samplers so).

    The step changes a sample's distance from the record's particle, whatever the scale of the kernel: the area of the cap within
    that distance, pi c^2 for the chord c, is multiplied by s, with ln s uniform in -ln FARTHEST .. ln FARTHEST, the azimuth is
    drawn anew, and the step is taken with the probability min(1, s pdf(y) / pdf(x)).  If x follows the pdf, a step from x to y
    and one from y to x are equally likely: of those whose larger cap has a given size, half go outwards.
    """
    rng = np.random.default_rng([5, seed])
    n = records_that_fit(representation, RECORDS)
    axes, weight = vector(uniform_directions(n, rng)), mi.Float(rng.lognormal(size=n).astype(np.float32))
    batch = ParticleBatch.from_arrays(axes, weight, dr.arange(mi.UInt32, n), n)
    state = representation.update(representation.init(n, seed), batch, seed)
    dr.eval(state)

    u = [mi.Float(numbers) for numbers in rng.random((6, LANES), np.float32)]
    record = dr.arange(mi.UInt32, LANES) % dr.opaque(mi.UInt32, n)
    x, pdf = representation.sample(state, record, u[0], mi.Point2f(u[1], u[2]))
    axis = mi.Frame3f(dr.gather(mi.Vector3f, axes, record))
    step = dr.exp((2 * u[3] - 1) * np.log(FARTHEST))
    before = dr.squared_norm(x - axis.n)
    after = before * step
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u[4])
    r = dr.safe_sqrt(after * (1 - after / 4))
    y = axis.to_world(mi.Vector3f(r * cos_phi, r * sin_phi, 1 - after / 2))
    taken = (pdf > 0) & (after < 4) & (u[5] * pdf < step * representation.pdf(state, record, y))
    octave = dr.clip(dr.floor(dr.log2(dr.maximum(before, after))), 3 - OCTAVES, 2) + (OCTAVES - 3)
    dr.eval(taken, octave, step)
    taken, octave, outwards = (as_numpy(a, LANES) for a in (taken, octave, step > 1))
    up, down = (np.bincount(octave.astype(int), taken * (outwards == way), OCTAVES) for way in (1, 0))

    p_values = PValues()
    chi2, bins, worst = chi_square(up, down, up + down, FEWEST)
    words = (f"{n} records of one particle: chi-square {chi2:.0f} over {bins} sizes; worst within the chord "
             f"{2 ** ((worst - OCTAVES + 4) / 2):.2g}: {up[worst]:.0f} steps outwards, {down[worst]:.0f} inwards")
    p_values.add(stats.chi2.sf(chi2, bins), words)
    p_values.add(of_sums(up.sum(), down.sum(), taken.sum())[0],
                 f"{n} records of one particle: {up.sum():.0f} steps outwards, {down.sum():.0f} inwards")
    return p_values.verdict(level, f"{n} records, {taken.sum():.0f} steps of {LANES} samples")
