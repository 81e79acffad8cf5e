"""A dark room beside a lit corridor; all light comes through the slit of a door left ajar.

After the situation of Veach's door scene, with measures, objects and textures of our own.  Length is in metres, z is
up.  The plan, before everything is turned by `rotation` so that no grid of a cache is flattered::

     4.4 +--------------------------+
         |   lamp                   |      corridor: pale, 2.1 m high, so that the leaf meets floor and
     2.8 +----------o=====.   ------+      ceiling however far it swings: nothing passes over or under it
     2.7 +----------+      +--------+      o hinge inside the wall, === leaf, . the slit
         | picture 1.35  2.25 picture
         |    table                 |      dark room: 3.2 x 2.7 x 2.35 m
       0 +-camera-------------------+
       y 0                         3.2 x

The leaf keeps the lamp itself from the slit: what comes through has met a wall of the corridor.
"""
from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.scenes import SceneError

if TYPE_CHECKING:
    from olpm_bench.scenes.geometry import Part

VERSION = 1                     # grows when the image changes
ROOMS = ("dark room", "corridor")

WIDTH, DEPTH, HEIGHT = 3.2, 2.7, 2.35       # dark room [m]
FAR_DEPTH, FAR_HEIGHT = 1.6, 2.1            # corridor [m]
WALL, SLAB = 0.1, 0.1                       # thickness of the wall between, and of all others [m]
HINGE, DOOR = 1.35, 0.9                     # left edge and width of the opening [m]
LEAF, OVERLAP, REBATE = 0.04, 0.015, 0.005   # the leaf: thickness, reach beyond the opening, depth in its frame [m]
LIT = DEPTH + WALL                          # y of the corridor's side of the wall [m]

RADIANCE = [4000.0, 3300.0, 2500.0]         # of the lamp; the dark room shows well at exposure 1 with the default gap


def build(gap: float = 0.07, rotation: float = 23.7, floor_roughness: float = 0.12) -> dict[str, Any]:
    """The scene as a dictionary for ``mi.load_dict``.

    Args:
        gap: clear width of the slit between the leaf and the frame [m], in [0, 0.9], and so the door's angle, asin(gap / 0.9)
            or 0.3 degrees more: 4.8 degrees for 0.07, 13.2 for 0.2; 0 shuts the door.
        rotation: angle by which everything is turned about the vertical [degrees].
        floor_roughness: GGX alpha of the varnish of the dark room's floor, in [0.01, 1].

    Raises:
        SceneError: a value out of its range.
    """
    check(gap, rotation, floor_roughness)
    import mitsuba as mi

    from olpm_bench.scenes import geometry as g

    turn, materials = g.turn_z(rotation), _materials(floor_roughness)
    parts = {**_rooms(), **_door(gap), **_lamp(), **_furniture(), **_pictures()}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": RADIANCE}}
    scene: dict[str, Any] = {"type": "scene"}
    for name, pieces in parts.items():
        scene[name] = g.mesh(name, pieces, materials[name], turn, emitter if name == "bulb" else None)
    origin, target = (turn @ np.array(p) for p in ((0.25, 0.1, 1.5), (1.53, 2.4, 0.9)))
    scene["sensor"] = {
        "type": "perspective", "fov": 73.0, "near_clip": 0.01, "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin.tolist(), target=target.tolist(), up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 320, "height": 180},
    }
    return scene


def slit(gap: float = 0.07, rotation: float = 23.7) -> np.ndarray:
    """Corners of the rectangle through which all light passes [4, 3] m: frame (floor, top), then leaf (top, floor).

    Raises:
        SceneError: a value out of its range.
    """
    _check_slit(gap, rotation)
    corner = np.array([HINGE + DOOR, LIT])
    _, across = _leaf_axes(gap)
    foot = corner + gap * across
    from olpm_bench.scenes.geometry import turn_z
    points = np.array([[*corner, 0], [*corner, FAR_HEIGHT], [*foot, FAR_HEIGHT], [*foot, 0]])
    return points @ turn_z(rotation).T


def room(p: np.ndarray, rotation: float = 23.7) -> np.ndarray:
    """Index into `ROOMS` of points [n, 3]: the wall's middle parts them."""
    from olpm_bench.scenes.geometry import turn_z
    return ((p @ turn_z(rotation))[:, 1] > (DEPTH + LIT) / 2).astype(int)


