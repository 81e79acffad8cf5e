"""Small scenes with known answers."""
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

RESOLUTION = 16


def wall(position: tuple[float, ...], facing: tuple[float, ...], scale: float = 1, **content: Any) -> dict[str, Any]:
    """A square of edge 2 * scale whose front side looks along `facing`."""
    up = (0, 0, 1) if abs(facing[2]) < 0.5 else (0, 1, 0)
    target = [p + f for p, f in zip(position, facing, strict=True)]
    to_world = mi.ScalarTransform4f().look_at(origin=position, target=target, up=up) @ mi.ScalarTransform4f().scale(scale)
    return {"type": "rectangle", "to_world": to_world, **content}


def camera(resolution: int = RESOLUTION) -> dict[str, Any]:
    """Looks from near the front wall of the box [-1, 1]^3 to its middle."""
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {"type": "perspective", "fov": 70, "film": film, "sampler": {"type": "independent"},
            "to_world": mi.ScalarTransform4f().look_at((0, -0.95, 0.1), (0, 1, -0.2), (0, 0, 1))}


def box(bsdf: dict[str, Any], overlap: float = 0, **content: Any) -> dict[str, Any]:
    """The inside of the cube [-1, 1]^3, all six walls of one BSDF, and what else is given.

    Between walls that only just meet, 1 path in 4,000 gets out; those that `overlap` keep all.
    """
    faces = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    walls = {f"wall{i}": wall(tuple(-x for x in f), f, 1 + overlap, bsdf=bsdf) for i, f in enumerate(faces)}
    return {"type": "scene", "sensor": camera(), **walls, **content}


def grey(reflectance: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}


def furnace(albedo: float, overlap: float = 0) -> mi.Scene:
    """A closed diffuse box whose walls emit radiance 1: everywhere 1 / (1 - albedo)."""
    scene = box(grey(albedo), overlap)
    for name, content in scene.items():
        if name.startswith("wall"):
            content["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    return mi.load_dict(scene, optimize=False)          # merging shapes would give the emitters another order each time


def lamp(radiance: float = 10) -> dict[str, Any]:
    """A small square light below the ceiling that shines upwards: most light in the box is indirect."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return wall((0.3, 0.4, 0.7), (0, 0, 1), 0.2, bsdf=grey(0.5), emitter=emitter)


def passes(scene: mi.Scene, integrator: Any, n: int = 16, spp: int = 64, seed: int = 0) -> np.ndarray:
    """Independent images [n, height, width, 3]."""
    images = [mi.render(scene, integrator=integrator, spp=spp, seed=seed + i) for i in range(n)]
    dr.eval(images)
    return np.stack([image.numpy() for image in images]).astype(np.float64)


def blocks(images: np.ndarray, size: int) -> np.ndarray:
    """Means over the channels and over size x size pixels [n, blocks]."""
    n, h, w, _ = images.shape
    return images.mean(-1).reshape(n, h // size, size, w // size, size).mean((2, 4)).reshape(n, -1)
