"""Equal-area map between the unit square and the upper hemisphere (Shirley & Chiu 1997).

The Jacobian is constant: a density on the square is 2 pi times the density per solid angle.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi

TO_SOLID_ANGLE = 1 / (2 * dr.pi)        # p(omega) = p_square * TO_SOLID_ANGLE  [1/sr]


def to_hemisphere(s: mi.Point2f) -> mi.Vector3f:
    """Square [0, 1]^2 -> unit vector with z >= 0, by way of the concentric disk (r, phi)."""
    disk = mi.warp.square_to_uniform_disk_concentric(s)
    r2 = dr.squared_norm(disk)
    disk *= dr.safe_sqrt(2 - r2)        # with z = 1 - r^2: a vector of unit length
    return mi.Vector3f(disk.x, disk.y, 1 - r2)


def from_hemisphere(wo: mi.Vector3f) -> mi.Point2f:
    """Unit vector with z >= 0 -> square; directions below the horizon land where their mirror image does."""
    # 1 / sqrt(2 - r^2) with r^2 = 1 - |z|
    disk = mi.Point2f(wo.x, wo.y) * dr.rsqrt(1 + dr.abs(wo.z))
    return mi.warp.uniform_disk_to_square_concentric(disk)
