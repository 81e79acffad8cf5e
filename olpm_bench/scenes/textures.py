"""Images that the embedded scenes are painted with, computed with NumPy: boards, noise, pictures.

Nothing here loads Mitsuba but :func:`texture`.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Array = np.ndarray
Vector = tuple[float, ...] | np.ndarray


def texture(image: Array, metres: tuple[float, float] = (1, 1)) -> dict[str, Any]:
    """Bitmap texture of linear RGB values [height, width, 3] (row 0 is the top) that repeats every `metres` of uv."""
    import mitsuba as mi

    bitmap = mi.Bitmap(np.ascontiguousarray(image[::-1], np.float32))        # v = 0 is row 0
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat",
            "to_uv": mi.ScalarTransform4f().scale([1 / metres[0], 1 / metres[1], 1])}


def noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int]) -> Array:
    """Smooth periodic noise in [0, 1] [shape]: random values on a grid of `cells`, interpolated."""
    grid = rng.random(cells)
    index: list[Any] = []
    for size, count in zip(shape, cells, strict=True):
        x = np.arange(size) * count / size
        i = x.astype(int)
        t = x - i
        index.append((i, (i + 1) % count, t * t * (3 - 2 * t)))
    (i0, i1, s), (j0, j1, t) = index
    rows = grid[i0] * (1 - s)[:, None] + grid[i1] * s[:, None]
    return rows[:, j0] * (1 - t) + rows[:, j1] * t


def boards(rng: np.random.Generator, rows: int, columns: int, pixels: int, dark: Vector,
           light: Vector) -> Array:
    """Wooden boards [pixels, pixels, 3]: `rows` of them, each row shifted against the last, with grain and joints."""
    y, x = np.mgrid[0:pixels, 0:pixels] / pixels
    row = (y * rows).astype(int)
    shifted = (x + rng.random(rows)[row]) % 1 * columns
    tone = rng.random((rows, columns))[row, shifted.astype(int)]
    grain = noise(rng, (pixels, pixels), (24 * rows, 5 * columns))
    t = np.clip(0.65 * tone + 0.45 * (grain - 0.3), 0, 1)[..., None]
    joint = (np.minimum(y * rows % 1, 1 - y * rows % 1) < 0.02) | (np.minimum(shifted % 1, 1 - shifted % 1) < 0.004)
    return (np.asarray(dark) * (1 - t) + np.asarray(light) * t) * np.where(joint, 0.35, 1.0)[..., None]


def painted(pixels: tuple[int, int], colour: Callable[[Array, Array], Array]) -> Array:
    """`colour(x, y)` in [0, 1]^2, y upwards, sampled at the centres of [height, width] pixels."""
    h, w = pixels
    y, x = np.mgrid[0:h, 0:w]
    return colour((x + 0.5) / w, 1 - (y + 0.5) / h)


def over(image: Array, mask: Array, colour: Vector) -> Array:
    """`image` [height, width, 3] with one colour where `mask` [height, width]."""
    return np.where(mask[..., None], np.asarray(colour), image)
