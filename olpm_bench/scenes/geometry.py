"""Meshes and the sun of the embedded scenes: boxes, turned bodies, sheets, cushions, computed with NumPy."""
from __future__ import annotations

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


def inside(p: Array, size: Vector, margin: float = 0.01) -> Array:
    """Whether points [n, 3] are in the box from the origin to `size`, or at most `margin` from it [m]."""
    return np.all((p > -margin) & (p < np.asarray(size) + margin), axis=1)


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


def frame(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], width: float) -> list[Part]:
    """Four bars, `width` wide, within the box x, y, z; one looks through along y."""
    (x0, x1), (y0, y1), (z0, z1), t = x, y, z, width
    return [box((x0, y0, z0), (x1, y1, z0 + t)), box((x0, y0, z1 - t), (x1, y1, z1)),
            box((x0, y0, z0 + t), (x0 + t, y1, z1 - t)), box((x1 - t, y0, z0 + t), (x1, y1, z1 - t))]


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


def sheet(points: Array) -> Part:
    """Smooth surface through a grid of points [rows, columns, 3] m, facing columns x rows; uv in [0, 1] along both."""
    rows, columns = points.shape[:2]
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    v, u = np.mgrid[0:1:rows * 1j, 0:1:columns * 1j]
    i, j = (x.ravel() for x in np.mgrid[0:rows - 1, 0:columns - 1])
    a, b, c, d = i * columns + j, i * columns + j + 1, (i + 1) * columns + j + 1, (i + 1) * columns + j
    return Part(points.reshape(-1, 3), normals.reshape(-1, 3), np.stack([u, v], -1).reshape(-1, 2),
                np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def cushion(low: Vector, high: Vector, radius: float, puff: float = 0.0, steps: int = 5) -> Part:
    """Box from its corners with edges rounded by `radius`, its sides bulging by `puff` [m]; uv in metres from its middle."""
    lo, hi = np.asarray(low, float), np.asarray(high, float)
    middle, half, edge = (lo + hi) / 2, (hi - lo) / 2, radius * np.linspace(0, 1, steps)
    parts = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            s, t = (np.concatenate([edge - half[k], np.linspace(-1, 1, 9)[1:-1] * (half[k] - radius), half[k] - edge[::-1]])
                    for k in (u, v))
            p = np.empty((len(t), len(s), 3))
            p[..., u], p[..., v], p[..., axis] = s[None], t[:, None], side * half[axis]
            inner = np.clip(p, radius - half, half - radius)
            outwards = (p - inner) / np.linalg.norm(p - inner, axis=2, keepdims=True)
            p = inner + radius * outwards
            bulge = np.cos(np.pi / 2 * p[..., u] / half[u]) * np.cos(np.pi / 2 * p[..., v] / half[v])
            p[..., axis] += side * puff * bulge
            if side < 0:
                p, outwards = p[:, ::-1], outwards[:, ::-1]
            part = sheet(p)
            normals = part.normals if puff else outwards.reshape(-1, 3)
            parts.append(Part(part.vertices + middle, normals, part.vertices[:, [u, v]], part.faces))
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


def sunlight(irradiance: Vector, elevation: float, azimuth: float, rotation: Array) -> dict[str, Any]:
    """Directional light, into rooms whose windows look along +y before `rotation` [3, 3].

    Args:
        irradiance: RGB [W/m^2] of a surface that faces the sun.
        elevation: of the sun above the horizon [degrees].
        azimuth: between the sun and the windows' normal [degrees]; positive: it shines towards +x.
    """
    e, a = np.radians(elevation), np.radians(azimuth)
    direction = rotation @ (np.cos(e) * np.sin(a), -np.cos(e) * np.cos(a), -np.sin(e))
    return {"type": "directional", "direction": direction.tolist(), "irradiance": {"type": "rgb", "value": list(irradiance)}}
