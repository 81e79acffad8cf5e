"""Parallax in the path tracer: unbiased, kept with the guide, and no difference to anything when it is off."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import assert_same_expectation, box, grey, lamp, passes

import olpm_bench
import representations
from olpm_bench.check.verdict import sidak
from olpm_bench.transport import settings
from olpm_bench.transport.cache import RecordCache
from olpm_bench.transport.gather import GATHERS
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.particles import emit_photons, trace
from olpm_bench.transport.training import surface_bounds, train

pytestmark = pytest.mark.slow

WIDE = settings.training(passes=2, photons=20_000, importons=10_000, camera_passes=2, camera_paths=2 ** 14, record_radius=0.1,
                         parallax=True)
DEPTH = 5
PATHS = settings.integrator(max_depth=DEPTH)


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    return mi.load_dict(box(grey(0.6), lamp=lamp()))


@pytest.fixture(scope="module")
def unguided(scene):
    return passes(scene, olpm_bench.integrator(None, max_depth=DEPTH), seed=100)


@pytest.mark.parametrize("name", representations.names())
def test_images_are_unbiased(scene, unguided, name):
    guide = train(scene, name, WIDE, PATHS)
    assert guide.parallax and guide.trained > 0.5
    guided = passes(scene, olpm_bench.integrator(guide, max_depth=DEPTH))
    assert_same_expectation(guided, unguided, level=sidak(0.01, len(representations.names())))


def test_guides_keep_it(scene, tmp_path):
    guide = train(scene, "gaussian_mixture", WIDE, PATHS)
    guide.save(tmp_path / "guide.npz")
    again = Guide.load(tmp_path / "guide.npz")
    assert again.parallax
    a, b = (mi.render(scene, integrator=olpm_bench.integrator(g, max_depth=DEPTH), spp=8, seed=1).numpy() for g in (guide, again))
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("gather", list(GATHERS))
def test_particles_of_a_record_meet_where_they_came_from(scene, gather):
    """Place and direction and distance in the record's frame give the point the particle came from, in world space."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 20_000)
    particles = trace(scene, emit_photons(scene, sampler), sampler, None, 0.5, DEPTH, mi.TransportMode.Importance)
    guide = Guide(RecordCache(surface_bounds(scene), 0.1), {"type": "cosine"})
    p, weight, d, distance, n = particles.read(particles.place)
    guide.grow(p, n, weight > 0, 0)
    batch = GATHERS[gather](guide.cache, particles, 100, parallax=True)
    assert GATHERS[gather](guide.cache, particles, 100).at is None
    position, normal, _, _ = guide.cache.row(batch.record)
    found = position + mi.Frame3f(normal).to_world(batch.at + batch.distance * batch.wo)
    origins = np.unique((p + distance * d).numpy().T.round(4), axis=0)
    for origin in found.numpy().T[::997]:
        assert np.abs(origins - origin).max(1).min() < 1e-3
    assert dr.max(dr.norm(batch.at))[0] < 3 * guide.cache.radius
