"""Linear RGB to what a screen shows: one exposure, the sRGB transfer function, eight bits.

Metrics and figures share this one tone curve.
"""
from __future__ import annotations

from pathlib import Path

import numpy as np

from olpm_bench.bench.files import replacing

INVALID = (255, 0, 255)         # how NaN and infinite pixels are shown: never as a plausible colour


def auto_exposure(reference: np.ndarray, quantile: float = 0.85, level: float = 0.5) -> float:
    """Factor that brings the given quantile of the channels' mean to `level` (linear); 1 for a black image.

    One per scene, from its reference, for every image of that scene.
    """
    brightness = float(np.quantile(np.nanmean(reference, axis=-1, dtype=np.float64), quantile))
    return level / brightness if np.isfinite(brightness) and brightness > 0 else 1.0


def encode(image: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    """Linear RGB (h, w, 3) times `exposure`, clipped to [0, 1], through the sRGB transfer function; float64."""
    import colour  # takes seconds

    return np.asarray(colour.cctf_encoding(np.clip(image * np.float64(exposure), 0, 1), function="sRGB"))


def srgb(image: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    """Linear RGB (h, w, 3) -> sRGB as uint8; pixels that are NaN or infinite become magenta."""
    valid = np.isfinite(image).all(axis=-1, keepdims=True)
    shown = np.round(255 * encode(np.where(valid, image, 0), exposure)).astype(np.uint8)
    return np.where(valid, shown, np.array(INVALID, np.uint8))


def write_png(path: Path, image: np.ndarray) -> None:
    """Write uint8 (h, w, 3); the file is whole or not there."""
    from skimage.io import imsave

    with replacing(path) as beside:
        imsave(beside, image, check_contrast=False)
