"""A dim sitting room beside a sunny one; all light is sunlight through the gap between two curtains.

After the situation of the talk's living room, with a plan, objects and textures of our own.  Length is in metres, z is up.
The plan, before everything is turned by `rotation` so that no grid of a cache is flattered::

     4.0 +------------------+-[==window==]-+
    3.75 | sofa, pictures   |~~~~~~~~~.~~~~|      ~ the curtains from wall to wall, . the gap
     3.6 |             lamp +              |
         |      table                      |      the opening in the partition is 2.25 m high
     2.0 |                  +              |
         |        sideboard |              |      dim room: 3.4 x 4 x 2.5 m
       0 +-camera-----------+--------------+
       y 0                 3.4            6.0 x

Behind the pleats is a flat blackout lining: what passes is a plane with one slit, and shading normals leak nothing.
The sun draws a stripe across the sunny room's floor, most of it behind the partition.

How hard that is for plain path tracing: `tests/scenes/test_references.py`.
"""
from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.scenes import SceneError, check_range
from olpm_bench.scenes.textures import over

if TYPE_CHECKING:
    from olpm_bench.scenes.geometry import Part

VERSION = 1                     # grows when the image changes
ROOMS = ("dim room", "sunny room", "outside")

DIM, SUNNY, DEPTH, HEIGHT = 3.4, 2.5, 4.0, 2.5      # widths of the rooms, their depth and height [m]
WALL, THICK = 0.1, 0.4                              # thickness of the walls, and of that with the window [m]
LEFT, RIGHT = DIM + WALL, DIM + WALL + SUNNY        # x of the sunny room's sides [m]
OPENING, LINTEL = (2.0, 3.6), 2.25                  # y of the opening in the partition, and its height [m]
LINING = 3.75                                       # y of the curtains' lining [m]
WINDOW = ((LEFT + 0.4, 0.1), (RIGHT - 0.5, 2.42))   # (x, z) of its corners [m]
MIDDLE = 4.95                                       # x of the middle of the gap [m]
WIDEST = 0.8                                        # gap [m]
PLEAT, SWING = 0.115, 0.035                         # width of a pleat, and half its depth [m]
IRRADIANCE = (900.0, 810.0, 680.0)                  # of the sun; the dim room shows well at exposure 1 with the default gap


def build(gap: float = 0.2, sun_elevation: float = 36.0, sun_azimuth: float = -32.0,
          rotation: float = 37.3) -> dict[str, Any]:
    """The scene as a dictionary for ``mi.load_dict``.

    Args:
        gap: width of the gap between the curtains [m], in [0, 0.8]; 0 closes them.
        sun_elevation: of the sun above the horizon [degrees], in [10, 70].
        sun_azimuth: between the sun and the window's normal [degrees], in [-45, 45]; negative: it shines towards the dim room.
        rotation: angle by which everything is turned about the vertical [degrees].

    Raises:
        SceneError: a value out of its range.
    """
    check(gap, sun_elevation, sun_azimuth, rotation)
    import mitsuba as mi

    from olpm_bench.scenes import geometry as g

    turn, materials = g.turn_z(rotation), _materials()
    scene: dict[str, Any] = {"type": "scene"}
    for name, pieces in {**_rooms(), **_curtains(gap), **_seats(), **_things()}.items():
        scene[name] = g.mesh(name, pieces, materials[name], turn)
    scene["sun"] = g.sunlight(IRRADIANCE, sun_elevation, sun_azimuth, turn)
    origin, target = (turn @ np.array(p) for p in ((0.3, 0.25, 1.35), (2.05, 3.2, 0.98)))
    scene["sensor"] = {
        "type": "perspective", "fov": 70.0, "near_clip": 0.01, "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin.tolist(), target=target.tolist(), up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 320, "height": 180},
    }
    return scene


