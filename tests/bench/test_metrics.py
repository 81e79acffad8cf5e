"""Metrics against closed forms."""
from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from olpm_bench.bench import metrics

RNG = np.random.default_rng(1)
REFERENCE = RNG.gamma(1.0, 0.5, (48, 64, 3)).astype(np.float32)


def flat(value: float, shape: tuple[int, int] = (40, 50)) -> np.ndarray:
    return np.full((*shape, 3), value, np.float32)


@pytest.mark.parametrize("name", metrics.METRICS)
def test_zero_for_the_reference_itself_and_positive_otherwise(name):
    metric = metrics.METRICS[name]
    assert metric(REFERENCE, REFERENCE) == pytest.approx(0, abs=1e-6)
    assert metric(REFERENCE * np.float32(1.5), REFERENCE) > 0.01
    assert isinstance(metric(REFERENCE, REFERENCE), float)


@pytest.mark.parametrize(("name", "expected"), [
    ("l1", 0.25), ("mape", 0.25 / 0.51), ("smape", 0.5 / 1.26), ("relmse", 0.0625 / 0.26),
    ("relmse_trimmed", 0.0625 / 0.26)])
def test_closed_form_on_flat_images(name, expected):
    assert metrics.METRICS[name](flat(0.75), flat(0.5)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", metrics.METRICS)
def test_shapes_must_agree_and_invalid_pixels_are_never_repaired(name):
    with pytest.raises(ValueError, match=r"\(40, 50, 3\).*\(50, 40, 3\)"):
        metrics.METRICS[name](flat(1), flat(1, (50, 40)))
    broken = REFERENCE.copy()
    broken[3, 4, 1] = np.nan
    assert np.isnan(metrics.METRICS[name](broken, REFERENCE))


def test_trimming_removes_whole_pixels_and_only_the_worst_thousandth():
    x = flat(0.5)                               # 2000 pixels: the worst 2
    x[0, :3] = [[9, 9, 9], [5, 5, 5], [1, 1, 1]]
    third = 0.25 / 0.26
    assert metrics.relmse_trimmed(x, flat(0.5)) == pytest.approx(third / 1998)
    assert metrics.relmse(x, flat(0.5)) == pytest.approx((8.5**2 / 0.26 + 4.5**2 / 0.26 + third) / 2000)


def test_a_noisy_reference_inflates_l1_as_the_documentation_says():
    """sqrt(1 + 1/k) - 1: 3 % at k = 16."""
    x, r = (RNG.normal(1, sigma, (400, 400, 3)) for sigma in (0.4, 0.1))
    assert metrics.l1(x, r) / metrics.l1(x, np.ones_like(x)) == pytest.approx(np.sqrt(1 + 1 / 16), abs=2e-3)


def test_luminance_is_that_of_rec_709():
    np.testing.assert_allclose(metrics.luminance(np.eye(3)), [0.2126, 0.7152, 0.0722])
    assert metrics.luminance(flat(1)).dtype == np.float64


def test_flip_grows_with_the_noise():
    noise = RNG.normal(0, 1, REFERENCE.shape)
    errors = [metrics.flip(np.maximum(REFERENCE + s * noise, 0), REFERENCE) for s in (0.02, 0.1, 0.5)]
    assert 0 < errors[0] < errors[1] < errors[2] < 1


def test_ssim_error_is_that_of_the_tone_mapped_images():
    assert metrics.ssim_error(REFERENCE * 4, REFERENCE * 4) == pytest.approx(0, abs=1e-12)
    x = np.maximum(REFERENCE + RNG.normal(0, 0.1, REFERENCE.shape), 0)
    assert metrics.ssim_error(4 * x, 4 * REFERENCE) == pytest.approx(metrics.ssim_error(x, REFERENCE), rel=1e-3)


def test_work_normalised_variance_of_a_known_variance():
    """Grey pixels of mean 1 and standard deviation s: the median of var is that of s^2 chi^2(n-1) / (n-1)."""
    n, s = 4, 0.1
    images = [np.repeat(RNG.normal(1, s, (300, 300, 1)), 3, axis=-1) for _ in range(n)]
    expected = s**2 * stats.chi2.median(n - 1) / (n - 1) / 1.001
    assert metrics.work_normalised_variance(images, seconds=7) == pytest.approx(7 * expected, rel=0.02)


def test_work_normalised_variance_is_the_same_after_twice_the_time():
    images = np.repeat(RNG.normal(1, 0.2, (8, 100, 100, 1)), 3, axis=-1)
    halves = (images[0::2] + images[1::2]) / 2
    once, twice = (metrics.work_normalised_variance(i, t) for i, t in ((images[:4], 1.0), (halves, 2.0)))
    assert once == pytest.approx(twice, rel=0.05)


def test_work_normalised_variance_needs_two_seeds_and_light():
    assert np.isnan(metrics.work_normalised_variance([REFERENCE], 1.0))
    assert np.isnan(metrics.work_normalised_variance([flat(0), flat(0)], 1.0))
