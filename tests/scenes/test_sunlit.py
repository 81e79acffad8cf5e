"""living_room and classroom: light comes in only where it should, they are dark and hard, and their parameters are checked."""
from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import olpm_bench
from olpm_bench import scenes
from olpm_bench.scenes import SceneError, classroom, geometry, living_room
from olpm_bench.scenes.load import load

RAYS = 300_000
TOLERANCE = 1e-3            # m
SUNLIT = ("living_room", "classroom")


def trace(name: str, parameters: dict, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """First hits [n, 3] of rays, in the frame of the plan; those that leave the scene are infinitely far."""
    turn = geometry.turn_z(scenes.parameters(name)["rotation"])
    o, d = ((turn @ x.T).astype(np.float32) for x in (origin, direction))
    si = load(name, parameters, 16, 9).ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
    return origin + np.where(np.array(si.is_valid()), np.array(si.t), 1e6)[:, None] * direction


def rays(low: tuple, high: tuple, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Origins [n, 3], uniform in a box, and directions, uniform on the sphere."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(RAYS, 3))
    return rng.uniform(low, high, (RAYS, 3)), direction / np.linalg.norm(direction, axis=1, keepdims=True)


def crossing(origin: np.ndarray, end: np.ndarray, y: float) -> np.ndarray:
    """x and z [n, 2] where segments cross the plane at y, which they must."""
    assert np.all((origin[:, 1] < y) & (end[:, 1] >= y - TOLERANCE))
    s = (y - origin[:, 1]) / (end[:, 1] - origin[:, 1])
    return (origin + s[:, None] * (end - origin))[:, ::2]


def behind_the_curtains(points: np.ndarray) -> np.ndarray:
    """Which points [n, 3] are in the bay between curtains and window, or outside."""
    outside = np.any((points < -living_room.WALL - TOLERANCE) | (points > 10), axis=1)
    bay = (points[:, 0] > living_room.DIM + living_room.WALL / 2) & (points[:, 1] > living_room.LINING + TOLERANCE)
    return outside | bay


@pytest.mark.parametrize("gap", [0.0, 0.01, 0.2])
def test_only_the_gap_leads_behind_the_curtains(gap: float):
    pleats = living_room.LINING - 0.2
    rooms = ((0.02, 0.02, 0.02), (living_room.RIGHT - 0.02, pleats, living_room.HEIGHT - 0.02))
    near = ((living_room.MIDDLE - 0.5, pleats - 0.6, 0.02), (living_room.MIDDLE + 0.5, pleats, living_room.HEIGHT - 0.02))
    passed = 0
    for seed, (low, high) in enumerate((rooms, near)):
        origin, direction = rays(low, high, seed)
        hit = trace("living_room", {"gap": gap}, origin, direction)
        beyond = behind_the_curtains(hit)
        x, z = crossing(origin[beyond], hit[beyond], living_room.LINING).T
        through = (abs(x - living_room.MIDDLE) <= gap / 2 + TOLERANCE) & (z >= 0) & (z <= living_room.HEIGHT)
        assert np.all(through), f"{np.sum(~through)} of {RAYS} rays pass beside the gap, one at x = {x[~through][0]}"
        passed += len(x)
    assert passed > 30 if gap else passed == 0


@pytest.mark.parametrize("slat_angle", [-90.0, -40.0, 20.0, 90.0])
def test_only_the_windows_lead_out_of_the_classroom(slat_angle: float):
    """And no ray passes shut jalousies."""
    inside = ((0.02, 0.02, 0.02), (classroom.LENGTH - 0.02, classroom.DEPTH - 0.02, classroom.HEIGHT - 0.02))
    origin, direction = rays(*inside, seed=2)
    hit = trace("classroom", {"slat_angle": slat_angle}, origin, direction)
    gone = np.abs(hit).max(axis=1) > 100
    for y in (classroom.DEPTH, classroom.DEPTH + classroom.THICK):
        x, z = crossing(origin[gone], hit[gone], y).T
        column = np.any([(low - TOLERANCE <= x) & (x <= high + TOLERANCE) for low, high in classroom.COLUMNS], axis=0)
        row = np.any([(low - TOLERANCE <= z) & (z <= high + TOLERANCE) for low, high in classroom.ROWS], axis=0)
        assert np.all(column & row), f"{np.sum(~(column & row))} of {RAYS} rays leave beside the windows"
    assert gone.sum() == 0 if abs(slat_angle) == 90 else gone.sum() > 100


@pytest.mark.parametrize("slat_angle", [-60.0, -39.0, -15.0, 0.0, 20.0])
def test_share_of_direct_sunlight(slat_angle: float):
    """Against rays along the sun; the slats' thickness takes a little from the closed form."""
    elevation, azimuth = (math.radians(scenes.parameters("classroom")[f"sun_{x}"]) for x in ("elevation", "azimuth"))
    sun = np.array([math.cos(elevation) * math.sin(azimuth), -math.cos(elevation) * math.cos(azimuth), -math.sin(elevation)])
    rng = np.random.default_rng(4)
    (left, right), (low, high) = classroom.COLUMNS[1], classroom.ROWS[0]
    on_slats = rng.uniform((left + 0.2, classroom.SLATS, low + 0.3), (right - 0.2, classroom.SLATS, high - 0.3), (200_000, 3))
    hit = trace("classroom", {"slat_angle": slat_angle}, on_slats - 2 * sun, np.broadcast_to(sun, on_slats.shape))
    found = np.mean(hit[:, 1] < classroom.DEPTH - 0.02)
    expected = classroom.direct(slat_angle, math.degrees(elevation), math.degrees(azimuth))
    assert expected - 0.06 <= found <= expected + 0.01


@pytest.mark.parametrize("name, parameters", [("living_room", {"gap": 0}), ("classroom", {"slat_angle": 90, "sky": 0.1}),
                                              ("classroom", {"slat_angle": -90})])
def test_black_when_shut(name: str, parameters: dict):
    assert dr.all(mi.render(load(name, parameters, 64, 36, max_depth=13), spp=64, seed=1) == 0, axis=None)


@pytest.mark.slow
@pytest.mark.parametrize("name", SUNLIT)
@pytest.mark.filterwarnings("error")
def test_a_guide_learns_from_photons_of_the_sun(name: str):
    """Without a warning, and paths then vary less than half as much."""
    scene = load(name, None, 48, 27, max_depth=13)
    guide = olpm_bench.train(scene, photons=100_000, importons=50_000, camera_passes=8, camera_paths=1 << 16, max_depth=13)
    variance = []
    for integrator in (olpm_bench.integrator(guide, max_depth=13), scene.integrator()):
        images = np.array([mi.render(scene, integrator=integrator, spp=16, seed=100 + i) for i in range(16)], float)
        luminance = images @ [0.2126, 0.7152, 0.0722]
        variance.append(np.median(luminance.var(0, ddof=1) / (luminance.mean(0)**2 + 1e-3 * luminance.mean()**2)))
    assert variance[0] < 0.5 * variance[1]


@pytest.mark.parametrize("name", SUNLIT)
def test_everything_turns_with_the_rotation(name: str):
    """Same depths but for the noise of sub-pixel edges, and the same angle between the view and the sun."""
    depth, sun = [], []
    for rotation in (scenes.parameters(name)["rotation"], 0.0):
        scene = load(name, {"rotation": rotation}, 32, 18)
        x, y = dr.meshgrid((dr.arange(mi.Float, 32) + 0.5) / 32, (dr.arange(mi.Float, 18) + 0.5) / 18)
        ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
        si = scene.ray_intersect(ray)
        depth.append(np.array(si.t))
        sun.append(np.array(dr.dot(ray.d, scene.sample_emitter_direction(si, mi.Point2f(0.5), False)[0].d)))
    assert np.mean(~np.isclose(*depth, rtol=0, atol=1e-3)) < 0.02
    assert np.allclose(*sun, atol=1e-5)


@pytest.mark.parametrize("name, parameters, message", [
    ("living_room", {"gap": -0.01}, r"gap = -0.01: must be in \[0, 0.8\], in metres"),
    ("living_room", {"gap": 1}, "gap = 1.0: must be in"),
    ("living_room", {"sun_elevation": 80}, r"sun_elevation = 80.0: must be in \[10, 70\], in degrees"),
    ("living_room", {"sun_azimuth": float("nan")}, "sun_azimuth = nan: must be a number"),
    ("living_room", {"rotation": float("inf")}, "rotation = inf: must be a number"),
    ("living_room", {"slat_angle": 3}, "no parameter 'slat_angle'; known: gap, sun_elevation, sun_azimuth, rotation"),
    ("classroom", {"slat_angle": 91}, r"slat_angle = 91.0: must be in \[-90, 90\], in degrees"),
    ("classroom", {"sun_azimuth": -61}, "sun_azimuth = -61.0: must be in"),
    ("classroom", {"sky": 2}, r"sky = 2.0: must be in \[0, 1\]"),
    ("classroom", {"sky": "blue"}, "must be a number"),
    ("classroom", {"rotation": float("nan")}, "rotation = nan: must be a number"),
])
def test_bad_parameters(name: str, parameters: dict, message: str):
    with pytest.raises(SceneError, match=message) as error:
        scenes.build(name, parameters)
    assert "\n" not in str(error.value)
