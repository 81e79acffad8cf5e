"""Ten thousands of records at once: what only one of them gets wrong, or what depends on the index of a record."""
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.density import ROUNDING, direction
from olpm_bench.check.particles import normalised, uniform_directions, vector
from olpm_bench.check.proposal import Proposals
from olpm_bench.check.samples import BINS, FEWEST, bin_of, chi_square
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import PValues, Verdict
from representations.interface import ParticleBatch
from representations.state import bytes_of

RECORDS, BYTES = 1 << 15, 1 << 28       # as many records, unless their state takes more memory than this
PARTICLES = 96              # of each: more than a mixture's first fit needs
SPREAD = 0.15               # radius of a record's lobe [rad]
DIRECTIONS = 16             # samples of each record, and as many directions of a proposal
PACKET = 16                 # lanes


def be_many(representation: Any, seed: int, level: float) -> Verdict:
    """Each record learns a lobe of its own; all samples and densities are looked at, and compared as in `follow_pdf`:
    over bins of the square, over blocks of records, and over the lanes of a packet.
    """
    rng = np.random.default_rng([4, seed])
    n = int(np.clip(BYTES * 64 // max(bytes_of(representation.init(64)), 1), BINS**2, RECORDS))
    axis = uniform_directions(n, rng)
    state = representation.update(representation.init(n, seed), _lobes(axis, rng), seed)
    dr.eval(state)

    record = rng.permutation(np.repeat(np.arange(n), DIRECTIONS))
    index, lanes = mi.UInt32(record.astype(np.uint32)), len(record)
    proposals = Proposals([(a[None], np.ones(1)) for a in axis], rng)
    x, reported = representation.sample(state, index, mi.Float(rng.random(lanes, np.float32)),
                                        mi.Point2f(rng.random((2, lanes), np.float32)))
    dr.eval(x, reported)
    x, y = np.stack([as_numpy(c, lanes) for c in x], -1), proposals.at(record, rng.random((lanes, 3)))
    reported, f_x, f_y = (as_numpy(p, lanes) for p in (reported, representation.pdf(state, index, vector(x)),
                                                       representation.pdf(state, index, vector(y))))
    fine = np.isfinite(x).all(1)
    for wo, f in ((x, f_x), (y, f_y)):
        fine &= np.isfinite(f) & (f >= 0) & ((wo[:, 2] > 0) | (f == 0))
    fine &= (reported == 0) | np.isclose(reported, f_x, rtol=ROUNDING, atol=0)
    if not fine.all():
        i = int(np.flatnonzero(~fine)[0])
        return Verdict(False, "wrong records", float(len(np.unique(record[~fine]))), 0.0, f"record {record[i]} of {n}: sample "
                       f"{direction(x[i])} reports {reported[i]:.5g} 1/sr, pdf() says {f_x[i]:.5g}, and {f_y[i]:.5g} at "
                       f"{direction(y[i])}")
    q_x, q_y = proposals.pdf(record, x), proposals.pdf(record, y)
    a = np.where((reported > 0) & (x[:, 2] > 0), q_x / (q_x + f_x), 0)
    b = np.where(y[:, 2] > 0, f_y / (q_y + f_y), 0)
    p_values, groups, lane = PValues(), BINS**2, np.arange(lanes) % PACKET
    for what, of_x, of_y in (("bins of the square", bin_of(x), bin_of(y)), ("lanes of a packet", lane, lane),
                             ("blocks of records", record * groups // n, record * groups // n)):
        sampled, expected = np.bincount(of_x, a, groups), np.bincount(of_y, b, groups)
        variance = np.bincount(of_x, a**2, groups) + np.bincount(of_y, b**2, groups)
        chi2, bins, worst = chi_square(sampled, expected, variance, FEWEST)
        words = (f"{n} records: chi-square {chi2:.0f} over {bins} {what}; worst is number {worst}: {sampled[worst]:.0f} sampled, "
                 f"{expected[worst]:.0f} by the pdf")
        p_values.add(stats.chi2.sf(chi2, bins), words)
    difference, error = a.sum() - b.sum(), np.sqrt((a**2).sum() + (b**2).sum())
    z = abs(difference) / error
    p_values.add(2 * stats.norm.sf(z), f"{n} records: samples and pdf differ by {difference / b.sum():+.2%}, {z:.1f} sd")
    return p_values.verdict(level, f"{n} records, {2 * lanes} directions")


def _lobes(axis: np.ndarray, rng: np.random.Generator) -> ParticleBatch:
    """A lobe around the axis of each record."""
    n = len(axis)
    wo = np.repeat(axis, PARTICLES, axis=0) + SPREAD * rng.standard_normal((n * PARTICLES, 3), np.float32)
    wo[:, 2] = np.abs(wo[:, 2]) + 1e-3
    record = mi.UInt32(np.repeat(np.arange(n, dtype=np.uint32), PARTICLES))
    return ParticleBatch.from_arrays(vector(normalised(wo)), dr.ones(mi.Float, n * PARTICLES), record, n)
