"""The map between square and hemisphere: a bijection of constant Jacobian."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.particles import uniform_directions, vector
from olpm_bench.check.verdict import sidak
from representations.square import TO_SOLID_ANGLE, from_hemisphere, to_hemisphere


def test_round_trip_from_square() -> None:
    u, v = np.meshgrid(np.linspace(0, 1, 257, dtype=np.float32), np.linspace(0, 1, 257, dtype=np.float32))
    s = np.stack([u.ravel(), v.ravel()])
    wo = to_hemisphere(mi.Point2f(s))
    assert np.allclose(dr.norm(wo), 1, atol=1e-6) and dr.all(wo.z >= -1e-6)
    assert np.allclose(from_hemisphere(wo), s, atol=2e-6)


def test_round_trip_from_hemisphere() -> None:
    wo = np.concatenate([uniform_directions(20_000, np.random.default_rng(0)),
                         np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0], [-0.6, 0, 0.8], [0.6, 0.8, 0]], np.float32)])
    assert np.allclose(np.array(to_hemisphere(from_hemisphere(vector(wo)))).T, wo, atol=2e-6)


def test_jacobian_is_constant() -> None:
    """d omega / d s by central differences is 2 pi everywhere off the seams."""
    rng, h = np.random.default_rng(1), 1e-3
    s = rng.uniform(0.01, 0.99, (2, 4096))
    s = s[:, (np.abs(s[0] - s[1]) > 5e-3) & (np.abs(s.sum(0) - 1) > 5e-3)]      # the map folds on the diagonals

    def at(du: float, dv: float) -> np.ndarray:
        return np.array(to_hemisphere(mi.Point2f(s[0] + du, s[1] + dv)), np.float64).T

    area = np.linalg.norm(np.cross(at(h, 0) - at(-h, 0), at(0, h) - at(0, -h)), axis=1) / (4 * h * h)
    assert np.allclose(area * TO_SOLID_ANGLE, 1, atol=5e-3)


def test_uniform_square_is_uniform_hemisphere() -> None:
    wo = to_hemisphere(mi.Point2f(np.random.default_rng(2).random((2, 100_000)).astype(np.float32)))
    level = sidak(1e-3, 2)
    assert stats.kstest(np.array(wo.z), "uniform").pvalue > level
    assert stats.kstest(np.arctan2(wo.y, wo.x) / (2 * np.pi) + 0.5, "uniform").pvalue > level


def test_agrees_with_shirley_and_chiu_in_numpy() -> None:
    """A transcript of the concentric map of 1997, then r -> (r sqrt(2 - r^2), 1 - r^2)."""
    u, v = np.random.default_rng(3).random((2, 1000))
    a, b = 2 * u - 1, 2 * v - 1
    wide = np.abs(a) > np.abs(b)
    r = np.where(wide, a, b)
    phi = np.where(wide, np.pi / 4 * b / np.where(wide, a, 1), np.pi / 2 - np.pi / 4 * a / np.where(wide, 1, b))
    t = r * np.sqrt(2 - r * r)
    expected = np.stack([t * np.cos(phi), t * np.sin(phi), 1 - r * r])
    assert np.allclose(to_hemisphere(mi.Point2f(u, v)), expected, atol=2e-6)


def test_below_the_horizon_is_mirrored() -> None:
    wo = uniform_directions(100, np.random.default_rng(4))
    assert np.array_equal(from_hemisphere(vector(wo)), from_hemisphere(vector(wo * [1, 1, -1])))
