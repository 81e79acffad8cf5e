"""Weights of two techniques, whatever their densities are said to be."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import assert_same_expectation, box, grey, lamp, passes

import olpm_bench
from olpm_bench.transport.mis import balance_weight, density, mis_weight, relative_density

LARGEST = np.finfo(np.float32).max
NOT_POSITIVE = [np.nan, -np.inf, -1.0, -0.0, 0.0]
POSITIVE = [2e-38, 1e-20, 1.0, 3.0, 1e20, LARGEST, np.inf]


def _pairs(a: list[float], b: list[float]) -> tuple[mi.Float, mi.Float]:
    """All pairs, as data that no compiler knows."""
    x, y = np.meshgrid(np.float32(a), np.float32(b), indexing="ij")
    return mi.Float(x.ravel()), mi.Float(y.ravel())


def test_odd_densities():
    found = density(mi.Float(NOT_POSITIVE + POSITIVE)).numpy()
    np.testing.assert_array_equal(found, np.float32([0] * len(NOT_POSITIVE) + POSITIVE[:-1] + [LARGEST]))
    a, b = _pairs(NOT_POSITIVE, NOT_POSITIVE + POSITIVE)
    assert np.all(np.isinf(relative_density(a, b).numpy()))


@pytest.mark.parametrize("weight, power", [(mis_weight, 2), (balance_weight, 1)])
def test_weights_of_odd_densities(weight, power):
    """Finite, in [0, 1]; 0 for whom can't make the direction, 1 for whom alone can, and 1 together."""
    a, b = _pairs(POSITIVE, NOT_POSITIVE)
    np.testing.assert_array_equal(weight(a, b).numpy(), 1)
    np.testing.assert_array_equal(weight(b, a).numpy(), 0)
    a, b = _pairs(NOT_POSITIVE, NOT_POSITIVE)
    np.testing.assert_array_equal(weight(a, b).numpy(), 0)
    a, b = _pairs(POSITIVE, POSITIVE)
    here, there = weight(a, b).numpy(), weight(b, a).numpy()
    assert here.min() >= 0 and here.max() <= 1
    np.testing.assert_allclose(here + there, 1, rtol=1e-6)
    x, y = (np.minimum(v.numpy().astype(float), LARGEST) for v in (a, b))
    np.testing.assert_allclose(here, 1 / (1 + (y / x) ** power), rtol=1e-5, atol=1e-30)


@pytest.mark.parametrize("guided", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_black_environment_map_changes_nothing(guided):
    """Mitsuba's answers NaN when asked for its density."""
    parts = box(grey(0.7), lamp=lamp(4.0))
    del parts["wall0"]              # so that paths leave
    truth = mi.load_dict(parts, optimize=False)
    black = {"type": "envmap", "bitmap": mi.Bitmap(np.zeros((4, 8, 3), np.float32))}
    scene = mi.load_dict({**parts, "sky": black}, optimize=False)
    sky, nowhere = scene.environment(), dr.zeros(mi.Interaction3f)
    assert np.all(np.isnan(sky.pdf_direction(nowhere, dr.zeros(mi.DirectionSample3f, 2), True).numpy()))
    guide = None
    if guided:
        guide = olpm_bench.train(scene, "gaussian_mixture", max_depth=4, passes=2, photons=20_000,
                                 importons=10_000, camera_passes=2, camera_paths=2 ** 14)
    expected = passes(truth, mi.load_dict({"type": "path", "max_depth": 4}), seed=1000)
    assert_same_expectation(passes(scene, olpm_bench.integrator(guide, max_depth=4)), expected)