def room(p: np.ndarray, rotation: float = 37.3) -> np.ndarray:
    """Index into `ROOMS` of points [n, 3]: the partition's middle parts the rooms, the curtains' lining ends the sunny one."""
    from olpm_bench.scenes.geometry import inside, turn_z
    p = p @ turn_z(rotation)
    indoors = inside(p, (DIM + WALL / 2, DEPTH, HEIGHT)) | inside(p, (RIGHT, LINING, HEIGHT))
    return np.where(indoors, p[:, 0] > DIM + WALL / 2, 2)


def check(gap: float, sun_elevation: float, sun_azimuth: float, rotation: float) -> None:
    """
    Raises:
        SceneError: a value out of its range.
    """
    check_range("living_room: gap", gap, 0, WIDEST, "metres")
    check_range("living_room: sun_elevation", sun_elevation, 10, 70, "degrees")
    check_range("living_room: sun_azimuth", sun_azimuth, -45, 45, "degrees")
    if not math.isfinite(rotation):
        raise SceneError(f"living_room: rotation = {rotation!r}: must be finite, in degrees")


def _rooms() -> dict[str, list[Part]]:
    from olpm_bench.scenes.geometry import box
    (y0, y1), t = OPENING, WALL
    (x_low, z_low), (x_high, z_high) = WINDOW
    end, outside = RIGHT + t, DEPTH + THICK
    skirting = [box((0, DEPTH - 0.012, 0), (DIM, DEPTH + 0.01, 0.08)), box((-0.01, 0, 0), (0.012, DEPTH, 0.08)),
                box((DIM - 0.012, 0, 0), (DIM + 0.01, y0, 0.08))]
    jamb = [box((DIM - 0.012, y0 - 0.06, 0), (LEFT + 0.012, y0 + 0.012, LINTEL + 0.06)),
            box((DIM - 0.012, y1 - 0.012, 0), (LEFT + 0.012, y1 + 0.06, LINTEL + 0.06)),
            box((DIM - 0.012, y0 + 0.012, LINTEL - 0.012), (LEFT + 0.012, y1 - 0.012, LINTEL + 0.06))]
    middle, bar = (x_low + x_high) / 2, 0.03
    return {
        "floor": [box((-t, -t, -t), (end, outside, 0))],
        "walls": [
            box((-t, -t, 0), (0, outside, HEIGHT)), box((RIGHT, -t, 0), (end, outside, HEIGHT)),
            box((0, -t, 0), (RIGHT, 0, HEIGHT)), box((0, DEPTH, 0), (LEFT, outside, HEIGHT)),
            # around the window
            box((LEFT, DEPTH, 0), (x_low, outside, HEIGHT)), box((x_high, DEPTH, 0), (RIGHT, outside, HEIGHT)),
            box((x_low, DEPTH, 0), (x_high, outside, z_low)), box((x_low, DEPTH, z_high), (x_high, outside, HEIGHT)),
        ],
        "ceiling": [box((-t, -t, HEIGHT), (end, outside, HEIGHT + t))],
        "partition": [box((DIM, 0, 0), (LEFT, y0, HEIGHT)), box((DIM, y1, 0), (LEFT, DEPTH, HEIGHT)),
                      box((DIM, y0, LINTEL), (LEFT, y1, HEIGHT))],
        "frame": [*skirting, *jamb, box((x_low, outside - 0.1, 1.6), (x_high, outside - 0.05, 1.6 + bar)),
                  box((middle - bar, outside - 0.1, z_low), (middle + bar, outside - 0.05, z_high))],
    }


