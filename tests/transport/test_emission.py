"""Guided emission: the density it states is the one it samples, photons carry the same flux, and more of them come in."""
from __future__ import annotations

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from small_scenes import assert_no_kernel_a_pass, box, grey, lamp, wall

from olpm_bench.check.verdict import sidak
from olpm_bench.transport import emission
from olpm_bench.transport.emission import EmissionGuide
from olpm_bench.transport.particles import Departures, ParticleRays, Particles, emit_importons, emit_photons, trace
from olpm_bench.transport.settings import IntegratorSettings
from olpm_bench.transport.settings import training as with_defaults
from olpm_bench.transport.training import Training, surface_bounds, train
from representations import state as states

DEPTH, N = 6, 200_000
PATHS = IntegratorSettings(max_depth=DEPTH)
settings = partial(with_defaults, camera_passes=0)
SMALL = settings(passes=3, photons=20_000, importons=20_000, record_radius=0.08)
WHITE = {"type": "rgb", "value": 1.0}
SKY = np.random.default_rng(0).gamma(0.3, size=(16, 32, 1)) * np.ones(3)
LIGHTS: dict[str, dict[str, Any]] = {
    "constant": {"type": "constant", "radiance": WHITE},
    "envmap": {"type": "envmap"},                       # its bitmap needs the variant
    "sunsky": {"type": "sunsky", "sun_direction": [0.3, 0.2, 0.9], "to_world": None},
    "directional": {"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": WHITE},
}


def light(name: str) -> dict[str, Any]:
    content = {k: v for k, v in LIGHTS[name].items() if v is not None}
    return {**content, "bitmap": mi.Bitmap(mi.TensorXf(SKY.astype(np.float32)))} if name == "envmap" else content


def room(gap: float = 0.2, **content: Any) -> mi.Scene:
    """The box with a gap across its ceiling, on a plain ten times as wide."""
    scene = box(grey(0.6), **content)
    ceiling = next(k for k, v in scene.items() if k.startswith("wall") and np.allclose(mi.ScalarPoint3f(
        v["to_world"] @ mi.ScalarPoint3f(0)), (0, 0, 1)))
    half = (1 - gap / 2) / 2
    for i, side in enumerate((-1, 1)):
        to_world = mi.ScalarTransform4f().translate((0, side * (1 - half), 1)).scale((1, half, 1))
        scene[f"ceiling{i}"] = {"type": "rectangle", "to_world": to_world @ mi.ScalarTransform4f().rotate((1, 0, 0), 180),
                                "bsdf": {"type": "twosided", "bsdf": grey(0.6)}}
    del scene[ceiling]
    scene["plain"] = wall((0, 0, -1.01), (0, 0, 1), 10, bsdf=grey(0.3))
    return mi.load_dict(scene, optimize=False)


def sampler(seed: int, n: int = N) -> mi.Sampler:
    independent = mi.load_dict({"type": "independent"})
    independent.seed(seed, n)
    return independent


def learnt(scene: mi.Scene, fraction: float = 0.2, passes: int = 3) -> EmissionGuide:
    guide = EmissionGuide(scene, surface_bounds(scene), fraction)
    for i in range(passes):
        s = sampler(i, 50_000)
        importons = trace(scene, emit_importons(scene.sensors()[0], s), s, None, 0.5, DEPTH, mi.TransportMode.Radiance,
                          emission=guide)
        guide.learn(importons.departures, i)
    assert guide.learnt
    return guide


def photons(scene: mi.Scene, rays: ParticleRays, s: mi.Sampler) -> Particles:
    return trace(scene, rays, s, None, 0.5, DEPTH, mi.TransportMode.Importance)


def inside(particles: Particles) -> tuple[np.ndarray, int]:
    """Flux that the paths of each lane have left on the floor of the room, and how many hits there are."""
    p, weight, _, _, n = particles.read(particles.place)
    floor = (dr.abs(p.z + 1) < 1e-3) & (n.z > 0.5) & (dr.abs(p.x) < 1) & (dr.abs(p.y) < 1)
    lane = particles.place.numpy()[floor.numpy()] % particles.lanes
    return np.bincount(lane, weight.numpy()[floor.numpy()], particles.lanes), len(lane)


