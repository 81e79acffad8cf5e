"""The radii that particles ask for: the formula, and a width of lobes that only looks at particles."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from olpm_bench.transport.cache import RecordCache
from olpm_bench.transport.gather import Gathered
from olpm_bench.transport.radius import mean_distance, wanted, width
from representations.interface import ParticleBatch

EACH = 2000         # particles of a record


def _lobes(sigmas: list[float], axis: np.ndarray, distance: float = 1.0) -> ParticleBatch:
    """A Gaussian lobe a record, of standard deviation sigma [radians], around one axis."""
    rng = np.random.default_rng(0)
    tangent = np.linalg.svd(axis[None])[2][1:]
    wo = np.concatenate([axis + s * rng.normal(size=(EACH, 2)) @ tangent for s in sigmas])
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    record = mi.UInt32(np.repeat(np.arange(len(sigmas)), EACH))
    return ParticleBatch.from_arrays(mi.Vector3f(wo.T), dr.ones(mi.Float, len(wo)), record, len(sigmas),
                                     dr.full(mi.Float, distance, len(wo)))


@pytest.mark.parametrize("axis", [(0, 0, 1), (0.6, 0, 0.8), (-0.3, 0.4, 0.866)], ids=["up", "tilted", "other"])
def test_width_is_that_of_a_gaussian_lobe(axis):
    """Wherever the lobe points."""
    sigmas = [0.003, 0.03, 0.06, 0.12]
    found = width(_lobes(sigmas, np.array(axis) / np.linalg.norm(axis))).numpy()
    np.testing.assert_allclose(found, sigmas, rtol=0.25)


def test_width_counts_particles_by_weight_and_needs_a_few():
    """A narrow lobe and a broad one: sharp where the narrow one is heavy; equal directions are finite; too few are smooth."""
    axis = np.array([0, 0, 1.0])
    mixed = _lobes([0.01, 0.3], axis)
    mixed.record, mixed.offset = dr.zeros(mi.UInt32, 2 * EACH), mi.UInt32([0, 2 * EACH, 2 * EACH])
    narrow = dr.arange(mi.UInt32, 2 * EACH) < EACH
    found = []
    for heavy in (1.0, 1e-4):
        mixed.weight = dr.select(narrow, mi.Float(heavy), 1e-2)
        found.append(width(mixed).numpy())
    assert found[0][0] < 0.05 and found[1][0] > 0.1
    assert found[0][1] == pytest.approx(np.pi)
    same = width(_lobes([0.0], axis)).numpy()
    assert 0 < same[0] < 1e-3


def test_mean_distance_is_that_of_each_record():
    rng = np.random.default_rng(1)
    record, distance = rng.integers(0, 5, 1000).astype(np.uint32), rng.random(1000).astype(np.float32)
    batch = ParticleBatch.from_arrays(mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, 1000), dr.ones(mi.Float, 1000),
                                      mi.UInt32(record), 6, mi.Float(distance))
    expected = [distance[record == r].mean() if r < 5 else 0 for r in range(6)]
    np.testing.assert_allclose(mean_distance(batch).numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize(("distance", "extent", "expected"), [
    (100.0, 1.0, 1.0),              # nothing asks for less
    (100.0, 0.3, 0.3),              # dense particles
    (0.5, 1.0, 0.5),                # a source so near that R_alpha is below: no smaller than half of what the particles fill
    (2.1, 1.0, 2.1 * np.tan(0.1 * 10 ** 0.5)),          # R_alpha = D tan(sqrt(10) sigma)
])
def test_radius_follows_the_formula(distance, extent, expected):
    cache = RecordCache(mi.ScalarBoundingBox3f((0, 0, 0), (1, 1, 0.1)), 0.02)
    x = mi.Point3f([0.1, 0.9], [0.1, 0.9], [0, 0])
    cache.grow(x, mi.Normal3f(0, 0, 1) + dr.zeros(mi.Normal3f, 2), mi.Bool(True))
    lobes = _lobes([0.1, 0.1], np.array([0, 0, 1.0]), distance * cache.radius)
    batch = Gathered(**vars(lobes), extent=dr.full(mi.Float, extent * cache.radius, 2), reach=dr.full(mi.Float, cache.radius, 2))
    radius = wanted(cache, batch) / cache.radius
    np.testing.assert_allclose(radius, expected, rtol=0.25)


def test_records_without_particles_stay_and_undersampled_ones_do_not_shrink():
    cache = RecordCache(mi.ScalarBoundingBox3f((0, 0, 0), (1, 1, 0.1)), 0.02)
    cache.grow(mi.Point3f([0.1, 0.9], [0.1, 0.9], [0, 0]), mi.Normal3f(0, 0, 1) + dr.zeros(mi.Normal3f, 2), mi.Bool(True))
    few = ParticleBatch.from_arrays(mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, 20), dr.ones(mi.Float, 20),
                                    dr.zeros(mi.UInt32, 20), 2, dr.full(mi.Float, 1e-6, 20))
    batch = Gathered(**vars(few), extent=dr.full(mi.Float, 0.8 * cache.radius, 2), reach=dr.full(mi.Float, cache.radius, 2))
    np.testing.assert_allclose(wanted(cache, batch) / cache.radius, [0.8, 1], rtol=1e-5)