def _curtains(gap: float) -> dict[str, list[Part]]:
    """Two pleated sheets on the room's side of their lining; both go on into floor, ceiling and walls."""
    from olpm_bench.scenes.geometry import quad, sheet
    z = np.linspace(-0.01, HEIGHT + 0.01, 12)[:, None]
    pleats, lining = [], []
    for edge, wall in ((MIDDLE - gap / 2, LEFT - 0.03), (MIDDLE + gap / 2, RIGHT + 0.03)):
        x = np.linspace(edge, wall, 20 * round(abs(wall - edge) / PLEAT) + 1)[None]
        phase = 2 * np.pi * abs(x - edge) / PLEAT
        swing = SWING * (1 - 0.35 * (z / HEIGHT) ** 2) * (1 + 0.3 * np.sin(5.1 * x + 0.7 * z))
        phase = phase + 0.5 * np.sin(phase / 7) * (1 - z / HEIGHT)
        y = LINING + 1e-3 + swing * (1 - np.cos(phase))
        pleats.append(sheet(np.stack(np.broadcast_arrays(x, y, z), -1)))
        lining.append(quad((edge, LINING, -0.01), (wall - edge, 0, 0), (0, 0, HEIGHT + 0.02)))
    return {"curtains": pleats, "lining": lining}


def _seats() -> dict[str, list[Part]]:
    """Sofa with cushions before the far wall."""
    from olpm_bench.scenes.geometry import box, cushion, lathe, turn_z
    x0, x1, y0, y1 = 0.45, 2.45, 3.02, 3.9                      # outline of the sofa [m]
    arm, seat, middle = 0.18, 0.44, 1.45
    sofa = [cushion((x0, y0 + 0.03, 0.12), (x1, y1, 0.3), 0.03), cushion((x0, y1 - 0.2, 0.12), (x1, y1, 0.78), 0.06)]
    sofa += [cushion((x, y0, 0.12), (x + arm, y1, 0.58), 0.06) for x in (x0, x1 - arm)]
    for low, high in ((x0 + arm, middle), (middle, x1 - arm)):
        sofa.append(cushion((low + 0.003, y0 - 0.01, 0.3), (high - 0.003, y1 - 0.2, seat), 0.045, 0.012))
        sofa.append(cushion((low + 0.003, 0, 0), (high - 0.003, 0.16, 0.42), 0.06, 0.02).transformed(
            _tilt(12), (0, y1 - 0.38, seat + 0.02)))
    legs = [lathe([(0, 0), (0.016, 0), (0.026, 0.13), (0, 0.13)], 16).transformed(np.eye(3), (x, y, 0))
            for x in (x0 + 0.08, x1 - 0.08) for y in (y0 + 0.08, y1 - 0.08)]

    def thrown(x: float, y: float, size: float, turn: float, tilt: float) -> Part:
        pillow = cushion((-size / 2, -0.05, 0), (size / 2, 0.05, size), 0.045, 0.045)
        return pillow.transformed(turn_z(turn) @ _tilt(tilt), (x, y, seat + 0.03))

    rug = [box((0.35, 1.5, -0.001), (2.75, 2.95, 0.012))]
    return {"sofa": sofa, "legs": legs, "rug": rug,
            "ochre": [thrown(0.9, 3.44, 0.4, 16, 20)], "rust": [thrown(2.02, 3.42, 0.42, -20, 22)],
            "white": [thrown(1.72, 3.36, 0.33, -8, 30)]}