def assert_same_mean(a: np.ndarray, b: np.ndarray, tests: int, level: float = 0.01) -> None:
    """Welch's t-test, corrected for the number of tests (Sidak)."""
    assert np.isfinite(a).all() and np.isfinite(b).all()
    error = (a.var(dtype=float) / len(a) + b.var(dtype=float) / len(b) + (1e-5 * b.mean()) ** 2) ** 0.5
    p = 2 * stats.norm.sf(abs(a.mean(dtype=float) - b.mean(dtype=float)) / error)
    assert p > sidak(level, tests), f"p = {p:.2g}: means {a.mean():.5g} and {b.mean():.5g}"


@pytest.mark.parametrize("name", LIGHTS)
def test_flux_is_the_same_and_more_photons_come_in(name):
    scene = room(light=light(name))
    guide = learnt(scene)
    s, t = sampler(10), sampler(11)
    guided, own = guide.emit(s), emit_photons(scene, t)
    assert_same_mean(mi.luminance(guided.weight).numpy(), mi.luminance(own.weight).numpy(), 2 * len(LIGHTS))
    (flux, n), (own_flux, own_n) = inside(photons(scene, guided, s)), inside(photons(scene, own, t))
    assert_same_mean(flux, own_flux, 2 * len(LIGHTS))
    assert n > 10 * own_n
    assert flux.var() < 0.2 * own_flux.var()


@pytest.mark.parametrize("name", ["sunsky", "directional"])
def test_the_sun_through_a_curtain_gap(name):
    """A gap of a 1000th of the plain's width: 2 or 3 photons in 100,000 come in unguided."""
    scene = room(gap=0.02, light=light(name))
    guide = learnt(scene, passes=2)
    s, t = sampler(16), sampler(17)
    _, n = inside(photons(scene, guide.emit(s), s))
    _, own_n = inside(photons(scene, emit_photons(scene, t), t))
    assert own_n < 1e-4 * N
    assert n > 0.1 * N


def test_lights_of_all_kinds_together():
    moon = {**light("directional"), "direction": [0, -1, -1]}
    scene = room(lamp=lamp(), sky=light("constant"), sun=light("directional"), moon=moon)
    guide = learnt(scene)
    s, t = sampler(12), sampler(13)
    guided, own = guide.emit(s), emit_photons(scene, t)
    assert_same_mean(mi.luminance(guided.weight).numpy(), mi.luminance(own.weight).numpy(), 2)
    (flux, n), (own_flux, own_n) = inside(photons(scene, guided, s)), inside(photons(scene, own, t))
    assert_same_mean(flux, own_flux, 2)
    assert n > 1.5 * own_n                              # a quarter of the photons comes from the lamp, inside


