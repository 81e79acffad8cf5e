"""Records: where they appear, and that a look-up finds them."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from olpm_bench.transport.cache import CELL, CHILDREN, LEVELS, MIN_COSINE, SMALLEST, STEADY, RecordCache

REACH = 1 + CELL * 3 ** 0.5         # greatest distance of a point from its record / radius


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


@pytest.fixture(scope="module")
def shrunk() -> RecordCache:
    """Records on the plane z = -1.2 shrink to a tenth around (0.5, 0.5), with gaps filled in between."""
    cache = RecordCache(mi.ScalarBoundingBox3f((-1, -1, -1.2), (1, 1, 1)), 0.05)
    for seed in range(6):
        near = np.linalg.norm(cache.points[:, :2] - 0.5, axis=1) * (cache.points[:, 2] < -1.1) + 9 * (cache.points[:, 2] > -1.1)
        cache.shrink(np.maximum(0.5 * near, 0.2 * SMALLEST * cache.radius))
        cache.grow(*_surface(200_000, seed), mi.Bool(True))
    return cache


def test_radii_shrink_and_gaps_are_filled(shrunk):
    """Every point still has a record, never beyond its reach, and small ones where they are wanted small."""
    q, m = _surface(20_000, 7)
    record, _, valid = shrunk.lookup(q, m, mi.Bool(True))
    q, index, ok = q.numpy().T, record.numpy(), valid.numpy()
    assert ok.mean() > 0.98
    radius = shrunk.radii[index[ok]]
    assert 0.999 < shrunk.radii.min() / (SMALLEST * shrunk.radius) < 1 / STEADY
    distance = np.linalg.norm(q[ok] - shrunk.points[index[ok], :3], axis=1)
    edge = CELL * shrunk.radius * 0.5 ** np.clip(np.ceil(np.log2(shrunk.radius / radius) - 1e-3), 0, LEVELS)
    assert (distance <= (radius + 3 ** 0.5 * edge) * 1.001).all()
    middle = (np.linalg.norm(q[ok, :2] - 0.5, axis=1) < 0.05) & (q[ok, 2] < -1.1)
    assert middle.any() and np.median(radius[middle]) < 0.4 * shrunk.radius
    assert np.median(radius[q[ok, 2] > -0.5]) == pytest.approx(shrunk.radius)


def test_neighbours_of_small_records_are_not_much_larger(shrunk):
    """R <= R_near up to what is left as it was: a radius grows by no more than the distance."""
    near = shrunk.clamped(shrunk.points, own=True)
    new = np.arange(len(shrunk)) > 0.7 * len(shrunk)            # most recently added: clamped when they appeared
    assert np.mean(shrunk.radii[new] <= near[new] * 1.2 + 1e-6) > 0.95


def test_shrinking_saturates_and_never_grows(shrunk):
    before, records, table = shrunk.radii.copy(), len(shrunk), len(shrunk.table)
    shrunk.shrink(np.full(len(shrunk), shrunk.radius))
    shrunk.grow(*_surface(200_000, 8), mi.Bool(True))
    np.testing.assert_array_equal(shrunk.radii[:records], before)
    assert len(shrunk) < 1.02 * records and len(shrunk.table) < 1.1 * table
    assert (len(shrunk.table) - shrunk.grid.n_cells) % CHILDREN == 0


def test_growth_is_the_same_each_time():
    caches = []
    for _ in range(2):
        cache = RecordCache(mi.ScalarBoundingBox3f((-1, -1, -1.2), (1, 1, 1)), 0.05)
        for seed in range(3):
            cache.grow(*_surface(20_000, seed), mi.Bool(True))
            cache.shrink(np.linspace(0.2, 1, len(cache)) * cache.radius)
        caches.append(cache.to_numpy())
    for key, value in caches[0].items():
        np.testing.assert_array_equal(value, caches[1][key], err_msg=key)


def test_cells_of_many_normals_are_split():
    """A ball smaller than a voxel: each side of it finds a record whose normal fits."""
    rng = np.random.default_rng(6)
    n = rng.normal(size=(20_000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    cache = RecordCache(mi.ScalarBoundingBox3f((-1, -1, -1), (1, 1, 1)), 0.2)
    points = mi.Point3f(0.01 * n.T), mi.Normal3f(n.T)
    for _ in range(3):
        cache.grow(*points, mi.Bool(True))
    assert np.mean(cache.lookup(*points, mi.Bool(True))[2].numpy()) > 0.97
    assert 6 <= len(cache) <= 40


def test_records_behind_a_thin_wall_are_no_neighbours():
    """Small records on one side of a sheet neither clamp those on the other nor hide them from a search."""
    cache = RecordCache(mi.ScalarBoundingBox3f((0, 0, -0.01), (1, 1, 0.01)), 0.1)
    rng = np.random.default_rng(4)
    xy = mi.Point2f(rng.random((2, 50_000)))
    p, up, down = mi.Point3f(xy.x, xy.y, 0), mi.Normal3f(0, 0, 1), mi.Normal3f(0, 0, -1)
    cache.grow(p, up + dr.zeros(mi.Normal3f, 50_000), mi.Bool(True))
    for _ in range(4):
        cache.shrink(np.full(len(cache), 0.1 * cache.radius))
        cache.grow(p, up + dr.zeros(mi.Normal3f, 50_000), mi.Bool(True))
    small = len(cache)
    added = cache.grow(p, down + dr.zeros(mi.Normal3f, 50_000), mi.Bool(True))
    assert added < 0.1 * small and (cache.radii[small:] == np.float32(cache.radius)).all()
    assert dr.all(cache.lookup(p, down + dr.zeros(mi.Normal3f, 50_000), mi.Bool(True))[2])


def test_parents_share_the_frame():
    cache = RecordCache(mi.ScalarBoundingBox3f((-1, -1, -1.2), (1, 1, 1)), 0.1)
    cache.grow(*_surface(50_000, 0), mi.Bool(True))
    before = len(cache)
    cache.shrink(np.full(before, 0.5 * cache.radius))
    cache.grow(*_surface(50_000, 1), mi.Bool(True))
    parent, new = cache.parents(before), cache.points[before:]
    has, flat = parent >= 0, new[:, 2] < -1.19
    assert has[flat].all() and not has[~flat].all() and parent.max() < before
    tangents = (mi.Frame3f(mi.Normal3f(n.T)).s.numpy() for n in (new[has, 3:], cache.points[parent[has], 3:]))
    assert (next(tangents) * next(tangents)).sum(0).min() > 0.999


def test_a_full_cache_says_so(monkeypatch):
    monkeypatch.setattr("olpm_bench.transport.cache.MOST_RECORDS", 50)
    cache = RecordCache(mi.ScalarBoundingBox3f((-1, -1, -1.2), (1, 1, 1)), 0.03)
    assert not cache.full
    cache.grow(*_surface(10_000, 0), mi.Bool(True))
    assert cache.full and len(cache) == 50


def test_empty_cache_finds_nothing():
    cache = RecordCache(mi.ScalarBoundingBox3f((0, 0, 0), (1, 1, 1)), 0.1)
    _, _, valid = cache.lookup(mi.Point3f(0.5), mi.Normal3f(0, 0, 1), mi.Bool(True))
    assert not dr.any(valid)
    assert cache.grow(mi.Point3f([0.5], [0.5], [0.5]), mi.Normal3f([0], [0], [1]), mi.Bool(False)) == 0


@pytest.mark.parametrize("name", ["cache", "shrunk"])
def test_round_trip(name, request):
    cache = request.getfixturevalue(name)
    again = RecordCache.from_numpy(cache.to_numpy())
    q, m = _surface(5_000, 5)
    for a, b in zip(cache.lookup(q, m, mi.Bool(True)), again.lookup(q, m, mi.Bool(True)), strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())
    more = _surface(50_000, 9)
    assert cache.grow(*more, mi.Bool(True)) == again.grow(*more, mi.Bool(True))
    np.testing.assert_array_equal(cache.points, again.points)
