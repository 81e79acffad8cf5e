"""Spread over seeds, and comparisons between methods: bands, intervals of ratios, equal error, means of ratios.

Error curves live on log-log axes, where convergence is a straight line of slope -1/2, so they are interpolated
there, and never beyond what was measured.  Seeds are paired: seed i of one method with seed i of another.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from olpm_bench.transport.settings import InputError

BAND = (5.0, 95.0)          # [%]


class Band(NamedTuple):
    """Median and 5 to 95 % range over seeds: floats, or arrays over a common axis."""
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray


class Interval(NamedTuple):
    """An estimate and its interval (90 %), NaN where there is none."""
    value: float
    low: float
    high: float
    bound: str = ""         # ">": at least the value; "<": at most
    why: str = ""           # there is no value, in words

    def ends(self, dash: str = "-") -> str:
        """The interval in brackets, after a space; empty where there is none."""
        return f" ({self.low:.2g}{dash}{self.high:.2g})" if np.isfinite([self.low, self.high]).all() else ""


class Curve(NamedTuple):
    """Error against time for several seeds on one time axis: times (n), errors (seeds, n)."""
    times: np.ndarray
    errors: np.ndarray

    @property
    def median(self) -> np.ndarray:
        return np.median(self.errors, axis=0)


def median_band(values: Sequence[float] | np.ndarray) -> Band:
    """Median and 5 to 95 % band over the first axis (seeds)."""
    low, median, high = np.percentile(np.asarray(values, np.float64), (BAND[0], 50.0, BAND[1]), axis=0)
    return Band(median, low, high)


def geometric_mean(ratios: Sequence[float] | np.ndarray) -> float:
    """exp(mean(log)): the mean of speed-ups over scenes.

    Raises:
        ValueError: no ratio, or one that is not positive and finite.
    """
    ratios = np.asarray(ratios, np.float64)
    if ratios.size == 0 or not (np.isfinite(ratios).all() and (ratios > 0).all()):
        raise ValueError(f"ratios {ratios.tolist()}: must be positive and finite, and at least one")
    return float(np.exp(np.log(ratios).mean()))


def interpolate(times: np.ndarray, errors: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Errors at the times `at`, linear on log-log axes; NaN outside the measured times."""
    return np.exp(np.interp(np.log(at), np.log(times), np.log(errors), left=np.nan, right=np.nan))


def common_curve(times: Sequence[np.ndarray], errors: Sequence[np.ndarray], n: int = 65) -> Curve:
    """Curves of several seeds, each with its own checkpoints, on the geometric axis of times that all of them cover.

    Curves of a single checkpoint each, or that share no time, are told by their ends, at the median of those times.

    Args:
        times, errors: per seed, equally long; times (or samples per pixel) increasing and positive, errors positive.
        n: points of the axis.

    Raises:
        InputError: an input out of that range.
    """
    for t, e in zip(times, errors, strict=True):
        if len(t) != len(e) or not (np.diff(t) > 0).all() or not np.min(t) > 0:
            raise InputError(f"times {np.asarray(t).tolist()}: must increase from above 0, one per error")
        if not (np.min(e) > 0 and np.isfinite(e).all()):
            raise InputError(f"errors {np.asarray(e).tolist()}: must be positive and finite")
    start, end = max(t[0] for t in times), min(t[-1] for t in times)
    if start > end or all(len(t) == 1 for t in times):
        return Curve(np.array([np.median([t[-1] for t in times])]), np.array([[e[-1]] for e in errors], np.float64))
    at = np.geomspace(start, end, n)
    at[0], at[-1] = start, end      # exactly: rounding must not leave the measured range
    return Curve(at, np.stack([interpolate(t, e, at) for t, e in zip(times, errors, strict=True)]))


