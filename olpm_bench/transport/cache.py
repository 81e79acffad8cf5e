"""A spatial cache of records on surfaces, with look-up in O(1).

A *record* is a surface point (position p, normal n, validity radius R) that stands for its neighbourhood.  The paper
keeps records in an octree and takes the one of smallest error  dist / r_max + 2 sqrt(1.001 - n.n')  [L]; that search
made its queries 9 times slower than those of a spatial tree (Mueller 2017).  Here space is cut into *cells*, voxels of
r_max / 2 times the six faces of the normal, and each cell in which particles have landed holds the index of
the best record for them.  A query reads its cell and checks the record it finds there.

Records grow where particles land: each newly met cell is represented by the first particle in it; a maximal
independent set of those that no record covers (no two within R of each other) become records.  All is decided by the
order of particles and never by the scheduling of threads.

Simpler than the paper: R is the same for all records, and they do not shrink near sources or where lobes are sharp.
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from olpm_bench.transport.settings import InputError

MISSING = 0xFFFFFFFF            # cell without a record
MIN_COSINE = 0.751              # 2 sqrt(1.001 - n.n') <= 1: the largest angle between the normals of point and record [L]
CELL = 0.5                      # edge of a voxel / validity radius
REACH = 1 + CELL * 3 ** 0.5     # a cell within R of its record may extend by its own diagonal beyond
NEIGHBOURS = 8                  # nearest records among which the best for a cell is sought
LEAST = 2                       # fewer new cells or records wait: Dr.Jit compiles arrays of one entry to other kernels
MOST_CELLS = 2 ** 27            # of a table: 512 MB


@dataclass
class Grid:
    """Voxels over the scene's bounding box times six normal directions.  Scalars are opaque: no kernel depends on them."""
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
        low, extent = np.array(bbox.min).ravel() - 0.5 * edge, np.array(bbox.extents()).ravel() + edge
        size = np.maximum(np.ceil(extent / edge), 1).astype(int)
        if 6 * np.prod(size.astype(float)) > MOST_CELLS:
            raise InputError(f"records of this radius need a table of {6 * np.prod(size.astype(float)):.1g} cells: "
                             f"at most {MOST_CELLS:.1g}; make record_radius larger")
        opaque = [dr.opaque(mi.Float, float(x)) for x in low], [dr.opaque(mi.UInt32, int(x)) for x in size]
        return Grid(mi.Point3f(opaque[0]), dr.opaque(mi.Float, 1 / edge), mi.Vector3u(opaque[1]), 6 * int(np.prod(size)))

    def coordinates(self, p: mi.Point3f) -> mi.Vector3u:
        """Voxel of a point; points outside the box go to its border."""
        x = mi.Vector3i(dr.floor((p - self.origin) * self.inverse_edge))
        return mi.Vector3u(dr.clip(x, 0, mi.Vector3i(self.size) - 1))

    def voxel(self, p: mi.Point3f) -> mi.UInt32:
        """Index of that voxel; neighbours along x follow one another."""
        x = self.coordinates(p)
        return x.x + self.size.x * (x.y + self.size.y * x.z)

    def cell(self, p: mi.Point3f, n: mi.Normal3f) -> mi.UInt32:
        """Index of the cell of a point and normal: six faces a voxel."""
        a = dr.abs(n)
        axis = dr.select((a.x >= a.y) & (a.x >= a.z), mi.UInt32(0), dr.select(a.y >= a.z, mi.UInt32(1), 2))
        sign = dr.select(axis == 0, n.x, dr.select(axis == 1, n.y, n.z)) < 0
        face = 2 * axis + dr.select(sign, mi.UInt32(1), 0)
        return face + 6 * self.voxel(p)


