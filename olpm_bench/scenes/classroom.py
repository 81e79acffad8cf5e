"""A classroom with two rows of windows behind jalousies; all light is sunlight that came past the slats.

After the situation of the talk's classroom, with a plan, objects and textures of our own.  Length is in metres, z is up.
The plan, before everything is turned by `rotation` so that no grid of a cache is flattered::

     5.6 +--[=====]---[=====]---[=====]--+      [==] a window of 1.05 m with one of 0.55 m above it
         |    desks     desks     desks  |
         |                               b      b the board
         |    desks     desks     desks  b
         |                               b      7.4 x 5.6 x 3.1 m
         |    desks     desks     desks  |
         |                        teacher|
       0 +-camera------------------------+
       y 0                              7.4 x

By default the slats stop all direct sunlight: it reaches the room from their lit upper sides by way of the undersides above.

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
ROOMS = ("classroom", "outside")

LENGTH, DEPTH, HEIGHT = 7.4, 5.6, 3.1                       # of the room, along x, y and z [m]
SLAB, THICK = 0.1, 0.25                                     # thickness of the walls, and of that with the windows [m]
COLUMNS = ((0.9, 2.2), (3.0, 4.3), (5.1, 6.4))              # x of the windows' sides [m]
ROWS = ((0.95, 2.0), (2.25, 2.8))                           # z of their lower and upper ends [m]
SLATS = DEPTH + 0.1                                         # y of the slats' axes [m]
SLAT, SPACING, SHEET = 0.06, 0.05, 0.002                    # width, distance and thickness of the slats [m]
IRRADIANCE = (100.0, 92.0, 80.0)                            # of the sun; the room shows well at exposure 1 by default


def build(slat_angle: float = 20.0, sun_elevation: float = 38.0, sun_azimuth: float = 20.0, sky: float = 0.0,
          rotation: float = -28.9) -> dict[str, Any]:
    """The scene as a dictionary for ``mi.load_dict``.

    Args:
        slat_angle: between the slats and the horizontal [degrees], in [-90, 90]; positive: the inner edge is the higher one.
            At -`sun_elevation` (for azimuth 0) the sun shines straight in; -90 and 90 shut the jalousies.
        sun_elevation: of the sun above the horizon [degrees], in [10, 70].
        sun_azimuth: between the sun and the windows' normal [degrees], in [-60, 60]; positive: it shines towards the board.
        sky: irradiance of an even blue, from all around, over that of the sun, in [0, 1]; with 0 there is none.
        rotation: angle by which everything is turned about the vertical [degrees].

    Raises:
        SceneError: a value out of its range.
    """
    check(slat_angle, sun_elevation, sun_azimuth, sky, rotation)
    import mitsuba as mi

    from olpm_bench.scenes import geometry as g

    turn, materials = g.turn_z(rotation), _materials()
    scene: dict[str, Any] = {"type": "scene"}
    for name, pieces in {**_room(), "slats": _slats(slat_angle), **_desks(), **_front()}.items():
        scene[name] = g.mesh(name, pieces, materials[name], turn)
    scene["sun"] = g.sunlight(IRRADIANCE, sun_elevation, sun_azimuth, turn)
    if sky > 0:
        radiance = [sky * IRRADIANCE[0] / math.pi * c for c in (0.6, 0.8, 1.0)]
        scene["sky"] = {"type": "constant", "radiance": {"type": "rgb", "value": radiance}}
    origin, target = (turn @ np.array(p) for p in ((0.25, 0.35, 1.75), (5.5, 3.65, 1.15)))
    scene["sensor"] = {
        "type": "perspective", "fov": 70.0, "near_clip": 0.01, "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f().look_at(origin=origin.tolist(), target=target.tolist(), up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 320, "height": 180},
    }
    return scene


def room(p: np.ndarray, rotation: float = -28.9) -> np.ndarray:
    """Index into `ROOMS` of points [n, 3]; the windows' reveals and the jalousies are outside."""
    from olpm_bench.scenes.geometry import inside, turn_z
    return np.where(inside(p @ turn_z(rotation), (LENGTH, DEPTH, HEIGHT)), 0, 1)


