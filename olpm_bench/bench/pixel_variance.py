"""The variance of a pixel, from all passes of all cells of a method in a scene.

The variance over 3 to 8 images, one per seed, says little of a pixel where rare samples carry the light: few of those images
have met them.  Each cell therefore keeps, beside the mean of its passes, the variance of that mean from the spread of its
passes.  The mean of these over the cells of all seeds is an unbiased estimate of the variance of one cell's image, at each
pixel, that stands on every pass.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from olpm_bench.bench.results import Cell

BLOCK = 8               # side of a block [pixels], about
FLOOR = 1e-3            # of the image's squared mean, which is added to that of a block: black blocks don't count without end


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

    @property
    def by_passes(self) -> bool:
        """Whether every cell knows its variance, which takes two passes."""
        return bool((self.passes > 1).all())

    @cached_property
    def estimates(self) -> np.ndarray:
        """(seeds, h, w, 3) what each cell says of the variance of an image; the mean over cells is unbiased.

        Where a cell has a single pass, these are the squared distances from the mean over cells instead, so scaled that their
        mean is unbiased; NaN for one cell.
        """
        if self.by_passes:
            return self.variance
        n = len(self)
        if n == 1:
            return np.full_like(self.mean, np.nan)
        distances: np.ndarray = (self.mean - self.mean.mean(axis=0)) ** 2 * (n / (n - 1))
        return distances

    @property
    def total_passes(self) -> int:
        """The number of images whose spread is the variance."""
        return int(self.passes.sum()) if self.by_passes else len(self)

    def subset(self, seeds: Sequence[int] | np.ndarray) -> CellImages:
        """The cells at these positions along the first axis."""
        at = np.asarray(seeds)
        return CellImages(self.mean[at], self.variance[at], self.passes[at], self.seconds[at])

    def pooled(self, seeds: Sequence[int] | np.ndarray | None = None) -> PixelMoments:
        """The moments of all cells, or of some, as for a jackknife.

        Args:
            seeds: positions along the first axis.
        """
        if seeds is not None:
            return self.subset(seeds).pooled()
        n, total = len(self), self.total_passes
        mean = self.mean.mean(axis=0)
        variance = self.estimates.mean(axis=0)
        work = np.tensordot(self.seconds, self.estimates, 1) / n
        of_pass = np.tensordot(self.passes if self.by_passes else np.ones(n), self.estimates, 1) / n
        squared = np.mean(mean**2, axis=-1)
        second_moment = squared + np.mean(of_pass, axis=-1) * (1 - 1 / total)
        effective = total * squared / np.maximum(second_moment, np.finfo(float).tiny)
        return PixelMoments(mean, variance, work, effective, n, total)


def read(cells: Sequence[Cell]) -> CellImages:
    """The images of cells, and what they cost; each file is read once."""
    images = [cell.image() for cell in cells]
    return CellImages(
        np.stack([image["mean"] for image in images]).astype(np.float64),
        np.stack([image["variance"] for image in images]).astype(np.float64),
        np.array([passes_of(cell, image["variance"]) for cell, image in zip(cells, images, strict=True)]),
        np.array([cell.info["charged_seconds"] for cell in cells], np.float64))


def passes_of(cell: Cell, variance: np.ndarray) -> int:
    """The number of passes in a cell's image.

    Cells of earlier versions do not say it, but most tell how many samples a pass has; images of training passes count by that.
    Of others it is known only whether a variance could be measured: then there were two passes at least.

    Args:
        variance: that layer of its image.
    """
    info = cell.info
    if "image_passes" in info:
        return int(info["image_passes"])
    if not np.isfinite(variance).all():
        return 1
    return max(2, round(info["spp"] / info["pass_spp"])) if "pass_spp" in info else 2


# ---------------------------------------------------------------- blocks

class Blocks(NamedTuple):
    """Rectangles of pixels that cover an image.

    number: (h, w) of the block of each pixel, from 0.
    sizes: (blocks) numbers of pixels.
    """
    number: np.ndarray
    sizes: np.ndarray

    def mean(self, values: np.ndarray) -> np.ndarray:
        """The mean over the pixels of each block: (h, w) -> (blocks)."""
        sums: np.ndarray = np.bincount(self.number.ravel(), values.ravel())
        return sums / self.sizes


def blocks(height: int, width: int, side: float = BLOCK) -> Blocks:
    """Blocks of equal shares of the image's height and width, as near to `side` pixels as whole numbers allow."""
    rows, columns = (max(1, round(n / side)) for n in (height, width))
    row, column = np.arange(height) * rows // height, np.arange(width) * columns // width
    number = row[:, None] * columns + column
    return Blocks(number, np.bincount(number.ravel()))


def squared_radiance(radiance: np.ndarray, of: Blocks) -> np.ndarray:
    """What variances are relative to (blocks): the squared mean of a block, averaged over channels, plus a share of the image's.

    Args:
        radiance: (h, w, 3) the reference, or the best mean that there is.
    """
    channels = np.stack([of.mean(radiance[..., c].astype(np.float64)) for c in range(3)], axis=-1)
    return np.mean(channels**2, axis=-1) + FLOOR * float(radiance.mean(dtype=np.float64)) ** 2
