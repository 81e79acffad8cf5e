"""Rays start where they do not meet their own surface, and no farther off it than they must."""
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import assert_same_expectation, box, grey, passes, wall

import olpm_bench
from olpm_bench.transport.ray_origins import RayOrigins

FAR = (5000.0, 1500.0, -5400.0)
N = 2 ** 18


def identity() -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f()


def moved(part: Any, by: tuple[float, ...]) -> Any:
    """A shape or camera, so far away."""
    if not isinstance(part, dict) or "to_world" not in part:
        return part
    return part | {"to_world": identity().translate(by) @ part["to_world"]}


def room(by: tuple[float, ...]) -> mi.Scene:
    """A box around a point, with a ball, that a lamp in plain view lights."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 4.0}}
    scene = box(grey(0.5), lamp=wall((0.2, 0.2, 0.8), (0, 0.2, -1), 0.3, emitter=emitter))
    at_floor = identity().translate((-0.3, 0.4, -0.5)).scale(0.4)
    scene["ball"] = {"type": "sphere", "to_world": at_floor, "bsdf": grey(0.5)}
    return mi.load_dict({name: moved(part, by) for name, part in scene.items()}, optimize=False)


def shape(name: str, to_world: mi.ScalarTransform4f) -> dict[str, Any]:
    """A scene with one shape, and a group if it is an instance of one."""
    if name != "instance":
        return {"type": "scene", "shape": {"type": name, "to_world": to_world}}
    group = {"type": "shapegroup", "id": "group", "cube": {"type": "cube"}}
    instance = {"type": "instance", "to_world": to_world, "group": {"type": "ref", "id": "group"}}
    return {"type": "scene", "group": group, "instance": instance}


@pytest.mark.parametrize("name", ["sphere", "rectangle", "disk", "cube", "cylinder", "instance"])
@pytest.mark.parametrize("distance", [0.0, 300.0, 5e4])
def test_no_ray_meets_the_surface_that_it_leaves(name, distance):
    """Shapes of one unit far away, and of 1e-3 units at the origin, hit from outside and left outwards."""
    size = 1.0 if distance else 1e-3
    by = (distance, 0.3 * distance, -1.08 * distance)
    to_world = identity().translate(by).rotate((0.3, 0.5, 0.8), 37).scale(size)
    scene = mi.load_dict(shape(name, to_world), optimize=False)
    origins = RayOrigins(scene)
    assert origins.offset is not None
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, N)
    centre = mi.Point3f([dr.opaque(mi.Float, x) for x in by])
    o = centre + 4 * size * mi.warp.square_to_uniform_sphere(sampler.next_2d())
    target = centre + 0.5 * size * mi.warp.square_to_uniform_sphere(sampler.next_2d())
    d = dr.normalize(target - o)
    si = scene.ray_intersect(mi.Ray3f(o, d))
    normal = dr.mulsign(mi.Vector3f(si.n), -dr.dot(si.n, d))
    flat = name in ("rectangle", "disk")
    outside = si.is_valid() & ((dr.dot(normal, si.p - centre) > 0) | flat)
    frame = mi.Frame3f(mi.Normal3f(normal))
    away = frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
    assert dr.count(outside)[0] > 0.3 * N
    assert dr.count(scene.ray_test(origins.spawn(si, away), outside))[0] == 0


@pytest.mark.parametrize("guided", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_far_from_the_origin_images_are_those_at_the_origin(guided):
    """Mitsuba's rays start half a unit off the surfaces of this room of two: its `path` is 5 % too dark."""
    scene = room(FAR)
    expected = passes(room((0, 0, 0)), mi.load_dict({"type": "path", "max_depth": 4}), seed=1000)
    guide = None
    if guided:
        guide = olpm_bench.train(scene, "gaussian_mixture", max_depth=4, passes=2, photons=20_000,
                                 importons=10_000, camera_passes=3, camera_paths=2 ** 14)
    assert_same_expectation(passes(scene, olpm_bench.integrator(guide, max_depth=4)), expected)


def test_near_the_origin_rays_are_mitsubas():
    origins = RayOrigins(room((0, 0, 0)))
    assert origins.offset is None
    assert not origins.warning()
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.p, si.n = mi.Point3f(0.5, -1, 2), mi.Normal3f(0, 0, 1)
    down = mi.Vector3f(0, 0, -1)
    np.testing.assert_array_equal(origins.spawn(si, down).o.numpy(), si.spawn_ray(down).o.numpy())


def test_too_far_from_the_origin_is_said_to_be_biased():
    assert not RayOrigins(room(FAR)).warning()
    warning = RayOrigins(room(tuple(100 * x for x in FAR))).warning()
    assert warning.startswith("images of this scene are biased: it is so far from the origin that rays start "
                              "0.5 units off surfaces, 29.7% of its radius")
