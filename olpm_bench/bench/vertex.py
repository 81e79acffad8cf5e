"""What a camera path meets at a vertex: where its light comes from, and how the densities that sample it look.

Learnt densities are to be proportional to  L_i cos  without the share that next-event estimation takes.  So the truth here is

    L_i = indirect radiance + w Le,        w: the share of an emitter's light that camera paths teach (`camera_paths.wanted`)

or, where the guide does not know what the surface reflects, the power heuristic of the BSDF's density against next-event
estimation; one truth for all methods.  (Photons leave direct light out.)

Everything is given on `n` x `n` bins of equal solid angle, those of the concentric square map, in the frame of the vertex: the
geometric normal on the incident side is z, and y points up in the image.
"""
from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport import mis
from olpm_bench.transport.camera_paths import wanted
from olpm_bench.transport.camera_rays import sample_ray
from olpm_bench.transport.gather import Gathered
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.guided_bsdf import GuidedBSDF, incident_normal
from olpm_bench.transport.settings import UNBOUNDED_DEPTH, InputError, IntegratorSettings
from representations import square

BINS = 64               # along an edge of the square: 1.5 msr, 2.2 degrees
FINE = 4                # densities are evaluated at FINE x FINE points of a bin
STRATA = 8              # a pass of the truth traces STRATA x STRATA paths a bin
NEGLIGIBLE = 1e-5       # share of the light that a density may miss: bins on the rim of a BSDF are in part beyond it


@dataclass(frozen=True)
class Vertex:
    """A surface point of a path, and the ray that arrives there.

    number: 1 at the first surface.
    o, d: origin and direction of the ray [3].
    p: the point; frame: rows x, y, z [3, 3], see above.
    mirror: mirror direction of the ray about the shading normal, in the frame [3].
    smooth: the BSDF is not purely specular.
    shape: its name in the scene.
    """
    number: int
    o: np.ndarray
    d: np.ndarray
    p: np.ndarray
    frame: np.ndarray
    mirror: np.ndarray
    smooth: bool
    shape: str

    @property
    def view(self) -> np.ndarray:
        """Where the path came from, in the frame."""
        return self.frame @ -self.d

    def interaction(self, scene: mi.Scene, width: int) -> tuple[mi.Ray3f, mi.SurfaceInteraction3f]:
        """The ray and what it meets, in so many lanes."""
        o, d = ([dr.opaque(mi.Float, float(x), width) for x in v] for v in (self.o, self.d))
        ray = mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))
        return ray, scene.ray_intersect(ray)

    def to_world(self, local: mi.Vector3f) -> mi.Vector3f:
        x, y, z = (mi.Vector3f([dr.opaque(mi.Float, float(c)) for c in axis]) for axis in self.frame)
        return x * local.x + y * local.y + z * local.z

    def to_local(self, d: np.ndarray) -> np.ndarray:
        """World directions [n, 3] in the frame."""
        return d @ self.frame.T


def trace(scene: mi.Scene, sensor: mi.Sensor, pixel: tuple[int, int], max_depth: int, seed: int = 0) -> Iterator[Vertex]:
    """The vertices of a path through the middle of a pixel that goes on as the BSDF samples it.

    Those at which the path can still go on: at most `max_depth` - 1.

    Args:
        pixel: x from the left and y from the top.
        max_depth: longest path [segments]; -1: no limit, for us `UNBOUNDED_DEPTH`.

    Raises:
        InputError: a pixel outside the image.
    """
    width, height = sensor.film().crop_size()
    if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
        raise InputError(f"pixel {pixel[0]},{pixel[1]} is outside the image, {width}x{height}: x from 0 to {width - 1}, "
                         f"y from 0 to {height - 1}")
    film = mi.Point2f(dr.opaque(mi.Float, (pixel[0] + 0.5) / width), dr.opaque(mi.Float, (pixel[1] + 0.5) / height))
    ray, _ = sample_ray(sensor, 0.0, 0.5, film, mi.Point2f(0.5))
    up = np.array(sensor.world_transform() @ mi.Vector3f(0, 1, 0)).ravel()
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, 1)
    for number in range(1, (max_depth if max_depth >= 0 else UNBOUNDED_DEPTH)):
        si = scene.ray_intersect(ray)
        if not si.is_valid()[0]:
            return
        n = incident_normal(si)
        o, d, p, z, mirror = (np.array([x[0] for x in v]) for v in (ray.o, ray.d, si.p, n, si.to_world(mi.reflect(si.wi))))
        bsdf, name, axes = si.bsdf(ray), si.shape[0].id() or "an unnamed shape", frame(z, d, up)
        yield Vertex(number, o, d, p, axes, axes @ mirror, bool(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)[0]), name)
        bs, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), True)
        if not dr.any(weight > 0)[0]:
            return
        ray = mi.Ray3f(si.spawn_ray(si.to_world(bs.wo)))
        sampler.schedule_state()
        dr.eval(ray)                                # one kernel for all vertices


