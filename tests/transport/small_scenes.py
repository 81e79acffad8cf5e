"""Small scenes with known answers, and the tests that compare images."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

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


def box(bsdf: dict[str, Any], **content: Any) -> dict[str, Any]:
    """The inside of the cube [-1, 1]^3, all six walls of one BSDF, and what else is given."""
    faces = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    walls = {f"wall{i}": wall(tuple(-x for x in f), f, bsdf=bsdf) for i, f in enumerate(faces)}
    return {"type": "scene", "sensor": camera(), **walls, **content}


def grey(reflectance: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}


def furnace(albedo: float) -> mi.Scene:
    """A closed diffuse box whose walls emit radiance 1: everywhere 1 / (1 - albedo)."""
    scene = box(grey(albedo))
    for name, content in scene.items():
        if name.startswith("wall"):
            content["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    return mi.load_dict(scene)


def lamp(radiance: float = 10) -> dict[str, Any]:
    """A small square light below the ceiling that shines upwards: most light in the box is indirect."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return wall((0.3, 0.4, 0.7), (0, 0, 1), 0.2, bsdf=grey(0.5), emitter=emitter)


def passes(scene: mi.Scene, integrator: Any, n: int = 16, spp: int = 64, seed: int = 0) -> np.ndarray:
    """Independent images [n, height, width, 3]."""
    images = [mi.render(scene, integrator=integrator, spp=spp, seed=seed + i) for i in range(n)]
    dr.eval(images)
    return np.stack([image.numpy() for image in images]).astype(np.float64)


def assert_same_expectation(a: np.ndarray, b: np.ndarray, level: float = 0.01) -> None:
    """Welch's t-test a pixel (of 2 x 2 blocks' luminance), corrected for their number (Sidak); and one of the image means.

    Args:
        a, b: independent images [n, height, width, 3].
        level: probability that equal expectations fail.
    """
    def blocks(images: np.ndarray) -> np.ndarray:
        grey = images.mean(-1)
        n, h, w = grey.shape
        return grey.reshape(n, h // 2, 2, w // 2, 2).mean((2, 4)).reshape(n, -1)

    assert np.isfinite(a).all() and np.isfinite(b).all()
    x, y = blocks(a), blocks(b)
    flat = (x.std(0) < 1e-6 * x.mean()) & (y.std(0) < 1e-6 * x.mean())
    np.testing.assert_allclose(x[:, flat].mean(0), y[:, flat].mean(0), rtol=1e-4)
    p = stats.ttest_ind(x[:, ~flat], y[:, ~flat], equal_var=False).pvalue
    p = np.append(p, stats.ttest_ind(x.mean(1), y.mean(1), equal_var=False).pvalue)
    threshold = 1 - (1 - level) ** (1 / len(p))
    worst = int(np.argmin(p))
    assert p.min() >= threshold, (f"p = {p.min():.2e} < {threshold:.2e} at {worst} of {len(p)}; "
                                  f"means {a.mean():.5f} and {b.mean():.5f}")


def assert_no_kernel_a_pass(passes: Iterator[Any]) -> None:
    """Training passes after the third compile no large kernel each: counts, seeds, sizes and pass numbers are data, not code.

    Some are let pass, of more than a hundred launched: with an empty kernel cache Dr.Jit at times gives a large loop a second
    form, and it makes several of small ones over the records, of some milliseconds each, by how arrays lie in memory.
    """
    for _ in range(3):
        next(passes)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        n = sum(1 for _ in passes)
        history = dr.kernel_history([dr.KernelType.JIT])
    compiled = [k["operation_count"] for k in history if not k["cache_hit"]]
    assert len(history) > 100
    assert len(compiled) <= 30 and sum(count > 400 for count in compiled) < n, compiled