def check(gap: float, rotation: float, floor_roughness: float) -> None:
    """
    Raises:
        SceneError: a value out of its range.
    """
    _check_slit(gap, rotation)
    if not 0.01 <= floor_roughness <= 1:
        raise SceneError(f"door_ajar: floor_roughness = {floor_roughness!r}: must be in [0.01, 1]")


def _check_slit(gap: float, rotation: float) -> None:
    if not 0 <= gap <= DOOR:
        raise SceneError(f"door_ajar: gap = {gap!r}: must be in [0, {DOOR}], the width of the door in metres")
    if not math.isfinite(rotation):
        raise SceneError(f"door_ajar: rotation = {rotation!r}: must be finite, in degrees")


def _leaf_axes(gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors along the leaf, from its hinge, and across it, into the corridor [2].

    The leaf turns about (HINGE, LIT - REBATE) until its face is `gap` away from the corner of the frame.
    """
    angle = math.asin(min(1.0, gap / math.hypot(DOOR, REBATE))) + math.atan2(REBATE, DOOR) if gap > 0 else 0.0
    return np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])


def _rooms() -> dict[str, list[Part]]:
    from olpm_bench.scenes.geometry import box
    end = LIT + FAR_DEPTH
    return {
        "floor": [box((-SLAB, -SLAB, -SLAB), (WIDTH + SLAB, LIT - REBATE, 0))],
        "plaster": [
            box((-SLAB, -SLAB, 0), (0, DEPTH, HEIGHT)), box((WIDTH, -SLAB, 0), (WIDTH + SLAB, DEPTH, HEIGHT)),
            box((0, -SLAB, 0), (WIDTH, 0, HEIGHT)), box((-SLAB, -SLAB, HEIGHT), (WIDTH + SLAB, LIT, HEIGHT + SLAB)),
            # the wall between the rooms: left and right of the opening, and above it
            box((-SLAB, DEPTH, 0), (HINGE, LIT, HEIGHT)), box((HINGE + DOOR, DEPTH, 0), (WIDTH + SLAB, LIT, HEIGHT)),
            box((HINGE, DEPTH, FAR_HEIGHT), (HINGE + DOOR, LIT, HEIGHT)),
        ],
        "corridor": [
            box((-SLAB, LIT - REBATE, -SLAB), (WIDTH + SLAB, end + SLAB, 0)),
            box((-SLAB, LIT, FAR_HEIGHT), (WIDTH + SLAB, end + SLAB, FAR_HEIGHT + SLAB)),
            box((-SLAB, LIT, 0), (0, end, FAR_HEIGHT)), box((WIDTH, LIT, 0), (WIDTH + SLAB, end, FAR_HEIGHT)),
            box((-SLAB, end, 0), (WIDTH + SLAB, end + SLAB, FAR_HEIGHT)),
        ],
        "frame": [
            box((HINGE - 0.07, DEPTH - 0.015, 0), (HINGE, DEPTH + 0.01, FAR_HEIGHT + 0.07)),
            box((HINGE + DOOR, DEPTH - 0.015, 0), (HINGE + DOOR + 0.07, DEPTH + 0.01, FAR_HEIGHT + 0.07)),
            box((HINGE, DEPTH - 0.015, FAR_HEIGHT), (HINGE + DOOR, DEPTH + 0.01, FAR_HEIGHT + 0.07)),
            box((0, DEPTH - 0.012, 0), (HINGE - 0.07, DEPTH + 0.01, 0.08)),
            box((HINGE + DOOR + 0.07, DEPTH - 0.012, 0), (WIDTH, DEPTH + 0.01, 0.08)),
            box((-0.01, 0, 0), (0.012, DEPTH, 0.08)), box((WIDTH - 0.012, 0, 0), (WIDTH + 0.01, DEPTH, 0.08)),
        ],
    }


def _door(gap: float) -> dict[str, list[Part]]:
    from olpm_bench.scenes.geometry import box, lathe
    along, across = _leaf_axes(gap)
    matrix = np.array([[along[0], across[0], 0], [along[1], across[1], 0], [0, 0, 1]])
    hinge = (HINGE, LIT - REBATE, 0)
    # The leaf goes on behind its hinge, into the wall, and into floor and ceiling: there is no crack.
    leaf = box((-0.03, 0, -0.02), (DOOR + OVERLAP, LEAF, FAR_HEIGHT + 0.02))
    stem = lathe([(0, 0), (0.024, 0), (0.024, 0.008), (0.009, 0.012), (0.009, 0.05), (0, 0.05)], 20)
    towards_room = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])       # z to -y
    handle = [stem.transformed(towards_room, (DOOR - 0.07, 0, 1.02)),
              box((DOOR - 0.19, -0.056, 1.011), (DOOR - 0.06, -0.042, 1.029))]
    return {"door": [leaf.transformed(matrix, hinge)], "handle": [p.transformed(matrix, hinge) for p in handle]}


def _lamp() -> dict[str, list[Part]]:
    """A framed panel under the corridor's ceiling, behind the leaf as seen from the slit."""
    from olpm_bench.scenes.geometry import box, quad
    (x0, y0), (x1, y1), t = (0.5, 3.4), (1.4, 3.9), 0.02            # outline and thickness of the frame [m]
    low, high = FAR_HEIGHT - 0.05, FAR_HEIGHT + 0.01
    frame = [box((x0, y0, low), (x1, y0 + t, high)), box((x0, y1 - t, low), (x1, y1, high)),
             box((x0, y0 + t, low), (x0 + t, y1 - t, high)), box((x1 - t, y0 + t, low), (x1, y1 - t, high))]
    bulb = quad((x0 + t, y1 - t, low + 0.02), (x1 - x0 - 2 * t, 0, 0), (0, y0 - y1 + 2 * t, 0))
    return {"lamp_frame": frame, "bulb": [bulb]}


# Outlines (radius, height) [m] of what stands on the table; those of hollow things go up outside and down inside.
POT = [(0, 0), (0.1, 0), (0.135, 0.03), (0.15, 0.08), (0.145, 0.14), (0.12, 0.185), (0.09, 0.2), (0.09, 0.206),
       (0.125, 0.206), (0.118, 0.222), (0.06, 0.243), (0.018, 0.25), (0.015, 0.262), (0.026, 0.275), (0.022, 0.292),
       (0, 0.298)]
CARAFE = [(0, 0), (0.07, 0), (0.085, 0.012), (0.092, 0.05), (0.085, 0.1), (0.055, 0.16), (0.034, 0.2), (0.032, 0.25),
          (0.044, 0.29), (0.04, 0.292), (0.027, 0.25), (0.028, 0.202), (0.048, 0.162), (0.078, 0.1), (0.085, 0.05),
          (0.078, 0.02), (0.065, 0.014), (0, 0.014)]
VASE = [(0, 0), (0.055, 0), (0.062, 0.008), (0.1, 0.1), (0.105, 0.16), (0.08, 0.24), (0.045, 0.29), (0.04, 0.33),
        (0.06, 0.37), (0.054, 0.372), (0.033, 0.33), (0.036, 0.29), (0.07, 0.236), (0.09, 0.16), (0.05, 0.02),
        (0, 0.02)]
BOWL = [(0, 0), (0.05, 0), (0.055, 0.012), (0.1, 0.05), (0.125, 0.095), (0.119, 0.097), (0.093, 0.055), (0.045, 0.02),
        (0, 0.02)]
BALL = [(0.045 * math.sin(t), -0.045 * math.cos(t)) for t in np.linspace(0, math.pi, 25)]


def _furniture() -> dict[str, list[Part]]:
    from olpm_bench.scenes.geometry import box, lathe, turn_z
    place, turned, top = (1.1, 1.58, 0.0), turn_z(14), 0.72         # middle, direction and height of the table
    x, y, leg = 0.55, 0.31, 0.03
    table = [box((-0.62, -0.38, top - 0.035), (0.62, 0.38, top))]
    table += [box((sx * x - leg, sy * y - leg, 0), (sx * x + leg, sy * y + leg, top - 0.03))
              for sx in (-1, 1) for sy in (-1, 1)]
    table += [box((-x, sy * y - 0.012, top - 0.1), (x, sy * y + 0.012, top - 0.03)) for sy in (-1, 1)]

    def on_table(outline: list[tuple[float, float]], x: float, y: float, z: float = 0.0) -> Part:
        # 0.2 mm above the top: glass that touches it would share its surface
        return lathe(outline, 56).transformed(turned, np.add(place, turned @ (x, y, top + z + 2e-4)))

    return {
        "table": [p.transformed(turned, place) for p in table],
        "pot": [on_table(POT, -0.05, 0.12)],
        "glass": [on_table(CARAFE, 0.3, -0.08), on_table(BALL, -0.18, -0.24, 0.045)],
        "clay": [on_table(VASE, -0.42, 0.02)],
        "bowl": [on_table(BOWL, 0.12, -0.25)],
    }


def _pictures() -> dict[str, list[Part]]:
    from olpm_bench.scenes.geometry import frame, quad
    y, wall = DEPTH - 0.01, (DEPTH - 0.03, DEPTH + 0.005)
    return {
        "picture_frame": frame((0.12, 1.14), wall, (1.15, 1.9), 0.035) + frame((2.48, 3.02), wall, (1.2, 1.9), 0.035),
        "landscape": [quad((0.155, y, 1.185), (0.95, 0, 0), (0, 0, 0.68))],
        "squares": [quad((2.515, y, 1.235), (0.47, 0, 0), (0, 0, 0.63))],
    }


def _materials(floor_roughness: float) -> dict[str, dict[str, Any]]:
    from olpm_bench.scenes import textures as t
    from olpm_bench.scenes.materials import diffuse, glass, metal, plastic
    rng = np.random.default_rng(1997)

    parquet = t.boards(rng, 12, 2, 512, (0.24, 0.12, 0.055), (0.6, 0.4, 0.22))
    wood = t.boards(rng, 5, 1, 256, (0.32, 0.19, 0.1), (0.55, 0.38, 0.22))
    streaks = t.noise(rng, (128, 256), (4, 64))[..., None] * t.noise(rng, (128, 256), (16, 8))[..., None]
    clay = np.asarray((0.58, 0.27, 0.16)) * (0.75 + 0.4 * streaks)
    return {
        "floor": plastic(t.texture(parquet, (1.6, 1.6)), floor_roughness),
        "plaster": diffuse((0.84, 0.82, 0.78)),
        "corridor": diffuse((0.86, 0.82, 0.75)),
        "frame": plastic((0.7, 0.69, 0.66), 0.2),
        "door": plastic((0.6, 0.7, 0.68), 0.25),
        "handle": metal("Cr", 0.2),
        "lamp_frame": metal("Al", 0.3),
        "bulb": diffuse((0.0, 0.0, 0.0)),
        "table": plastic(t.texture(wood, (0.76, 0.76)), 0.15),
        "pot": metal("Cu", 0.15),
        "glass": glass(),
        "clay": diffuse(t.texture(clay)),
        "bowl": plastic((0.08, 0.25, 0.3), 0.1),
        "picture_frame": plastic((0.06, 0.04, 0.03), 0.1),
        "landscape": diffuse(t.texture(t.painted((195, 282), _landscape))),
        "squares": diffuse(t.texture(t.painted((146, 116), _squares))),
    }


def _landscape(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Evening over three ranges of hills."""
    t = y[..., None]
    image = (1 - t) * np.array([0.85, 0.45, 0.2]) + t * np.array([0.1, 0.2, 0.5])
    sun = np.exp(-(((x - 0.68) / 0.05) ** 2 + ((y - 0.55) / 0.07) ** 2))[..., None]
    image = image + sun * np.array([0.4, 0.4, 0.25]) * (1 - image)
    hills = ((0.5, 5.0, (0.3, 0.25, 0.35)), (0.36, 8.0, (0.16, 0.18, 0.2)), (0.2, 11.0, (0.05, 0.09, 0.05)))
    for base, wave, colour in hills:
        ridge = base + 0.07 * np.sin(wave * x + 3 * base) + 0.03 * np.sin(3.1 * wave * x + wave)
        image = np.where((y < ridge)[..., None], np.array(colour) * (0.8 + 0.4 * t), image)
    return np.clip(image, 0, 0.9)


def _squares(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Nested squares that grow lighter inwards."""
    image = np.full((*x.shape, 3), (0.5, 0.12, 0.06))
    for size, colour in ((0.38, (0.7, 0.3, 0.08)), (0.27, (0.75, 0.5, 0.15)), (0.15, (0.8, 0.72, 0.4))):
        inside = (abs(x - 0.5) < size) & (abs(y - 0.25 - size * 0.75) < size)
        image[inside] = colour
    return image
