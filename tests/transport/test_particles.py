"""Particles carry the flux that the closed form says, guided or not, and land in a repeatable order."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import box, furnace, grey, lamp

from olpm_bench.transport.particles import Particles, emit_importons, emit_photons, trace
from olpm_bench.transport.settings import IntegratorSettings, TrainingSettings
from olpm_bench.transport.training import Training

ALBEDO, DEPTH, N = 0.6, 7, 100_000


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    return mi.load_dict(box(grey(ALBEDO), light={"type": "point", "position": [0.3, 0.2, 0.4], "intensity": 1.0}), optimize=False)


def _sampler(seed: int, n: int = N) -> mi.Sampler:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, n)
    return sampler


def _photons(scene, seed, guide=None, fraction=0.5):
    sampler = _sampler(seed)
    rays = emit_photons(scene, sampler)
    return rays, trace(scene, rays, sampler, guide, fraction, DEPTH, mi.TransportMode.Importance)


def _flux(particles) -> np.ndarray:
    """Sum of the weights that paths have left: means over each lane's paths."""
    _, weight, _, _, _ = particles.read(particles.place)
    lanes = particles.lanes
    paths = np.bincount(np.arange(N) % lanes)
    return np.bincount(particles.place.numpy() % lanes, weight.numpy(), lanes) / paths


@pytest.mark.parametrize("guided", [False, True])
def test_flux_of_a_closed_box(scene, guided):
    """A box of albedo a: of the flux Phi, Phi a^(k-1) arrives at vertex k.  Kept are vertices 2 to DEPTH - 1."""
    guide = None
    if guided:
        settings = TrainingSettings(passes=2, camera_passes=0, photons=20_000, importons=20_000, record_radius=0.08)
        training = Training(scene, "jensen", settings, IntegratorSettings(max_depth=DEPTH))
        for _ in training.run():
            pass
        guide = training.importance
        assert guide.particles > 10_000
    rays, particles = _photons(scene, 1, guide)
    assert rays.unit[0] == pytest.approx(4 * np.pi, rel=1e-5)
    flux = _flux(particles)
    expected = 4 * np.pi * sum(ALBEDO ** (k - 1) for k in range(2, DEPTH))
    error = flux.std() / len(flux) ** 0.5
    assert abs(flux.mean() - expected) < 4 * error + 1e-4 * expected
    assert flux.std() > 0 or not guided


def test_splitting_keeps_the_expectation(scene):
    """A starting weight far above the window makes twins at every vertex; the flux stays."""
    sampler = _sampler(5)
    rays = emit_photons(scene, sampler)
    heavy = dr.arange(mi.UInt32, N) % 100 == 0
    rays.weight = dr.select(heavy, 100 * rays.weight, 0)
    particles = trace(scene, rays, sampler, None, 0.5, DEPTH, mi.TransportMode.Importance)
    assert len(particles) > 10 * (DEPTH - 2) * N / 100      # paths without copies leave at most this many, without the 10
    flux = _flux(particles)
    expected = 4 * np.pi * sum(ALBEDO ** (k - 1) for k in range(2, DEPTH))
    assert flux.mean() == pytest.approx(expected, rel=1e-2)


def test_importance_of_a_closed_box():
    """Importons start with 1; vertex k receives a^(k-1)."""
    scene = furnace(ALBEDO)
    sampler = _sampler(2)
    particles = trace(scene, emit_importons(scene.sensors()[0], sampler), sampler, None, 0.5, DEPTH, mi.TransportMode.Radiance)
    assert _flux(particles).mean() == pytest.approx(sum(ALBEDO ** (k - 1) for k in range(2, DEPTH)), rel=1e-3)


def test_directions_point_back_to_where_particles_came_from(scene):
    _, particles = _photons(scene, 3)
    p, weight, d, distance, n = particles.read(particles.place)
    assert dr.all(weight > 0) and dr.all(dr.dot(d, n) > 0)
    before = p + d * distance                           # the vertex before: on a wall of the box
    on_wall = dr.max(dr.abs(before)) - 1
    assert np.abs(on_wall.numpy()).max() < 1e-3


def test_caustic_photons_are_kept():
    """light - glass - diffuse: the glass vertex counts, so the diffuse one is the second and is kept."""
    scene = mi.load_dict(box(grey(0.0), light={"type": "point", "position": [0, 0, 0.6], "intensity": 1.0},
                             glass={"type": "sphere", "radius": 0.3, "bsdf": {"type": "dielectric"}}), optimize=False)
    _, particles = _photons(scene, 4)
    p, _, _, _, _ = particles.read(particles.place)
    assert len(p.x) > 1000
    assert dr.all(dr.max(dr.abs(p)) > 0.999)            # on walls only, never on the glass


def test_same_seed_same_particles_whatever_the_threads(scene):
    threads = dr.thread_count()
    try:
        runs = []
        for count in (1, 2):
            dr.set_thread_count(count)
            _, particles = _photons(scene, 7)
            runs.append([a.numpy() for a in particles.read(particles.place)])
    finally:
        dr.set_thread_count(threads)
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_lamp_that_nothing_reaches_leaves_no_particles():
    """First hits belong to next-event estimation: black walls keep nothing."""
    scene = mi.load_dict(box(grey(0.0), lamp=lamp()))
    _, particles = _photons(scene, 6)
    assert len(particles) == 0


def test_particles_by_region():
    """All hits count, and weights that are equal are all effective."""
    p = np.zeros((6, 4), np.float32)
    p[:, 0], p[:, 3] = [-1, -1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 0]
    hits = Particles(mi.Float(p.ravel()), mi.Float(p.ravel()), mi.Float(p.ravel()), dr.arange(mi.UInt32, 6), 6)
    np.testing.assert_allclose(hits.by_region(lambda p: (p[:, 0] > 0).astype(int), 2), [[2, 2], [4, 3]])


@pytest.mark.parametrize("n, places", [(1, [7, 3, 5, 1, 9]), (2, [7, 5, 9]), (4, [7, 9]), (100, [7])])
def test_one_of_so_many(n, places):
    nothing = mi.Float()
    hits = Particles(nothing, nothing, nothing, mi.UInt32([7, 3, 5, 1, 9]), 1)
    assert hits.one_of(n).place.numpy().tolist() == places
