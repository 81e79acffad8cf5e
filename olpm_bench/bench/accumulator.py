"""The mean of an image's passes, and how well it is known."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class Accumulator:
    """Running mean of independent passes, and the variance of that mean from their spread.

    A pass weighs as many as its samples are.  The variance is the sum of (weight (pass - mean))^2, as passes of training
    may be noisier than later ones of another size, whose spread says nothing of theirs.  It is unbiased for passes of one
    size, however much their noise differs, and for passes of one noise per sample, however much their sizes differ.

    Pixels are float64: a long render adds many small passes.
    """
    mean: np.ndarray            # (h, w, 3) weighted by samples
    square_mean: np.ndarray     # (h, w, 3) mean of the passes weighted by squared samples
    square_m2: np.ndarray       # (h, w, 3) sum over passes of spp^2 (pass - square_mean)^2
    spp: int = 0
    square_spp: float = 0.0     # sum over passes of spp^2
    passes: int = 0

    @staticmethod
    def empty(height: int, width: int) -> Accumulator:
        zeros = np.zeros((height, width, 3))
        return Accumulator(zeros, zeros.copy(), zeros.copy())

    @staticmethod
    def resume(mean: np.ndarray, variance: np.ndarray, spp: int, passes: int) -> Accumulator:
        """The accumulator whose mean, variance and counts these are, as if its passes had been of one size."""
        if passes == 0:
            return Accumulator.empty(*mean.shape[:2])
        mean = mean.astype(np.float64)
        m2 = variance.astype(np.float64) * spp**2 * (1 - 1 / passes) if passes > 1 else np.zeros_like(mean)
        return Accumulator(mean, mean.copy(), m2, spp, spp**2 / passes, passes)

    def add(self, image: np.ndarray, spp: int) -> None:
        """Add a pass: an image (h, w, 3) of `spp` samples a pixel."""
        total, square_total = self.spp + spp, self.square_spp + spp**2
        mean = self.mean + (image - self.mean) * (spp / total)
        delta = image - self.square_mean                                                # Welford 1962
        square_mean = self.square_mean + delta * (spp**2 / square_total)
        square_m2 = self.square_m2 + spp**2 * delta * (image - square_mean)
        # All at once, so that Ctrl-C tears nothing.
        self.mean, self.square_mean, self.square_m2, self.spp, self.square_spp, self.passes = (
            mean, square_mean, square_m2, total, square_total, self.passes + 1)

    def variance(self) -> np.ndarray:
        """Variance of `mean` (h, w, 3); infinite before there are two passes."""
        if self.passes < 2:
            return np.full_like(self.mean, np.inf)
        about_mean = self.square_m2 + self.square_spp * (self.square_mean - self.mean) ** 2
        variance: np.ndarray = about_mean / (self.spp**2 - self.square_spp)
        return variance
