"""What the camera and its paths see: the extent and the scale that records must resolve.

A scene may stand on a plain of 40 km, or hold one object that is far away.  The box around all surfaces then says nothing of
what the image shows.  So a few paths are traced before training, from the camera and without a guide.  Each vertex on a
surface that can be guided counts by the throughput of its path: by what light of it would bring to the image.  From these
vertices follow

* the *seen box*: along each axis, what holds all but `TAIL` of their weight on either side, enlarged by `MARGIN`, within the
  box of all surfaces;
* the *scale*, which the record radius is a share of: the diagonal of the seen box, but no more than `SEGMENTS` median segments.
  A room from whose window one sees a valley is as large as its paths are long;
* the *covered box*, over which look-up tables lie: all surfaces, if a table of moderate size can cover them, and else as much
  around the seen box as it can.  There are no records outside of it.
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport.cache import CELL, MOST_CELLS, Grid
from olpm_bench.transport.particles import emit_importons
from olpm_bench.transport.settings import UNBOUNDED_DEPTH

PATHS = 2 ** 14             # traced, from uniform points of the film
SEED = 2014                 # always the same: the extent is the scene's and the camera's, not that of one trial
MAX_VERTICES = 12           # kept of a path; later ones carry little
TAIL = 0.02                 # share of the weight beyond the quantiles, on either side of each axis
MARGIN = 1 / 6              # of the distance between the quantiles, added on either side
SEGMENTS = 10.0             # largest scale / median length of a segment; in rooms the diagonal is 4 to 11 of them
MIN_DIAGONAL = 1e-6         # of the seen box / that of all surfaces; of a smaller one float32 can't tell the points
MODERATE_CELLS = 2 ** 22    # of a table: 16 MB; or, for small records, ...
MODERATE_CUBES = 2.0        # ... as many as so many cubes have whose diagonal is the scale
HALVINGS = 40               # of the interval in which the covered box is sought
MAX_CLOSER = 1 / 3          # share of what is seen that may lie closer to the next surface than a record reaches
MAX_UNCOVERED = 0.05        # share of what is seen that may lie outside of the tables


@dataclass
class CameraVertices:
    """Vertices of unguided camera paths on surfaces that are not purely specular.

    position: [n, 3] scene units.
    weight: [n] luminance of the path's throughput, at most 1.
    segment: [n] length of the segment that continues the path [scene units]; infinite where it leaves the scene.
    """
    position: np.ndarray
    weight: np.ndarray
    segment: np.ndarray


@dataclass
class SeenExtent:
    """How large is what the camera and its paths see, and how much of it tables cover.

    box: the seen box.
    covered: the covered box, which holds it unless the table would be too large.
    scale: what `record_radius` is a share of [scene units].
    vertices: what it was measured from.
    """
    box: mi.ScalarBoundingBox3f
    covered: mi.ScalarBoundingBox3f
    scale: float
    vertices: CameraVertices

    @staticmethod
    def of(scene: mi.Scene, sensor: mi.Sensor, max_depth: int, bounds: mi.ScalarBoundingBox3f,
           record_radius: float) -> SeenExtent:
        """Measure it; where the camera sees no surface to guide from, it is that of all surfaces.

        Args:
            max_depth: longest camera path [segments]; -1: no limit.
            bounds: box around all surfaces.
            record_radius: largest radius of records, as a share of the scale.
        """
        vertices = camera_vertices(scene, sensor, max_depth)
        surfaces = np.array([bounds.min, bounds.max], float).reshape(2, 3)
        diagonal = np.linalg.norm(surfaces[1] - surfaces[0])
        if len(vertices.weight) == 0:
            return SeenExtent(bounds, bounds, float(diagonal), vertices)
        quantiles = [weighted_quantiles(x, vertices.weight, [TAIL, 0.5, 1 - TAIL]) for x in vertices.position.T]
        first, median, last = np.transpose(quantiles)
        margin = MARGIN * (last - first)
        seen = np.clip([first - margin, last + margin], *surfaces)
        scale = float(np.linalg.norm(seen[1] - seen[0]))
        if scale < MIN_DIAGONAL * diagonal:
            return SeenExtent(bounds, bounds, float(diagonal), vertices)
        segment = weighted_quantiles(vertices.segment, vertices.weight, [0.5])[0]
        scale = min(scale, SEGMENTS * float(segment))
        covered = _covered(surfaces, seen, median, record_radius, scale)
        return SeenExtent(_box(seen), _box(covered), scale, vertices)

    def contains(self, p: mi.Point3f) -> mi.Bool:
        """Whether points lie in the seen box.  Its corners are opaque: no kernel depends on them."""
        low, high = (mi.Point3f([dr.opaque(mi.Float, float(x)) for x in np.array(corner).ravel()])
                     for corner in (self.box.min, self.box.max))
        return dr.all((p >= low) & (p <= high))

    def warnings(self, radius: float) -> list[str]:
        """What is too small or too far away for records of a radius [scene units]."""
        weight, total = self.vertices.weight, self.vertices.weight.sum()
        said = []
        closer = weight[self.vertices.segment < radius].sum()
        if closer > MAX_CLOSER * total:
            fitting = weighted_quantiles(self.vertices.segment, weight, [MAX_CLOSER])[0] / self.scale
            said.append(f"records are too coarse: {closer / total:.0%} of what the camera's paths meet lies closer to the next "
                        f"surface than the radius of records, {radius:.2g}; make record_radius smaller than {fitting:.1g}")
        low, high = np.array(self.covered.min).ravel(), np.array(self.covered.max).ravel()
        outside = weight[((self.vertices.position < low) | (self.vertices.position > high)).any(1)].sum()
        if outside > MAX_UNCOVERED * total:
            said.append(f"{outside / total:.0%} of what the camera's paths meet lies too far from the rest for the tables of "
                        f"records of radius {radius:.2g}, and stays unguided; make record_radius larger")
        return said


@dr.syntax
def camera_vertices(scene: mi.Scene, sensor: mi.Sensor, max_depth: int) -> CameraVertices:
    """Trace `PATHS` unguided paths from uniform points of the film.

    Args:
        max_depth: longest path [segments]; -1: no limit.
    """
    rows = min(max(max_depth, 1) if max_depth >= 0 else UNBOUNDED_DEPTH, MAX_VERTICES)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, SEED), PATHS)
    ray = mi.Ray3f(emit_importons(sensor, sampler).ray)
    vertex = dr.zeros(mi.Float, 4 * rows * PATHS)
    segment = dr.full(mi.Float, dr.inf, (rows + 1) * PATHS)         # that leads to each vertex, and beyond the last
    lane, last = dr.arange(mi.UInt32, PATHS), dr.opaque(mi.UInt32, rows)
    ctx = mi.BSDFContext()
    throughput = mi.Spectrum(1)
    depth = mi.UInt32(0)
    active = mi.Bool(True)
    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        active &= si.is_valid()
        place = depth * PATHS + lane
        dr.scatter(segment, si.t, place, active)
        active &= depth < last
        bsdf = si.bsdf(ray)
        weight = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth), mi.luminance(throughput), 0)
        dr.scatter(vertex, mi.Vector4f(si.p.x, si.p.y, si.p.z, weight), place, active)
        bs, bsdf_weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        throughput *= bsdf_weight
        ray = si.spawn_ray(si.to_world(bs.wo))
        depth += 1
        active &= dr.max(throughput) > 0
    dr.eval(vertex, segment)
    found = vertex.numpy().reshape(-1, 4).astype(float)
    used = np.isfinite(found).all(1) & (found[:, 3] > 0)
    following = segment.numpy()[PATHS:].astype(float)
    return CameraVertices(found[used, :3], np.minimum(found[used, 3], 1), following[used])


def weighted_quantiles(values: np.ndarray, weights: np.ndarray, shares: list[float]) -> np.ndarray:
    """The values up to which these shares of the total weight lie [len(shares)]."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    index = np.searchsorted(sums, np.asarray(shares) * sums[-1])
    return values[order[np.minimum(index, len(order) - 1)]]


