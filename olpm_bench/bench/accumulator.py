"""The mean of an image's passes, and how well it is known."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass
class Accumulator:
    """Running mean of passes, and the variance of that mean from their spread (Welford 1962, weighted by samples).

    Pixels are float64: a long render adds many small passes.
    """
    mean: np.ndarray        # (h, w, 3)
    m2: np.ndarray          # (h, w, 3) sum over passes of spp (x - mean)^2
    spp: int = 0
    passes: int = 0

    @staticmethod
    def empty(height: int, width: int) -> Accumulator:
        return Accumulator(np.zeros((height, width, 3)), np.zeros((height, width, 3)))

    @staticmethod
    def resume(mean: np.ndarray, variance: np.ndarray, spp: int, passes: int) -> Accumulator:
        """The accumulator whose mean, variance and counts these are."""
        return Accumulator(mean.astype(np.float64), variance.astype(np.float64) * max(passes - 1, 0) * spp, spp, passes)

    def add(self, image: np.ndarray, spp: int) -> None:
        """Add a pass: an image (h, w, 3) of `spp` samples a pixel."""
        total, delta = self.spp + spp, image - self.mean
        mean = self.mean + delta * (spp / total)
        m2 = self.m2 + spp * delta * (image - mean)
        self.mean, self.m2, self.spp, self.passes = mean, m2, total, self.passes + 1       # at once: Ctrl-C tears nothing

    def variance(self) -> np.ndarray:
        """Variance of `mean` (h, w, 3); infinite before there are two passes."""
        if self.passes < 2:
            return np.full_like(self.mean, np.inf)
        return self.m2 / ((self.passes - 1) * self.spp)
