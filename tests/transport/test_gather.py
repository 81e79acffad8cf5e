"""Which particles a record learns from."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import box, grey

from olpm_bench.transport import gather
from olpm_bench.transport.cache import RecordCache
from olpm_bench.transport.gather import ENOUGH, FARTHEST_LENDER, LENDERS, MIN_COSINE, MIN_ELEVATION, binned, nearest, pooled
from olpm_bench.transport.particles import emit_photons, trace
from olpm_bench.transport.training import surface_bounds


@pytest.fixture(scope="module")
def landed():
    scene = mi.load_dict(box(grey(0.7), ball={"type": "sphere", "radius": 0.4, "bsdf": grey(0.7)},
                             light={"type": "point", "position": [0.6, 0.2, 0.4], "intensity": 1.0}), optimize=False)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 30_000)
    particles = trace(scene, emit_photons(scene, sampler), sampler, None, 0.5, 6, mi.TransportMode.Importance)
    cache = RecordCache(surface_bounds(scene), 0.06)
    p, _, _, _, n = particles.read(particles.place)
    cache.grow(p, n, mi.Bool(True))
    return cache, particles


def _key(record, weight):
    return sorted(zip(record.tolist(), weight.tolist(), strict=True))


@pytest.mark.parametrize("neighbours", [20, 250, 5000])
def test_nearest_are_the_nearest(landed, neighbours):
    """Against NumPy: the k smallest distances among those within the radius whose direction and normal fit."""
    cache, particles = landed
    batch = nearest(cache, particles, neighbours)
    p, weight, d, _, n = (np.atleast_2d(a.numpy()).T for a in particles.read(particles.place))
    offset = batch.offset.numpy()
    for record in range(0, len(cache), 37):
        centre, normal = cache.points[record, :3], cache.points[record, 3:]
        d2 = ((p - centre) ** 2).sum(1)
        usable = np.flatnonzero((d2 < cache.radius ** 2) & (d @ normal >= MIN_ELEVATION) & (n @ normal >= MIN_COSINE))
        expected = usable[np.argsort(d2[usable], kind="stable")[:neighbours]]
        rows = slice(offset[record], offset[record + 1])
        assert rows.stop - rows.start == len(expected)
        # Equal but for swaps among particles whose distances differ by less than the key's resolution.
        got = np.sort(batch.weight.numpy()[rows])
        different = np.setxor1d(got, weight[expected, 0])
        assert len(different) <= 2
        wo = mi.Frame3f(mi.Normal3f(*map(float, normal))).to_local(mi.Vector3f(d[expected].T)).numpy().T
        assert np.abs(np.sort(batch.wo.numpy().T[rows, 2]) - np.sort(wo[:, 2])).max() < (1e-5 if not len(different) else 2)


def test_binned_are_those_that_look_the_record_up(landed):
    cache, particles = landed
    p, _, d, _, n = particles.read(particles.place)
    record, normal, valid = cache.lookup(p, n, mi.Bool(True))
    valid &= dr.dot(d, normal) >= MIN_ELEVATION
    found = np.bincount(record.numpy()[valid.numpy()], minlength=len(cache))
    everything = binned(cache, particles, 10 ** 6)
    np.testing.assert_array_equal(everything.count().numpy(), found)
    few = binned(cache, particles, 50)
    np.testing.assert_array_equal(few.count().numpy(), np.minimum(found, 50))
    assert np.all(np.diff(few.record.numpy().astype(int)) >= 0)
    # Those kept stand for those left out: the weight of all records stays, up to the noise of the choice.
    total = dr.sum(everything.weight)[0]
    assert dr.sum(few.weight)[0] == pytest.approx(total, rel=0.02)


def test_pooled_records_with_few_particles_learn_from_those_around_them(landed):
    cache, particles = landed[0], landed[1].one_of(4)
    wanted = ENOUGH
    own = binned(cache, particles, 10 ** 6).count().numpy()
    batch = pooled(cache, particles, wanted, parallax=True)
    count = batch.count().numpy()
    assert (own < wanted / 2).mean() > 0.2
    assert (count <= wanted).all()
    assert (count >= 0.7 * np.minimum(own, wanted)).all()       # all see the same directions, but for their horizons
    assert np.mean(count[own < wanted / 2] > wanted / 2) > 0.8
    assert np.all(np.diff(batch.record.numpy().astype(int)) >= 0)
    farthest = (FARTHEST_LENDER + 2) * cache.radius             # a lender's own particles lie around it
    assert np.linalg.norm(batch.at.numpy(), axis=0).max() < farthest
    assert batch.wo.numpy()[2].min() >= MIN_ELEVATION * 0.99


def test_pooled_takes_no_more_than_it_needs(landed):
    """Records with enough particles of their own keep to these."""
    cache, particles = landed
    one = int(np.median(binned(cache, particles, 10 ** 6).count().numpy()))
    few = max(one // (2 * LENDERS), 1)
    a, b = pooled(cache, particles, few, parallax=True), binned(cache, particles, few, parallax=True)
    own = binned(cache, particles, 10 ** 6).count().numpy() >= 2 * few
    distance = [np.linalg.norm(x.at.numpy(), axis=0)[own[x.record.numpy()]].max() for x in (a, b)]
    assert distance[0] < 1.2 * distance[1]


@pytest.mark.parametrize("gather", [binned, pooled, nearest])
def test_directions_are_in_the_frame_of_the_record(landed, gather):
    cache, particles = landed
    batch = gather(cache, particles, 250)
    np.testing.assert_allclose(dr.norm(batch.wo).numpy(), 1, atol=1e-5)
    assert dr.min(batch.wo.z)[0] >= MIN_ELEVATION * 0.99
    assert len(batch.offset) == len(cache) + 1 and batch.offset.numpy()[-1] == len(batch)


def test_extent_is_the_radius_that_would_hold_the_neighbours(landed):
    """`nearest`: the farthest used, r_max with too few; `binned`: by the number found."""
    cache, particles = landed
    batch = nearest(cache, particles, 100)
    record, count = batch.record.numpy(), batch.count().numpy()
    extent = batch.extent.numpy()
    np.testing.assert_allclose(extent[count < 100], cache.radius, rtol=1e-5)
    assert (extent[count == 100] <= cache.radius * 1.00001).all() and (extent < 0.9 * cache.radius).any()
    more = nearest(cache, particles, 200).extent.numpy()
    assert (more >= extent).all() and len(record) == count.sum()
    found = binned(cache, particles, 10 ** 6).count().numpy()
    np.testing.assert_allclose(binned(cache, particles, 100).extent.numpy(),
                               cache.radius * np.minimum(np.sqrt(100 / np.maximum(found, 1)), 1), rtol=1e-4)


@pytest.mark.parametrize("gather", [binned, pooled, nearest])
def test_same_particles_same_batch(landed, gather):
    cache, particles = landed
    a, b = (gather(cache, particles, 100) for _ in range(2))
    for field in ("weight", "distance", "record", "offset"):
        np.testing.assert_array_equal(getattr(a, field).numpy(), getattr(b, field).numpy())


def test_fluence_does_not_depend_on_how_many_are_taken(landed):
    """Weight over the area that it fell on: with more neighbours the disk is larger."""
    cache, particles = landed
    few, many = (batch.sums().numpy() / batch.reach.numpy() ** 2 for batch in (nearest(cache, particles, n) for n in (60, 240)))
    assert np.median(few / np.maximum(many, 1e-30)) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("neighbours", [20, 60])
def test_small_voxels_find_the_same_particles(landed, neighbours, monkeypatch):
    """Most records look in them first, and some of these find too few there."""
    monkeypatch.setattr(gather, "AMPLE", 0.5)
    cache, particles = landed
    level, _ = gather._levels(cache, particles, neighbours)
    assert np.mean(level > 0) > 0.5
    fine = nearest(cache, particles, neighbours)
    monkeypatch.setattr(gather, "FINEST", 0)
    coarse = nearest(cache, particles, neighbours)
    np.testing.assert_array_equal(fine.extent.numpy(), coarse.extent.numpy())
    np.testing.assert_array_equal(fine.record.numpy(), coarse.record.numpy())
    radius = cache.radius / 2.0 ** level
    assert np.any(fine.extent.numpy() > radius)
    swapped = np.any(fine.wo.numpy() != coarse.wo.numpy(), axis=0)
    assert swapped.mean() < 1e-3        # among particles as far as one another, to the key's resolution
