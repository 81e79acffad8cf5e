"""Ten thousands of records at once: what only one of them gets wrong, or what depends on the index of a record."""
from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.density import ROUNDING, direction
from olpm_bench.check.particles import normalised, uniform_directions, vector
from olpm_bench.check.picture import of_density, over_disk
from olpm_bench.check.proposal import Proposals
from olpm_bench.check.samples import BINS, FEWEST, bin_of, chi_square, of_sums
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import Panel, Picture, PValues, Verdict, sidak, worst_of
from representations.interface import ParticleBatch
from representations.state import bytes_of

RECORDS, BYTES = 1 << 15, 1 << 28       # as many records, unless their states take more memory than this
PARTICLES = 96              # of each in its first batch: more than a mixture's first fit needs
SPREAD = 0.15               # radius of a record's lobe [rad]
PLACES = 0.05               # deviation of the points where particles land, and from which records are asked [scene units]
DIRECTIONS = 16             # samples of each record, and as many directions of a proposal
PACKET = 16                 # lanes
SHOWN = 1 << 17             # samples of a record in the picture of it


def are_right(representation: Any, seed: int, level: float) -> Verdict:
    """Each record learns a lobe of its own in two batches; all samples and densities are looked at, and compared as in
    `follow_pdf`: over bins of the square, over blocks of records, and over the lanes of a packet.  Without parallax, and with it,
    asked from beside the record and as it is.
    """
    found, rng = {}, np.random.default_rng([4, seed])
    axis = uniform_directions(records_that_fit(representation, RECORDS), rng)
    for parallax in (False, True):
        state = representation.init(len(axis), seed, parallax)
        for index, particles in enumerate((PARTICLES, PARTICLES // 4)):
            state = representation.update(state, _lobes(axis, particles, parallax, rng), seed + index)
            dr.eval(state)
        for aside, words in ((True, "with parallax"), (False, "with parallax, asked as it is")) if parallax else ((False, ""),):
            found[words] = _compare(representation, state, axis, aside, sidak(level, 3), rng)
    return worst_of(found)


def _compare(representation: Any, state: Any, axis: np.ndarray, aside: bool, level: float, rng: np.random.Generator) -> Verdict:
    """Samples and densities, asked from beside the records or as they are."""
    n = len(axis)
    record = rng.permutation(np.repeat(np.arange(n), DIRECTIONS))
    index, lanes = mi.UInt32(record.astype(np.uint32)), len(record)
    at = vector(PLACES * rng.standard_normal((lanes, 3), np.float32)) if aside else None
    proposals = Proposals(list(zip(axis[:, None], np.ones((n, 1)), strict=True)), rng)
    x, reported = representation.sample(state, index, mi.Float(rng.random(lanes, np.float32)),
                                        mi.Point2f(rng.random((2, lanes), np.float32)), True, at)
    dr.eval(x, reported)
    x, y = np.stack([as_numpy(c, lanes) for c in x], -1), proposals.at(record, rng.random((lanes, 3)))
    reported, f_x, f_y = (as_numpy(p, lanes) for p in (reported, representation.pdf(state, index, vector(x), True, at),
                                                       representation.pdf(state, index, vector(y), True, at)))
    fine = np.isfinite(x).all(1)
    for wo, f in ((x, f_x), (y, f_y)):
        fine &= np.isfinite(f) & (f >= 0) & ((wo[:, 2] > 0) | (f == 0))
    fine &= (reported == 0) | np.isclose(reported, f_x, rtol=ROUNDING, atol=0)
    if not fine.all():
        i = int(np.flatnonzero(~fine)[0])
        return Verdict(False, "wrong records", float(len(np.unique(record[~fine]))), 0.0, f"record {record[i]} of {n}: sample "
                       f"{direction(x[i])} reports {reported[i]:.5g} 1/sr, pdf() says {f_x[i]:.5g}, and {f_y[i]:.5g} at "
                       f"{direction(y[i])}", picture=_of_record(representation, state, int(record[i])))
    q_x, q_y = proposals.pdf(record, x), proposals.pdf(record, y)
    a = np.where((reported > 0) & (x[:, 2] > 0), q_x / (q_x + f_x), 0)
    b = np.where(y[:, 2] > 0, f_y / (q_y + f_y), 0)
    # A lane's x and y are of the same record: a - b has the mean 0, and the variance E (a - b)^2.  Of blocks and lanes the
    # numbers of terms are fixed; of bins they are not, and E (a^2 + b^2) = E a = E b stands for it (see `follow_pdf`).
    apart, block, lane, in_x, in_y = (a - b) ** 2, record * BINS**2 // n, np.arange(lanes) % PACKET, bin_of(x), bin_of(y)
    p_values = PValues()
    for what, of_x, of_y in (("blocks of records", block, block), ("lanes of a packet", lane, lane),
                             ("bins of the square", in_x, in_y)):
        sampled, expected = np.bincount(of_x, a, BINS**2), np.bincount(of_y, b, BINS**2)
        variance = np.bincount(of_x, apart, BINS**2) if of_x is of_y else (sampled + expected) / 2
        chi2, bins, worst = chi_square(sampled, expected, variance, FEWEST)
        words = (f"{n} records: chi-square {chi2:.0f} over {bins} {what}; worst is number {worst}: {sampled[worst]:.0f} sampled, "
                 f"{expected[worst]:.0f} by the pdf")
        picture = partial(_of_groups, what, sampled, expected, variance)
        p_values.add(stats.chi2.sf(chi2, bins), words, picture)
    p, words = of_sums(a.sum(), b.sum(), apart.sum())
    p_values.add(p, f"{n} records: {words}", picture)
    return p_values.verdict(level, f"{n} records, {2 * lanes} directions")


def records_that_fit(representation: Any, most: int) -> int:
    """As many as `most`, or as `BYTES` hold."""
    return int(np.clip(BYTES * 64 // max(bytes_of(representation.init(64)), 1), BINS**2, most))


def _of_record(representation: Any, state: Any, record: int) -> Picture:
    """Its density and its samples."""
    def panels() -> list[Panel]:
        index, rng = dr.full(mi.UInt32, record, SHOWN), np.random.default_rng(0)
        wo, pdf = representation.sample(state, index, mi.Float(rng.random(SHOWN, np.float32)),
                                        mi.Point2f(rng.random((2, SHOWN), np.float32)))
        x = np.stack([as_numpy(c, SHOWN) for c in wo], -1)[as_numpy(pdf, SHOWN) > 0]
        return [of_density(f"pdf of record {record}", lambda wo: as_numpy(
                    representation.pdf(state, dr.full(mi.UInt32, record, len(wo)), vector(wo)), len(wo))),
                Panel(f"histogram of {len(x)} samples", over_disk(x, np.full(len(x), 1 / SHOWN)))]
    return panels


def _of_groups(what: str, sampled: np.ndarray, expected: np.ndarray, variance: np.ndarray) -> list[Panel]:
    """Bins of the square; others are drawn in rows of as many, from the top."""
    z = np.divide(sampled - expected, np.sqrt(variance), out=np.full(len(variance), np.nan), where=variance > 0)
    order = -1 if what == "bins of the square" else 1
    return [Panel(title, values.reshape(BINS, BINS)[::order], scale, unit) for title, values, scale, unit in (
        (f"sampled, {what}", np.where(variance > 0, sampled, np.nan), "linear", "sum of weights"),
        ("by the pdf", np.where(variance > 0, expected, np.nan), "linear", "sum of weights"),
        ("sampled - by the pdf", z, "signed", "standard deviations"))]


def _lobes(axis: np.ndarray, particles: int, parallax: bool, rng: np.random.Generator) -> ParticleBatch:
    """A lobe around the axis of each record, of light that is far away, so that it is there from all places."""
    n, m = len(axis), len(axis) * particles
    wo = np.repeat(axis, particles, axis=0) + SPREAD * rng.standard_normal((m, 3), np.float32)
    wo[:, 2] = np.abs(wo[:, 2]) + 1e-3
    record = mi.UInt32(np.repeat(np.arange(n, dtype=np.uint32), particles))
    at = vector(PLACES * rng.standard_normal((m, 3), np.float32)) if parallax else None
    return ParticleBatch.from_arrays(vector(normalised(wo)), dr.ones(mi.Float, m), record, n, None, at)