class RecordCache:
    """Records and the table that finds them; the same class holds radiance and importance records.

    Args:
        bbox: the scene's bounding box.
        record_radius: validity radius R in units of the box's diagonal.
    """

    def __init__(self, bbox: mi.ScalarBoundingBox3f, record_radius: float) -> None:
        self.bbox, self.record_radius = bbox, record_radius
        self.radius = record_radius * float(dr.norm(bbox.extents()))         # [scene units]
        self.grid = Grid.over(bbox, CELL * self.radius)
        self.table = dr.full(mi.UInt32, MISSING, self.grid.n_cells)
        self.rows = dr.zeros(mi.Float, 0)                           # [n * 8] p, squared reach, n, unused
        self.points = np.zeros((0, 6), np.float32)                  # records: p, n
        self.cells = np.zeros(0, np.uint32)                         # occupied cells, ...
        self.cell_points = np.zeros((0, 6), np.float32)             # ... and the point that represents each

    def __len__(self) -> int:
        return len(self.points)

    def row(self, record: mi.UInt32, active: mi.Bool = True) -> tuple[mi.Point3f, mi.Normal3f, mi.Float]:
        """Position, normal (the n of its frame) and squared reach of records."""
        row = dr.gather(mi.ArrayXf, self.rows, record, active, shape=(8, dr.width(record)))
        return mi.Point3f(row[0], row[1], row[2]), mi.Normal3f(row[4], row[5], row[6]), row[3]

    def lookup(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> tuple[mi.UInt32, mi.Normal3f, mi.Bool]:
        """The record that serves a point with its normal: (index, the record's normal, whether there is one)."""
        if len(self) == 0:
            return mi.UInt32(0), mi.Normal3f(0, 0, 1), mi.Bool(False)
        record = dr.gather(mi.UInt32, self.table, self.grid.cell(p, n), active)
        found = active & (record != MISSING)
        position, normal, reach2 = self.row(record, found)
        near = dr.squared_norm(p - position) <= reach2
        return dr.select(found, record, 0), normal, found & near & (dr.dot(n, normal) >= MIN_COSINE)

    def grow(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> int:
        """Add records for the points in cells that have none; returns how many.  Existing records keep their index."""
        cell = self.grid.cell(p, n)
        new = dr.compress(active & (dr.gather(mi.UInt32, self.table, cell, active) == MISSING))
        if len(new) < LEAST:
            return 0
        cell = dr.gather(mi.UInt32, cell, new)
        first = dr.full(mi.UInt32, MISSING, self.grid.n_cells)
        dr.scatter_reduce(dr.ReduceOp.Min, first, new, cell)
        cells = dr.compress(first != MISSING)
        if len(cells) < LEAST:
            return 0
        representative = dr.gather(mi.UInt32, first, cells)
        # By component: to turn a whole vector into NumPy compiles its length into a kernel.
        points = np.stack([dr.gather(mi.Float, x, representative).numpy() for x in (*p, *n)], axis=1)
        uncovered = self._best(points)[1] > self.radius
        added = points[_independent(points, uncovered, self.radius)]
        known = np.ones(len(points), bool)
        if len(added) < LEAST:
            added, known = added[:0], ~uncovered            # their cells stay new
        # New cells need a record, and so do old ones with an added record near them: it may be better.
        stale = np.concatenate([_near(self.cell_points, added, self.radius), np.ones(known.sum(), bool)])
        self.cells = np.concatenate([self.cells, cells.numpy()[known]])
        self.cell_points = np.concatenate([self.cell_points, points[known]])
        self.points = np.concatenate([self.points, added])
        self._tabulate(stale)
        return len(added)

    def _best(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Per point, the record of smallest error and its distance (inf where no normal fits)."""
        k = min(NEIGHBOURS, len(self))
        if k == 0 or len(points) == 0:
            return np.zeros(len(points), np.intp), np.full(len(points), np.inf)
        distance, index = cKDTree(self.points[:, :3]).query(points[:, :3], k=[*range(1, k + 1)], workers=dr.thread_count())
        cosine = np.einsum("ij,ikj->ik", points[:, 3:], self.points[index, 3:])
        error = np.where(cosine >= MIN_COSINE, distance / self.radius + 2 * np.sqrt(np.maximum(1.001 - cosine, 0)), np.inf)
        best = np.argmin(error, axis=1, keepdims=True)
        distance = np.where(np.isfinite(np.take_along_axis(error, best, 1)), np.take_along_axis(distance, best, 1), np.inf)
        return np.take_along_axis(index, best, 1)[:, 0], distance[:, 0]

    def _tabulate(self, stale: np.ndarray) -> None:
        """Enter into the `stale` ones of the occupied cells the best record for the point that represents each."""
        record, distance = self._best(self.cell_points[stale])
        entry = np.where(distance <= self.radius, record, MISSING).astype(np.uint32)
        dr.scatter(self.table, _copied(mi.UInt32, entry), _copied(mi.UInt32, self.cells[stale]))
        rows = np.zeros((len(self), 8), np.float32)
        rows[:, :3], rows[:, 3], rows[:, 4:7] = self.points[:, :3], (REACH * self.radius) ** 2, self.points[:, 3:]
        self.rows = _copied(mi.Float, rows.ravel())
        dr.eval(self.table, self.rows)

    def to_numpy(self) -> dict[str, np.ndarray]:
        """Everything needed to rebuild the cache, for files."""
        return {"bbox": np.array([np.array(self.bbox.min).ravel(), np.array(self.bbox.max).ravel()]), "record_radius":
                np.array(self.record_radius), "points": self.points, "cells": self.cells, "cell_points": self.cell_points}

    @staticmethod
    def from_numpy(arrays: dict[str, Any]) -> RecordCache:
        """The cache that `to_numpy` described."""
        bbox = mi.ScalarBoundingBox3f(*(mi.ScalarPoint3f(*map(float, corner)) for corner in arrays["bbox"]))
        cache = RecordCache(bbox, float(arrays["record_radius"]))
        cache.points, cache.cells, cache.cell_points = (arrays[k] for k in ("points", "cells", "cell_points"))
        if len(cache):
            cache._tabulate(np.ones(len(cache.cells), bool))
        return cache


def _copied(dtype: Any, array: np.ndarray) -> Any:
    """In Dr.Jit's own memory: NumPy's is aligned now this way, now that, and each way compiles other kernels."""
    copy = dr.gather(dtype, dtype(array), dr.arange(mi.UInt32, len(array)))
    dr.eval(copy)
    return copy


def _near(points: np.ndarray, others: np.ndarray, radius: float) -> np.ndarray:
    """Mask of the points with one of the others within `radius`."""
    if len(points) == 0 or len(others) == 0:
        return np.zeros(len(points), bool)
    return np.isfinite(cKDTree(others[:, :3]).query(points[:, :3], distance_upper_bound=radius)[0])


def _independent(points: np.ndarray, candidates: np.ndarray, radius: float) -> np.ndarray:
    """Indices of a maximal set of candidate points of which no two lie within `radius` with similar normals.

    Luby's algorithm (1986): in each round the candidates that precede all their neighbours are chosen and their
    neighbours leave.  The precedence is a fixed hash of the index.
    """
    index = np.flatnonzero(candidates)
    pairs = cKDTree(points[index, :3]).query_pairs(radius, output_type="ndarray")
    pairs = pairs[np.einsum("ij,ij->i", points[index[pairs[:, 0]], 3:], points[index[pairs[:, 1]], 3:]) >= MIN_COSINE]
    rank = np.random.default_rng(0).permutation(len(index))
    chosen, undecided = np.zeros(len(index), bool), np.ones(len(index), bool)
    while undecided.any():
        pairs = pairs[undecided[pairs].all(1)]
        lowest = np.full(len(index), len(index))
        np.minimum.at(lowest, pairs.ravel(), rank[pairs[:, ::-1]].ravel())
        new = undecided & (rank < lowest)
        chosen |= new
        undecided &= ~new
        undecided[pairs[new[pairs[:, 0]], 1]] = False
        undecided[pairs[new[pairs[:, 1]], 0]] = False
    return index[chosen]
