"""Work-normalised variances of methods, and the gains of one over another, with their intervals.

The work-normalised variance of a pixel is the variance of its colour (mean over channels) in the image of one cell, times the
charged seconds of that cell, over the squared mean of the block of about 8 x 8 pixels around it plus 1/1000 of the image's
squared mean.  Variances come from all passes of all cells; the mean is the reference's, or without one that of all cells of all
methods in the scene.  Three numbers sum it up, and the gain of a method is the baseline's over its own:

- "median": the median over blocks of the mean over a block;
- "trimmed": the mean over pixels without the worst 0.1 % of pixels (rounded down);
- "mean": the mean over all pixels.

A median over pixels would be far too small where rare samples carry the light, as most pixels have met none of them, and a
relative variance far too small where the mean is that of the same few samples.  Blocks pool them.

An interval is a 90 % jackknife over seeds, paired between methods, widened by the rule of three: events that have not been seen
in n trials may have an expected number of 3.  So the upper end of a variance allows for three more outliers, in each block for a
median.  In a gain they are as large as the largest that was seen; in a variance that stands alone twice as large, which is the
mean size above the largest of outliers whose variance is barely finite (densities as x^-3).  There is no number without an
interval, and none where too little light was met; then a sentence says why.
"""
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from olpm_bench.bench import pixel_variance, statistics
from olpm_bench.bench.pixel_variance import Blocks, CellImages
from olpm_bench.bench.statistics import Interval

KINDS = ("median", "trimmed", "mean")
WORST = 0.001               # share of pixels that "trimmed" leaves out
UNSEEN = 3.0                # rule of three: 95 % of what is expected as often was seen
ALONE = 2.0                 # size of the unseen outliers of a variance that stands alone, of the largest that was seen
MIN_SEEDS = 3               # two leave no interval
MIN_EFFECTIVE_PASSES = 10.0     # of the passes of a block's pixels that met light
MAX_SHARE = 0.5             # of a mean over pixels that a single pixel of a single cell may be


@dataclass(frozen=True)
class WorkVariance:
    """The variances of the pixels of a method in a scene times charged seconds, for `estimate` and `gain` normalised.

    method: its name, for sentences.
    by_cell: (seeds, h, w) what each cell says of them; the mean over cells is the estimate.
    effective_passes: (blocks) how many passes of pixels of a block met light, by their weight.
    passes: of all cells.
    """
    method: str
    by_cell: np.ndarray
    blocks: Blocks
    effective_passes: np.ndarray
    passes: int

    @property
    def seeds(self) -> int:
        return len(self.by_cell)

    def value(self, kind: str, seeds: np.ndarray | None = None) -> float:
        """One of `KINDS`, of all cells or of those at some positions."""
        pixels = (self.by_cell if seeds is None else self.by_cell[seeds]).mean(axis=0, dtype=np.float64)
        if kind == "median":
            return float(np.median(self.blocks.mean(pixels)))
        return float(np.mean(without_worst(pixels) if kind == "trimmed" else pixels))

    def allowance(self, kind: str, outliers: float = UNSEEN) -> float:
        """The factor by which the variance grows with so many more outliers as large as the largest that was seen.

        For a median they are as large as the largest of each block, and in each block.
        """
        value = self.value(kind)
        if kind != "median":
            return 1 + outliers * float(self.by_cell.max()) / self.by_cell.size / value
        largest = np.zeros(len(self.blocks.sizes))
        np.maximum.at(largest, self.blocks.number.ravel(), self.by_cell.max(axis=0).ravel())
        grown = self.blocks.mean(self.by_cell.mean(axis=0)) + outliers * largest / (self.seeds * self.blocks.sizes)
        return float(np.median(grown)) / value

    def largest_share(self, kind: str) -> float:
        """The largest share that a single pixel of a single cell has in a mean over pixels."""
        pixels = self.by_cell.mean(axis=0, dtype=np.float64)
        kept = pixels <= without_worst(pixels)[-1] if kind == "trimmed" else np.ones_like(pixels, bool)
        return float(self.by_cell[:, kept].max() / (self.seeds * pixels[kept].sum()))

    def undefined(self, kind: str) -> str:
        """Why there is no such number, in a sentence without a full stop; empty where there is one."""
        if self.seeds < MIN_SEEDS:
            return f"an interval needs at least {MIN_SEEDS} seeds, and there {_are(self.seeds)}"
        if not self.effective_passes.any():
            return f"the image is black in all {self.passes} passes of {self.method}"
        if kind == "median":
            typical = float(np.median(self.effective_passes))
            if typical == 0:
                return f"the median block of pixels is black in all {self.passes} passes of {self.method}"
            if typical < MIN_EFFECTIVE_PASSES:
                return (f"in the median block of pixels the light of {self.method} is that of {typical:.2g} passes of a pixel, "
                        f"and at least {MIN_EFFECTIVE_PASSES:.0f} are needed")
        value = self.value(kind)
        if not value > 0:
            return f"the images of {self.method} have no noise"
        if kind != "median" and (share := self.largest_share(kind)) > MAX_SHARE:
            return f"a single pixel of a single cell is {share:.0%} of the mean for {self.method}"
        return ""


