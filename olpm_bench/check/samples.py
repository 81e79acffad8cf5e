"""sample() realises pdf(): it reports that density, and follows it."""
from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.density import ROUNDING, direction
from olpm_bench.check.fine_scale import Tosses
from olpm_bench.check.particles import vector
from olpm_bench.check.picture import of_record
from olpm_bench.check.trained import CORNERS, Samples, Trained, as_numpy
from olpm_bench.check.verdict import Failure, PValues, Verdict, exact, worst_of
from representations.square import from_hemisphere, to_hemisphere

BINS = 16                   # along each side of the square in the chi-square test
FEWEST = 50.0               # terms of a bin; bins with fewer are pooled
NEIGHBOURS = 2.0**-22       # how far apart directions may be that differ by rounding
LOST = 1e-3                 # share of samples above the horizon whose pdf may be 0: carried over a rim by rounding


def report_pdf(trained: Trained) -> Verdict:
    """The density that sample() returns is the one that pdf() gives for its direction; directions have unit length."""
    records, found = trained.records, []
    for d, how in ((trained.drawn, ""), (trained.corners, f" {CORNERS}")):
        alive = d.alive
        with np.errstate(invalid="ignore", divide="ignore"):
            other = alive & ~(np.abs(d.reported / d.pdf - 1) <= ROUNDING)
        other[other] = ~(np.abs(d.reported - d.pdf)[other] <= _steepness(trained, d, other))
        not_finite = ~np.isfinite(d.wo).all(1) | ~np.isfinite(d.reported)
        not_unit = alive & (np.abs(np.linalg.norm(d.wo, axis=1) - 1) > 1e-5)
        for wrong, what in ((not_finite, "not finite"), (d.reported < 0, "negative"),
                            (alive & (d.wo[:, 2] <= 0), "below the horizon"), (not_unit, "not of unit length"),
                            (other, "another density")):
            if wrong.any():
                i = int(np.flatnonzero(wrong)[0])
                words = (f"{records.name(d.record[i])}: a sample{how} at {direction(d.wo[i])} reports {d.reported[i]:.5g} 1/sr, "
                         f"pdf() says {d.pdf[i]:.5g}: {what}; {wrong.sum()} of {len(wrong)} samples")
                found.append(Failure(wrong.sum(), words, of_record(trained, d.record[i], d.wo[i])))
    d, alive = trained.drawn, trained.drawn.alive
    lost = ~alive & (d.wo[:, 2] > 0)
    share = np.bincount(d.record, lost, len(records)) / records.counts
    if share.max() > LOST:
        r = int(share.argmax())
        found.append(Failure(lost.sum(), f"{records.name(r)}: {share[r]:.2%} of the samples fail, but are not below the horizon",
                             of_record(trained, r)))
    return exact(found, "wrong samples", f"{len(alive)} samples, {1 - alive.mean():.2%} fail, {lost.mean():.1e} by rounding")


def _steepness(trained: Trained, drawn: Samples, some: np.ndarray) -> np.ndarray:
    """By how much pdf() differs between directions of some samples and others that float32 can hardly tell from them [1/sr]."""
    record, wo, pdf = drawn.record[some], drawn.wo[some], drawn.pdf[some]
    if len(record) == 0:
        return np.zeros(0)
    steps = NEIGHBOURS * np.concatenate([np.eye(3), -np.eye(3)])
    return np.max([np.abs(trained.density(record, wo + step) - pdf) for step in steps], axis=0)


def follow_pdf(trained: Trained, level: float) -> Verdict:
    """Chi-square of samples against pdf() over the bins of the square, a record each; sums over all bins; and cells of all sizes.

    Grids miss narrow lobes and plain Monte Carlo integrals of pdf() are heavy-tailed.  So with x from sample(), y from
    a proposal q and f = pdf(), compare in each bin B the means of 1_B q / (q + f) over x and 1_B f / (q + f) over y:
    both estimate the integral of f q / (q + f) over B if x follows f, and neither has terms above 1.

    A record's x and y are independent draws, and their numbers are fixed: the variance of a mean of terms t over n of them is
    (E t^2 - (E t)^2) / n.  So it is for the sum over all bins; in the bins E t^2 / n stands for it (see `chi_square`).  Of both
    means together that is the integral over B of (f q^2 + q f^2) / (q + f)^2, which is the integral of f q / (q + f) again: a
    bin's variance is its own mean over n.  Squares of few terms would be a poor estimate: where q is a hundredth of f, one y in
    place of hundreds of x holds all of the variance, and a bin may have none.
    """
    records, d, p = trained.records, trained.drawn, trained.records.proposed
    above = d.alive & (d.wo[:, 2] > 0)
    record, wo, f_x, f_y = d.record[above], d.wo[above], d.pdf[above], trained.proposed
    q_x = records.proposals.pdf(record, wo)
    sampled, variance_x = _binned(q_x / (q_x + f_x), record, wo, records.counts)
    expected, variance_y = _binned(f_y / (p.q + f_y), p.record, p.wo, records.counts)
    variance, p_values = variance_x + variance_y, PValues()
    for r in range(len(records)):
        n = records.counts[r]
        chi2, bins, worst = chi_square(sampled[r], expected[r], (sampled[r] + expected[r]) / (2 * n), FEWEST / n)
        centre = _centre(worst)
        words = f"{records.name(r)}: chi-square {chi2:.0f} for {bins} bins, worst around {direction(centre)}"
        p_values.add(stats.chi2.sf(chi2, bins), words, of_record(trained, r, centre))
    for condition in dict.fromkeys(records.conditions):
        some = [c == condition for c in records.conditions]
        p_value, words = of_sums(sampled[some].sum(), expected[some].sum(), variance[some].sum())
        p_values.add(p_value, f"all records '{condition}': {words}", of_record(trained, some.index(True)))
    tosses = Tosses(records.rng(16))
    tosses.add(True, record, wo, f_x, q_x)
    tosses.add(False, p.record, p.wo, f_y, p.q)
    for p_value, words, r in tosses.tests([records.name(r) for r in range(len(records))]):
        p_values.add(p_value, words, of_record(trained, r))
    return p_values.verdict(level, f"{len(q_x) + len(f_y)} directions")


