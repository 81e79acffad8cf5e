"""How large a scene is."""
from __future__ import annotations

import mitsuba as mi

from olpm_bench.transport.settings import InputError


def surface_bounds(scene: mi.Scene) -> mi.ScalarBoundingBox3f:
    """Box around all surfaces.

    Mitsuba 3.9.1 gives meshes that its loader merged from rectangles, and with them the scene, an invalid box.

    Raises:
        InputError: the scene has no surface.
    """
    bounds = mi.ScalarBoundingBox3f()
    for shape in scene.shapes():
        if shape.bbox().valid():
            bounds.expand(shape.bbox())
        elif shape.is_mesh():
            vertices = shape.vertex_positions_buffer().numpy().reshape(-1, 3).astype(float)
            bounds.expand(mi.ScalarPoint3f(*vertices.min(0)))
            bounds.expand(mi.ScalarPoint3f(*vertices.max(0)))
    if not bounds.valid():
        raise InputError("the scene has no surface to guide paths from")
    return bounds