def _covered(surfaces: np.ndarray, seen: np.ndarray, median: np.ndarray, record_radius: float, scale: float) -> np.ndarray:
    """Corners of the covered box [2, 3].

    If all surfaces are too much, all sides move outwards alike from the seen box.  If that is too much already, they move
    inwards from it, towards the median.

    Args:
        surfaces, seen: corners of the boxes [2, 3].
        median: a point in the seen box [3].
    """
    edge = CELL * record_radius * scale
    cube = np.full(3, scale / 3 ** 0.5)
    cells = Grid.cells_over(cube, edge)         # at least those of the seen box, unless segments have limited the scale
    limit = max(MODERATE_CELLS, cells, min(MODERATE_CUBES * cells, MOST_CELLS))

    def fits(corners: np.ndarray) -> bool:
        return Grid.cells_over(corners[1] - corners[0], edge) <= limit

    def inwards(share: float) -> np.ndarray:
        return median + share * (seen - median)

    def outwards(share: float) -> np.ndarray:
        far = share * np.abs(surfaces - seen).max()
        return np.stack([np.maximum(seen[0] - far, surfaces[0]), np.minimum(seen[1] + far, surfaces[1])])

    if fits(surfaces):
        return surfaces
    box = outwards if fits(seen) else inwards
    fitting, too_large = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (fitting + too_large)
        if fits(box(middle)):
            fitting = middle
        else:
            too_large = middle
    return box(fitting)


def _box(corners: np.ndarray) -> mi.ScalarBoundingBox3f:
    return mi.ScalarBoundingBox3f(*(mi.ScalarPoint3f(*map(float, corner)) for corner in corners))
