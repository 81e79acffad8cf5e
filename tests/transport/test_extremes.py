"""Scenes and settings at the end of what is possible: images as Mitsuba's, or one line that says why there is none."""
from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil
import pytest
from small_scenes import assert_same_expectation, box, grey, lamp, passes, wall

import olpm_bench
from olpm_bench.transport import headroom
from olpm_bench.transport.cache import RecordCache
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.settings import InputError

DEPTH = 5
TRAINING: dict[str, Any] = {"passes": 2, "photons": 30_000, "importons": 10_000, "camera_passes": 3, "camera_paths": 2 ** 14,
                            "max_depth": DEPTH}
GUIDE = {"type": "jensen", "resolution": 8}


def scaled(size: float, radiance: float = 10, resolution: int = 16, **more: Any) -> mi.Scene:
    """A box with a lamp that shines at its ceiling, and more, so many times as large; radiance does not depend on that."""
    scene = box(grey(0.7), lamp=lamp(radiance), **more)
    for content in scene.values():
        if isinstance(content, dict) and content["type"] == "rectangle":
            content["to_world"] = mi.ScalarTransform4f().scale(size) @ content["to_world"]
    origin, target = (0, -0.95 * size, 0.1 * size), (0, size, -0.2 * size)
    scene["sensor"] |= {"to_world": mi.ScalarTransform4f().look_at(origin, target, (0, 0, 1)),
                        "near_clip": 1e-3 * size, "far_clip": 1e3 * size}
    scene["sensor"]["film"] |= {"width": resolution, "height": resolution}
    return mi.load_dict(scene, optimize=False)


def images(scene: mi.Scene, guide: Guide | None, n: int = 16) -> np.ndarray:
    return passes(scene, olpm_bench.integrator(guide, max_depth=DEPTH), n, 32, seed=100)


def by_mitsuba(scene: mi.Scene, n: int = 16) -> np.ndarray:
    return passes(scene, mi.load_dict({"type": "path", "max_depth": DEPTH}), n, 32)


def train(scene: mi.Scene, **changes: Any) -> Guide:
    return olpm_bench.train(scene, GUIDE, **{**TRAINING, **changes})


@pytest.mark.slow
@pytest.mark.parametrize("size, radiance", [(0.03, 10), (1e6, 10), (1, 1e30), (1, 1e-30)])
def test_small_and_huge_scenes_and_powers(size, radiance):
    scene = scaled(size, radiance)
    guide, expected = train(scene), by_mitsuba(scene) / radiance
    assert guide.records > 100 and guide.trained > 0.5
    for found in (images(scene, None), images(scene, guide)):
        assert_same_expectation(found / radiance, expected, level=0.001)