def _tilt(degrees: float) -> np.ndarray:
    """Lean back, towards +y [3, 3]."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


# Outlines (radius, height) [m], those of hollow things go up outside and down inside.
SHADE = [(0.2, 0), (0.13, 0.3), (0.128, 0.3), (0.198, 0)]
STAND = [(0, 0), (0.14, 0), (0.14, 0.012), (0.03, 0.028), (0.011, 0.045), (0.011, 1.4), (0, 1.4)]
TUMBLER = [(0, 0), (0.03, 0), (0.036, 0.1), (0.034, 0.1), (0.0285, 0.012), (0, 0.012)]
DECANTER = [(0, 0), (0.06, 0), (0.068, 0.01), (0.068, 0.08), (0.055, 0.12), (0.022, 0.16), (0.02, 0.2), (0.03, 0.225),
            (0.026, 0.226), (0.016, 0.2), (0.018, 0.158), (0.05, 0.116), (0.062, 0.078), (0.06, 0.014), (0, 0.014)]
TEAPOT = [(0, 0), (0.06, 0), (0.09, 0.03), (0.1, 0.07), (0.09, 0.11), (0.05, 0.135), (0.05, 0.14), (0.02, 0.152),
          (0.012, 0.158), (0.018, 0.172), (0, 0.18)]
BOWL = [(0, 0), (0.06, 0), (0.065, 0.012), (0.13, 0.05), (0.165, 0.1), (0.159, 0.102), (0.125, 0.056), (0.05, 0.02), (0, 0.02)]
BOTTLE_VASE = [(0, 0), (0.07, 0), (0.11, 0.06), (0.12, 0.13), (0.09, 0.21), (0.035, 0.27), (0.028, 0.36), (0.045, 0.4),
               (0.04, 0.402), (0.022, 0.36), (0.03, 0.268), (0.084, 0.205), (0.11, 0.13), (0.06, 0.02), (0, 0.02)]
URN = [(0, 0), (0.055, 0), (0.06, 0.015), (0.085, 0.1), (0.08, 0.17), (0.05, 0.22), (0.062, 0.25), (0.056, 0.251),
       (0.044, 0.22), (0.074, 0.165), (0.05, 0.03), (0, 0.03)]
ORANGE = [(0.04 * math.sin(t), -0.04 * math.cos(t)) for t in np.linspace(0, math.pi, 21)]


def _things() -> dict[str, list[Part]]:
    """Table, lamp, sideboard and pictures, and what stands on them."""
    from olpm_bench.scenes.geometry import box, cushion, frame, lathe, quad, turn_z
    place, turned, top = np.array((1.5, 2.2, 0.012)), turn_z(-9), 0.42

    def on_table(part: Part, x: float, y: float, z: float = 0.0, turn: float = 0.0) -> Part:
        # 0.2 mm above the top: glass that touches it would share its surface
        return part.transformed(turned @ turn_z(turn), place + turned @ (x, y, top + z + 2e-4))

    table = [cushion((-0.55, -0.3, top - 0.03), (0.55, 0.3, top), 0.012)]
    legs = [box((x - 0.014, y - 0.014, 0), (x + 0.014, y + 0.014, top - 0.025)) for x in (-0.47, 0.47) for y in (-0.23, 0.23)]
    legs += [box((x - 0.01, -0.23, 0.05), (x + 0.01, 0.23, 0.066)) for x in (-0.47, 0.47)]
    lamp = np.array((2.88, 3.5, 0))
    side = (DIM - 0.4, DIM - 0.013), (0.75, 1.9), 0.72                # sideboard: x, y, height [m]
    (sx0, sx1), (sy0, sy1), high = side
    sideboard = [box((sx0, sy0, 0.12), (sx1, sy1, high))]
    doors = [box((sx0 - 0.016, y + 0.006, 0.135), (sx0 + 0.001, y + 0.375, high - 0.015)) for y in sy0 + 0.383 * np.arange(3)]
    feet = [box((x - 0.02, y - 0.02, 0), (x + 0.02, y + 0.02, 0.125))
            for x in (sx0 + 0.05, sx1 - 0.05) for y in (sy0 + 0.06, sy1 - 0.06)]

    def on_sideboard(outline: list[tuple[float, float]], x: float, y: float) -> Part:
        return lathe(outline, 56).transformed(np.eye(3), (sx0 + x, y, high + 2e-4))

    def sheet_of(x0: float, x1: float, z0: float, z1: float) -> Part:
        return quad((x0, DEPTH - 0.012, z0), (x1 - x0, 0, 0), (0, 0, z1 - z0))

    pictures = {"sea": (0.5, 1.3, 1.22, 1.86), "leaves": (1.45, 1.9, 1.22, 1.86), "circles": (2.05, 2.5, 1.4, 1.86)}
    hung = {name: [sheet_of(x0 + 0.028, x1 - 0.028, z0 + 0.028, z1 - 0.028)] for name, (x0, x1, z0, z1) in pictures.items()}
    return {
        **hung, "picture_frames": [p for x0, x1, z0, z1 in pictures.values()
                           for p in frame((x0, x1), (DEPTH - 0.028, DEPTH + 0.005), (z0, z1), 0.03)],
        "table": [p.transformed(turned, place) for p in table],
        "steel": [p.transformed(turned, place) for p in legs],
        "books": [on_table(box((-0.14, -0.1, 0), (0.14, 0.1, 0.028)), -0.33, 0.08, 0, 12)],
        "book": [on_table(box((-0.11, -0.08, 0), (0.11, 0.08, 0.022)), -0.34, 0.08, 0.029, -6)],
        "glasses": [on_table(lathe(TUMBLER, 48), 0.2, -0.14), on_table(lathe(TUMBLER, 48), 0.32, -0.06),
                    on_table(lathe(DECANTER, 56), 0.32, 0.12)],
        "teapot": [on_table(lathe(TEAPOT, 56), -0.06, -0.12)],
        "bowl": [on_table(lathe(BOWL, 56), 0.03, 0.14)],
        "oranges": [on_table(lathe(ORANGE, 32), 0.03 + x, 0.14 + y, 0.07 + z)
                    for x, y, z in ((-0.05, 0.02, 0), (0.045, 0.04, 0), (0.005, -0.045, 0), (0.0, 0.015, 0.055))],
        "lamp_stand": [lathe(STAND, 40).transformed(np.eye(3), lamp)],
        "shade": [lathe(SHADE, 64).transformed(np.eye(3), np.add(lamp, (0, 0, 1.25)))],
        "sideboard": sideboard + feet, "doors": doors,
        "copper": [on_sideboard(URN, 0.2, 1.74)],
        "vase": [on_sideboard(BOTTLE_VASE, 0.19, 1.45)],
        "crystal": [on_sideboard(BOWL, 0.2, 1.1)],
    }


def _materials() -> dict[str, dict[str, Any]]:
    from olpm_bench.scenes import textures as t
    from olpm_bench.scenes.materials import diffuse, glass, metal, plastic
    rng = np.random.default_rng(2014)
    oak = t.boards(rng, 10, 2, 512, (0.33, 0.23, 0.15), (0.6, 0.47, 0.33))
    walnut = t.boards(rng, 4, 1, 256, (0.13, 0.07, 0.04), (0.3, 0.18, 0.1))
    weave = 0.75 + 0.5 * t.noise(rng, (128, 128), (64, 64))[..., None]
    return {
        "floor": plastic(t.texture(oak, (1.5, 1.5)), 0.14),
        "walls": diffuse((0.82, 0.82, 0.8)),
        "ceiling": diffuse((0.86, 0.86, 0.85)),
        "partition": diffuse((0.72, 0.77, 0.74)),
        "frame": plastic((0.75, 0.74, 0.71), 0.2),
        "curtains": diffuse((0.3, 0.43, 0.46)),
        "lining": diffuse((0.4, 0.38, 0.35)),
        "sofa": diffuse(t.texture(weave * (0.22, 0.33, 0.4), (0.3, 0.3))),
        "legs": plastic((0.2, 0.11, 0.06), 0.2),
        "rug": diffuse(t.texture(t.painted((256, 424), _rug), (2.4, 1.45))),
        "ochre": diffuse(t.texture(weave * (0.68, 0.45, 0.1), (0.2, 0.2))),
        "rust": diffuse(t.texture(weave * (0.6, 0.2, 0.1), (0.2, 0.2))),
        "white": diffuse(t.texture(t.painted((64, 64), _stripes), (0.12, 0.12))),
        "sea": plastic(t.texture(t.painted((176, 224), _sea)), 0.05),
        "leaves": plastic(t.texture(t.painted((192, 128), _leaves)), 0.05),
        "circles": plastic(t.texture(t.painted((128, 128), _circles)), 0.05),
        "picture_frames": plastic((0.05, 0.04, 0.035), 0.1),
        "table": plastic(t.texture(walnut, (0.6, 0.6)), 0.1),
        "steel": metal("Cr", 0.15),
        "books": plastic((0.12, 0.25, 0.3), 0.3),
        "book": plastic((0.65, 0.55, 0.4), 0.3),
        "glasses": glass(),
        "teapot": plastic((0.75, 0.75, 0.72), 0.06),
        "bowl": diffuse((0.3, 0.42, 0.4)),
        "oranges": plastic((0.8, 0.3, 0.03), 0.25),
        "lamp_stand": metal("Cu", 0.2),
        "shade": diffuse((0.82, 0.76, 0.64)),
        "sideboard": plastic(t.texture(walnut[::-1], (0.7, 0.7)), 0.15),
        "doors": plastic((0.62, 0.66, 0.6), 0.2),
        "copper": metal("Cu", 0.12),
        "vase": plastic((0.1, 0.24, 0.32), 0.06),
        "crystal": glass(),
    }


def _rug(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Lozenges between two borders."""
    image = np.full((*x.shape, 3), (0.5, 0.44, 0.36))
    lozenge = abs(x * 9 % 1 - 0.5) + abs(y * 5 % 1 - 0.5)
    image = over(image, lozenge < 0.36, (0.34, 0.13, 0.1))
    image = over(image, lozenge < 0.22, (0.55, 0.48, 0.38))
    image = over(image, lozenge < 0.1, (0.12, 0.18, 0.24))
    edge = np.minimum(np.minimum(x, 1 - x) * 1.66, np.minimum(y, 1 - y))
    image = over(image, edge < 0.09, (0.14, 0.2, 0.26))
    return over(image, edge < 0.02, (0.5, 0.44, 0.36))


