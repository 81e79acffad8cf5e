"""Light samples of lamps with smooth vertex normals: right where Mitsuba's `path` is not."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import assert_same_expectation, box, grey, passes, wall
from smooth_lamps import area, bulb, panel, texture

import olpm_bench
from olpm_bench.transport.light_sampling import LightSampling, has_smooth_normals

DEPTH = 3
N = 2 ** 18


def several(weight: float) -> dict[str, Any]:
    """A bulb and a panel beside lamps with nothing wrong, all sampled with different probabilities."""
    return {"bulb": bulb(area(sampling_weight=2 * weight), (-0.4, 0.5, 0.5), 0.2),
            "panel": panel(area(2.0, sampling_weight=weight)),
            "ball": {"type": "sphere", "center": [0.5, 0.4, -0.6], "radius": 0.25,
                     "emitter": area(1.0, sampling_weight=weight / 2)},
            "square": wall((0, 0.9, -0.2), (0, -1, 0), 0.3, emitter=area(sampling_weight=weight)),
            "sky": {"type": "constant", "radiance": 0.3, "sampling_weight": weight}}


LAMPS: dict[str, Callable[[float], dict[str, Any]]] = {
    "panel": lambda weight: {"panel": panel(area(sampling_weight=weight))},
    "textured panel": lambda weight: {"panel": panel(area(texture(), sampling_weight=weight))},
    "several": several,
}


def scene_with(lamps: dict[str, Any]) -> mi.Scene:
    """A box, open where there is a sky."""
    content = box(grey(0.5), **lamps)
    if "sky" in lamps:
        del content["wall0"]
    return mi.load_dict(content, optimize=False)


def without_light_sampling(name: str) -> np.ndarray:
    """Images by paths that find lamps by themselves: light sampling finds a light too far and dim to see."""
    dim = {"type": "point", "position": [0, 0, -50.0], "intensity": 1e-6}
    scene = scene_with({**LAMPS[name](0.0), "dim": dim})
    return passes(scene, mi.load_dict({"type": "path", "max_depth": DEPTH}), spp=256, seed=1000)


@pytest.mark.parametrize("name", LAMPS)
def test_images_are_those_without_light_sampling(name):
    found = passes(scene_with(LAMPS[name](1.0)), olpm_bench.integrator(max_depth=DEPTH))
    assert_same_expectation(found, without_light_sampling(name))


def test_guided_images_are_those_without_light_sampling():
    scene = scene_with(LAMPS["panel"](1.0))
    guide = olpm_bench.train(scene, "gaussian_mixture", max_depth=DEPTH, passes=2, photons=40_000,
                             importons=10_000, camera_passes=2, camera_paths=2 ** 14, record_radius=0.2)
    assert guide.trained > 0.2
    found = passes(scene, olpm_bench.integrator(guide, max_depth=DEPTH))
    assert_same_expectation(found, without_light_sampling("panel"))


@pytest.mark.parametrize("emitter", [area(), area(texture())])
def test_the_density_of_light_samples_integrates_to_1(emitter):
    """Over all directions in which a panel is seen, it is the share of light samples that arrive."""
    scene = scene_with({"panel": panel(emitter)})
    lights = LightSampling(scene)
    assert lights.smooth
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, N)
    si = dr.zeros(mi.SurfaceInteraction3f, N)
    si.p, si.n = mi.Point3f(-0.4, 0.1, 0.1), mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    hit = scene.ray_intersect(si.spawn_ray(d))
    pdf = lights.pdf(si, hit, mi.DirectionSample3f(scene, hit, si), mi.Bool(True)).numpy()
    integral = 4 * np.pi * pdf
    ds, _ = lights.sample(si, sampler.next_2d(), mi.Bool(True))
    arrive = (ds.pdf > 0).numpy() & np.ones(N, bool)
    error = np.sqrt((integral.var() + arrive.var()) / N)
    assert arrive.mean() > 0.5          # n_s faces away elsewhere
    assert abs(integral.mean() - arrive.mean()) < 4 * error


def test_only_normals_that_differ_from_those_of_the_faces_are_smooth():
    assert has_smooth_normals(bulb(area()))
    assert has_smooth_normals(panel(area()))
    assert not has_smooth_normals(bulb(area(), smooth=False))
    assert not has_smooth_normals(panel(area(), tilt=0))
    assert not has_smooth_normals(mi.load_dict({"type": "sphere"}))
    assert not LightSampling(scene_with({"dark": bulb(None), "lamp": panel(area(), tilt=0)})).smooth


@pytest.mark.parametrize("lamp", [bulb, panel])
def test_photons_leave_as_the_lamp_is_seen(lamp):
    """By direction, the flux of photons is what parallel rays see of the lamp."""
    scene = mi.load_dict({"type": "scene", "lamp": lamp(area(1.0))}, optimize=False)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(2, N)
    ray, flux = LightSampling(scene).sample_photon(sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    leaving = dr.select(scene.ray_test(ray), 0, mi.luminance(flux)).numpy()
    d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    disk = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
    centre = mi.Point3f([dr.opaque(mi.Float, float(x)) for x in np.ravel(scene.bbox().center())])
    beside = mi.Frame3f(d).to_world(mi.Vector3f(disk.x, disk.y, 2))
    si = scene.ray_intersect(mi.Ray3f(centre + beside, -d))
    seen = (4 * np.pi ** 2 * mi.luminance(si.emitter(scene).eval(si, si.is_valid()))).numpy()
    height, height_seen = ray.d.z.numpy(), d.z.numpy()
    for low in np.arange(-1, 1, 0.25):
        here = np.where((height >= low) & (height < low + 0.25), leaving, 0.0)
        there = np.where((height_seen >= low) & (height_seen < low + 0.25), seen, 0.0)
        error = np.sqrt((here.var() + there.var()) / N)
        assert abs(here.mean() - there.mean()) < 4 * error      # 16 tests, 6e-5 each
