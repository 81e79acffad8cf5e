"""door_ajar: closed but for the slit, dark, hard, and its parameters checked."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from olpm_bench import scenes
from olpm_bench.scenes import SceneError, door_ajar, geometry
from olpm_bench.scenes.load import load

RAYS = 1_000_000
TOLERANCE = 1e-3            # m


def first_hits(gap: float, low: tuple, high: tuple, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins [n, 3], uniform in a box, and first hits [n, 3] of rays in all directions, in the frame of the plan."""
    scene = load("door_ajar", {"gap": gap}, 16, 9)
    turn = geometry.turn_z(scenes.parameters("door_ajar")["rotation"])
    rng = np.random.default_rng(seed)
    origin = rng.uniform(low, high, (RAYS, 3))
    direction = rng.normal(size=(RAYS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    o, d = ((turn @ x.T).astype(np.float32) for x in (origin, direction))
    ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
    si = scene.ray_intersect_preliminary(ray)
    t, valid = np.array(si.t), np.array(si.is_valid())
    assert np.all(valid), f"{np.sum(~valid)} of {RAYS} rays leave the closed scene"
    return origin, origin + t[:, None] * direction


def behind_the_leaf(points: np.ndarray, gap: float) -> np.ndarray:
    """Which points [n, 3] are on the corridor's side: beyond the wall, not in the wedge between wall, leaf and slit."""
    corner, _, _, foot = door_ajar.slit(gap, rotation=0)
    across = (foot - corner) / gap
    along = np.array([across[1], -across[0], 0])
    hinge = np.array([door_ajar.HINGE, door_ajar.LIT - door_ajar.REBATE, 0])
    wedge = ((points - corner) @ along <= TOLERANCE) & ((points - hinge) @ across <= TOLERANCE)
    return (points[:, 1] > door_ajar.LIT + TOLERANCE) & ~wedge


@pytest.mark.parametrize("gap", [0.01, 0.07, 0.3])
def test_only_the_slit_leads_into_the_corridor(gap: float):
    dark = ((0.02, 0.02, 0.02), (door_ajar.WIDTH - 0.02, door_ajar.DEPTH - 0.02, door_ajar.HEIGHT - 0.02))
    # More of the rays start where a crack would show: around the door.
    near = ((door_ajar.HINGE - 0.2, door_ajar.DEPTH - 0.25, 0.02), (door_ajar.HINGE + 1.1, door_ajar.DEPTH - 0.02, 2.2))
    corner, top, _, foot = door_ajar.slit(gap, rotation=0)
    across = (foot - corner) / gap
    along = np.array([across[1], -across[0], 0])
    passed = 0
    for seed, (low, high) in enumerate((dark, near)):
        origin, hit = first_hits(gap, low, high, seed)
        lit = behind_the_leaf(hit, gap)
        origin, hit = origin[lit], hit[lit]
        s = ((corner - origin) @ along) / ((hit - origin) @ along)
        crossing = origin + s[:, None] * (hit - origin) - corner
        through = (s > 0) & (s <= 1 + TOLERANCE) & (np.abs(crossing @ across - gap / 2) <= gap / 2 + TOLERANCE)
        through &= (crossing[:, 2] >= -TOLERANCE) & (crossing[:, 2] <= top[2] + TOLERANCE)
        assert np.all(through), f"{np.sum(~through)} of {RAYS} rays enter beside the slit, from {origin[~through][0]}"
        passed += len(hit)
    assert passed > 100


def test_no_ray_passes_the_shut_door():
    for low, high in (((0.02, 0.02, 0.02), (3.18, 2.68, 2.33)), ((1.3, 2.4, 0.02), (2.35, 2.69, 2.15))):
        _, hit = first_hits(0, low, high, seed=3)
        assert hit[:, 1].max() <= door_ajar.LIT - door_ajar.REBATE + TOLERANCE


def test_the_room_is_black_when_the_door_is_shut():
    scene = load("door_ajar", {"gap": 0}, 64, 36, max_depth=13)
    assert dr.all(mi.render(scene, spp=64, seed=1) == 0, axis=None)


def test_slit_has_the_width_of_the_gap_and_no_view_of_the_lamp():
    for gap in (0.01, 0.07, 0.5, door_ajar.DOOR):
        frame, _, _, leaf = door_ajar.slit(gap)
        assert np.linalg.norm(frame - leaf) == pytest.approx(gap)
    image = mi.render(load("door_ajar", None, 96, 54, max_depth=1), spp=16)
    assert dr.all(image == 0, axis=None)


def test_everything_turns_with_the_rotation():
    """Same image, but for the noise of sub-pixel edges, since camera and room turn together."""
    depth = [np.array(load("door_ajar", {"rotation": r}, 32, 18).ray_intersect(centre_rays(r)).t) for r in (23.7, 0.0)]
    assert np.mean(np.abs(depth[0] - depth[1]) > 1e-3) < 0.01


def centre_rays(rotation: float) -> mi.Ray3f:
    sensor = load("door_ajar", {"rotation": rotation}, 32, 18).sensors()[0]
    x, y = dr.meshgrid((dr.arange(mi.Float, 32) + 0.5) / 32, (dr.arange(mi.Float, 18) + 0.5) / 18)
    return sensor.sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))[0]


@pytest.mark.parametrize("parameters, message", [
    ({"gap": -0.01}, "gap = -0.01: must be in"),
    ({"gap": 0.95}, "width of the door"),
    ({"gap": float("nan")}, "gap = nan"),
    ({"gap": "wide"}, "must be a number"),
    ({"rotation": float("inf")}, "rotation = inf: must be a number"),
    ({"floor_roughness": 0}, "floor_roughness = 0.0: must be in"),
    ({"gab": 0.07}, "no parameter 'gab'; known: gap, rotation, floor_roughness"),
])
def test_bad_parameters(parameters: dict, message: str):
    with pytest.raises(SceneError, match=message) as error:
        scenes.build("door_ajar", parameters)
    assert "\n" not in str(error.value)
