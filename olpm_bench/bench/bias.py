"""The bias guard: do the mean images of two methods differ by more than their noise, in the whole or in a block of pixels?

An unbiased estimator of few samples may look biased where rare samples carry the light, as it has met none of them.  So the
error of a mean is the larger of those by the spread of passes and over seeds, and allows for one more outlier as large as the
largest anywhere in the method's images.  Differences count from 6 standard errors on, and in blocks from so
many that any block of the image exceeds them as rarely.
"""
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from olpm_bench.bench import pixel_variance
from olpm_bench.bench.pixel_variance import CellImages
from olpm_bench.bench.results import Cell

APART = 6.0             # standard errors between the mean images of two methods, beyond which that is said
MAX_BLOCKS = 64         # about: larger images have larger blocks


class Means(NamedTuple):
    """The mean over all cells of a method in a scene, and its standard error, NaN where it is not known.

    image, image_error: luminance of the whole image.
    blocks, block_errors: (blocks) radiance, the mean over channels.
    """
    image: float
    image_error: float
    blocks: np.ndarray
    block_errors: np.ndarray


class Difference(NamedTuple):
    """How far the mean images of two methods are apart.

    apart: standard errors, of the whole image or of the block that differs most, whichever counts more.  Those of a block are
        scaled so that `APART` is the limit for them, too.  0 where no error is known.
    bias_seen: the bias of the whole image that would have been seen, a share of its mean; NaN where that is not known.
    block_bias_seen: that of the median block, a share of its mean; NaN where it is black, or no error is known.
    """
    apart: float
    bias_seen: float
    block_bias_seen: float


def means(cells: Sequence[Cell], images: CellImages) -> Means:
    """
    Args:
        cells, images: of a method in a scene, one per seed; the images are those of the cells.
    """
    of_image, errors = (np.array([cell.info[key] for cell in cells], np.float64) for key in ("mean", "mean_stderr"))
    n, (height, width) = len(cells), images.mean.shape[1:3]
    by_passes = float(np.mean(np.where(np.isnan(errors), np.inf, errors) ** 2))
    over_seeds = float(np.var(of_image, ddof=1)) if n > 1 else 0.0

    side = max(pixel_variance.BLOCK, math.sqrt(height * width / MAX_BLOCKS))
    blocks = pixel_variance.blocks(height, width, side)
    of_block = np.stack([blocks.mean(image.mean(axis=-1)) for image in images.mean])
    deviations = np.sqrt(images.estimates).mean(axis=-1)                # at most, if channels vary together
    by_passes_of_block = np.mean([blocks.mean(deviation**2) for deviation in deviations], axis=0) / blocks.sizes
    over_seeds_of_block = np.var(of_block, axis=0, ddof=1) if n > 1 else np.zeros(len(blocks.sizes))
    outlier = float(deviations.max()) / n
    error = math.sqrt(max(by_passes, over_seeds) / n + (outlier / (height * width)) ** 2)
    block_variances = np.maximum(by_passes_of_block, over_seeds_of_block) / n + (outlier / blocks.sizes) ** 2
    return Means(float(of_image.mean()), error, of_block.mean(axis=0), np.sqrt(block_variances))


def difference(a: Means, b: Means) -> Difference:
    """
    Raises:
        ValueError: images of different sizes.
    """
    if a.blocks.shape != b.blocks.shape:
        raise ValueError(f"{len(a.blocks)} and {len(b.blocks)} blocks: images must be of one size")
    tiny = np.finfo(float).tiny
    error, block_errors = np.hypot(a.image_error, b.image_error), np.hypot(a.block_errors, b.block_errors)
    limit = -special.ndtri(special.ndtr(-APART) / len(a.blocks))       # of the largest of so many
    with np.errstate(invalid="ignore", divide="ignore"):
        of_image = abs(a.image - b.image) / max(error, tiny)
        of_blocks = np.abs(a.blocks - b.blocks) / np.maximum(block_errors, tiny) * (APART / limit)
        seen = APART * error / (a.image + b.image) * 2
        shares = limit * block_errors / (a.blocks + b.blocks) * 2
    apart = max(_known(of_image), *(_known(z) for z in of_blocks))
    return Difference(apart, float(seen), float(np.median(shares)))


def _known(standard_errors: float) -> float:
    return 0.0 if np.isnan(standard_errors) else float(standard_errors)
