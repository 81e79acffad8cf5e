"""A spatial cache of records on surfaces, with look-up in O(1).

A *record* is a surface point (position p, normal n, validity radius R) that stands for its neighbourhood.  The paper
keeps records in an octree and takes the one of smallest error  dist / r_max + 2 sqrt(1.001 - n.n')  [L]; that search
made its queries 9 times slower than those of a spatial tree (Mueller 2017).  Here space is cut into *cells*, voxels of
r_max / 2 times the six faces of the normal, and each cell in which particles have landed holds the index of
the best record for them.  A query reads its cell and checks the record it finds there.

Where that is too coarse a cell is *split* into 32, halved along x, y, z and both coordinates of its face, up to
`LEVELS` times: where a record is smaller than two edges of the cell, and where points in it miss the record that the
cell holds because their normals differ.  So a query reads its cell and at most `LEVELS` more.

Records grow where particles land: each newly met cell is represented by the first particle in it; a maximal
independent set of those that no record covers (no two within the smaller of their radii) become records.  When a record
shrinks, cells that it no longer covers and no other record does are given up, and the next particle in them starts anew.
All is decided by the order of particles and never by the scheduling of threads.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from olpm_bench.transport import headroom, npz
from olpm_bench.transport.settings import InputError
from representations.state import copied, join

MIN_COSINE = 0.751              # 2 sqrt(1.001 - n.n') <= 1: the largest angle between the normals of point and record [L]
NEAR_COSINE = 0.4               # of the normals of records that clamp each other's radii [L]
SAME = 0.9998                   # cosine between the normals of records that can share what they have learnt: 1 degree
SMALLEST = 0.1                  # smallest validity radius / r_max [L]
STEADY = 0.9                    # radii that would shrink to more than this part of what they are stay: fewer cells to redo
CELL = 0.5                      # edge of a voxel / r_max, and of a split one / validity radius
LEVELS = 3                      # times that a cell can be split
CHILDREN = 32
NEIGHBOURS = 8                  # nearest records among which the best for a cell is sought
LEAST = 2                       # fewer new cells or records wait: Dr.Jit compiles arrays of one entry to other kernels
FEW = 100                       # points that are still new after others have been served wait, ...
RARE = 1000                     # ... and those that are less than one of so many: to add a record costs as much as to add many
SMALLEST_RADIUS = 1e-15         # r_max [scene units], and 1 / the largest
MOST_CELLS = 2 ** 27            # of a table: 512 MB
MOST_RECORDS = 2 ** 17

# An entry of the table: SPLIT + block of children, or a record; UNKNOWN if it was chosen for another cell, or MISSING.
SPLIT, UNKNOWN, MISSING = 1 << 31, 1 << 30, (1 << 31) - 1


@dataclass
class Grid:
    """Voxels over a box times six normal directions.  Scalars are opaque: no kernel depends on them."""
    origin: mi.Point3f
    inverse_edge: mi.Float
    size: mi.Vector3u
    n_cells: int

    @staticmethod
    def over(bbox: mi.ScalarBoundingBox3f, edge: float) -> Grid:
        """Voxels of `edge` scene units; a little larger than the box, so that no surface lies on its border.

        Raises:
            InputError: more cells than a table may have.
        """
        low, extent = np.array(bbox.min).ravel() - 0.5 * edge, np.array(bbox.extents()).ravel()
        n_cells = Grid.cells_over(extent, edge)
        if n_cells > MOST_CELLS:
            raise InputError(f"records of this radius need a table of {n_cells:.1g} cells, {4e-9 * n_cells:.2g} GB: "
                             f"at most {MOST_CELLS:.1g}; make record_radius larger")
        headroom.require(2 * 4 * n_cells, f"the tables of a cache of {n_cells:.1g} cells", "make record_radius larger")
        size = Grid._voxels(extent, edge).astype(int)
        opaque = [dr.opaque(mi.Float, float(x)) for x in low], [dr.opaque(mi.UInt32, int(x)) for x in size]
        return Grid(mi.Point3f(opaque[0]), dr.opaque(mi.Float, 1 / edge), mi.Vector3u(opaque[1]), 6 * int(np.prod(size)))

    @staticmethod
    def _voxels(extent: np.ndarray, edge: float) -> np.ndarray:
        """Along each axis [3]; as floats, which do not overflow."""
        return np.maximum(np.ceil((extent + edge) / edge), 1).astype(float)

    @staticmethod
    def cells_over(extent: np.ndarray, edge: float) -> float:
        """Number of cells over a box of an extent [3, scene units] with voxels of `edge` scene units."""
        return 6 * float(np.prod(Grid._voxels(extent, edge)))

    def covers(self, p: mi.Point3f) -> mi.Bool:
        """Whether a point lies in one of the voxels."""
        x = mi.Vector3i(dr.floor((p - self.origin) * self.inverse_edge))
        return dr.all((x >= 0) & (x < mi.Vector3i(self.size)))

    def coordinates(self, p: mi.Point3f, level: int = 0) -> mi.Vector3u:
        """Voxel of a point, of edges halved `level` times; points that no voxel covers go to the border."""
        x = mi.Vector3i(dr.floor((p - self.origin) * self.inverse_edge * 2 ** level))
        return mi.Vector3u(dr.clip(x, 0, (mi.Vector3i(self.size) << level) - 1))

    def voxel(self, p: mi.Point3f) -> mi.UInt32:
        """Index of that voxel; neighbours along x follow one another."""
        x = self.coordinates(p)
        return x.x + self.size.x * (x.y + self.size.y * x.z)

    def cell(self, p: mi.Point3f, n: mi.Normal3f) -> mi.UInt32:
        """Index of the cell of a point and normal: six faces a voxel."""
        axis, along, _, _ = _face(n)
        return 2 * axis + dr.select(along < 0, mi.UInt32(1), 0) + 6 * self.voxel(p)

    def child(self, p: mi.Point3f, n: mi.Normal3f, level: mi.UInt32 | int) -> mi.UInt32:
        """Which child of its cell, split `level` times, holds a point and normal: a bit for each of x, y, z, u, v."""
        _, along, u, v = _face(n)
        scale = 2 ** (LEVELS - 1) / dr.abs(along)
        face = (mi.UInt32(dr.clip(mi.Int32(x * scale + 2 ** (LEVELS - 1)), 0, 2 ** LEVELS - 1)) for x in (u, v))
        shift, child = LEVELS - 1 - mi.UInt32(level), mi.UInt32(0)
        for i, x in enumerate((*self.coordinates(p, LEVELS), *face)):
            child |= ((x >> shift) & 1) << i
        return child


def _face(n: mi.Normal3f) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Float]:
    """The axis closest to a normal, the normal's component along it, and the other two in order."""
    a = dr.abs(n)
    x, y = (a.x >= a.y) & (a.x >= a.z), a.y >= a.z
    axis = dr.select(x, mi.UInt32(0), dr.select(y, mi.UInt32(1), 2))
    along = dr.select(x, n.x, dr.select(y, n.y, n.z))
    return axis, along, dr.select(x, n.y, n.x), dr.select(x | y, n.z, n.y)


