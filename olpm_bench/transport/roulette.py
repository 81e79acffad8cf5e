"""Roulette by expected contribution: how likely a camera path is to be worth its pixel's while.

At a vertex with throughput beta, on a record that returns the radiance L_o on the average, a path can be expected to bring
beta L_o to a pixel that is worth I.  It goes on with probability  q = min(beta L_o / (I window), 1)  (adjoint-driven
Russian roulette, Vorba & Křivánek 2016, without its splitting), at least `LEAST` so that a wrong estimate costs little.  Any
estimates leave the image unbiased: survivors are divided by q.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter, median_filter

from olpm_bench.transport.settings import UNBOUNDED_DEPTH
from representations.state import copied

LEAST = 0.05            # survival probability
MOST = 0.95             # of paths by their throughput, and of those of more than `UNBOUNDED_DEPTH` segments
DARKEST = 0.02          # of a pixel, relative to the image's mean: black ones would keep every path
SIGMA = 1.0             # of the filter [pixels]


class PixelEstimate:
    """A smooth estimate of the luminance of each pixel.

    Args:
        luminance: noisy image (h, w); an outlier is removed by a median over 3 x 3 pixels.
    """

    def __init__(self, luminance: np.ndarray) -> None:
        self.luminance = np.asarray(luminance, np.float32)
        smooth = gaussian_filter(median_filter(self.luminance, 3), SIGMA)
        smooth = np.maximum(smooth, DARKEST * max(float(smooth.mean()), 1e-30))
        self.height, self.width = smooth.shape
        self.values = copied(mi.Float, smooth.ravel())
        self.size = dr.opaque(mi.UInt32, self.width), dr.opaque(mi.UInt32, self.height)

    def at(self, position: mi.Point2f) -> mi.Float:
        """Luminance at positions on the film in [0, 1]^2."""
        x, y = (dr.minimum(mi.UInt32(dr.maximum(p, 0) * s), s - 1) for p, s in zip(position, self.size, strict=True))
        return dr.gather(mi.Float, self.values, y * self.size[0] + x)


def by_throughput(beta: mi.Spectrum, eta: mi.Float, deep: mi.Bool) -> mi.Float:
    """Survival probability after scattering, as in Mitsuba's `path`.

    `eta` cancels the square that refraction multiplies with.  Where a BSDF's `eta` or value is NaN, the path
    goes on: an end that nothing makes up for would be a bias.
    """
    survival = dr.max(beta) * dr.square(eta)
    return dr.select(deep & (survival < MOST), survival, dr.select(deep, mi.Float(MOST), 1))


def by_contribution(beta: mi.Spectrum, outgoing: mi.Float, worth: mi.Float, depth: mi.UInt32) -> mi.Float:
    """Survival probability before scattering: expected contribution over what is `worth` a path; see above.

    Paths without limit must end somewhere, though between white walls they may stay worth their while.  A
    contribution that is NaN, 0 / 0 or infinity times 0, counts as none.
    """
    contribution = mi.luminance(beta) * outgoing / worth
    most = dr.select(depth < UNBOUNDED_DEPTH, mi.Float(1), MOST)
    return dr.select(contribution > LEAST, dr.minimum(contribution, most), LEAST)
