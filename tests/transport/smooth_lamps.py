"""Small meshes with smooth vertex normals that shine."""
from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from small_scenes import grey


def mesh(vertices: Any, faces: Any, normals: Any, emitter: dict[str, Any] | None,
         texcoords: Any = None) -> mi.Mesh:
    """A grey mesh.

    Args:
        vertices, normals: [n, 3].
        faces: indices of their corners [m, 3].
        emitter: an area light, or none.
        texcoords: [n, 2].
    """
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(grey(0.5))
    if emitter is not None:
        props["emitter"] = mi.load_dict(emitter)
    made = mi.Mesh("mesh", len(vertices), len(faces), props=props, has_vertex_normals=True,
                   has_vertex_texcoords=texcoords is not None)
    parameters = mi.traverse(made)
    parameters["vertex_positions"] = np.ravel(np.float32(vertices))
    parameters["vertex_normals"] = np.ravel(np.float32(normals))
    if texcoords is not None:
        parameters["vertex_texcoords"] = np.ravel(np.float32(texcoords))
    parameters["faces"] = np.ravel(np.uint32(faces))
    parameters.update()
    return made


def bulb(emitter: dict[str, Any] | None, position: tuple[float, ...] = (0, 0.3, 0.3), size: float = 0.35,
         smooth: bool = True) -> mi.Mesh:
    """An octahedron; smooth normals are those of a sphere."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = [[i, (i + 1) % 4, 4] for i in range(4)] + [[(i + 1) % 4, i, 5] for i in range(4)]
    vertices = corners[np.ravel(faces)]                     # each face has its own
    flat = np.repeat(vertices.reshape(8, 3, 3).mean(1) * np.sqrt(3), 3, 0)
    normals = vertices if smooth else flat
    return mesh(size * vertices + position, np.arange(24).reshape(8, 3), normals, emitter)


def panel(emitter: dict[str, Any] | None, position: tuple[float, ...] = (0.2, 0.3, 0.5),
          size: float = 0.35, tilt: float = 2.0) -> mi.Mesh:
    """A square that looks down, whose vertex normals point outwards: `tilt` is the tangent of their angle."""
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]], float)
    vertices = np.concatenate([size * corners, np.zeros((4, 1))], 1) + position
    normals = np.concatenate([tilt * corners / np.sqrt(2), -np.ones((4, 1))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return mesh(vertices, [[0, 1, 2], [0, 2, 3]], normals, emitter, (corners + 1) / 2)


def area(radiance: Any = 4.0, **more: Any) -> dict[str, Any]:
    """An area light of a radiance or a texture."""
    texture = radiance if isinstance(radiance, dict) else {"type": "rgb", "value": radiance}
    return {"type": "area", "radiance": texture, **more}


def texture() -> dict[str, Any]:
    """Radiances between .1 and 12."""
    pixels = 12 * np.random.default_rng(3).random((6, 6, 1), np.float32) ** 3 + 0.1
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.repeat(pixels, 3, 2)), "raw": True, "wrap_mode": "clamp"}
