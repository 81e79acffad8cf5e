"""Metrics against closed forms."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.bench import flip, metrics

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


@pytest.mark.parametrize("scale", [1e-12, 1e-7, 1e20])
def test_the_unit_of_radiance_does_not_matter_to_flip(scale):
    x = np.maximum(REFERENCE + RNG.normal(0, 0.1, REFERENCE.shape), 0)
    assert metrics.flip(x * scale, REFERENCE * scale) == pytest.approx(metrics.flip(x, REFERENCE), rel=1e-5)


def test_flip_is_that_of_the_evaluator_where_no_pixel_is_black():
    import flip_evaluator

    x = np.maximum(REFERENCE + RNG.normal(0, 0.1, REFERENCE.shape), 0).astype(np.float32)
    _, theirs, parameters = flip_evaluator.evaluate(REFERENCE, x, "HDR", applyMagma=False)
    found = flip.exposures(REFERENCE)
    assert found.count == parameters["numExposures"]
    assert found.start == pytest.approx(parameters["startExposure"], abs=1e-3)
    assert found.stop == pytest.approx(parameters["stopExposure"], abs=1e-3)
    assert metrics.flip(x, REFERENCE) == pytest.approx(theirs, rel=1e-4)


def test_flip_has_no_value_for_a_black_reference_and_one_for_a_black_image():
    assert np.isnan(metrics.flip(REFERENCE, 0 * REFERENCE))
    assert 0.5 < metrics.flip(0 * REFERENCE, REFERENCE) < 1


def test_exposures_do_not_jump_where_more_than_half_of_a_reference_becomes_black():
    """31, 32 and 33 of 64 columns: the median of all pixels goes down by 17 stops, and HDR-FLIP up by a fifth."""
    found = []
    for black in (31, 32, 33):
        reference = REFERENCE.copy()
        reference[:, :black] = 0
        found.append(flip.exposures(reference))
    assert np.ptp([e.start for e in found]) == pytest.approx(0, abs=1e-12) and np.ptp([e.stop for e in found]) < 0.1


def test_exposures_of_a_lamp_among_faint_light_are_few():
    reference = np.full_like(REFERENCE, 1e-20)
    reference[:3, :3] = 5.0
    found = flip.exposures(reference)
    assert found.stop - found.start == 0 and found.count == 2
    assert 0 < metrics.flip(reference + np.float32(0.5), reference) < 1


def test_an_evaluator_that_ends_costs_one_metric_and_the_next_request_has_another(monkeypatch):
    x = np.maximum(REFERENCE + RNG.normal(0, 0.1, REFERENCE.shape), 0)
    good = flip.exposures(REFERENCE)
    with monkeypatch.context() as patched:
        patched.setattr(flip, "exposures", lambda r: flip.Exposures(start=good.stop, stop=good.start, count=2))
        errors, failures = metrics.errors([x, x], REFERENCE)
    assert np.isnan(errors["flip"]).all() and np.isfinite(errors["l1"]).all() and list(errors) == list(metrics.METRICS)
    assert failures == ["flip has no value: the evaluator of HDR-FLIP ended its process: exit code 255"]
    assert 0 < metrics.flip(x, REFERENCE) < 1


@pytest.mark.parametrize("error", [ZeroDivisionError("no light"), SystemExit(3)])
def test_a_metric_that_fails_costs_its_column(monkeypatch, error):
    def fails(x, r):
        raise error
    monkeypatch.setitem(metrics.METRICS, "own", fails)
    errors, failures = metrics.errors([REFERENCE], REFERENCE)
    assert np.isnan(errors["own"]) and errors["l1"] == [0] and failures == [f"own has no value: {error}"]


def test_ssim_error_is_that_of_the_tone_mapped_images():
    assert metrics.ssim_error(REFERENCE * 4, REFERENCE * 4) == pytest.approx(0, abs=1e-12)
    x = np.maximum(REFERENCE + RNG.normal(0, 0.1, REFERENCE.shape), 0)
    assert metrics.ssim_error(4 * x, 4 * REFERENCE) == pytest.approx(metrics.ssim_error(x, REFERENCE), rel=1e-3)