def test_directions_follow_their_density():
    """Chi-square over the raster's 800 areas, under a constant light."""
    scene = room(light=light("constant"))
    guide = learnt(scene)
    d = -guide.emit(sampler(14)).ray.d
    area = emission._parent(emission._cell(d).numpy().astype(int) // emission.BLOCK ** 2, emission.BLOCKS)
    mass = np.bincount(emission._parent(np.arange(emission.N_BLOCKS), emission.BLOCKS), guide.mass.numpy(), emission.N_AREAS)
    expected = N * (guide.fraction / emission.N_AREAS + (1 - guide.fraction) * mass / mass.sum())
    assert stats.chisquare(np.bincount(area, minlength=emission.N_AREAS), expected).pvalue > 0.01
    # ... and the density of directions is that of the blocks, with an integral of 1
    cell = dr.arange(mi.UInt32, emission.N_CELLS)
    pdf = guide._direction_pdf(emission._direction_in(cell, mi.Point2f(0.3, 0.6))).numpy()
    assert pdf.sum() * emission.CELL_SOLID_ANGLE == pytest.approx(1, rel=1e-4)


def test_positions_follow_their_density():
    """Chi-square over squares within the guided disk of a directional light, and the rest."""
    scene = room(light=light("directional"))
    guide = learnt(scene, fraction=0.5)
    rays = guide.emit(sampler(15))
    d = mi.Vector3f(-rays.ray.d.x[0], -rays.ray.d.y[0], -rays.ray.d.z[0])
    frame, r, bins, sub = mi.Frame3f(d), guide.guided_radius[0] / 2 ** 0.5, 40, 16
    local = frame.to_local(rays.ray.o - guide.guided_center)
    alive = (rays.weight.x > 0).numpy()
    counts, _, _ = np.histogram2d(local.x.numpy()[alive], local.y.numpy()[alive], bins, [[-r, r], [-r, r]])
    x, y = dr.meshgrid(*[(dr.arange(mi.Float, bins * sub) + 0.5) * (2 * r / (bins * sub)) - r] * 2, indexing="ij")
    points = guide.guided_center + frame.to_world(mi.Vector3f(x, y, 0))
    pdf = 0.5 * guide._position_pdf(points, d, guide._serving(d, mi.UInt32(0), mi.Bool(False), mi.Bool(True)))
    pdf += 0.5 / (dr.pi * guide.radius ** 2)
    expected = pdf.numpy().astype(float).reshape(bins, sub, bins, sub).mean((1, 3)) * (2 * r / bins) ** 2 * N
    many = expected > 20
    assert many.sum() > 50
    observed, expected = (np.append(n[many], N - n[many].sum()) for n in (counts, expected))
    assert stats.chisquare(observed, expected).pvalue > 0.01


def test_cells_and_directions_are_inverse():
    cell = dr.arange(mi.UInt32, emission.N_CELLS)
    np.testing.assert_array_equal(emission._cell(emission._direction_in(cell, mi.Point2f(0.4, 0.7))).numpy(), cell.numpy())


@pytest.mark.parametrize("name", ["envmap", "directional"])
def test_learning_repeats_bit_for_bit_whatever_the_threads(name):
    scene, threads, results = room(light=light(name)), dr.thread_count(), []
    try:
        for count in (1, 2):
            dr.set_thread_count(count)
            guide = learnt(scene, passes=2)
            results.append(states.to_numpy(guide.state) | {"seen": guide.seen, "importance": guide.importance})
    finally:
        dr.set_thread_count(threads)
    for key, value in results[0].items():
        np.testing.assert_array_equal(value, results[1][key], err_msg=key)


def test_no_kernel_is_compiled_after_warm_up():
    scene = room(sky=light("envmap"), sun=light("directional"))
    many = settings(passes=8, photons=20_000, importons=20_000, record_radius=0.08)
    train(scene, "jensen", many, PATHS)
    assert_no_kernel_a_pass(Training(scene, "jensen", many, PATHS, seed=1).run())


def test_memory_is_bounded():
    """Records are as many as there are blocks with departing importons, ever fewer of them new."""
    scene = room(sky=light("constant"))
    training = Training(scene, "jensen", settings(passes=6, photons=1000, importons=20_000, record_radius=0.08), PATHS)
    records = []
    for _ in training.run():
        assert training.emission is not None
        records.append(len(training.emission.seen))
        assert states.bytes_of(training.emission.state) < 1500 * records[-1]
    new = np.diff([0, *records])
    assert new[-1] < 0.3 * new[0] and records[-1] <= emission.N_KEYS


def departures(*x: float, n: int = 5000) -> Departures:
    """Importons that leave upwards through windows of 10 cm about those x."""
    rng = np.random.default_rng(len(x))
    d = rng.normal(size=(3, n)) * 0.1 + np.array([[0], [0], [1]])
    p = np.stack([np.resize(x, n), np.zeros(n), np.ones(n)]) + rng.uniform(-0.05, 0.05, (3, n))
    return Departures(mi.Point3f(p), mi.Vector3f(d / np.linalg.norm(d, axis=0)), dr.ones(mi.Float, n), dr.zeros(mi.UInt32, n))


def test_the_guided_disk_is_as_small_as_the_window_on_a_plain_of_40_km():
    """Importons leave within 0.2 units: a share of the scene's radius would be 28 of them."""
    scene = room(sky=light("constant"))
    guide = EmissionGuide(scene, mi.ScalarBoundingBox3f((-2e4, -2e4, -1), (2e4, 2e4, 1)), 0.2)
    guide.learn(departures(-0.8), 0)
    alone = EmissionGuide(scene, surface_bounds(scene), 0.2)
    alone.learn(departures(-0.8), 0)
    assert float(guide.guided_radius[0]) < max(2 * float(alone.guided_radius[0]), 1.01e-5 * guide.radius) < 1


def test_another_way_out_is_learnt_when_importons_find_it():
    """A disk over the first window alone would start no photon above the second."""
    guide = EmissionGuide(scene := room(sky=light("constant")), surface_bounds(scene), 0.2)
    guide.learn(departures(-0.8), 0)
    first = float(guide.guided_radius[0])
    guide.learn(departures(-0.8), 1)
    assert float(guide.guided_radius[0]) == first < 0.2
    guide.learn(departures(0.8, -0.8), 2)
    assert guide.learnt and float(guide.guided_radius[0]) > 0.7
    rays = guide.emit(sampler(3))
    x = (rays.ray.o + rays.ray.d * ((1 - rays.ray.o.z) / rays.ray.d.z)).numpy()        # where they cross the ceiling
    for window in (-0.8, 0.8):
        assert np.mean(np.hypot(x[0] - window, x[1]) < 0.1) > 0.2
    assert_same_mean(mi.luminance(rays.weight).numpy(), mi.luminance(emit_photons(scene, sampler(4)).weight).numpy(), 1)


# ---------------------- Nothing to learn ----------------------

def test_each_light_whose_photons_nothing_guides_is_told():
    """The sky shines into the room, the sun from below the plain."""
    sun = {**light("directional"), "direction": [0, 0.1, 1]}
    training = Training(room(sky=light("constant"), sun=sun), "jensen", SMALL, PATHS)
    told = [message for statistics in training.run() for message in statistics.warnings]
    assert training.emission.learnt and "too few importons leave towards 1 of 2 lights at infinity" in told[-1]


def test_scenes_without_a_light_at_infinity_train_as_ever():
    scene = mi.load_dict(box(grey(0.6), lamp=lamp()))
    assert Training(scene, "jensen", SMALL, PATHS).emission is None
    assert Training(room(sky=light("constant")), "jensen", settings(emission="emitter"), PATHS).emission is None


@pytest.mark.parametrize("name", LIGHTS)
def test_importons_that_never_leave_start_photons_by_the_emitter(name):
    scene = mi.load_dict(box(grey(0.6), sky=light(name), lamp=lamp()), optimize=False)
    training = Training(scene, "jensen", SMALL, PATHS)
    told = [statistics.warnings for statistics in training.run()]
    assert any("too few importons leave" in message for message in told[0])
    assert training.emission is not None and not training.emission.learnt
    guided, own = training.emission.emit(sampler(20)), emit_photons(scene, sampler(21))
    assert_same_mean(mi.luminance(guided.weight).numpy(), mi.luminance(own.weight).numpy(), len(LIGHTS))


@pytest.mark.parametrize("dark", [
    {"type": "constant", "radiance": {"type": "rgb", "value": 0.0}},
    {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 0.0}},
    {"type": "sunsky", "sun_scale": 0.0, "sky_scale": 0.0},
    {"type": "envmap"},
])
def test_a_light_without_power_leaves_the_others(dark):
    if dark["type"] == "envmap":
        dark = {**dark, "bitmap": mi.Bitmap(mi.TensorXf(np.zeros((8, 16, 3), np.float32)))}
    scene = room(dark=dark, lamp=lamp())
    training = Training(scene, "jensen", SMALL, PATHS)
    for statistics in training.run():
        assert statistics.stored > 1000
    rays = training.emission.emit(sampler(22))
    assert dr.all(dr.isfinite(rays.weight), axis=None)
    assert_same_mean(mi.luminance(rays.weight).numpy(), mi.luminance(emit_photons(scene, sampler(23)).weight).numpy(), 4)
