"""How often claims that are false by a hair hold, and how often true ones do."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from olpm_bench.bench import gate
from olpm_bench.bench.config import Claim
from olpm_bench.bench.pixel_variance import CellImages
from olpm_bench.bench.ratio_bound import MIN_SEEDS, ratio_bound

FALSE_ALARMS = 0.07         # of claims at 95 % at a true ratio of 1, in each family
LEVEL = 1e-3                # of each test


def test_the_bound_is_where_the_mean_difference_is_as_far_away_as_it_says():
    rng = np.random.default_rng(1)
    a, b = rng.gamma(2, 1, MIN_SEEDS), rng.gamma(3, 1, MIN_SEEDS)
    found = ratio_bound(a, b, 0.95)
    assert found.value == a.mean() / b.mean()
    t = stats.t.ppf(0.975, MIN_SEEDS - 1)
    reach = np.sqrt(t**2 * stats.sem(a - found.high * b) ** 2 + (19 - t**2) * stats.sem(a) ** 2)
    assert found.high * b.mean() - a.mean() == pytest.approx(reach)


def test_the_bounds_of_the_inverse_are_the_inverse_bounds():
    rng = np.random.default_rng(2)
    a, b = rng.gamma(20, 1, (2, MIN_SEEDS))
    there, back = ratio_bound(a, b, 0.9), ratio_bound(b, a, 0.9)
    assert (1 / back.high, 1 / back.low) == pytest.approx((there.low, there.high))


def test_an_outlier_of_the_better_method_widens_the_bound_more_than_one_of_the_worse():
    ones, outlier = np.ones(MIN_SEEDS), 1 + np.eye(1, MIN_SEEDS)[0]
    assert ratio_bound(outlier, ones, 0.95).high == pytest.approx(1 + (1 + np.sqrt(19)) / MIN_SEEDS)
    assert 1 < ratio_bound(ones, outlier, 0.95).high < 1 + 2 / MIN_SEEDS


def test_unseen_events_widen_a_bound_by_what_they_add():
    ones = np.ones(MIN_SEEDS)
    assert ratio_bound(ones, 2 * ones, 0.95, (0.5, 1.0))[:3] == pytest.approx((0.5, 1 / 3, 0.75))


def test_what_cannot_be_bounded_is_infinite_or_undefined():
    ones, once = np.ones(MIN_SEEDS), np.eye(1, MIN_SEEDS)[0]
    assert ratio_bound(ones, once, 0.95).high == np.inf         # a single seed is all of the denominator
    assert ratio_bound(once, ones, 0.95).low == 0
    for a, b in ((ones, 0 * ones), (ones * np.nan, ones), (ones, ones * np.inf)):
        assert np.isnan(ratio_bound(a, b, 0.95)[:3]).all()


# ---------------------------------------------------------------- errors

def spread(rng: np.random.Generator, sigma: float) -> np.ndarray:
    """Log-normal errors whose expectation is 1."""
    return np.exp(sigma * rng.standard_normal(MIN_SEEDS) - sigma**2 / 2)


def with_fireflies(rng: np.random.Generator, probability: float, size: float) -> np.ndarray:
    """Errors whose expectation is 1, of seeds of which some have a firefly of `size`."""
    hit = rng.random(MIN_SEEDS) < probability
    return (1 - probability * size) * (1 + 0.05 * rng.standard_normal(MIN_SEEDS)) + size * hit


FAMILIES: dict[str, Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]] = {
    "normal": lambda rng: tuple(1 + 0.2 * rng.standard_normal((2, MIN_SEEDS))),
    "better exponential": lambda rng: (rng.exponential(size=MIN_SEEDS), spread(rng, 0.05)),
    "both exponential": lambda rng: tuple(rng.exponential(size=(2, MIN_SEEDS))),
    "fireflies in one of 10 seeds of the better": lambda rng: (with_fireflies(rng, 0.1, 5), spread(rng, 0.05)),
    "fireflies in one of 14 seeds of the better": lambda rng: (with_fireflies(rng, 0.07, 13), spread(rng, 0.05)),
    "fireflies in one of 10 seeds of the worse": lambda rng: (spread(rng, 0.05), with_fireflies(rng, 0.1, 5)),
    "no noise in one of 14 seeds of the worse": lambda rng: (spread(rng, 0.05), (rng.random(MIN_SEEDS) >= 0.07) / 0.93),
    "log-normal, the better 1, the worse 0.2": lambda rng: (spread(rng, 1.0), spread(rng, 0.2)),
    "log-normal, the better 1.5, the worse 0.2": lambda rng: (spread(rng, 1.5), spread(rng, 0.2)),
    "log-normal, the better 0.2, the worse 1": lambda rng: (spread(rng, 0.2), spread(rng, 1.0)),
}


def held(family: str, ratio: float, trials: int, true_ratio: float = 1.0) -> int:
    rng, count = np.random.default_rng(7), 0
    for _ in range(trials):
        better, worse = FAMILIES[family](rng)
        count += ratio_bound(true_ratio * better, worse, 0.95).high <= ratio
    return count


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_claims_on_errors_that_are_false_by_a_hair_hold_as_rarely_as_they_say(family):
    trials = 4000
    assert stats.binomtest(held(family, 1.0, trials), trials, FALSE_ALARMS, alternative="greater").pvalue > LEVEL


@pytest.mark.slow
def test_claims_that_are_true_hold_as_often_as_they_say():
    """Independent normal errors with a standard deviation of a fifth."""
    v, trials = 0.2, 1000
    t = stats.t.ppf(0.975, MIN_SEEDS - 1)
    true_ratio = 1 - v * (np.sqrt(19 + t**2) + np.sqrt(2) * stats.norm.ppf(0.95)) / np.sqrt(MIN_SEEDS)
    assert true_ratio == pytest.approx(0.773, abs=0.002)
    assert stats.binomtest(held("normal", 1.0, trials, true_ratio), trials, 0.95, alternative="less").pvalue > LEVEL


# ---------------------------------------------------------------- variances

LOG_NORMAL = 1.5
PIXELS: dict[str, Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]] = {     # of mean 0 and variance 1
    "log-normal": lambda rng, shape: (np.exp(LOG_NORMAL * rng.standard_normal(shape)) - np.exp(LOG_NORMAL**2 / 2)) / np.sqrt(
        np.expm1(LOG_NORMAL**2) * np.exp(LOG_NORMAL**2)),
    "fireflies in one of 50": lambda rng, shape: ((rng.random(shape) < 0.02) - 0.02) / np.sqrt(0.02 * 0.98),
    "normal": lambda rng, shape: rng.standard_normal(shape),
}


def cells(rng: np.random.Generator, noise: str, passes: int, side: int, deviation: float = 1.0) -> CellImages:
    """Grey images of radiance 2, whose pixels have the squared deviation as variance in each pass; a second each."""
    values = 2 + deviation * PIXELS[noise](rng, (MIN_SEEDS, passes, side, side, 1))
    mean = np.repeat(values.mean(axis=1), 3, axis=-1)
    variance = np.repeat(values.var(axis=1, ddof=1) / passes, 3, axis=-1) if passes > 1 else np.full_like(mean, np.inf)
    return CellImages(mean, variance, np.full(MIN_SEEDS, passes), np.ones(MIN_SEEDS))


def variances_held(noise: str, passes: int, side: int, trials: int, true_ratio: float = 1.0) -> int:
    claim = Claim(better="Better", worse="Worse", metric="relative_variance", ratio=1.0)
    rng, count = np.random.default_rng(8), 0
    for _ in range(trials):
        better, worse = cells(rng, noise, passes, side, np.sqrt(true_ratio)), cells(rng, "normal", passes, side)
        count += gate.ratio(claim, better, worse, None).high <= claim.ratio
    return count


@pytest.mark.slow
@pytest.mark.parametrize("noise, passes, side", [
    ("log-normal", 1, 8), ("log-normal", 1, 16), ("log-normal", 4, 12),
    ("fireflies in one of 50", 1, 8), ("fireflies in one of 50", 4, 12), ("normal", 4, 12)])
def test_claims_on_variances_that_are_false_by_a_hair_hold_as_rarely_as_they_say(noise, passes, side):
    trials = 1000
    count = variances_held(noise, passes, side, trials)
    assert stats.binomtest(count, trials, FALSE_ALARMS, alternative="greater").pvalue > LEVEL


@pytest.mark.parametrize("noise, true_ratio, least", [
    ("normal", 0.9, 20), ("fireflies in one of 50", 0.7, 20), ("log-normal", 0.5, 10)])
def test_claims_on_variances_that_are_true_hold(noise, true_ratio, least):
    """Of 20."""
    assert variances_held(noise, 4, 16, 20, true_ratio) >= least
