"""The variance of a pixel, from all passes of all cells of a method in a scene.

The variance over 3 to 8 images, one per seed, says little of a pixel where rare samples carry the light: few of those images
have met them.  Each cell therefore keeps, beside the mean of its passes, the variance of that mean from the spread of its
passes.  The mean of these over the cells of all seeds is an unbiased estimate of the variance of one cell's image, at each
pixel, that stands on every pass.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from olpm_bench.bench.files import ResultError
from olpm_bench.bench.results import Cell


@dataclass(frozen=True)
class PixelMoments:
    """What the pooled passes of several cells tell of each pixel.  Radiance is linear RGB.

    mean: (h, w, 3) of the cells' images, each weighing the same.
    variance: (h, w, 3) of the image of one cell; NaN where there is one cell of one pass.
    work: (h, w, 3) variance of the image of one cell times its charged seconds [s], the mean over cells.
    effective_passes: (h, w) the number of passes of equal value that have the same mean and variance, at most all of them:
        (sum x)^2 / sum x^2 of the pass values x.  It is 0 for a pixel that is black in all passes, 1 where a single pass met
        light, and never above the number of passes that did.
    cells, passes: how many there are.
    """
    mean: np.ndarray
    variance: np.ndarray
    work: np.ndarray
    effective_passes: np.ndarray
    cells: int
    passes: int


@dataclass(frozen=True)
class CellImages:
    """The images of the cells of a method in a scene, one per seed, and what they cost.

    mean, variance: (seeds, h, w, 3) the mean over the passes of a cell, and the variance of that mean.
    passes: (seeds) numbers of passes.
    seconds: (seeds) charged seconds.
    """
    mean: np.ndarray
    variance: np.ndarray
    passes: np.ndarray
    seconds: np.ndarray

    def __len__(self) -> int:
        return len(self.seconds)

    def pooled(self, seeds: Sequence[int] | np.ndarray | None = None) -> PixelMoments:
        """The moments of the cells of some seeds, by default of all.

        Cells of a single pass know no variance: if there is one, the variance is that over the images of the cells instead.

        Args:
            seeds: positions along the first axis, as a jackknife leaves one out.
        """
        at = np.arange(len(self)) if seeds is None else np.asarray(seeds)
        images, seconds, passes = self.mean[at], self.seconds[at], self.passes[at]
        mean = images.mean(axis=0)
        if (passes > 1).all():
            variances = self.variance[at]
            variance = variances.mean(axis=0)
            work = np.tensordot(seconds, variances, 1) / len(at)
            total = int(passes.sum())
            # A pass is about as many times as noisy as there are passes in its cell.
            of_pass = np.tensordot(passes, variances, 1) / len(at)
        else:
            total = len(at)
            variance = images.var(axis=0, ddof=1) if total > 1 else np.full_like(mean, np.nan)
            work = variance * seconds.mean()
            of_pass = variance
        squared = np.mean(mean**2, axis=-1)
        second_moment = squared + np.mean(of_pass, axis=-1) * (1 - 1 / total)
        effective = total * squared / np.maximum(second_moment, np.finfo(float).tiny)
        return PixelMoments(mean, variance, work, effective, len(at), total)


def read(cells: Sequence[Cell]) -> CellImages:
    """The images of cells, and what they cost; each file is read once.

    Raises:
        ResultError: a cell does not say of how many passes it is; the message says to run it again.
    """
    images = [cell.image() for cell in cells]
    return CellImages(
        np.stack([image["mean"] for image in images]).astype(np.float64),
        np.stack([image["variance"] for image in images]).astype(np.float64),
        np.array([passes_of(cell) for cell in cells]),
        np.array([cell.info["charged_seconds"] for cell in cells], np.float64))


def passes_of(cell: Cell) -> int:
    """The number of passes in a cell's image.

    Cells of earlier versions do not say it, but tell how many samples a pass has; images of training passes count by that.

    Raises:
        ResultError: neither is known.
    """
    info = cell.info
    if "image_passes" in info:
        return int(info["image_passes"])
    if "pass_spp" in info:
        return max(1, round(info["spp"] / info["pass_spp"]))
    raise ResultError(f"{cell.folder / 'cell.json'} does not say of how many passes its image is: remove the folder of the cell, "
                      "and run the experiment again")