def without_worst(pixels: np.ndarray) -> np.ndarray:
    """The values without the largest 0.1 % of them (rounded down), in increasing order."""
    ordered = np.sort(pixels, axis=None)
    return ordered[:ordered.size - int(WORST * ordered.size)]


def work_variance(method: str, images: CellImages) -> WorkVariance:
    """The variances of a method's pixels times charged seconds, not normalised."""
    height, width = images.mean.shape[1:3]
    blocks = pixel_variance.blocks(height, width)
    by_cell = images.estimates.mean(axis=-1) * images.seconds[:, None, None]
    return WorkVariance(method, by_cell.astype(np.float32), blocks, _effective_passes(images, blocks), images.total_passes)


def normalised(variance: WorkVariance, radiance: np.ndarray) -> WorkVariance:
    """Relative to the squared mean of each block.

    Args:
        radiance: (h, w, 3) the reference, or the best mean that there is.
    """
    squared = pixel_variance.squared_radiance(radiance, variance.blocks)[variance.blocks.number]
    with np.errstate(divide="ignore", invalid="ignore"):
        return replace(variance, by_cell=(variance.by_cell / squared).astype(np.float32))


def _effective_passes(images: CellImages, blocks: Blocks) -> np.ndarray:
    """(sum x)^2 / sum x^2 over the passes of all pixels of a block (blocks); 0 where it is black."""
    moments = images.pooled()
    squared = np.mean(moments.mean**2, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        second = np.where(squared > 0, moments.passes * squared / moments.effective_passes, 0)
        radiance = blocks.mean(np.sqrt(squared))
        effective = moments.passes * blocks.sizes * radiance**2 / blocks.mean(second)
    return np.where(radiance > 0, effective, 0)


def estimate(variance: WorkVariance, kind: str) -> Interval:
    """The work-normalised variance [s] of a method, by one of `KINDS`, or why there is none."""
    return _interval(variance.undefined(kind), lambda seeds: variance.value(kind, seeds), variance.seeds,
                     lambda: (1.0, variance.allowance(kind, ALONE * UNSEEN)))


def gain(baseline: WorkVariance, method: WorkVariance, kind: str) -> Interval:
    """The baseline's work-normalised variance over that of the method, by one of `KINDS`, or why there is none.

    Raises:
        ValueError: numbers of seeds that differ.
    """
    if baseline.seeds != method.seeds:
        raise ValueError(f"{baseline.seeds} and {method.seeds} seeds: methods are compared in pairs of seeds")
    undefined = baseline.undefined(kind) or method.undefined(kind)
    if method is baseline and not undefined:
        return Interval(1.0, 1.0, 1.0)
    return _interval(undefined,
                     lambda seeds: baseline.value(kind, seeds) / method.value(kind, seeds), method.seeds,
                     lambda: (method.allowance(kind), baseline.allowance(kind)))


def _interval(undefined: str, statistic: Callable[[np.ndarray], float], seeds: int,
              allowances: Callable[[], tuple[float, float]]) -> Interval:
    """A jackknife interval, its lower end divided and its upper end multiplied by the allowances."""
    if not undefined:
        with np.errstate(divide="ignore", invalid="ignore"):
            found = statistics.jackknife(statistic, seeds)
        below, above = allowances()
        if math.isfinite(found.low) and math.isfinite(found.high):
            return found._replace(low=found.low / below, high=found.high * above)
        undefined = "without one of the seeds there is none"
    return Interval(math.nan, math.nan, math.nan, why=undefined)


def _are(n: int) -> str:
    return "is 1" if n == 1 else f"are {n}"
