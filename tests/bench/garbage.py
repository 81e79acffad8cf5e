"""A Gaussian mixture that learns from directions at random, where it should from those of the particles: gates must refuse it."""
from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from representations.gaussian_mixture import GaussianMixture


class Garbage(GaussianMixture):
    def update(self, state, batch, seed=0):
        index, salt = dr.arange(mi.UInt32, len(batch)), dr.opaque(mi.UInt32, seed)
        sample = mi.Point2f(mi.sample_tea_float32(index, salt), mi.sample_tea_float32(index, salt + 1))
        return super().update(state, replace(batch, wo=mi.warp.square_to_uniform_hemisphere(sample)), seed)