@dataclass
class Cells:
    """The occupied cells, each with the point that represents it."""
    slot: np.ndarray        # [n] uint32: of the table
    level: np.ndarray       # [n] uint8: times split
    path: np.ndarray        # [n] uint16: which child holds the point, and which child of that, 5 bits a level
    record: np.ndarray      # [n] uint32: the best for the point
    point: np.ndarray       # [n, 6] float32: p, n

    @staticmethod
    def none() -> Cells:
        return Cells(np.zeros(0, np.uint32), np.zeros(0, np.uint8), np.zeros(0, np.uint16), np.zeros(0, np.uint32),
                     np.zeros((0, 6), np.float32))

    def __len__(self) -> int:
        return len(self.slot)

    def take(self, which: np.ndarray) -> Cells:
        return Cells(*(field[which] for field in vars(self).values()))

    def and_then(self, more: Cells) -> Cells:
        return Cells(*(np.concatenate([vars(self)[name], vars(more)[name]]) for name in vars(self)))


class RecordCache:
    """Records and the table that finds them; the same class holds radiance and importance records.

    Args:
        bbox: the box that the table covers; no record is added outside of it.
        record_radius: largest validity radius r_max, with which records begin, as a share of the scale.
        scale: that of what records must resolve [scene units], see `SeenExtent`; None: the diagonal of the box.
    """

    def __init__(self, bbox: mi.ScalarBoundingBox3f, record_radius: float, scale: float | None = None) -> None:
        self.bbox, self.record_radius = bbox, record_radius
        self.scale = float(dr.norm(bbox.extents())) if scale is None else scale
        self.radius = record_radius * self.scale                    # r_max [scene units]
        if not SMALLEST_RADIUS < self.radius < 1 / SMALLEST_RADIUS:
            raise InputError(f"records of radius {self.radius:.2g}: scenes must be of a size whose square float32 can hold")
        self.grid = Grid.over(bbox, CELL * self.radius)
        self.table = dr.full(mi.UInt32, MISSING, self.grid.n_cells)  # [n_cells + CHILDREN * blocks]
        self.n_roots = dr.opaque(mi.UInt32, self.grid.n_cells)
        self.rows = dr.zeros(mi.Float, 0)                           # [n * 8] p, squared reach, n, R
        self.points = np.zeros((0, 6), np.float32)                  # records: p, n, ...
        self.radii = np.zeros(0, np.float32)                        # ... R [scene units]
        self.cells = Cells.none()
        self.full = False                                           # more are wanted than there can be

    def __len__(self) -> int:
        return len(self.points)

    def row(self, record: mi.UInt32, active: mi.Bool = True) -> tuple[mi.Point3f, mi.Normal3f, mi.Float, mi.Float]:
        """Position, normal (the n of its frame), squared reach and validity radius of records.

        A point may lie a cell's diagonal farther from its record than the one that represents the cell.
        """
        row = dr.gather(mi.ArrayXf, self.rows, record, active, shape=(8, dr.width(record)))
        return mi.Point3f(row[0], row[1], row[2]), mi.Normal3f(row[4], row[5], row[6]), row[3], row[7]

    def lookup(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Normal3f, mi.Bool]:
        """The record that serves a point with its normal: (index, the record's normal, whether there is one)."""
        if len(self) == 0:
            return mi.UInt32(0), mi.Normal3f(0, 0, 1), mi.Bool(False)
        return self._check(self._descend(p, n, active)[1], p, n, active)

    @dr.syntax
    def _descend(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32, mi.UInt32]:
        """The cell of a point, the last that is not split: its slot of the table, the entry, its level."""
        slot, level = self.grid.cell(p, n), mi.UInt32(0)
        entry = dr.gather(mi.UInt32, self.table, slot, active)
        while dr.hint(active & (entry >= SPLIT), mode="symbolic", label="split cells"):
            slot = (entry ^ SPLIT) * CHILDREN + self.grid.child(p, n, level) + self.n_roots
            entry = dr.gather(mi.UInt32, self.table, slot)
            level += 1
        return slot, entry, level

    def _check(self, entry: mi.UInt32, p: mi.Point3f, n: mi.Normal3f,
               active: mi.Bool) -> tuple[mi.UInt32, mi.Normal3f, mi.Bool]:
        """Whether the record of a cell serves a point: as `lookup`."""
        found = active & (entry != MISSING)
        record = dr.select(found, entry & (UNKNOWN - 1), 0)
        position, normal, reach2, _ = self.row(record, found)
        near = dr.squared_norm(p - position) <= reach2
        return record, normal, found & near & (dr.dot(n, normal) >= MIN_COSINE)

    # ---------------------- Growth ----------------------

    def grow(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> int:
        """Add records for the points in the box that have none; returns how many.  Existing records keep their index."""
        active = active & self.grid.covers(p)
        before, few = len(self), max(LEAST, dr.width(p) // RARE)
        for i in range(LEVELS + 1):             # a cell may have to be split, and its child, and so on
            new = dr.compress(self._is_new(p, n, active))
            if len(new) < max(few, FEW if i else 0):
                break
            p, n, active = dr.gather(mi.Point3f, p, new), dr.gather(mi.Normal3f, n, new), mi.Bool(True)
            slot, entry, level = self._descend(p, n, active)
            path = sum(self.grid.child(p, n, i) << 5 * i for i in range(LEVELS))
            known = (entry & UNKNOWN) == 0
            first = dr.full(mi.UInt32, MISSING, len(self.table))
            # `Local`: by default each thread reduces into a copy of its own, whose size is compiled into the kernel.
            dr.scatter_reduce(dr.ReduceOp.Min, first, dr.arange(mi.UInt32, len(new)), slot, mode=dr.ReduceMode.Local)
            first = dr.gather(mi.UInt32, first, dr.compress(first != MISSING))
            if len(first) < LEAST:
                break
            # By component: to turn a whole vector into NumPy compiles its length into a kernel.
            slots, levels, paths, occupied, *point = (dr.gather(type(x), x, first).numpy()
                                                      for x in (slot, level, path, known, *p, *n))
            if occupied.any():                  # their records do not suit all points in them
                order = np.argsort(self.cells.slot)
                self._split(order[np.searchsorted(self.cells.slot, slots[occupied], sorter=order)])
            self._enter(Cells(slots, levels.astype(np.uint8), paths.astype(np.uint16), np.zeros(len(slots), np.uint32),
                              np.stack(point, axis=1)).take(~occupied))
        return len(self) - before

    def _is_new(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> mi.Bool:
        """Whether the cell of a point is not occupied, or holds a record that does not suit the point and can be split."""
        _, entry, level = self._descend(p, n, active)
        known = active & ((entry & UNKNOWN) == 0)
        if len(self) == 0:
            return active & ~known
        return active & (~known | (~self._check(entry, p, n, known)[2] & (level < LEVELS)))

    def shrink(self, radius: np.ndarray) -> None:
        """Let the first n records shrink to a radius [n, scene units], or to `SMALLEST`; they never grow."""
        radius = np.maximum(radius, SMALLEST * self.radius).astype(np.float32)
        smaller = np.zeros(len(self), bool)
        smaller[:len(radius)] = radius < STEADY * self.radii[:len(radius)]
        self.radii[smaller] = radius[smaller[:len(radius)]]
        if smaller.any():
            self._assign(smaller[self.cells.record])

    def clamped(self, points: np.ndarray, own: bool = False) -> np.ndarray:
        """R_near of points [n, 6]: the least distance + R over their nearest records that face alike, at most r_max [L].

        Args:
            own: the points are the records themselves, who do not clamp themselves.
        """
        near = np.full(len(points), self.radius)
        k = min(NEIGHBOURS + own, len(self))
        if k <= own or len(points) == 0:
            return near
        index, distance, cosine = nearest_points(self.points, points, k, self.radius)
        neighbour = (cosine > NEAR_COSINE) & (~own | (index != np.arange(len(points))[:, None]))
        return np.minimum(near, np.where(neighbour, distance + self.radii[index], np.inf).min(1))

    def parents(self, first: int) -> np.ndarray:
        """Of each record from number `first` on, the nearest older one within r_max and with the same frame; -1 without."""
        old, new = self.points[:first], self.points[first:]
        if len(old) == 0 or len(new) == 0:
            return np.full(len(new), -1)
        index, distance, cosine = (x[:, 0] for x in nearest_points(old, new, 1, self.radius))
        same = (cosine > SAME) & (np.signbit(new[:, 5]) == np.signbit(old[index, 5]))   # tangents leap where n.z changes sign
        return np.where(same & (distance <= self.radius), index, -1)

    def _enter(self, cells: Cells) -> None:
        """Occupy cells, and add the records that they need."""
        if len(cells) == 0:
            return
        uncovered = self._best(cells.point)[1] == np.inf
        radius = self.clamped(cells.point).astype(np.float32)
        added = _independent(cells.point, uncovered, radius)
        if len(self) + len(added) > MOST_RECORDS:
            self.full = True
            added = added[:MOST_RECORDS - len(self)]
        added = added[:0] if len(added) < LEAST else added              # a single one waits
        self.points = np.concatenate([self.points, cells.point[added]])
        self.radii = np.concatenate([self.radii, radius[added]])
        # New cells need a record, and so do old ones with an added record near them: it may be better.
        stale = np.concatenate([_near(self.cells.point, cells.point[added], self.radius), np.ones(len(cells), bool)])
        self.cells = self.cells.and_then(cells)
        self._assign(stale)

    def _best(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Per point, the record of smallest error that covers it, and that error (inf where none does)."""
        k = min(NEIGHBOURS, len(self))
        if k == 0 or len(points) == 0:
            return np.zeros(len(points), np.intp), np.full(len(points), np.inf)
        index, distance, cosine = nearest_points(self.points, points, k, self.radius)
        covers = (cosine >= MIN_COSINE) & (distance <= self.radii[index])
        error = np.where(covers, distance / self.radius + 2 * np.sqrt(np.maximum(1.001 - cosine, 0)), np.inf)
        best = np.argmin(error, axis=1, keepdims=True)
        return np.take_along_axis(index, best, 1)[:, 0], np.take_along_axis(error, best, 1)[:, 0]

    def _assign(self, stale: np.ndarray) -> None:
        """Enter into the `stale` ones of the occupied cells the best record for the point that represents each.

        Cells that none covers are given up; those that are large for their record are split.
        """
        record, error = self._best(self.cells.point[stale])
        self.cells.record[stale] = np.where(error < np.inf, record, MISSING)
        self._write(self.cells.slot[stale], self.cells.record[stale])
        self.cells = self.cells.take(self.cells.record != MISSING)
        levels = self._levels()
        while (large := self.cells.level < levels[self.cells.record]).any():
            self._split(np.flatnonzero(large))
        rows = np.zeros((len(self), 8), np.float32)
        rows[:, :3], rows[:, 4:7], rows[:, 7] = self.points[:, :3], self.points[:, 3:], self.radii
        rows[:, 3] = (self.radii + 3 ** 0.5 * CELL * self.radius * 0.5 ** levels) ** 2
        self.rows = copied(mi.Float, rows.ravel())
        dr.eval(self.rows)

    def _levels(self) -> np.ndarray:
        """How often the cells of each record are split, at least [n]."""
        return np.clip(np.ceil(np.log2(self.radius / self.radii) - 1e-3), 0, LEVELS).astype(np.uint8)

    def _split(self, which: np.ndarray) -> None:
        """Split occupied cells: all children inherit the record, the one with the point that represents the cell keeps it."""
        cells, old = self.cells.take(which), len(self.table)
        block = (old - self.grid.n_cells) // CHILDREN + np.arange(len(cells), dtype=np.uint32)
        slot = old + CHILDREN * np.arange(len(cells)) + (cells.path >> 5 * cells.level & (CHILDREN - 1))
        children = np.repeat(cells.record | UNKNOWN, CHILDREN).astype(np.uint32)
        children[slot - old] = cells.record
        self.table = join(self.table, copied(mi.UInt32, children))
        self._write(cells.slot, block | SPLIT)
        self.cells.slot[which] = slot
        self.cells.level[which] += 1

    def _write(self, slot: np.ndarray, entry: np.ndarray) -> None:
        """Entries of the table; a single one twice."""
        if len(slot) == 1:
            slot, entry = np.repeat(slot, 2), np.repeat(entry, 2)
        if len(slot):
            dr.scatter(self.table, copied(mi.UInt32, entry.astype(np.uint32)), copied(mi.UInt32, slot))
        dr.eval(self.table)

    # ---------------------- Files ----------------------

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Everything needed to rebuild the cache, for files."""
        table = self.table.numpy()
        used = np.flatnonzero(table != MISSING).astype(np.uint32)
        return {"bbox": np.array([np.array(self.bbox.min).ravel(), np.array(self.bbox.max).ravel()]),
                "record_radius": np.array(self.record_radius), "scale": np.array(self.scale),
                "points": self.points, "radii": self.radii,
                "table_size": np.array(len(table)), "table_used": used, "table_entries": table[used],
                **{f"cells_{name}": field for name, field in vars(self.cells).items()}}

    @staticmethod
    def from_numpy(arrays: dict[str, Any]) -> RecordCache:
        """The cache that `to_numpy` described.

        Raises:
            ValueError: nothing that it describes; InputError: its table would be too large.
        """
        bounds, record_radius = npz.checked(arrays, "bbox", np.float32, 2, 3), float(arrays["record_radius"])
        npz.require(np.isfinite(bounds).all() and (bounds[0] <= bounds[1]).all() and (bounds[0] < bounds[1]).any(), "bbox")
        npz.require(0 < record_radius <= 0.25, "record_radius")
        bbox = mi.ScalarBoundingBox3f(*(mi.ScalarPoint3f(*map(float, corner)) for corner in bounds))
        scale = float(arrays["scale"]) if "scale" in arrays else None       # older files have none
        npz.require(scale is None or 0 < scale < np.inf, "scale")
        cache = RecordCache(bbox, record_radius, scale)
        n, m = len(arrays["points"]), len(arrays["cells_slot"])
        cache.points = npz.checked(arrays, "points", np.float32, n, 6)
        cache.radii = npz.checked(arrays, "radii", np.float32, n)
        cache.cells = Cells(**{name: npz.checked(arrays, f"cells_{name}", field.dtype, m, *field.shape[1:])
                               for name, field in vars(cache.cells).items()})
        npz.require(n <= MOST_RECORDS and np.isfinite(cache.points).all(), "points")
        npz.require(((cache.radii > 0) & (cache.radii <= 1.001 * cache.radius)).all(), "radii")
        if len(cache):
            table = cache._stored_table(arrays)
            cells = cache.cells
            npz.require((cells.slot < len(table)).all() and (cells.level <= LEVELS).all() and (cells.record < n).all()
                        and np.isfinite(cells.point).all(), "cells")
            cache.table = copied(mi.UInt32, table)
            cache._assign(np.zeros(len(cache.cells), bool))
        return cache

    def _stored_table(self, arrays: dict[str, Any]) -> np.ndarray:
        """The table that `to_numpy` described, if all that look-ups read in it exists."""
        size, roots, k = int(arrays["table_size"]), self.grid.n_cells, len(arrays["table_used"])
        used = npz.checked(arrays, "table_used", np.uint32, k)
        entries = npz.checked(arrays, "table_entries", np.uint32, k)
        blocks = (size - roots) // CHILDREN
        npz.require(0 <= blocks <= MOST_CELLS // CHILDREN and size == roots + CHILDREN * blocks, "table_size")
        npz.require((used < size).all(), "table_used")
        split = entries >= SPLIT
        npz.require((entries[split] ^ SPLIT < blocks).all(), "table_entries")
        npz.require((entries[~split] & (UNKNOWN - 1) < len(self)).all(), "table_entries")
        table = np.full(size, MISSING, np.uint32)
        table[used] = entries
        read = table[:roots]
        for _ in range(LEVELS + 1):
            below = np.unique(read[read >= SPLIT]) ^ SPLIT
            read = table[roots:].reshape(blocks, CHILDREN)[below].ravel()
        npz.require(len(read) == 0, "table_entries")              # cells are split so often at most
        return table


def nearest_points(points: np.ndarray, queries: np.ndarray, k: int, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The k nearest of points [n, 6] to each query: indices, distances, cosines between normals [queries, k].

    Nearest by distance / radius and 2 sqrt(1 - n.n') as two sides of a right angle: those behind a thin wall are far.
    """
    points, queries = (np.hstack([x[:, :3] / radius, 2 ** 0.5 * x[:, 3:]]) for x in (points, queries))
    _, index = cKDTree(points).query(queries, k=[*range(1, k + 1)], workers=dr.thread_count())
    near = points[index]
    return (index, radius * np.linalg.norm(near[..., :3] - queries[:, None, :3], axis=2),
            0.5 * np.einsum("ij,ikj->ik", queries[:, 3:], near[..., 3:]))


def _near(points: np.ndarray, others: np.ndarray, radius: float) -> np.ndarray:
    """Mask of the points with one of the others within `radius`."""
    if len(points) == 0 or len(others) == 0:
        return np.zeros(len(points), bool)
    return np.isfinite(cKDTree(others[:, :3]).query(points[:, :3], distance_upper_bound=radius, workers=dr.thread_count())[0])


def _independent(points: np.ndarray, candidates: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Indices of a maximal set of candidate points of which no two lie within the smaller of their radii with similar normals.

    By octaves of the radius, the largest first, so that few pairs are looked at.  In each, Luby's algorithm (1986):
    in each round the candidates that precede all their neighbours are chosen and their neighbours leave.  The precedence
    is a fixed hash of the index.
    """
    chosen = np.zeros(0, np.intp)
    octave = np.full(len(points), -1)
    octave[candidates] = np.floor(np.log2(radius.max(initial=1) / radius[candidates]))
    for i in range(octave.max(initial=-1) + 1):
        index = np.flatnonzero(octave == i)
        index = index[~_covered(points, index, chosen, radius)]
        chosen = np.concatenate([chosen, index[_luby(points[index], radius[index])]])
    return chosen


def _covered(points: np.ndarray, index: np.ndarray, chosen: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Mask of the points `index` with one of the `chosen`, of similar normal, within their radius [len(index)]."""
    if len(index) == 0 or len(chosen) == 0:
        return np.zeros(len(index), bool)
    k = min(NEIGHBOURS, len(chosen))
    _, distance, cosine = nearest_points(points[chosen], points[index], k, radius.max())
    return np.any((distance <= radius[index, None]) & (cosine >= MIN_COSINE), axis=1)


def _luby(points: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Mask of a maximal independent set of points of like radii."""
    pairs = cKDTree(points[:, :3]).query_pairs(radius.max(initial=0), output_type="ndarray")
    a, b = points[pairs[:, 0]], points[pairs[:, 1]]
    close = np.linalg.norm(a[:, :3] - b[:, :3], axis=1) <= radius[pairs].min(1)
    pairs = pairs[close & (np.einsum("ij,ij->i", a[:, 3:], b[:, 3:]) >= MIN_COSINE)]
    rank = np.random.default_rng(0).permutation(len(points))
    chosen, undecided = np.zeros(len(points), bool), np.ones(len(points), bool)
    while undecided.any():
        pairs = pairs[undecided[pairs].all(1)]
        lowest = np.full(len(points), len(points))
        np.minimum.at(lowest, pairs.ravel(), rank[pairs[:, ::-1]].ravel())
        new = undecided & (rank < lowest)
        chosen |= new
        undecided &= ~new
        undecided[pairs[new[pairs[:, 0]], 1]] = False
        undecided[pairs[new[pairs[:, 1]], 0]] = False
    return chosen
