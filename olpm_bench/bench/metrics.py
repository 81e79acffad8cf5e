"""The error metrics: how far an image `x` is from its reference `r`.

Both are linear RGB (h, w, 3); the mean runs over pixels and channels, in float64.  Nothing is clamped first:
fireflies count, and a pixel that is NaN or infinite makes the metric so.
"""
from __future__ import annotations

import functools
from collections.abc import Callable, Iterable

import numpy as np

from olpm_bench.bench import flip as hdr_flip
from olpm_bench.report import tonemap

EPSILON = 0.01          # of the relative metrics, in units of radiance
WORST = 0.001           # fraction of pixels that trimmed means leave out


@functools.cache
def _luminance_weights() -> np.ndarray:
    import colour  # takes seconds

    weights: np.ndarray = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ[1]
    return weights


def mean(image: np.ndarray) -> float:
    """Mean over pixels and channels (h, w, 3), by which images are told apart: the weights of the errors here, and of the
    page's viewer."""
    return float(np.mean(image, dtype=np.float64))


def luminance(image: np.ndarray) -> np.ndarray:
    """Rec. 709 luminance of linear RGB: (..., 3) -> (...), float64."""
    return image.astype(np.float64) @ _luminance_weights()


def _pair(x: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if x.shape != r.shape or x.ndim != 3:
        raise ValueError(f"image {x.shape} and reference {r.shape}: both must be (height, width, channels)")
    return x.astype(np.float64), r.astype(np.float64)


def l1(x: np.ndarray, r: np.ndarray) -> float:
    """Mean |x - r|: the headline, as in the talk."""
    x, r = _pair(x, r)
    return float(np.mean(np.abs(x - r)))


def mape(x: np.ndarray, r: np.ndarray) -> float:
    """Mean |x - r| / (r + 0.01)."""
    x, r = _pair(x, r)
    return float(np.mean(np.abs(x - r) / (r + EPSILON)))


def smape(x: np.ndarray, r: np.ndarray) -> float:
    """Mean 2 |x - r| / (x + r + 0.01)."""
    x, r = _pair(x, r)
    return float(np.mean(2 * np.abs(x - r) / (x + r + EPSILON)))


def _relative_squared_error(x: np.ndarray, r: np.ndarray) -> np.ndarray:
    """(h, w, channels)."""
    x, r = _pair(x, r)
    return (x - r) ** 2 / (r**2 + EPSILON)


def relmse(x: np.ndarray, r: np.ndarray) -> float:
    """Mean (x - r)^2 / (r^2 + 0.01)."""
    return float(np.mean(_relative_squared_error(x, r)))


def relmse_trimmed(x: np.ndarray, r: np.ndarray) -> float:
    """relMSE without the worst 0.1 % of *pixels* (rounded down); shown beside the untrimmed one, never alone."""
    pixels = np.sort(_relative_squared_error(x, r).mean(axis=-1), axis=None)       # NaN sorts last: keep it in
    if np.isnan(pixels[-1]):
        return float("nan")
    return float(np.mean(pixels[:pixels.size - int(WORST * pixels.size)]))


def flip(x: np.ndarray, r: np.ndarray) -> float:
    """Mean HDR-FLIP at the exposures that the reference fixes; NaN for a black one: see `olpm_bench.bench.flip`."""
    _pair(x, r)
    return hdr_flip.flip(x, r)


def ssim_error(x: np.ndarray, r: np.ndarray) -> float:
    """1 - SSIM [Wang et al. 2004] of the tone-mapped images, at the reference's exposure; NaN below its window of 7 x 7."""
    from skimage.metrics import structural_similarity

    _pair(x, r)
    if min(x.shape[:2]) < 7:
        return float("nan")
    exposure = tonemap.auto_exposure(r)
    shown_x, shown_r = tonemap.encode(x, exposure), tonemap.encode(r, exposure)
    return float(1 - structural_similarity(shown_x, shown_r, data_range=1, channel_axis=-1))


# The registries: a new metric is a function and its name here; summaries, comparisons and claims know it by that.
METRICS: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {
    f.__name__: f for f in (l1, mape, smape, relmse, relmse_trimmed, flip, ssim_error)}


def error(name: str, images: Iterable[np.ndarray], reference: np.ndarray) -> tuple[np.ndarray, str]:
    """A metric of every image (h, w, 3).

    Returns:
        The errors (images), NaN where the metric is undefined or fails; and a sentence that says how it failed, or "".
    """
    images = list(images)
    try:
        return np.array([METRICS[name](image, reference) for image in images], np.float64), ""
    except (Exception, SystemExit) as failure:      # whatever is wrong with a metric, the others have their values
        return np.full(len(images), np.nan), f"{name} has no value: {failure or type(failure).__name__}"


def errors(images: Iterable[np.ndarray], reference: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
    """Every metric of every image (h, w, 3).

    Returns:
        Metric -> errors (images), NaN where the metric is undefined or fails; and a sentence on each metric that fails.
    """
    images = list(images)
    found = {name: error(name, images, reference) for name in METRICS}
    return {name: values for name, (values, _) in found.items()}, [failure for _, failure in found.values() if failure]


# Of all seeds of a method; they need no reference.
VARIANCES = ("relative_variance", "work_normalised_variance")
