"""A closed box with coloured sides, two blocks and a lamp in the ceiling: easy, guiding must not cost much here.

After the Cornell box, with measures of our own: 2 x 2 x 2 m, z up, the camera inside, before the open fourth wall.
"""
from __future__ import annotations

import math
from typing import Any

from olpm_bench.scenes import SceneError

VERSION = 1                     # grows when the image changes


def build(light_size: float = 0.5, rotation: float = 11.3) -> dict[str, Any]:
    """The scene as a dictionary for ``mi.load_dict``.

    Args:
        light_size: side of the square lamp [m], in [0.01, 1.9]; its power does not depend on it.
        rotation: angle by which everything is turned about the vertical [degrees].

    Raises:
        SceneError: a value out of its range.
    """
    check(light_size, rotation)
    import mitsuba as mi

    from olpm_bench.scenes.geometry import box, mesh, quad, turn_z

    turn = turn_z(rotation)

    def diffuse(*reflectance: float) -> dict[str, Any]:
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(reflectance)}}
        return {"type": "twosided", "bsdf": bsdf}

    half, t = light_size / 2, 0.1
    white = [box((-1 - t, -3 - t, -t), (1 + t, 1 + t, 0)), box((-1 - t, -3 - t, 2), (1 + t, 1 + t, 2 + t)),
             box((-1 - t, 1, 0), (1 + t, 1 + t, 2)), box((-1 - t, -3 - t, 0), (1 + t, -3, 2))]
    tall = box((-0.3, -0.3, 0), (0.3, 0.3, 1.2)).transformed(turn_z(18), (-0.38, 0.3, 0))
    low = box((-0.3, -0.3, 0), (0.3, 0.3, 0.6)).transformed(turn_z(-16), (0.38, -0.35, 0))
    metal = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.25, "material": "Al"}}
    lamp = quad((-half, half, 1.995), (light_size, 0, 0), (0, -light_size, 0))
    radiance = [1.6 / light_size**2 * c for c in (1.0, 0.85, 0.6)]
    origin, target = ((turn @ p).tolist() for p in ((0.0, -2.95, 1.0), (0.0, 0.0, 1.0)))
    return {
        "type": "scene",
        "white": mesh("white", white, diffuse(0.73, 0.73, 0.71), turn),
        "red": mesh("red", [box((-1 - t, -3, 0), (-1, 1, 2))], diffuse(0.62, 0.07, 0.06), turn),
        "green": mesh("green", [box((1, -3, 0), (1 + t, 1, 2))], diffuse(0.14, 0.46, 0.1), turn),
        "tall": mesh("tall", [tall], metal, turn),
        "low": mesh("low", [low], diffuse(0.73, 0.73, 0.71), turn),
        "lamp": mesh("lamp", [lamp], diffuse(0.0, 0.0, 0.0), turn,
                     {"type": "area", "radiance": {"type": "rgb", "value": radiance}}),
        "sensor": {
            "type": "perspective", "fov": 44.0, "near_clip": 0.01, "far_clip": 100.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 256, "height": 256},
        },
    }


def check(light_size: float, rotation: float) -> None:
    """
    Raises:
        SceneError: a value out of its range.
    """
    if not 0.01 <= light_size <= 1.9:
        raise SceneError(f"cornell_box: light_size = {light_size!r}: must be in [0.01, 1.9], in metres")
    if not math.isfinite(rotation):
        raise SceneError(f"cornell_box: rotation = {rotation!r}: must be finite, in degrees")