def frame(n: np.ndarray, d: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Axes of a surface with normal n that is seen along d: z = n, and y is the tangent that points up to the eye [3, 3]."""
    up = up - d * (up @ d)
    if up @ up < 1e-6:                              # a later vertex may be reached vertically
        up = np.eye(3)[np.argmin(abs(d))]
    y = up - d * (up @ n) / (d @ n)
    y -= n * (y @ n)
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, n), y, n])


# ---------------------------------------------------------------- truth

@dataclass
class Truth:
    """Radiance of the bins, pass by pass [passes, n * n]: of independent, unbiased passes.

    incident: L_i cos.
    reflected: f L_i cos, the product with the BSDF.
    """
    incident: np.ndarray
    reflected: np.ndarray
    paths: int = 0                      # of a bin, over all passes

    @property
    def bins(self) -> int:
        return math.isqrt(self.incident.shape[1])

    @property
    def noise(self) -> float:
        """Standard error of a bin of `incident`, relative, mean by their light; NaN if there is none."""
        m, total = len(self.incident), self.incident.mean(0).sum()
        return float(self.incident.std(0, ddof=1).sum() / math.sqrt(m) / total) if m > 1 and total > 0 else math.nan


def truth(scene: mi.Scene, vertex: Vertex, integrator: IntegratorSettings, guide: Guide | None, passes: int, bins: int = BINS,
          seed: int = 0, on_pass: Callable[[float], None] = lambda share: None) -> Truth:
    """The light that arrives at a vertex, by brute force: paths that start in every bin.

    Args:
        integrator: depth of the experiment's paths; roulette is left out, its noise is worse than its price.
        guide: guides the paths from their next vertex on; the result is unbiased with any, and without.
        on_pass: called with the share of the passes done.
    """
    from olpm_bench.transport.path import GuidedPathIntegrator

    depth = integrator.max_depth if integrator.max_depth >= 0 else UNBOUNDED_DEPTH
    props = mi.Properties("guided_path")
    props["hide_emitters"] = True                   # at the first vertex: added below with their weight
    tracer = GuidedPathIntegrator(replace(integrator, roulette="none", max_depth=depth - vertex.number), guide, props)
    sampler, n = mi.load_dict({"type": "independent"}), bins * bins * STRATA * STRATA
    lights = tracer.light_sampling(scene)
    found = Truth(np.zeros((passes, bins * bins)), np.zeros((passes, bins * bins)), passes * STRATA * STRATA)
    for index in range(passes):
        sampler.seed(dr.opaque(mi.UInt32, int(np.random.SeedSequence((seed, index)).generate_state(1)[0])), n)
        local = square.to_hemisphere(_jittered(sampler.next_2d(), bins))
        ray, si = vertex.interaction(scene, n)
        bsdf, wo = si.bsdf(ray), vertex.to_world(local)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(wo), True)
        onward = lights.origins.spawn(si, wo)
        # ---------------------- Emitters, with the share that the guide is to learn ----------------------
        hit = scene.ray_intersect(onward)
        ds = mi.DirectionSample3f(scene, hit, si)
        emitted, nee = ds.emitter.eval(hit, True), mis.density(lights.pdf(si, hit, ds, True))
        known = GuidedBSDF(si.bsdf(ray), si, guide, integrator.fraction, True).reflected
        learnt = wanted(nee, mi.luminance(value * emitted), known)
        share = dr.select(known > 0, learnt, mis.mis_weight(pdf, nee))
        # ---------------------- All other light ----------------------
        with dr.suspend_grad():
            indirect, _, _ = tracer.walk(scene, sampler, onward, True)
        incident = mi.Spectrum(share * emitted + indirect)
        arrays = mi.luminance(incident) * local.z, mi.luminance(incident * value)
        dr.eval(*arrays)
        for kept, array in zip((found.incident, found.reflected), arrays, strict=True):
            kept[index] = array.numpy().reshape(bins * bins, -1).mean(1, dtype=float)
        on_pass((index + 1) / passes)
    return found


def _jittered(offset: mi.Point2f, bins: int) -> mi.Point2f:
    """Points of the square: STRATA x STRATA of each bin, bin by bin, at offsets in [0, 1)^2 of their stratum."""
    lane = dr.arange(mi.UInt32, dr.width(offset))
    stratum, cell = lane % (STRATA * STRATA), lane // (STRATA * STRATA)
    x, y = cell % bins * STRATA + stratum % STRATA, cell // bins * STRATA + stratum // STRATA
    return mi.Point2f(mi.Float(x) + offset.x, mi.Float(y) + offset.y) / (bins * STRATA)


# ---------------------------------------------------------------- densities

@dataclass
class Density:
    """What samples the direction at a vertex.

    bsdf: density of the BSDF, with which the guide is mixed [edge, edge] at the middle of cells of the square, 1/sr.
    guide: density of the record; None where there is none.
    fraction: probability of the BSDF; 1 where it is alone.
    record: index, or None; particles: that it has seen; radius: validity radius [scene units].
    """
    bsdf: np.ndarray
    guide: np.ndarray | None = None
    fraction: float = 1.0
    record: int | None = None
    particles: int = 0
    radius: float = math.nan

    @property
    def mixture(self) -> np.ndarray:
        """What the path tracer samples."""
        return self.bsdf if self.guide is None else self.fraction * self.bsdf + (1 - self.fraction) * self.guide


def density(scene: mi.Scene, vertex: Vertex, guide: Guide | None, fraction: float, bins: int = BINS) -> Density:
    """The densities with which the path tracer goes on from a vertex.

    Args:
        guide: None samples the BSDF.
        fraction: BSDF fraction of records that learn none.
    """
    edge = bins * FINE
    lane = dr.arange(mi.UInt32, edge * edge)
    local = square.to_hemisphere(mi.Point2f(mi.Float(lane % edge) + 0.5, mi.Float(lane // edge) + 0.5) / edge)
    ray, si = vertex.interaction(scene, edge * edge)
    wo = vertex.to_world(local)
    bsdf = GuidedBSDF(si.bsdf(ray), si, guide, fraction, True)
    alone = bsdf.bsdf.pdf(mi.BSDFContext(), si, si.to_local(wo))
    if guide is None or bsdf.guided is None:
        return Density(alone.numpy().reshape(edge, edge).astype(float))
    point = bsdf.guided
    learnt = guide.representation.pdf(guide.state, point.record, point.frame.to_local(wo), point.found, point.at)
    dr.eval(alone, learnt, point.record, point.found, bsdf.fraction)
    alone, learnt = (x.numpy().reshape(edge, edge).astype(float) for x in (alone, learnt))
    if not point.found.numpy()[0]:
        return Density(alone)
    record = int(point.record.numpy()[0])
    return Density(alone, learnt, float(bsdf.fraction.numpy()[0]), record, int(guide.count.numpy()[record]),
                   float(guide.cache.radii[record]))


@dataclass(frozen=True)
class Fit:
    """How well a density samples the truth.

    divergence: Kullback-Leibler, of the density from the truth, KL(truth || pdf) [nat].
    deviation: relative standard deviation of truth / pdf, whose mean is the light: the noise of one sample.
    missed: share of the light where the density is 0; if it isn't `NEGLIGIBLE`, the others are infinite.
    """
    divergence: float
    deviation: float
    missed: float


def fit(passes: np.ndarray, pdf: np.ndarray) -> Fit:
    """A density against the truth, bin by bin; what happens within bins does not show.

    The mean of m noisy passes has squares that are too large by its variance, and x log x by half of variance / x: both are
    taken off.

    Args:
        passes: `Truth.incident` or `Truth.reflected` [m, n * n]; pdf: on cells of the square [edge, edge], 1/sr.
    """
    m, size = passes.shape
    solid_angle = 2 * math.pi / size
    t, q = passes.mean(0) * solid_angle, over_bins(pdf, math.isqrt(size)) * solid_angle
    if t.sum() <= 0:
        return Fit(math.nan, math.nan, math.nan)
    variance = (passes * solid_angle).var(0, ddof=1) / m if m > 1 else np.zeros(size)
    reached, total = (t > 0) & (q > 0), t.sum()
    missed = float(t[q <= 0].sum() / total)
    if missed > NEGLIGIBLE:
        return Fit(math.inf, math.inf, missed)
    t, q, variance = t[reached], q[reached], variance[reached]
    divergence = float((t * np.log(t / total / q) - variance / t / 2).sum() / total)
    second = float(((t * t - variance) / q).sum()) / (total * total - float(variance.sum()))
    return Fit(max(divergence, 0.0), math.sqrt(max(second - 1, 0.0)), missed)


def over_bins(fine: np.ndarray, bins: int) -> np.ndarray:
    """Means of cells of the square over bins: [edge, edge] -> [bins * bins]."""
    k = fine.shape[0] // bins
    return fine.reshape(bins, k, bins, k).mean((1, 3)).ravel()


# ---------------------------------------------------------------- particles

def particles(batch: Gathered, guide: Guide, vertex: Vertex, record: int) -> tuple[np.ndarray, np.ndarray]:
    """The particles of a batch that a record learns from: directions in the vertex's frame [m, 3], weights over their mean."""
    first, end = (int(x) for x in batch.offset.numpy()[record:record + 2])
    if first == end:
        return np.zeros((0, 3)), np.zeros(0)
    local = np.stack([x.numpy()[first:end] for x in batch.wo], 1).astype(float)
    axes = mi.Frame3f(guide.cache.row(mi.UInt32(record))[1])
    world = local @ np.stack([np.array(axis).ravel() for axis in (axes.s, axes.t, axes.n)])
    weight = batch.weight.numpy()[first:end].astype(float)
    return vertex.to_local(world), weight / max(weight.mean(), 1e-300)