def time_to_error(times: np.ndarray, errors: np.ndarray, error: float) -> float:
    """First time at which the curve is down to `error`, by log-log interpolation.

    Returns:
        NaN where it never is, and where it is already below at its first point: that time was not measured.
    """
    if errors[0] < error:
        return float("nan")
    reached = np.flatnonzero(errors <= error)
    if reached.size == 0:
        return float("nan")
    i = int(reached[0])
    if errors[i] == error:
        return float(times[i])
    log_t, log_e = np.log(times[i - 1:i + 1]), np.log(errors[i - 1:i + 1])
    return float(np.exp(np.interp(-np.log(error), -log_e, log_t)))


def jackknife(statistic: Callable[[np.ndarray], float], n: int, confidence: float = BAND[1] / 100) -> Interval:
    """Interval of a positive statistic of seeds from its logarithm without one of them at a time (Tukey 1958), by Student's t.

    For statistics that count how often a seed was drawn, as variances do: a bootstrap draws some twice.

    Args:
        statistic: of seeds, which gets their numbers and so leaves one out of all methods at once.
        n: number of seeds.
        confidence: that of each end.

    Returns:
        The interval is NaN with two seeds or fewer, and where the statistic without some seed has no logarithm.
    """
    seeds = np.arange(n)
    value = float(statistic(seeds))
    if n <= 2:
        return Interval(value, float("nan"), float("nan"))
    with np.errstate(invalid="ignore", divide="ignore"):
        without = np.log([statistic(np.delete(seeds, i)) for i in seeds])
        reach = np.exp(special.stdtrit(n - 1, confidence) * np.sqrt((n - 1) * np.var(without)))
    return Interval(value, float(value / reach), float(value * reach))


def speed_up(baseline: Curve, method: Curve, error: float | None = None, least: float = 0.0) -> Interval:
    """Time of the baseline over time of the method at equal error (geometric mean over seeds), with a paired jackknife interval.

    Args:
        error: the error to reach; by default the lowest that both curves reach, found anew without each seed.
        least: but none below this, where both curves level out in the noise of the reference.

    Returns:
        NaN where one of them does not reach the error, or both start below it.  Where only one starts below, the ratio with its
        first time bounds the speed-up, and `bound` says from which side.  No interval where a seed less makes that so, nor with
        two seeds.
    """
    _paired(baseline, method)
    n = len(method.errors)

    def ratio(index: np.ndarray) -> tuple[float, str]:
        a, b = (np.exp(np.log(curve.errors[index]).mean(axis=0)) for curve in (baseline, method))
        level = max(a.min(), b.min(), least) if error is None else error
        below = a[0] < level, b[0] < level
        if all(below):
            return float("nan"), ""
        time_a = baseline.times[0] if below[0] else time_to_error(baseline.times, a, level)
        time_b = method.times[0] if below[1] else time_to_error(method.times, b, level)
        return float(time_a / time_b), "<" if below[0] else ">" if below[1] else ""

    def measured(index: np.ndarray) -> float:
        value, bound = ratio(index)
        return value if not bound else float("nan")
    interval = jackknife(measured, n)
    value, bound = ratio(np.arange(n))
    return interval._replace(value=value, bound=bound)


def worst_speed_up(baseline: Curve, method: Curve, least: float = 0.0) -> float:
    """The least ratio of the times at which two median curves are down to the same error, of all errors that both reach.

    Looked for at the points of either curve: between them the ratio's logarithm is linear in that of the error.  When a curve
    was down to what it is below from the start was not measured.  NaN where there is no such error of `least` or more.
    """
    a, b = baseline.median, method.median
    ratios = [time_to_error(baseline.times, a, error) / time_to_error(method.times, b, error) for error in (*a, *b)
              if error >= least]
    return min((ratio for ratio in ratios if np.isfinite(ratio)), default=float("nan"))


def _paired(a: Curve, b: Curve) -> None:
    if len(a.errors) != len(b.errors):
        raise ValueError(f"{len(a.errors)} and {len(b.errors)} seeds: curves are compared in pairs of seeds")
