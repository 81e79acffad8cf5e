"""References as they are stored: `references/<scene-key>/{reference.exr, meta.json}`, or an EXR of another renderer.

:mod:`olpm_bench.bench.reference` makes them.
"""
from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from olpm_bench.bench.exr import read_exr, write_exr
from olpm_bench.bench.files import SCHEMA_VERSION, NewerSchemaError, ResultError, read_json, write_json

NEAR_FLOOR = 2.0        # errors below this many noise floors are the reference's own, as much as the image's


@dataclass
class Reference:
    """A converged image, as two halves made with different seeds.

    An EXR of another renderer has no halves: then a and b are the same image and the noise floor is unknown.
    """
    a: np.ndarray               # (h, w, 3) linear RGB
    b: np.ndarray
    a_variance: np.ndarray      # (h, w, 3) variance of the mean
    b_variance: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def has_halves(self) -> bool:
        return self.a is not self.b

    @property
    def mean(self) -> np.ndarray:
        """Both halves together, weighted by their samples (h, w, 3)."""
        if not self.has_halves:
            return self.a
        n_a, n_b = self.meta["spp_a"], self.meta["spp_b"]
        return ((n_a * self.a.astype(np.float64) + n_b * self.b) / (n_a + n_b)).astype(np.float32)

    @property
    def noise_floor(self) -> float | None:
        """mean |A - B| / 2: about the L1 error of the mean; None if unknown."""
        return float(np.mean(np.abs(self.a.astype(np.float64) - self.b))) / 2 if self.has_halves else None


def find_reference(key: str, folders: list[Path]) -> Path | None:
    """The first of `folders` (each a `references` folder) that has a reference with this key."""
    return next((f / key for f in folders if (f / key / "meta.json").exists()), None)


def read_reference(path: Path, width: int, height: int) -> Reference:
    """A reference folder, or an EXR of another renderer, for an image of `width` x `height`.

    Either may be larger by a whole factor: its pixels are averaged, which with the box filter is the smaller image.

    Raises:
        ResultError: missing, broken, newer, or of another size.
    """
    if path.is_file():
        parts, header = read_exr(path)
        if "a.mean" in parts:           # one of ours, by the name of its file
            return _of_halves(parts, header, path, width, height)
        image = next(iter(parts.values()))
        if image.shape[2] != 3:
            raise ResultError(f"reference {path} has no RGB image")
        if not np.isfinite(image).all():
            raise ResultError(f"reference {path} has pixels that are not finite")
        image = _shrink(image, width, height, path)
        unknown = np.full_like(image, np.inf)
        return Reference(image, image, unknown, unknown, {"estimator": f"{path.name}, of another renderer"})
    try:
        meta = read_json(path / "meta.json")
        parts, header = read_exr(path / "reference.exr")
    except NewerSchemaError:
        raise
    except ResultError as error:
        raise ResultError(f"{error}; remove the folder and make it again") from None
    # The header is of the same moment as the pixels, should the two files differ
    return _of_halves(parts, meta | header, path / "reference.exr", width, height)


def _of_halves(parts: dict[str, np.ndarray], meta: dict[str, Any], path: Path, width: int, height: int) -> Reference:
    remedy = "another program may have written it; remove the folder and make it again"
    for name in ("a.mean", "b.mean", "a.variance", "b.variance"):
        image = parts.get(name)
        if image is None or image.shape != (*parts["a.mean"].shape[:2], 3) or not np.isfinite(image).all():
            raise ResultError(f"{path} is broken: no finite RGB part '{name}' of the size of 'a.mean'; {remedy}")
    for name in ("spp_a", "spp_b"):
        if not isinstance(n := meta.get(name), int) or not 0 < n < 2**63:
            raise ResultError(f"{path} is broken: {name} = {n!r}, must be the samples of a half; {remedy}")
    averaged = parts["a.mean"].shape[1] // width                # pixels that become one, along a side
    images = [_shrink(parts[name], width, height, path) for name in ("a.mean", "b.mean", "a.variance", "b.variance")]
    return Reference(images[0], images[1], images[2] / averaged ** 2, images[3] / averaged ** 2, meta)


def _shrink(image: np.ndarray, width: int, height: int, path: Path) -> np.ndarray:
    h, w, _ = image.shape
    factor = w // width
    if factor < 1 or (w, h) != (factor * width, factor * height):
        raise ResultError(f"reference {path} is {w}x{h}, the experiment's image is {width}x{height}: "
                          "must be the same, or that times a whole number")
    return image.reshape(height, factor, width, factor, 3).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def write_reference(folder: Path, reference: Reference) -> None:
    """Write a reference, meta.json last."""
    parts = {"a.mean": reference.a, "b.mean": reference.b,
             "a.variance": reference.a_variance, "b.variance": reference.b_variance}
    write_exr(folder / "reference.exr", parts, reference.meta)
    write_json(folder / "meta.json", {"schema_version": SCHEMA_VERSION, **reference.meta})