@pytest.mark.slow
def test_a_tiny_scene_is_right_though_mitsubas_is_not():
    """Mitsuba starts rays 9e-5 units off surfaces, here far outside of the box: only what the camera sees of a lamp is left."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 4.0}}
    scene, large = (scaled(size, seen=wall((0.2, 0.6, -0.3), (0, -1, 0.3), 0.3, bsdf=grey(0.5), emitter=emitter))
                    for size in (1e-6, 1))
    assert (by_mitsuba(scene, 2).max((0, 3)) > 0).mean() < 0.15
    expected = by_mitsuba(large)
    for found in (images(scene, None), images(scene, train(scene))):
        assert_same_expectation(found, expected, level=0.001)


@pytest.mark.slow
def test_one_pixel():
    scene = scaled(1, resolution=1)
    guide = train(scene)
    found, expected = images(scene, guide, 64).mean((1, 2, 3)), by_mitsuba(scene, 64).mean((1, 2, 3))
    error = np.sqrt(found.var(ddof=1) / 64 + expected.var(ddof=1) / 64)
    assert abs(found.mean() - expected.mean()) < 3.5 * error


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{"photons": 1, "importons": 1, "camera_passes": 0}, {"photons": 1, "importons": 0},
                                     {"passes": 0, "camera_paths": 1, "camera_passes": 1}, {"passes": 0, "camera_passes": 0},
                                     {"photons": 1, "importons": 1, "camera_passes": 0, "preset": "paper2014"}])
def test_one_particle_and_no_pass(changes):
    """What learns too little to guide is unbiased, too."""
    scene = scaled(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        guide = train(scene, **changes)
    assert_same_expectation(images(scene, guide), by_mitsuba(scene), level=0.001)


@pytest.mark.slow
def test_lamps_without_power_are_black_and_said_to_be():
    scene = scaled(1, radiance=0)
    with pytest.warns(UserWarning, match="photons carry nothing: the emitters have no power"):
        guide = train(scene)
    assert not images(scene, guide, 2).any() and not images(scene, None, 2).any()


def test_lamps_too_strong_for_float32_are_refused():
    with pytest.raises(InputError, match="photons are NaN, infinite or negative"):
        train(scaled(1, radiance=3e38))


@pytest.mark.slow
def test_a_camera_inside_a_wall_sees_nothing():
    """Between two walls that stand back to back, and away from every lamp."""
    scene = box(grey(0.7), lamp=lamp(), inner=wall((0, -0.9, 0), (0, 1, 0), 1, bsdf=grey(0.7)))
    scene["sensor"]["to_world"] = mi.ScalarTransform4f().look_at((0, -0.95, 0), (0, 1, 0), (0, 0, 1))
    loaded = mi.load_dict(scene, optimize=False)
    with warnings.catch_warnings(record=True):
        guide = train(loaded)
    for found in (images(loaded, guide, 2), images(loaded, None, 2), by_mitsuba(loaded, 2)):
        assert not found.any()


def test_no_emitter_no_camera_no_surface():
    camera = {"type": "perspective"}
    ball, sky = {"type": "sphere"}, {"type": "constant"}
    for parts, message in (({"camera": camera, "ball": ball}, "the scene has no emitter"),
                           ({"ball": ball, "sky": sky}, "the scene has no camera"),
                           ({"camera": camera, "sky": sky}, "the scene has no surface to guide paths from")):
        with pytest.raises(InputError, match=message):
            train(mi.load_dict({"type": "scene", **parts}))
    camera["film"] = {"type": "hdrfilm", "width": 4, "height": 4}
    dark = mi.load_dict({"type": "scene", "camera": camera, "ball": ball})
    assert not mi.render(dark, integrator=olpm_bench.integrator(max_depth=DEPTH), spp=2).numpy().any()


def test_more_memory_than_there_is_is_refused_before_it_is_taken(monkeypatch):
    """10^7 records would need a table that is too large anywhere; fewer, more than a small machine has."""
    bounds = mi.ScalarBoundingBox3f(-1, 1)
    with pytest.raises(InputError, match=r"a table of \d.*e\+\d+ cells, .* GB: .*; make record_radius larger"):
        RecordCache(bounds, 3e-4)
    monkeypatch.setattr(headroom, "free", lambda: 1e6)
    with pytest.raises(InputError, match=r"the tables of a cache of .* take about .* GB, and 0.001 GB are free: make record"):
        RecordCache(bounds, 0.01)
    guide = Guide(RecordCache(bounds, 0.2), {"type": "hey", "cones": 4096})
    rng = np.random.default_rng(0)
    p, n = (mi.Point3f(rng.uniform(-1, 1, (3, 5000)).astype(np.float32)) for _ in range(2))
    with pytest.raises(InputError, match=r"\d+ records of 98308 bytes take about .* GB, and 0.001 GB are free"):
        guide.grow(p, mi.Normal3f(n) / mi.Float(2), mi.Bool(True), 0)
    monkeypatch.setattr(headroom, "free", lambda: 5e6)
    with pytest.raises(InputError, match=r"30000 particles of up to 6 hits in one trace take about"):
        train(scaled(1), record_radius=0.2)


def test_the_memory_of_a_container_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(headroom, "CGROUP", tmp_path)
    machine = headroom.free()
    (tmp_path / "memory.current").write_text("1000\n")
    (tmp_path / "memory.stat").write_text("file 500\ninactive_file 300\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert headroom.free() > 0.5 * machine
    (tmp_path / "memory.max").write_text("4000\n")
    assert headroom.free() == 3300


def test_memory_that_arrays_have_left_is_free(monkeypatch):
    """Dr.Jit keeps it: a sweep whose largest cell was first would be refused all others."""
    machine = psutil.Process().memory_info().rss + 3e8
    monkeypatch.setattr(headroom, "free", lambda: machine - psutil.Process().memory_info().rss)
    large = dr.arange(mi.Float, 50_000_000)
    dr.eval(large)
    dr.sync_thread()
    with pytest.raises(InputError, match=r"an array take about 0\.2 GB, and"):
        headroom.require(2e8, "an array", "wait")
    del large
    headroom.require(2e8, "an array", "wait")
