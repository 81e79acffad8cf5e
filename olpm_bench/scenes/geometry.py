"""Meshes and textures of the embedded scenes: boxes, turned bodies, boards and plaster, computed with NumPy."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

Array = np.ndarray
Vector = tuple[float, ...] | np.ndarray


@dataclass
class Part:
    """Triangles with their own vertices; several of one material become one mesh."""
    vertices: Array         # [n, 3] m
    normals: Array          # [n, 3] unit length, outwards
    uv: Array               # [n, 2] m on boxes, in [0, 1] elsewhere
    faces: Array            # [m, 3]

    def transformed(self, matrix: Array, offset: Vector = (0, 0, 0)) -> Part:
        """Rotated by `matrix` [3, 3], then moved."""
        return Part(self.vertices @ matrix.T + np.asarray(offset), self.normals @ matrix.T, self.uv, self.faces)


def turn_z(degrees: float) -> Array:
    """Rotation about the vertical [3, 3]."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def quad(corner: Vector, u: Vector, v: Vector, in_metres: bool = False) -> Part:
    """Parallelogram `corner` + s u + t v, facing u x v; uv = (s, t), or in metres along u and v."""
    o, u_, v_ = (np.asarray(x, float) for x in (corner, u, v))
    n = np.cross(u_, v_)
    scale = [np.linalg.norm(u_), np.linalg.norm(v_)] if in_metres else [1, 1]
    return Part(np.array([o, o + u_, o + u_ + v_, o + v_]), np.tile(n / np.linalg.norm(n), (4, 1)),
                np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]) * scale, np.array([[0, 1, 2], [0, 2, 3]]))


def box(low: Vector, high: Vector) -> Part:
    """Axis-aligned box from its corners, facing outwards; uv in metres from its low corner."""
    lo, size = np.asarray(low, float), np.asarray(high, float) - np.asarray(low, float)
    x, y, z = np.diag(size)
    return join([quad(lo, y, x, True), quad(lo + z, x, y, True), quad(lo, x, z, True),
                 quad(lo + y, z, x, True), quad(lo, z, y, True), quad(lo + x, y, z, True)])


def lathe(profile: list[tuple[float, float]], segments: int = 48, crease: float = 40) -> Part:
    """Body of revolution about z.  Going along `profile` [(radius, z), ...] [m], the outside is on the right.

    Normals are smooth but where the profile turns by more than `crease` [degrees].
    """
    p = np.asarray(profile, float)
    direction = np.diff(p, axis=0)
    normal = np.stack([direction[:, 1], -direction[:, 0]], 1) / np.linalg.norm(direction, axis=1, keepdims=True)
    phi = np.linspace(0, 2 * np.pi, segments + 1)
    circle = np.stack([np.cos(phi), np.sin(phi)], 1)
    parts = []
    for i in np.flatnonzero(p[:-1, 0] + p[1:, 0] > 0):      # no surface along the axis
        ends = []
        for end, neighbour in ((i, i - 1), (i + 1, i + 1)):
            n = normal[i]
            if 0 <= neighbour < len(normal) and normal[neighbour] @ n > np.cos(np.radians(crease)):
                n = n + normal[neighbour]
            ends.append((p[end], n / np.linalg.norm(n)))
        vertices, normals, uv = [], [], []
        for k, ((r, z), (nr, nz)) in enumerate(ends):
            vertices.append(np.column_stack([r * circle, np.full(segments + 1, z)]))
            normals.append(np.column_stack([nr * circle, np.full(segments + 1, nz)]))
            uv.append(np.column_stack([phi / (2 * np.pi), np.full(segments + 1, (i + k) / len(direction))]))
        a = np.arange(segments)
        b, c, d = a + 1, a + segments + 2, a + segments + 1
        faces = [np.stack(t, 1) for t, r in (((a, b, c), ends[0][0][0]), ((a, c, d), ends[1][0][0])) if r > 0]
        parts.append(Part(np.concatenate(vertices), np.concatenate(normals), np.concatenate(uv), np.concatenate(faces)))
    return join(parts)


