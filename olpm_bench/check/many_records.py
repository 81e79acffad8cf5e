"""Ten thousands of records at once: what only one of them gets wrong, or what depends on the index of a record."""
from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.density import ROUNDING, direction
from olpm_bench.check.particles import distances, normalised, uniform_directions, vector
from olpm_bench.check.picture import of_density, over_disk
from olpm_bench.check.proposal import Proposals
from olpm_bench.check.samples import BINS, FEWEST, bin_of, chi_square, of_sums
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.trials import FAINT
from olpm_bench.check.verdict import Panel, Picture, PValues, Verdict, sidak, worst_of
from representations.interface import ParticleBatch
from representations.state import bytes_of

RECORDS = (1 << 17) - 1     # almost as many as a guide may have, and a prime: who works in blocks has a remainder
BYTES = 1 << 28             # of their states: fewer records, if they would take more memory
LEARNERS = 7                # every seventh record learns
PARTICLES = 96              # of each in a batch: more than a mixture's first fit needs
SPREAD = 0.15               # radius of a record's lobe [rad]
PLACES = 0.05               # deviation of the points where particles land, and from which records are asked [scene units]
DIRECTIONS, OF_OTHERS = 24, 1       # samples of a record that learns, and of one that does not, and as many of a proposal
HELD_OUT = 4                # directions of each lobe that nothing was learnt from
COARSE = 16                 # blocks of records
PACKET = 16                 # lanes
SHOWN = 1 << 17             # samples of a record in the picture of it


def are_right(representation: Any, seed: int, level: float) -> Verdict:
    """Every seventh record learns a lobe of its own, then another one.  All samples and densities are looked at, and compared as
    in `follow_pdf`: over bins of the square, over blocks of records, and over the lanes of a packet.  How well records have
    learnt doesn't depend on their index.  Without parallax, and with it, asked from beside the record and as it is.
    """
    found, rng = {}, np.random.default_rng([4, seed])
    axis = uniform_directions(records_that_fit(representation, RECORDS), rng)
    other = axis * np.array([-1, -1, 1], np.float32)
    for parallax in (False, True):
        state = representation.init(len(axis), seed, parallax)
        for index, lobe in enumerate((axis, other)):
            state = representation.update(state, _lobes(lobe, parallax, rng), seed + index)
            dr.eval(state)
        for aside, words in ((True, "with parallax"), (False, "with parallax, asked as it is")) if parallax else ((False, ""),):
            found[words] = _compare(representation, state, axis, other, aside, sidak(level, 3), rng)
    return worst_of(found)


def _compare(representation: Any, state: Any, axis: np.ndarray, other: np.ndarray, aside: bool, level: float,
             rng: np.random.Generator) -> Verdict:
    """Samples and densities, asked from beside the records or as they are."""
    n = len(axis)
    learners = np.arange(0, n, LEARNERS)
    counts = np.full(n, OF_OTHERS)
    counts[learners] = DIRECTIONS
    record = rng.permutation(np.repeat(np.arange(n), counts))
    index, lanes = mi.UInt32(record.astype(np.uint32)), len(record)
    at = places(lanes, rng) if aside else None
    proposals = Proposals(list(zip(np.stack([axis, other], 1), np.ones((n, 2)), strict=True)), rng)
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
    apart, lane, in_x, in_y = (a - b) ** 2, np.arange(lanes) % PACKET, bin_of(x), bin_of(y)
    block, coarse = record * BINS**2 // n, record * COARSE // n
    p_values = PValues()
    for what, of_x, of_y in (("blocks of records", block, block), ("coarse blocks of records", coarse, coarse),
                             ("lanes of a packet", lane, lane), ("bins of the square", in_x, in_y)):
        sampled, expected = np.bincount(of_x, a, BINS**2), np.bincount(of_y, b, BINS**2)
        variance = np.bincount(of_x, apart, BINS**2) if of_x is of_y else (sampled + expected) / 2
        chi2, bins, worst = chi_square(sampled, expected, variance, FEWEST)
        words = (f"{n} records: chi-square {chi2:.0f} over {bins} {what}; worst is number {worst}: {sampled[worst]:.0f} sampled, "
                 f"{expected[worst]:.0f} by the pdf")
        picture = partial(_of_groups, what, sampled, expected, variance)
        p_values.add(stats.chi2.sf(chi2, bins), words, picture)
    p, words = of_sums(a.sum(), b.sum(), apart.sum())
    p_values.add(p, f"{n} records: {words}", picture)
    p_values.add(*_learn_alike(representation, state, other, learners, aside, rng))
    return p_values.verdict(level, f"{n} records, {2 * lanes} directions")


def places(n: int, rng: np.random.Generator) -> mi.Vector3f:
    """Beside a record, and a hundredth exactly there: records are made where particles land."""
    return vector(PLACES * (rng.random((n, 1)) > 0.01) * rng.standard_normal((n, 3), np.float32))


def _learn_alike(representation: Any, state: Any, axis: np.ndarray, learners: np.ndarray, aside: bool,
                 rng: np.random.Generator) -> tuple[float, str, Picture]:
    """Kruskal and Wallis' test of the mean ln pdf at held-out directions of each learner, over blocks of them; words, and a
    picture of the one that has learnt least in the worst block.
    """
    record = np.repeat(learners, HELD_OUT)
    index, at = mi.UInt32(record.astype(np.uint32)), places(len(record), rng) if aside else None
    pdf = as_numpy(representation.pdf(state, index, vector(_around(axis[record], rng)), True, at), len(record))
    learnt = np.log(np.maximum(pdf, FAINT)).reshape(-1, HELD_OUT).mean(1)
    blocks = np.array_split(learnt, np.clip(len(learners) // 32, 2, BINS**2))
    means = np.array([block.mean() for block in blocks])
    p = float(stats.kruskal(*blocks).pvalue) if np.ptp(learnt) > 0 else 1.0
    worst = int(means.argmin())
    shown = int(learners[sum(map(len, blocks[:worst])) + blocks[worst].argmin()])
    words = (f"{len(axis)} records: they don't learn alike: mean ln pdf of held-out directions is {means[worst]:.2f} in number "
             f"{worst} of {len(blocks)} blocks, {learnt.mean():.2f} in all")
    return p, words, _of_record(representation, state, shown)


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


def _lobes(axis: np.ndarray, parallax: bool, rng: np.random.Generator) -> ParticleBatch:
    """A lobe around the axes of records; others get nothing.  Light is nearby, as in training, but for parallax far away, so that
    it is there from all places.
    """
    n, record = len(axis), np.repeat(np.arange(0, len(axis), LEARNERS), PARTICLES)
    at, distance = (places(len(record), rng), None) if parallax else (None, mi.Float(distances(len(record), rng)))
    return ParticleBatch.from_arrays(vector(_around(axis[record], rng)), dr.ones(mi.Float, len(record)),
                                     mi.UInt32(record.astype(np.uint32)), n, distance, at)


def _around(axis: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A direction of the lobe around each axis [n, 3]."""
    wo = axis + SPREAD * rng.standard_normal(axis.shape, np.float32)
    wo[:, 2] = np.abs(wo[:, 2]) + 1e-3
    return normalised(wo)
