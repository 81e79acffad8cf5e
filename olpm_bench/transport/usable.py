"""What training can use of numbers that scenes provide.

A texture, a mesh or a BSDF may answer NaN for a few samples.  What is not usable is left out of training and counted:
the images that follow are right without it, and show such values where they matter.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.settings import InputError

TOLERATED = 1e-3        # share of unusable values that nobody needs to hear of
MAX_UNUSABLE = 0.5      # share of them from which the scene is refused


def usable(value: mi.Spectrum | mi.Float) -> mi.Bool:
    """Whether radiance, flux or importance is finite and not negative, in all channels."""
    fine = dr.isfinite(value) & (value >= 0)
    return dr.all(fine) if dr.depth_v(value) > 1 else fine


def usable_ray(ray: mi.Ray3f) -> mi.Bool:
    """Whether a ray starts somewhere and leads somewhere."""
    return dr.all(dr.isfinite(ray.o)) & dr.all(dr.isfinite(ray.d))


def require_usable(unusable: int, n: int, what: str) -> str:
    """What to tell the user of n values, some of which are unusable; empty where there is nothing to tell.

    Args:
        what: their name, in the plural.

    Raises:
        InputError: most of them are unusable.
    """
    where = "look for such values in the scene's emitters, textures and BSDFs"
    if unusable > MAX_UNUSABLE * n:
        raise InputError(f"{unusable} of {n} {what} are NaN, infinite or negative: {where}")
    if unusable > TOLERATED * n:
        return f"more than {TOLERATED:.1%} of the {what} are NaN, infinite or negative and teach nothing: {where}"
    return ""