def join(parts: list[Part]) -> Part:
    """All triangles of `parts`."""
    first = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    return Part(np.concatenate([p.vertices for p in parts]), np.concatenate([p.normals for p in parts]),
                np.concatenate([p.uv for p in parts]),
                np.concatenate([p.faces + o for p, o in zip(parts, first, strict=True)]))


def mesh(name: str, parts: list[Part], bsdf: dict[str, Any], rotation: Array,
         emitter: dict[str, Any] | None = None) -> mi.Mesh:
    """One Mitsuba mesh of one material; all its parts are turned by `rotation` [3, 3]."""
    part = join(parts).transformed(rotation)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    if emitter is not None:
        props["emitter"] = mi.load_dict(emitter)
    shape = mi.Mesh(name, len(part.vertices), len(part.faces), has_vertex_normals=True, has_vertex_texcoords=True,
                    props=props)
    values = mi.traverse(shape)
    values["vertex_positions"] = mi.Float(part.vertices.ravel())
    values["vertex_normals"] = mi.Float(part.normals.ravel())
    values["vertex_texcoords"] = mi.Float(part.uv.ravel())
    values["faces"] = mi.UInt32(part.faces.astype(np.uint32).ravel())
    values.update()
    return shape


def texture(image: Array, metres: tuple[float, float] = (1, 1)) -> dict[str, Any]:
    """Bitmap texture of linear RGB values [height, width, 3] (row 0 is the top) that repeats every `metres` of uv."""
    bitmap = mi.Bitmap(np.ascontiguousarray(image[::-1], np.float32))        # v = 0 is row 0
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat",
            "to_uv": mi.ScalarTransform4f().scale([1 / metres[0], 1 / metres[1], 1])}


def noise(rng: np.random.Generator, shape: tuple[int, int], cells: tuple[int, int]) -> Array:
    """Smooth periodic noise in [0, 1] [shape]: random values on a grid of `cells`, interpolated."""
    grid = rng.random(cells)
    index: list[Any] = []
    for size, count in zip(shape, cells, strict=True):
        x = np.arange(size) * count / size
        i = x.astype(int)
        t = x - i
        index.append((i, (i + 1) % count, t * t * (3 - 2 * t)))
    (i0, i1, s), (j0, j1, t) = index
    rows = grid[i0] * (1 - s)[:, None] + grid[i1] * s[:, None]
    return rows[:, j0] * (1 - t) + rows[:, j1] * t


def boards(rng: np.random.Generator, rows: int, columns: int, pixels: int, dark: Vector,
           light: Vector) -> Array:
    """Wooden boards [pixels, pixels, 3]: `rows` of them, each row shifted against the last, with grain and joints."""
    y, x = np.mgrid[0:pixels, 0:pixels] / pixels
    row = (y * rows).astype(int)
    shifted = (x + rng.random(rows)[row]) % 1 * columns
    tone = rng.random((rows, columns))[row, shifted.astype(int)]
    grain = noise(rng, (pixels, pixels), (24 * rows, 5 * columns))
    t = np.clip(0.65 * tone + 0.45 * (grain - 0.3), 0, 1)[..., None]
    joint = (np.minimum(y * rows % 1, 1 - y * rows % 1) < 0.02) | (np.minimum(shifted % 1, 1 - shifted % 1) < 0.004)
    return (np.asarray(dark) * (1 - t) + np.asarray(light) * t) * np.where(joint, 0.35, 1.0)[..., None]


def painted(pixels: tuple[int, int], colour: Callable[[Array, Array], Array]) -> Array:
    """`colour(x, y)` in [0, 1]^2, y upwards, sampled at the centres of [height, width] pixels."""
    h, w = pixels
    y, x = np.mgrid[0:h, 0:w]
    return colour((x + 0.5) / w, 1 - (y + 0.5) / h)