def _stripes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return over(np.full((*x.shape, 3), (0.74, 0.71, 0.64)), abs(x - 0.5) < 0.16, (0.15, 0.25, 0.33))


def _sea(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A sail on the water under a high sky."""
    t = np.clip((y - 0.4) / 0.6, 0, 1)[..., None]
    image = (1 - t) * np.array([0.75, 0.66, 0.5]) + t * np.array([0.22, 0.42, 0.62])
    waves = 0.5 + 0.5 * np.sin(90 * y + 4 * np.sin(14 * x + 25 * y))
    image = np.where((y < 0.4)[..., None], np.array([0.06, 0.22, 0.3]) + waves[..., None] * np.array([0.1, 0.14, 0.14]), image)
    height = (y - 0.36) / 0.36
    image = over(image, (abs(x - 0.62 + 0.05 * height) < 0.09 * (1 - height)) & (height > 0.1), (0.85, 0.82, 0.74))
    return over(image, (abs(x - 0.62) < 0.11) & (abs(y - 0.36) < 0.018), (0.3, 0.1, 0.05))


def _leaves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A twig with leaves on paper."""
    image = over(np.full((*x.shape, 3), (0.76, 0.74, 0.66)), abs(x - 0.5 - 0.05 * np.sin(5 * y)) < 0.008, (0.2, 0.22, 0.1))
    for i, height in enumerate(np.linspace(0.22, 0.74, 5)):
        side = 1 if i % 2 else -1
        u, v = (x - 0.5 - 0.05 * np.sin(5 * height)) * side, (y - height) * 1.4
        along, across = 0.8 * u + 0.6 * v, 0.8 * v - 0.6 * u
        leaf = abs(across) < 0.065 * np.sin(np.pi * np.clip(along / 0.34, 0, 1))
        image = over(image, leaf, (0.12 + 0.05 * i, 0.32, 0.16))
    return over(image, (y < 0.08) | (y > 0.92) | (x < 0.12) | (x > 0.88), (0.8, 0.79, 0.74))


def _circles(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    image = np.full((*x.shape, 3), (0.7, 0.62, 0.48))
    for cx, cy, r, colour in ((0.4, 0.42, 0.3, (0.55, 0.12, 0.07)), (0.64, 0.6, 0.24, (0.08, 0.2, 0.3)),
                              (0.56, 0.5, 0.11, (0.8, 0.55, 0.12))):
        image = over(image, (x - cx) ** 2 + (y - cy) ** 2 < r * r, colour)
    return image
