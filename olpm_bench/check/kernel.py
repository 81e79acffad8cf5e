"""Around a single particle: the shape of what a representation makes of it, to fractions of a per cent."""
from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.many_records import records_that_fit
from olpm_bench.check.particles import distances, uniform_directions, vector
from olpm_bench.check.samples import FEWEST, chi_square, of_sums
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import Panel, PValues, Verdict
from representations.interface import ParticleBatch

RECORDS = 4093              # with one particle each; a prime, as in `many_records`
LANES = 1 << 22             # samples of all records
FARTHEST = 8.0              # a step multiplies or divides the area within a sample's distance from the particle by up to this
OCTAVES = 40                # of that area
WIDEST = 1.4                # half the edge of a picture, at most: its corners are within the chord 2
CELLS, FINER = 32, 32       # along its edge, and along that of a cell


def keep_balance(representation: Any, seed: int, level: float) -> Verdict:
    """A step of the Metropolis algorithm for pdf() leaves samples distributed as they are (Gandy & Scott 2020 test samplers so).

    The step changes a sample's distance from the record's particle, whatever the scale of the kernel: the area of the cap within
    that distance, pi c^2 for the chord c, is multiplied by s, with ln s uniform in -ln FARTHEST .. ln FARTHEST, the azimuth is
    drawn anew, and the step is taken with the probability min(1, s pdf(y) / pdf(x)).  If x follows the pdf, a step from x to y
    and one from y to x are equally likely: of those whose larger cap has a given size, half go outwards.
    """
    rng = np.random.default_rng([5, seed])
    n = records_that_fit(representation, RECORDS)
    particles = uniform_directions(n, rng)
    axes, weight = vector(particles), mi.Float(rng.lognormal(size=n).astype(np.float32))
    batch = ParticleBatch.from_arrays(axes, weight, dr.arange(mi.UInt32, n), n, mi.Float(distances(n, rng)))
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
    chord = 2 ** ((worst - OCTAVES + 4) / 2)
    words = (f"{n} records of one particle: chi-square {chi2:.0f} over {bins} sizes; worst within the chord "
             f"{chord:.2g}: {up[worst]:.0f} steps outwards, {down[worst]:.0f} inwards")
    steps = np.bincount(np.arange(LANES) % n, taken * (octave == worst) * (2 * outwards - 1), n)
    shown = int(np.abs(steps).argmax())
    picture = partial(_around, representation, state, shown, particles[shown], min(1.5 * chord, WIDEST))
    p_values.add(stats.chi2.sf(chi2, bins), words, picture)
    p_values.add(of_sums(up.sum(), down.sum(), taken.sum())[0],
                 f"{n} records of one particle: {up.sum():.0f} steps outwards, {down.sum():.0f} inwards", picture)
    return p_values.verdict(level, f"{n} records, {taken.sum():.0f} steps of {LANES} samples")


def _around(representation: Any, state: Any, record: int, axis: np.ndarray, edge: float) -> list[Panel]:
    """pdf() and samples around a record's particle: the equal-area map of chords, in its tangent plane, up to `edge` each way."""
    tangents, solid_angle = np.linalg.svd(axis[None])[2][1:], (2 * edge / CELLS) ** 2
    grid = edge * ((np.arange(CELLS * FINER) + 0.5) * 2 / (CELLS * FINER) - 1)
    v = np.stack(np.meshgrid(grid, -grid), -1).reshape(-1, 2)
    c2 = (v**2).sum(1, keepdims=True)
    y = axis * (1 - c2 / 2) + v @ tangents * np.sqrt(1 - c2 / 4)
    pdf = as_numpy(representation.pdf(state, dr.full(mi.UInt32, record, len(y)), vector(y)), len(y))
    expected = pdf.reshape(CELLS, FINER, CELLS, FINER).mean((1, 3))

    u = [mi.Float(numbers) for numbers in np.random.default_rng(0).random((3, LANES), np.float32)]
    x, reported = representation.sample(state, dr.full(mi.UInt32, record, LANES), u[0], mi.Point2f(u[1], u[2]))
    x = np.stack([as_numpy(c, LANES) for c in x], -1)[as_numpy(reported, LANES) > 0]
    at = x @ tangents.T / np.sqrt(np.maximum(1 - ((x - axis) ** 2).sum(1, keepdims=True) / 4, 1e-12))
    sampled = np.histogram2d(-at[:, 1], at[:, 0], CELLS, [[-edge, edge]] * 2)[0] / (LANES * solid_angle)
    error = np.sqrt(np.maximum(expected, sampled) / (LANES * solid_angle))
    z = np.divide(sampled - expected, error, out=np.zeros_like(error), where=error > 0)
    return [Panel(f"record {record}: pdf, chords to {edge:.2g}", expected, "linear"),
            Panel(f"histogram of {LANES} samples", sampled, "linear"),
            Panel("samples - pdf", z, "signed", "standard deviations")]