def check(slat_angle: float, sun_elevation: float, sun_azimuth: float, sky: float, rotation: float) -> None:
    """
    Raises:
        SceneError: a value out of its range.
    """
    check_range("classroom: slat_angle", slat_angle, -90, 90, "degrees")
    check_range("classroom: sun_elevation", sun_elevation, 10, 70, "degrees")
    check_range("classroom: sun_azimuth", sun_azimuth, -60, 60, "degrees")
    check_range("classroom: sky", sky, 0, 1)
    if not math.isfinite(rotation):
        raise SceneError(f"classroom: rotation = {rotation!r}: must be finite, in degrees")


def direct(slat_angle: float, sun_elevation: float, sun_azimuth: float) -> float:
    """Share of the sunlight on a jalousie that passes between its (infinitely thin) slats without meeting one."""
    slope = math.tan(math.radians(sun_elevation)) / math.cos(math.radians(sun_azimuth))     # in the slats' section
    sun, slat = math.atan(slope), math.radians(slat_angle)
    return max(0.0, 1 - SLAT * abs(math.sin(slat + sun)) / (SPACING * math.cos(sun)))


def _room() -> dict[str, list[Part]]:
    from olpm_bench.scenes.geometry import box
    end, outside, t = LENGTH + SLAB, DEPTH + THICK, SLAB
    sides = [-t, *(x for column in COLUMNS for x in column), end]
    levels = [0, *(z for row in ROWS for z in row), HEIGHT]
    window_wall = [box((-t, DEPTH, low), (end, outside, high)) for low, high in zip(levels[::2], levels[1::2], strict=True)]
    window_wall += [box((left, DEPTH, low), (right, outside, high)) for low, high in ROWS
                    for left, right in zip(sides[::2], sides[1::2], strict=True)]
    level = ROWS[0][0]
    sills = [box((x0 - 0.04, DEPTH - 0.12, level - 0.03), (x1 + 0.04, DEPTH + 0.01, level + 0.002)) for x0, x1 in COLUMNS]
    radiators = [box((x0 + 0.06 + 0.06 * i, DEPTH - 0.1, 0.15), (x0 + 0.105 + 0.06 * i, DEPTH - 0.03, 0.8))
                 for x0, _ in COLUMNS for i in range(20)]
    radiators += [box((x0 + 0.06, DEPTH - 0.08, z), (x0 + 1.245, DEPTH - 0.05, z + 0.05))
                  for x0, _ in COLUMNS for z in (0.2, 0.7)]
    lamps = [box((x, 1.0, HEIGHT - 0.32), (x + 0.16, 4.6, HEIGHT - 0.26)) for x in (2.0, 4.6)]
    cords = [box((x + 0.075, y, HEIGHT - 0.27), (x + 0.085, y + 0.01, HEIGHT + 0.01))
             for x in (2.0, 4.6) for y in (1.3, 4.3)]
    return {
        "floor": [box((-t, -t, -t), (end, outside, 0))],
        "walls": [*window_wall, box((-t, -t, 0), (0, DEPTH, HEIGHT)), box((LENGTH, -t, 0), (end, DEPTH, HEIGHT)),
                  box((0, -t, 0), (LENGTH, 0, HEIGHT))],
        "ceiling": [box((-t, -t, HEIGHT), (end, outside, HEIGHT + t))],
        "sills": sills, "radiators": radiators, "lamps": lamps, "cords": cords,
        "skirting": [box((LENGTH - 0.015, 0, 0), (LENGTH + 0.01, DEPTH, 0.09)),
                     box((0, DEPTH - 0.015, 0), (LENGTH, DEPTH + 0.01, 0.09))],
    }


def _slats(angle: float) -> list[Part]:
    """Thin boxes from jamb to jamb; when shut they overlap, and reach into sill and lintel."""
    from olpm_bench.scenes.geometry import box
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
    turn = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])                 # lifts the inner edge, at -y
    return [box((x0 - 5e-3, -SLAT / 2, -SHEET / 2), (x1 + 5e-3, SLAT / 2, SHEET / 2)).transformed(turn, (0, SLATS, z))
            for x0, x1 in COLUMNS for low, high in ROWS for z in np.arange(low + SPACING / 2, high, SPACING)]


