"""Records: where they appear, and that a look-up finds them."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from olpm_bench.transport.cache import MIN_COSINE, REACH, RecordCache


def _surface(n: int, seed: int) -> tuple[mi.Point3f, mi.Normal3f]:
    """Points on the unit sphere and on the plane z = -1.2, with their normals."""
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    normal = p.copy()
    flat = rng.random(n) < 0.5
    p[flat] = np.column_stack([rng.uniform(-1, 1, (flat.sum(), 2)), np.full(flat.sum(), -1.2)])
    normal[flat] = (0, 0, 1)
    return mi.Point3f(p.T), mi.Normal3f(normal.T)


@pytest.fixture(scope="module")
def cache() -> RecordCache:
    cache = RecordCache(mi.ScalarBoundingBox3f((-1, -1, -1.2), (1, 1, 1)), 0.03)
    cache.grow(*_surface(100_000, 0), mi.Bool(True))
    return cache


def test_records_are_independent_and_cover(cache):
    """No two similar records within the radius; every fresh point on the surfaces has one within reach."""
    p, n = cache.points[:, :3], cache.points[:, 3:]
    distance = np.linalg.norm(p[:, None] - p[None], axis=-1)
    similar = (n @ n.T >= MIN_COSINE) & ~np.eye(len(p), dtype=bool)
    assert distance[similar].min() > cache.radius
    q, m = _surface(20_000, 1)
    record, normal, valid = cache.lookup(q, m, mi.Bool(True))
    assert np.mean(valid.numpy()) > 0.97
    index, ok = record.numpy(), valid.numpy()
    assert np.linalg.norm(q.numpy().T - p[index], axis=1)[ok].max() <= REACH * cache.radius * 1.001
    assert np.einsum("ij,ij->i", m.numpy().T, n[index])[ok].min() >= MIN_COSINE - 1e-5
    np.testing.assert_allclose(normal.numpy().T[ok], n[index][ok], atol=1e-6)


def test_lookup_is_nearly_the_best_record(cache):
    """The cell's record is seldom much worse than the best of an exhaustive search."""
    q, m = _surface(2_000, 2)
    record, _, valid = cache.lookup(q, m, mi.Bool(True))
    q, m, ok = q.numpy().T, m.numpy().T, valid.numpy()
    p, n = cache.points[:, :3], cache.points[:, 3:]
    cosine = m @ n.T
    error = np.where(cosine >= MIN_COSINE, np.linalg.norm(q[:, None] - p, axis=-1) / cache.radius
                     + 2 * np.sqrt(np.maximum(1.001 - cosine, 0)), np.inf)
    excess = error[np.arange(len(q)), record.numpy()][ok] - error.min(1)[ok]
    assert excess.min() >= -1e-4
    assert np.median(excess) < 0.05 and np.quantile(excess, 0.95) < 1.0


def test_growth_keeps_records(cache):
    grown = RecordCache(cache.bbox, cache.record_radius)
    p, n = _surface(50_000, 3)
    grown.grow(p, n, p.z < 0)
    before = grown.points.copy()
    added = grown.grow(p, n, mi.Bool(True))
    assert added > 0 and len(grown) == len(before) + added
    np.testing.assert_array_equal(grown.points[:len(before)], before)
    assert grown.grow(p, n, mi.Bool(True)) == 0


def test_both_sides_of_a_wall_have_their_own_records():
    cache = RecordCache(mi.ScalarBoundingBox3f((0, 0, -0.01), (1, 1, 0.01)), 0.1)
    rng = np.random.default_rng(4)
    xy = rng.random((2, 5000))
    up = mi.Normal3f(0, 0, dr.select(dr.arange(mi.UInt32, 5000) % 2 == 0, mi.Float(1), -1))
    p = mi.Point3f(mi.Float(xy[0]), mi.Float(xy[1]), 0)
    cache.grow(p, up, mi.Bool(True))
    _, normal, valid = cache.lookup(p, up, mi.Bool(True))
    assert dr.all(valid & (normal.z == up.z))


def test_empty_cache_finds_nothing():
    cache = RecordCache(mi.ScalarBoundingBox3f((0, 0, 0), (1, 1, 1)), 0.1)
    _, _, valid = cache.lookup(mi.Point3f(0.5), mi.Normal3f(0, 0, 1), mi.Bool(True))
    assert not dr.any(valid)
    assert cache.grow(mi.Point3f([0.5], [0.5], [0.5]), mi.Normal3f([0], [0], [1]), mi.Bool(False)) == 0


def test_round_trip(cache):
    again = RecordCache.from_numpy(cache.to_numpy())
    q, m = _surface(5_000, 5)
    for a, b in zip(cache.lookup(q, m, mi.Bool(True)), again.lookup(q, m, mi.Bool(True)), strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())
