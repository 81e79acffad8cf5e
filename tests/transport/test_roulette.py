"""The pixel estimate and the two rules; that roulette leaves images alone is tested in test_path.py."""
from __future__ import annotations

import mitsuba as mi
import numpy as np

from olpm_bench.transport import roulette
from olpm_bench.transport.roulette import PixelEstimate


def test_pixels_are_found_by_their_place_on_the_film():
    luminance = np.ones((20, 30))
    luminance[:, 15:] = 4
    estimate = PixelEstimate(luminance)
    x, y = np.array([0, 0.2, 0.49, 0.8, 1.0]), np.array([0, 0.5, 0.999, 0.5, 1.0])
    found = estimate.at(mi.Point2f(np.stack([x, y]))).numpy()
    np.testing.assert_allclose(found[[0, 1, 3, 4]], [1, 1, 4, 4], rtol=1e-3)
    assert 1 <= found[2] <= 4


def test_outliers_and_black_pixels():
    luminance = np.zeros((16, 16))
    luminance[:8] = 1
    luminance[4, 4] = 1e6
    estimate = PixelEstimate(luminance).values.numpy().reshape(16, 16)
    assert estimate[:6].max() < 1.01
    assert estimate[15].min() > 0


def test_survival():
    beta = mi.Spectrum(0.1)
    contribution = roulette.by_contribution(beta, mi.Float(0, 0.5, 2, 1e6, 1e6), mi.Float(1), mi.UInt32(1, 1, 1, 31, 32))
    np.testing.assert_allclose(contribution.numpy(), [roulette.LEAST, 0.05, 0.2, 1, roulette.MOST])     # none is endless
    throughput = roulette.by_throughput(beta, mi.Float(1, 2, 100), mi.Bool(True))
    np.testing.assert_allclose(throughput.numpy(), [0.1, 0.4, 0.95], rtol=1e-5)
    assert roulette.by_throughput(beta, mi.Float(1), mi.Bool(False)).numpy() == 1


def test_odd_values_end_no_path_for_good():
    """A survival probability that is NaN would end paths, and nothing would make up for them."""
    odd = mi.Float(np.float32([np.nan, np.inf, 0]))
    one = mi.Spectrum(1.0)
    found = roulette.by_throughput(one, odd, mi.Bool(True)).numpy()
    np.testing.assert_array_equal(found, np.float32([roulette.MOST, roulette.MOST, 0]))
    outgoing, worth = mi.Float(np.float32([np.nan, 1, 0, 1])), mi.Float(np.float32([1, np.nan, 0, 0]))
    found = roulette.by_contribution(one, outgoing, worth, mi.UInt32(1)).numpy()
    np.testing.assert_array_equal(found, np.float32([roulette.LEAST, roulette.LEAST, roulette.LEAST, 1]))
