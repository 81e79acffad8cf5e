"""Statistics against closed forms and simulated data."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.bench import statistics

TIMES = np.geomspace(1, 16, 9)


def converging(factor: float, times: np.ndarray = TIMES) -> np.ndarray:
    """The error of a Monte Carlo estimate: factor / sqrt(t)."""
    return factor / np.sqrt(times)


def curve(*factors: float, times: np.ndarray = TIMES) -> statistics.Curve:
    return statistics.common_curve([times] * len(factors), [converging(f, times) for f in factors])


def test_median_band_is_the_quantiles_over_seeds():
    band = statistics.median_band(np.arange(101.0)[:, None] * [1, 2])
    np.testing.assert_allclose(band, [[50, 100], [5, 10], [95, 190]])
    assert statistics.median_band([3.0]) == (3, 3, 3)


def test_geometric_mean():
    assert statistics.geometric_mean([2, 8]) == pytest.approx(4)
    assert statistics.geometric_mean([3, 1 / 3]) == pytest.approx(1)
    for ratios in ([], [1, 0], [1, -2], [1, np.nan], [np.inf]):
        with pytest.raises(ValueError, match="must be positive and finite"):
            statistics.geometric_mean(ratios)


def test_a_slope_of_minus_one_half_interpolates_exactly():
    at = np.random.default_rng(1).uniform(1, 16, 100)
    np.testing.assert_allclose(statistics.interpolate(TIMES, converging(3), at), converging(3, at), rtol=1e-12)


def test_nothing_is_extrapolated():
    assert np.isnan(statistics.interpolate(TIMES, converging(3), np.array([0.99, 16.1]))).all()
    assert np.isnan(statistics.time_to_error(TIMES, converging(4), 0.99))       # ends at 1
    assert np.isnan(statistics.time_to_error(TIMES, converging(4), 4.01))       # starts at 4


def test_time_to_error_inverts_the_curve_and_takes_the_first_crossing():
    for error in (4, 2.7, 1.3, 1):
        assert statistics.time_to_error(TIMES, converging(4), error) == pytest.approx((4 / error) ** 2)
    assert statistics.time_to_error(np.array([1.0, 2, 4, 8]), np.array([4.0, 1, 3, 1]), 1) == 2


def test_seeds_with_different_checkpoints_meet_on_the_times_that_all_cover():
    a, b = np.geomspace(1, 15, 8), np.geomspace(1.5, 17, 6)
    both = statistics.common_curve([a, b], [converging(2, a), converging(6, b)])
    assert both.times[0] == 1.5 and both.times[-1] == 15 and both.errors.shape == (2, both.times.size)
    np.testing.assert_allclose(both.errors, [converging(2, both.times), converging(6, both.times)])
    np.testing.assert_allclose(both.median, converging(4, both.times))


@pytest.mark.parametrize(("times", "errors", "message"), [
    ([[2, 1]], [[1, 1]], "must increase"),
    ([[0, 1]], [[1, 1]], "must increase"),
    ([[1, 2]], [[1]], "one per error"),
    ([[1, 2]], [[1, np.nan]], "positive and finite"),
    ([[1, 2]], [[1, 0]], "positive and finite"),
])
def test_curves_that_cannot_be_compared_are_refused(times, errors, message):
    with pytest.raises(ValueError, match=message):
        statistics.common_curve([np.array(t, float) for t in times], [np.array(e, float) for e in errors])


def test_speed_up_of_two_converging_curves_is_the_squared_ratio_of_their_errors():
    slow, fast = curve(4, 4.4, 3.6), curve(2, 2.2, 1.8)
    for a, b, expected in ((slow, fast, 4), (fast, slow, 1 / 4)):
        ratio = statistics.speed_up(a, b)
        assert ratio.value == pytest.approx(expected) and ratio.bound == ""
        assert ratio.low == pytest.approx(expected) and ratio.high == pytest.approx(expected)      # paired: no spread
    assert statistics.speed_up(slow, fast, error=1.5).value == pytest.approx(4)


def test_speed_up_only_where_both_curves_reach_the_error():
    slow, fast = curve(4, 4), curve(2, 2)
    assert np.isnan(statistics.speed_up(slow, fast, error=0.9).value)       # slow ends at 1
    assert statistics.speed_up(slow, fast, least=1.5).value == pytest.approx(4)
    assert np.isnan(statistics.speed_up(slow, fast, error=4.5).value)       # both start below
    bounded = statistics.speed_up(slow, fast, error=2.5)                    # fast starts at 2, at time 1
    assert bounded.value == pytest.approx((4 / 2.5) ** 2) and bounded.bound == ">"
    assert statistics.speed_up(fast, slow, error=2.5).bound == "<"
    with pytest.raises(ValueError, match="2 and 3 seeds"):
        statistics.speed_up(slow, curve(1, 2, 3))


def test_the_worst_speed_up_is_where_a_method_has_just_begun():
    """One that trains for 3 s and then converges four times as fast is down to an error e after 3 + 4 / e^2 s, path tracing
    after 16 / e^2: for e = 2, where it begins, both after 4 s, for e = 1, where path tracing ends, after 7 and 16 s."""
    slow, at = curve(4), np.geomspace(4, 16, 65)
    fast = statistics.Curve(at, converging(2, at - 3)[None])
    assert statistics.worst_speed_up(slow, fast) == pytest.approx(1, rel=1e-6)
    assert statistics.worst_speed_up(fast, slow) == pytest.approx(7 / 16, rel=0.01)
    late = statistics.Curve(np.array([15.5, 16]), np.array([[3.9, 2]]))
    assert statistics.worst_speed_up(slow, late) == pytest.approx((4 / 3.9) ** 2 / 15.5, rel=1e-6)
    assert statistics.worst_speed_up(slow, slow) == 1
    assert np.isnan(statistics.worst_speed_up(slow, curve(40)))                 # which ends at 10, and slow begins at 4
    assert np.isnan(statistics.worst_speed_up(slow, curve(0.4)))
    assert statistics.worst_speed_up(fast, slow, least=1.5) == pytest.approx((3 + 4 / 1.5**2) / (16 / 1.5**2), rel=0.02)


def test_a_speed_up_that_a_seed_less_leaves_unmeasured_has_no_interval():
    """Without the slowest of its seeds the fast curve starts below the error: the speed-up is more than its first time says."""
    slow, fast = curve(3.8, 3.9, 4, 4.1, 4.2), curve(2.3, 2.4, 2.6, 2.7, 2.8)
    known, unknown = statistics.speed_up(slow, fast, error=2.2), statistics.speed_up(slow, fast, error=2.5)
    assert known.low < known.value < known.high and known.ends("~") == f" ({known.low:.2g}~{known.high:.2g})"
    assert 2 < unknown.value < 3 and unknown.bound == "" == unknown.ends()
    assert statistics.speed_up(curve(4), curve(2)).ends() == statistics.speed_up(curve(4, 5), curve(2, 3)).ends() == ""


@pytest.mark.parametrize("n", [3, 6])
def test_intervals_of_speed_ups_cover_it(n):
    """Of 90 % intervals at least 85 % and not all hold the truth, 4, with errors that differ by 5 % from seed to seed."""
    rng, held, runs = np.random.default_rng(9), 0, 200
    for _ in range(runs):
        slow, fast = (curve(*(error * np.exp(0.05 * rng.standard_normal(n)))) for error in (4, 2))
        interval = statistics.speed_up(slow, fast)
        held += interval.low <= 4 <= interval.high
    assert 0.85 * runs <= held < runs


def test_pairing_removes_what_the_seeds_share():
    rng = np.random.default_rng(2)
    shared, own = rng.lognormal(0, 0.5, 12), rng.lognormal(0, 0.01, 12)
    slow, fast = curve(*(4 * shared)), curve(*(2 * shared * own))
    interval = statistics.speed_up(slow, fast)
    assert 3.88 < interval.low <= interval.value <= interval.high < 4.12


def test_curves_that_share_no_time_are_told_by_their_ends():
    curve = statistics.common_curve([np.array([1.0, 2]), np.array([3.0, 4])], [np.array([3.0, 2]), np.array([5.0, 4])])
    np.testing.assert_allclose(curve.times, [3])
    np.testing.assert_allclose(curve.errors, [[2], [4]])