def _desks() -> dict[str, list[Part]]:
    """Nine desks for two, with chairs that nobody has put straight, and what lies on them."""
    from olpm_bench.scenes.geometry import box, cushion, lathe, turn_z
    rng = np.random.default_rng(16)
    high = 0.74
    tops, steel, chairs, glasses, apples = ([] for _ in range(5))
    books: dict[str, list[Part]] = {"blue": [], "red": []}
    frame = [box((x - 0.014, y - 0.014, 0), (x + 0.014, y + 0.014, high - 0.02)) for x in (-0.2, 0.2) for y in (-0.55, 0.55)]
    frame += [box((-0.2, y - 0.012, high - 0.05), (0.2, y + 0.012, high - 0.02)) for y in (-0.55, 0.55)]
    frame += [box((-0.21, -0.55, high - 0.12), (-0.19, 0.55, high - 0.09))]
    chair = [cushion((-0.2, -0.2, 0.44), (0.2, 0.2, 0.458), 0.008), cushion((-0.222, -0.19, 0.63), (-0.206, 0.19, 0.84), 0.007)]
    legs = [box((x - 0.011, y - 0.011, 0), (x + 0.011, y + 0.011, 0.445)) for x in (-0.18, 0.18) for y in (-0.17, 0.17)]
    legs += [box((-0.207, y - 0.011, 0.44), (-0.19, y + 0.011, 0.8)) for y in (-0.17, 0.17)]
    for i, x in enumerate((2.2, 3.7, 5.2)):
        for k, y in enumerate((1.05, 2.75, 4.45)):
            turn, place = turn_z(rng.uniform(-3, 3)), np.array((x, y, 0))
            tops.append(cushion((-0.27, -0.62, high - 0.024), (0.27, 0.62, high), 0.01).transformed(turn, place))
            steel += [p.transformed(turn, place) for p in frame]
            for side in (-0.3, 0.3):
                aside = turn_z(rng.uniform(-25, 25))
                at = place + turn @ (-0.38 + rng.uniform(-0.12, 0.08), side + rng.uniform(-0.04, 0.04), 0)
                chairs += [p.transformed(aside, at) for p in chair]
                steel += [p.transformed(aside, at) for p in legs]
            for colour, share, size in (("blue", 0.7, (0.11, 0.15, 0.012)), ("red", 0.5, (0.09, 0.12, 0.025))):
                if rng.random() < share:
                    book = box((-size[0], -size[1], 0), (size[0], size[1], size[2]))
                    at = np.add(place, (rng.uniform(-0.1, 0.1), rng.choice((-0.3, 0.3)) + rng.uniform(-0.1, 0.1), high + 2e-4))
                    books[colour].append(book.transformed(turn_z(rng.uniform(-30, 30)), at))
            if (i, k) in ((0, 1), (1, 0), (1, 2)):
                glasses.append(lathe(BEAKER, 40).transformed(turn, np.add(place, (0.15, 0.05, high + 2e-4))))
            if (i, k) in ((0, 1), (2, 1)):
                apples.append(lathe(APPLE, 32).transformed(turn, np.add(place, (0.1, -0.06, high + 0.002))))
    return {"desks": tops, "steel": steel, "chairs": chairs, **books, "glasses": glasses, "apples": apples}


# Outlines (radius, height) [m], those of hollow things go up outside and down inside.
BEAKER = [(0, 0), (0.036, 0), (0.037, 0.004), (0.037, 0.1), (0.04, 0.104), (0.038, 0.104), (0.0345, 0.1), (0.0345, 0.008),
          (0, 0.008)]
APPLE = [(0, 0.008), (0.015, 0.002), (0.03, 0.014), (0.038, 0.04), (0.034, 0.062), (0.018, 0.074), (0.006, 0.07), (0, 0.062)]
BIN = [(0, 0), (0.12, 0), (0.15, 0.34), (0.146, 0.34), (0.117, 0.006), (0, 0.006)]
FOOT = [(0, 0), (0.1, 0), (0.1, 0.01), (0.02, 0.03), (0.01, 0.06), (0.01, 0.09), (0, 0.09)]
GLOBE = [(0.16 * math.sin(t), -0.16 * math.cos(t)) for t in np.linspace(0, math.pi, 33)]
CLOCK = [(0, 0), (0.15, 0), (0.15, 0.03), (0.14, 0.03), (0.138, 0.02), (0, 0.02)]