def _binned(terms: np.ndarray, record: np.ndarray, wo: np.ndarray, trials: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means over a record's trials of the terms in each bin [n_records, BINS^2], and the variance of their sum [n_records]."""
    n = len(trials)
    mean = np.bincount(record * BINS**2 + bin_of(wo), terms, n * BINS**2).reshape(n, BINS**2) / trials[:, None]
    return mean, (np.bincount(record, terms**2, n) / trials - mean.sum(1) ** 2) / trials


def chi_square(sampled: np.ndarray, expected: np.ndarray, variance: np.ndarray, fewest: float) -> tuple[float, int, int]:
    """Of two estimates a bin; bins with less than `fewest` in both are pooled, so that sums are close to normal.

    Where a term falls into one bin of many, the estimates of two bins are correlated.  With p and s the means of terms and of
    their squares in the bins, the covariance of the sums over n terms is n (diag(s) - p p^T), which n diag(s) exceeds by a
    matrix that is not negative: with s for the variance the statistic is at most chi-square.  What that loses is close to one
    degree of freedom, the sum over all bins, which `of_sums` tests.

    Returns:
        The statistic, its degrees of freedom (bins with anything in them), and a bin that differs most.
    """
    group = np.where(sampled + expected < fewest, 0, np.arange(1, len(sampled) + 1))
    group = np.unique(group, return_inverse=True)[1]
    a, b, v = (np.bincount(group, t) for t in (sampled, expected, variance))
    z2 = _beyond_rounding(a, b) ** 2 / np.maximum(v, 1e-30)
    return float(z2.sum()), max(int(np.count_nonzero(v)), 1), int(np.flatnonzero(group == np.argmax(z2))[0])


def of_sums(sampled: float, expected: float, variance: float) -> tuple[float, str]:
    """p-value, and words, of two sums of many terms whose difference has this variance."""
    z, relative = _beyond_rounding(sampled, expected) / np.sqrt(max(variance, 1e-30)), (sampled - expected) / max(expected, 1e-30)
    return 2 * float(stats.norm.sf(z)), f"samples and pdf differ by {relative:+.2%}, {z:.1f} standard deviations"


def _beyond_rounding(sampled: Any, expected: Any) -> Any:
    """How far they are apart, less what float32 is forgiven."""
    return np.maximum(np.abs(sampled - expected) - ROUNDING * expected, 0)


def bin_of(wo: np.ndarray) -> np.ndarray:
    """On the square [n], in 0 .. BINS^2 - 1."""
    x, y = np.clip((np.array(from_hemisphere(vector(wo))) * BINS).astype(int), 0, BINS - 1)
    return y * BINS + x


def _centre(index: int) -> np.ndarray:
    wo = to_hemisphere(mi.Point2f((index % BINS + 0.5) / BINS, (index // BINS + 0.5) / BINS))
    return np.array(wo).ravel()


def mind_active(several: Sequence[Trained]) -> Verdict:
    """Lanes that are switched off may ask for records that don't exist: nothing is read there, and other lanes don't notice.

    Such a read may return anything or end the process; `JitFlag.Debug` makes it 0, and a line on sys.stderr.
    """
    return worst_of({"" if trained.records.at is None else "with parallax": _mind_active(trained) for trained in several})


def _mind_active(trained: Trained, n: int = 4096) -> Verdict:
    rng, records, r = trained.records.rng(7), trained.records, trained.representation
    chosen, on = rng.integers(0, len(records), n), rng.random(n) < 0.5
    active, record = mi.Bool(on), mi.UInt32(chosen.astype(np.uint32))
    masked, at = mi.UInt32(np.where(on, chosen, len(records)).astype(np.uint32)), trained.at(chosen)
    u, v = mi.Float(rng.random(n).astype(np.float32)), mi.Point2f(rng.random((2, n)).astype(np.float32))
    expected, expected_pdf = r.sample(trained.state, record, u, v, True, at)
    dr.eval(expected, expected_pdf)
    found, said = [], io.StringIO()
    with contextlib.redirect_stderr(said), dr.scoped_set_flag(dr.JitFlag.Debug):
        wo, pdf = r.sample(trained.state, masked, u, v, active, at)
        again = r.pdf(trained.state, masked, expected, active, at)
        dr.eval(wo, pdf, again)
        dr.sync_thread()
    if reads := [line.strip() for line in said.getvalue().splitlines() if "out-of-bounds" in line]:
        found.append(Failure(len(reads), f"lanes that are switched off read the state: {reads[0]}"))
    for name, a, b in (("the pdf of sample()", pdf, expected_pdf), ("the direction of sample()", wo.z, expected.z),
                       ("pdf()", again, expected_pdf)):
        a, b = as_numpy(a, n), as_numpy(b, n)
        wrong = on & ~np.isclose(a, b, rtol=ROUNDING, equal_nan=True)
        if wrong.any():
            i = int(np.flatnonzero(wrong)[0])
            words = f"{records.name(chosen[i])}: {name} is {a[i]:.5g} instead of {b[i]:.5g} where other lanes are switched off"
            found.append(Failure(wrong.sum(), words))
    return exact(found, "reads, or lanes that notice", f"{n} lanes, half of them switched off")
