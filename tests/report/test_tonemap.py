"""The tone curve against the sRGB standard (IEC 61966-2-1)."""
from __future__ import annotations

import numpy as np
import pytest
from skimage.io import imread

from olpm_bench.report import tonemap


def test_the_curve_is_srgb():
    x = np.linspace(0, 1, 1001)
    expected = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(tonemap.encode(x), expected, atol=1e-6)


def test_exposure_scales_linear_values_and_clips():
    image = np.array([[[0.0, 0.18, 0.5], [1.0, 7.0, -1.0]]], np.float32)
    assert tonemap.srgb(image).tolist() == [[[0, 118, 188], [255, 255, 0]]]
    assert (tonemap.srgb(image, 0.5) == tonemap.srgb(image / 2)).all()
    assert tonemap.srgb(image).dtype == np.uint8


def test_invalid_pixels_are_shown_as_such():
    image = np.full((1, 3, 3), 0.5)
    image[0, 0, 1], image[0, 1, 2] = np.nan, np.inf
    assert tonemap.srgb(image).tolist() == [[list(tonemap.INVALID), list(tonemap.INVALID), [188, 188, 188]]]


def test_auto_exposure_undoes_a_scale_and_survives_black():
    image = np.random.default_rng(1).gamma(1, 1, (20, 30, 3))
    assert tonemap.auto_exposure(8 * image) == pytest.approx(tonemap.auto_exposure(image) / 8)
    assert np.quantile((tonemap.auto_exposure(image) * image).mean(axis=-1), 0.85) == pytest.approx(0.5)
    assert tonemap.auto_exposure(np.zeros((4, 4, 3))) == 1


def test_png_round_trip_replaces_what_was_there(tmp_path):
    image = np.random.default_rng(1).integers(0, 256, (5, 7, 3), np.uint8)
    for _ in range(2):
        tonemap.write_png(tmp_path / "image.png", image)
    assert (imread(tmp_path / "image.png") == image).all()
    assert [file.name for file in tmp_path.iterdir()] == ["image.png"]
