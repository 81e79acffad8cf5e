"""A room full of spheres, each with another BSDF and its own block of pixels, under any of Mitsuba's emitters."""
from __future__ import annotations

import functools
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from olpm_bench.check.small_scenes import grey, wall

COLUMNS, CELL = 6, 6        # spheres in a row; pixels along each side of the block that shows one
PITCH, RADIUS = 0.4, 0.17   # of the spheres, in scene units
_FILES = tempfile.TemporaryDirectory()


def _texture(seed: int = 3, mean: float = 0.5, spread: float = 0.3, **properties: Any) -> dict[str, Any]:
    image = np.random.default_rng(seed).uniform(mean - spread, mean + spread, (8, 8, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, **properties}


def _normals() -> dict[str, Any]:
    image = np.random.default_rng(4).normal(0.5, 0.08, (8, 8, 3)).astype(np.float32)
    image[..., 2] = 0.95
    return {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True}


def _bumps() -> dict[str, Any]:
    return _texture(seed=6, to_uv=mi.ScalarTransform4f().scale(2))


@functools.cache
def _measurements() -> str:
    """A file of what nobody has measured: random reflectance, of random half vectors."""
    rng, path = np.random.default_rng(9), Path(_FILES.name) / "measured.bsdf"

    def table(*shape: int) -> np.ndarray:
        return rng.uniform(0.5, 1.5, shape).astype(np.float32)

    elevations, size = np.linspace(0, np.pi / 2, 8, dtype=np.float32), (8, 8)
    angles, u = (1, len(elevations)), np.linspace(0, 1, 64, dtype=np.float32)       # u^2 pi / 2: elevation of the half vector
    mi.tensor_io.write(str(path), description=np.frombuffer(b"random", np.uint8), jacobian=np.zeros(1, np.uint8),
                       theta_i=elevations, phi_i=np.zeros(1, np.float32), ndf=table(*size), sigma=table(*size),
                       vndf=u**3 * table(*angles, 8, len(u)), luminance=table(*angles, *size),
                       rgb=0.08 * table(*angles, 3, *size))
    return str(path)


# All BSDFs of Mitsuba 3.9.1 but those that only mind polarisation (measured_polarized, polarizer, retarder, circular).
BSDFS = {
    "diffuse": lambda: {"type": "diffuse", "reflectance": _texture()},
    "conductor": lambda: {"type": "conductor", "material": "Cu"},
    "roughconductor": lambda: {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.3, "distribution": "ggx"},
    "roughconductor, all normals": lambda: {"type": "roughconductor", "alpha": 0.3, "sample_visible": False},
    "dielectric": lambda: {"type": "dielectric"},
    "thindielectric": lambda: {"type": "thindielectric"},
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.3},
    "roughdielectric, ggx": lambda: {"type": "roughdielectric", "alpha": 0.15, "distribution": "ggx"},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": _texture()},
    "plastic, nonlinear": lambda: {"type": "plastic", "nonlinear": True},
    "roughplastic": lambda: {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": _texture()},
    "pplastic": lambda: {"type": "pplastic", "alpha": 0.2},
    "principled": lambda: {"type": "principled", "roughness": 0.4, "metallic": 0.3, "anisotropic": 0.5, "sheen": 0.5,
                           "clearcoat": 0.5, "flatness": 0.3},
    "principled, transmissive": lambda: {"type": "principled", "roughness": 0.4, "spec_trans": 0.6, "eta": 1.4},
    "principledthin": lambda: {"type": "principledthin", "roughness": 0.4, "spec_trans": 0.4, "diff_trans": 0.6, "eta": 1.4},
    "hair": lambda: {"type": "hair", "longitudinal_roughness": 0.4, "azimuthal_roughness": 0.4},
    "null": lambda: {"type": "null"},
    "mask": lambda: {"type": "mask", "opacity": 0.6, "bsdf": _two_sided(grey(0.7))},
    "mask, textured": lambda: {"type": "mask", "opacity": _texture(), "bsdf": _two_sided({"type": "plastic"})},
    "blendbsdf": lambda: {"type": "blendbsdf", "weight": 0.4, "a": {"type": "conductor"}, "b": grey(0.6)},
    "blendbsdf, textured": lambda: {"type": "blendbsdf", "weight": _texture(), "a": {"type": "roughconductor", "alpha": 0.2},
                                    "b": {"type": "roughplastic"}},
    "twosided": lambda: _two_sided({"type": "roughplastic"}, grey(0.5)),
    "bumpmap": lambda: {"type": "bumpmap", "scale": 0.05, "bump": _bumps(), "bsdf": {"type": "roughplastic", "alpha": 0.2}},
    "measured": lambda: {"type": "measured", "filename": _measurements()},
    "normalmap": lambda: {"type": "normalmap", "normalmap": _normals(), "bsdf": {"type": "roughconductor", "alpha": 0.3}},
}


def _two_sided(*bsdfs: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", **{f"bsdf{i}": bsdf for i, bsdf in enumerate(bsdfs)}}


def _looking(origin: tuple[float, ...], target: tuple[float, ...]) -> Any:
    return mi.ScalarTransform4f().look_at(origin, target, (0.1, 0.2, 1))


def _panel(radiance: dict[str, Any], kind: str = "area") -> dict[str, Any]:
    return wall((0.3, -1.4, 1.15), (-0.1, 0.6, -0.5), 0.35, bsdf=grey(0.3), emitter={"type": kind, "radiance": radiance})


def _sky() -> mi.Bitmap:
    return mi.Bitmap(np.random.default_rng(5).random((8, 16, 3)).astype(np.float32) ** 4)


# Those that shine together are as bright as one another in the image, so that none hides another's error.
# The sun of `sunsky` is as wide as a fist at arm's length, or else what glass makes of it is too rare for any test.
EMITTERS = {
    "area": lambda: _panel({"type": "rgb", "value": 5.0}),
    "textured area": lambda: _panel(_texture(seed=7, mean=5, spread=4.9)),
    "directionalarea": lambda: _panel({"type": "rgb", "value": 1.0}, "directionalarea"),
    "point": lambda: {"type": "point", "position": [0.3, -1.2, 0.6], "intensity": 1.0},
    "spot": lambda: {"type": "spot", "intensity": 2.3, "cutoff_angle": 50.0, "to_world": _looking((0.3, -1.6, 0.6), (0, 0, 0))},
    "projector": lambda: {"type": "projector", "irradiance": _texture(seed=8), "fov": 60.0, "scale": 1.5,
                          "to_world": _looking((0.3, -1.6, 0.6), (0, 0, 0))},
    "directional": lambda: {"type": "directional", "direction": [0.2, 0.6, -1.0], "irradiance": 1.0},
    "constant": lambda: {"type": "constant", "radiance": 1.0},
    "envmap": lambda: {"type": "envmap", "bitmap": _sky(), "to_world": mi.ScalarTransform4f().rotate((1, 0, 0), 50)},
    "sunsky": lambda: {"type": "sunsky", "sun_direction": [0.2, -0.6, 0.8], "sun_aperture": 10.0, "sun_scale": 0.1,
                       "sky_scale": 5.0},
}


def scene(emitters: Sequence[str], bsdfs: Sequence[str]) -> mi.Scene:
    """An open box, spheres of these BSDFs before its back wall, and a camera that sees a sphere in each block of `CELL` x `CELL`
    pixels.
    """
    rows = -(-len(bsdfs) // COLUMNS)
    width, height = COLUMNS * PITCH / 2, rows * PITCH / 2               # half the room's
    room = max(width, height) + 0.01
    back, middle, up = 0.4, 0.4 - room, room - height
    walls = {f"wall{i}": wall(position, facing, room, bsdf=_two_sided(grey(0.6))) for i, (position, facing) in enumerate((
        ((0, back, 0), (0, -1, 0)), ((0, back - 2 * room, 0), (0, 1, 0)), ((0, middle, -height), (0, 0, 1)),
        ((-width, middle, up), (1, 0, 0)), ((width, middle, up), (-1, 0, 0))))}
    spheres = {}
    for i, bsdf in enumerate(bsdfs):
        centre = [(i % COLUMNS + 0.5) * PITCH - width, 0, height - (i // COLUMNS + 0.5) * PITCH]
        turned = mi.ScalarTransform4f().translate(centre).rotate((2 / 3, 1 / 3, 2 / 3), 40 * i).scale(RADIUS)
        spheres[f"sphere{i}"] = {"type": "sphere", "to_world": turned, "bsdf": BSDFS[bsdf]()}
    film = {"type": "hdrfilm", "width": COLUMNS * CELL, "height": rows * CELL, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at((0, -1.9, 0), (0, 0, 0), (0, 0, 1)) @ mi.ScalarTransform4f().scale((width, width, 1))
    camera = {"type": "orthographic", "film": film, "sampler": {"type": "independent"}, "to_world": view}
    return mi.load_dict({"type": "scene", "sensor": camera, **walls, **spheres,
                         **{f"emitter{i}": EMITTERS[name]() for i, name in enumerate(emitters)}}, optimize=False)