def _front() -> dict[str, list[Part]]:
    """The board, the teacher's desk with a globe, a clock and a poster."""
    from olpm_bench.scenes.geometry import box, lathe, quad, turn_z
    face, (y0, y1), (z0, z1), t = LENGTH - 0.03, (1.4, 4.6), (0.9, 2.15), 0.04
    towards_room = np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0.0]])       # z to -x
    front, back = face - 0.012, LENGTH + 0.01
    frame = [box((front, y0 - t, z0 - t), (back, y1 + t, z0)), box((front, y0 - t, z1), (back, y1 + t, z1 + t)),
             box((front, y0 - t, z0), (back, y0, z1)), box((front, y1, z0), (back, y1 + t, z1)),
             box((face - 0.1, y0, z0 - t - 0.012), (face, y1, z0 - t))]
    chalk = [box((face - 0.07, y, z0 - t + 2e-4), (face - 0.056, y + 0.07, z0 - t + 0.014)) for y in (2.0, 2.15, 3.4)]
    turn, place, high = turn_z(8), np.array((6.3, 0.8, 0)), 0.76
    desk = [box((-0.35, -0.6, high - 0.03), (0.35, 0.6, high)), box((-0.33, -0.58, 0), (0.33, -0.2, high - 0.03)),
            box((-0.33, 0.55, 0), (0.33, 0.58, high - 0.03)), box((0.3, -0.2, 0.3), (0.32, 0.55, high - 0.03))]
    on_desk = place + turn @ (0.1, 0.3, high + 2e-4)
    return {
        "board": [quad((face, y1, z0), (0, y0 - y1, 0), (0, 0, z1 - z0))],
        "board_frame": frame, "chalk": chalk,
        "teacher": [p.transformed(turn, place) for p in desk],
        "brass": [lathe(FOOT, 40).transformed(np.eye(3), on_desk)],
        "globe": [lathe(GLOBE, 64).transformed(turn_z(150), np.add(on_desk, (0, 0, 0.245)))],
        "bin": [lathe(BIN, 48).transformed(np.eye(3), (7.05, 5.1, 0))],
        "clock": [lathe(CLOCK, 48).transformed(towards_room, (LENGTH + 0.005, 3.0, 2.6))],
        "poster": [quad((LENGTH - 0.004, 1.05, 1.2), (0, -0.7, 0), (0, 0, 0.95))],
    }


def _materials() -> dict[str, dict[str, Any]]:
    from olpm_bench.scenes import textures as t
    from olpm_bench.scenes.materials import diffuse, glass, metal, plastic
    rng = np.random.default_rng(1998)
    beech = t.boards(rng, 4, 1, 256, (0.52, 0.36, 0.2), (0.68, 0.5, 0.31))
    marble = 0.5 * t.noise(rng, (256, 256), (24, 24)) + 0.5 * t.noise(rng, (256, 256), (90, 90))
    wiped = t.noise(rng, (160, 400), (5, 9)) * t.noise(rng, (160, 400), (40, 12))
    land = 0.6 * t.noise(rng, (96, 192), (5, 8)) + 0.4 * t.noise(rng, (96, 192), (14, 26))
    return {
        "floor": plastic(t.texture(t.painted((256, 256), lambda x, y: _tiles(x, y, marble)), (1.2, 1.2)), 0.13),
        "walls": diffuse((0.8, 0.79, 0.73)),
        "ceiling": diffuse((0.86, 0.86, 0.84)),
        "sills": plastic((0.75, 0.74, 0.71), 0.1),
        "radiators": plastic((0.75, 0.74, 0.7), 0.2),
        "lamps": plastic((0.8, 0.8, 0.78), 0.15),
        "cords": diffuse((0.1, 0.1, 0.1)),
        "skirting": plastic((0.35, 0.22, 0.12), 0.2),
        "slats": plastic((0.78, 0.77, 0.74), 0.25),
        "desks": plastic(t.texture(beech, (0.54, 0.54)), 0.12),
        "steel": metal("Cr", 0.2),
        "chairs": plastic((0.14, 0.36, 0.4), 0.15),
        "blue": plastic((0.08, 0.2, 0.42), 0.3),
        "red": plastic((0.55, 0.1, 0.07), 0.3),
        "glasses": glass(),
        "apples": plastic((0.45, 0.55, 0.08), 0.1),
        "board": plastic(t.texture(t.painted((160, 400), lambda x, y: _chalk(x, y, wiped))), 0.35),
        "board_frame": metal("Al", 0.25),
        "chalk": diffuse((0.8, 0.8, 0.78)),
        "teacher": plastic(t.texture(beech[:, ::-1] * (0.6, 0.5, 0.45), (0.6, 0.6)), 0.12),
        "brass": metal("Au", 0.2),
        "globe": plastic(t.texture(_map(land)), 0.06),
        "bin": metal("Cu", 0.15),
        "clock": plastic(t.texture(t.painted((64, 64), lambda x, y: np.full((*x.shape, 3), 0.75))), 0.1),
        "poster": diffuse(t.texture(t.painted((152, 112), _poster))),
    }


