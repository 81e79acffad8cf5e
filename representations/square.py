"""Equal-area map between the unit square and the upper hemisphere (Shirley & Chiu 1997).

The Jacobian is constant: a density on the square is 2 pi times the density per solid angle.
"""
from __future__ import annotations

from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

Float = TypeVar("Float", bound=Any)           # mi.Float, or mi.ArrayXf [K, n]

TO_SOLID_ANGLE = 1 / (2 * dr.pi)        # p(omega) = p_square * TO_SOLID_ANGLE  [1/sr]

# 4/pi atan(t) / t on [0, 1] as a polynomial in t^2, relative error 1e-7: half the time of `dr.atan2`, and closer.
ARCTAN = (1.27323942, -0.42439609, 0.25426247, -0.17850181, 0.12623325, -0.07574115, 0.03087959, -0.00597579)


def to_hemisphere(s: mi.Point2f) -> mi.Vector3f:
    """Square [0, 1]^2 -> unit vector with z >= 0, by way of the concentric disk (r, phi)."""
    disk = mi.warp.square_to_uniform_disk_concentric(s)
    r2 = dr.squared_norm(disk)
    disk *= dr.safe_sqrt(2 - r2)        # with z = 1 - r^2: a vector of unit length
    return mi.Vector3f(disk.x, disk.y, dr.maximum(1 - r2, 0))


def from_hemisphere(wo: mi.Vector3f) -> mi.Point2f:
    """Unit vector with z >= 0 -> square; directions below the horizon land where their mirror image does."""
    return mi.Point2f(*components_from_hemisphere(*wo))


def components_from_hemisphere(wo_x: Float, wo_y: Float, wo_z: Float) -> tuple[Float, Float]:
    """:func:`from_hemisphere`, also of [K, n] components."""
    x, y = dr.abs(wo_x), dr.abs(wo_y)
    r = dr.sqrt(dr.fma(x, x, y * y) * dr.rcp(1 + dr.abs(wo_z)))         # sqrt(1 - |z|), without cancellation
    t = dr.minimum(x, y) / dr.maximum(dr.maximum(x, y), 1e-30)          # tangent of the angle within the sector
    t2, angle = t * t, ARCTAN[-1]
    for coefficient in ARCTAN[-2::-1]:
        angle = dr.fma(angle, t2, coefficient)
    across = r * t * angle
    u, v = dr.select(y > x, across, r), dr.select(y > x, r, across)
    return dr.fma(dr.mulsign(u, wo_x), 0.5, 0.5), dr.fma(dr.mulsign(v, wo_y), 0.5, 0.5)
