"""Where rays start: a little off the surface they leave, so that they do not meet it again.

Mitsuba starts them  epsilon (1 + max |p|)  off, epsilon = 8.9e-5.  This covers two errors at once: that of
an intersection, which grows with the length of rays, and that of the coordinates themselves, which grows
with |p|.  The second is much smaller relative to |p|.  In a room of 4 units that lies 5,000 units from the
origin, rays then start .4 units off the walls, and images are wrong by several percent.  In a scene of 1e-3
units they start 9 % of its size off.  In such scenes we start rays

    epsilon R + ROUNDING max |p|,         R the radius of the scene,

off the surface.  Half as much of the second part already leaves no ray that meets its own surface, on
rectangles, disks, spheres, cylinders, meshes and instances up to 50,000 units from the origin.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport.bounds import surface_bounds

ROUNDING = 16 * 2.0 ** -24      # of coordinates, relative to the largest
# Our rays start at surfaces if they start so many times closer to them than Mitsuba's.
CLOSER = 4.0
# Of the scene's radius: images of rays that start farther off surfaces are wrong by half a percent or more.
BIASED = 0.01


class RayOrigins:
    """Starts rays at the surfaces of a scene; as Mitsuba does, unless it is tiny or far from the origin.

    Attributes:
        radius: half the diagonal of the box around all surfaces [scene units].
        farthest: how far off surfaces rays start, at most [scene units].
        offset: [1] the part of it that is the same everywhere [scene units]; None: rays start as Mitsuba's.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self.radius = 0.0
        self.farthest = 0.0
        self.offset: mi.Float | None = None
        if not scene.shapes():
            return
        bounds = scene.bbox() if scene.bbox().valid() else surface_bounds(scene)
        coordinate = float(np.abs([bounds.min, bounds.max]).max())
        self.radius = 0.5 * float(dr.norm(bounds.extents()))
        self.farthest = mi.math.RayEpsilon * (1 + coordinate)
        ours = mi.math.RayEpsilon * self.radius + ROUNDING * coordinate
        if CLOSER * ours < self.farthest:
            self.farthest = ours
            self.offset = dr.opaque(mi.Float, mi.math.RayEpsilon * self.radius)

    def warning(self) -> str:
        """What to tell of a scene so far from the origin that its images are biased; else nothing."""
        if self.farthest <= BIASED * self.radius:
            return ""
        return (f"images of this scene are biased: it is so far from the origin that rays start "
                f"{self.farthest:.1g} units off surfaces, {self.farthest / self.radius:.1%} of its radius, for "
                f"the rounding of 32-bit coordinates; move it to the origin")

    def spawn(self, si: mi.Interaction3f, d: mi.Vector3f) -> mi.Ray3f:
        """A ray that leaves a surface along d."""
        if self.offset is None:
            return si.spawn_ray(d)
        return mi.Ray3f(self._origin(si, d), d, dr.largest(mi.Float), si.time, si.wavelengths)

    def spawn_to(self, si: mi.Interaction3f, p: mi.Point3f) -> mi.Ray3f:
        """A ray that leaves a surface towards p and ends just in front of it."""
        if self.offset is None:
            return si.spawn_ray_to(p)
        origin = self._origin(si, p - si.p)
        distance = dr.norm(p - origin)
        end = distance * (1 - mi.math.ShadowEpsilon) - self._distance(p)
        return mi.Ray3f(origin, (p - origin) / distance, end, si.time, si.wavelengths)

    def _origin(self, si: mi.Interaction3f, d: mi.Vector3f) -> mi.Point3f:
        distance = dr.mulsign(self._distance(si.p), dr.dot(si.n, d))
        return dr.fma(distance, mi.Vector3f(si.n), si.p)

    def _distance(self, p: mi.Point3f) -> mi.Float:
        """From the surface to where rays start."""
        assert self.offset is not None
        return dr.fma(dr.max(dr.abs(p)), ROUNDING, self.offset)