def _tiles(x: np.ndarray, y: np.ndarray, marble: np.ndarray) -> np.ndarray:
    """Two by two tiles of marbled linoleum."""
    light = ((x < 0.5) == (y < 0.5))[..., None]
    joint = np.minimum(abs(x * 2 % 1 - 0.5), abs(y * 2 % 1 - 0.5)) > 0.49
    image = np.where(light, np.array((0.56, 0.54, 0.47)), np.array((0.33, 0.4, 0.4))) * (0.75 + 0.45 * marble[..., None])
    return over(image, joint, (0.2, 0.2, 0.19))


def _chalk(x: np.ndarray, y: np.ndarray, wiped: np.ndarray) -> np.ndarray:
    """A mixture of three bells over its axis, on a green board that has been wiped."""
    image = np.array((0.035, 0.1, 0.075)) + 0.09 * wiped[..., None]
    bells = [w * np.exp(-(((x - m) / s) ** 2)) for w, m, s in ((0.34, 0.25, 0.06), (0.5, 0.45, 0.045), (0.22, 0.68, 0.1))]
    chalk = (abs(y - 0.2) < 0.007) & (x > 0.08) & (x < 0.92) | (abs(x - 0.1) < 0.003) & (y > 0.14) & (y < 0.86)

    def curve(height: Any, width: float) -> Any:
        slope = np.gradient(height, axis=1) * x.shape[1] * 0.4
        return (abs(y - height) < width * np.hypot(1, slope)) & (x > 0.1) & (x < 0.9)

    for bell in bells:
        image = over(image, curve(0.2 + bell, 0.006) & (x * 60 % 1 < 0.6), (0.62, 0.5, 0.2))
    return over(image, chalk | curve(0.2 + sum(bells), 0.008), (0.66, 0.68, 0.66))


def _map(land: np.ndarray) -> np.ndarray:
    """Continents by a level of noise, with ice at the poles."""
    height = abs(np.linspace(-1, 1, land.shape[0]))[:, None]
    image = over(np.full((*land.shape, 3), (0.06, 0.2, 0.42)), land > 0.52, (0.36, 0.42, 0.14))
    image = over(image, land > 0.64, (0.5, 0.36, 0.2))
    return over(image, height + 0.2 * land > 0.98, (0.8, 0.82, 0.84))


def _poster(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A snow-topped mountain and its reflection."""
    image = np.full((*x.shape, 3), (0.25, 0.45, 0.65)) + 0.3 * (1 - abs(y - 0.4))[..., None]
    top = 0.42 + 0.4 * np.clip(1 - abs(x - 0.55) / 0.4, 0, 1) + 0.03 * np.sin(23 * x)
    mirrored = abs(y - 0.4)                                                 # height above the water
    image = over(image, mirrored + 0.4 < top, (0.2, 0.22, 0.26))
    image = over(image, (mirrored + 0.4 < top) & (mirrored > 0.24), (0.8, 0.82, 0.85))
    image = np.where((y < 0.4)[..., None], image * (0.5, 0.6, 0.65), image)
    return np.clip(over(image, (np.minimum(x, 1 - x) < 0.05) | (np.minimum(y, 1 - y) < 0.04), (0.8, 0.8, 0.76)), 0, 0.9)
