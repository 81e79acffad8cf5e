"""Trace photons and importons, and keep where they land.

A *photon* starts at an emitter and carries flux; an *importon* starts at the camera and carries importance.  Both
scatter through the same `GuidedBSDF` as camera paths: photons by the learnt importance, importons by the
learnt radiance [T 70-91].

Kept is every hit on a surface that is not purely specular, from the second vertex on: direct light and the points the
camera sees belong to next-event estimation [L].
"""
from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport import adjoint
from olpm_bench.transport.camera_rays import sample_ray
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.guided_bsdf import GuidedBSDF, incident_normal
from olpm_bench.transport.headroom import require
from olpm_bench.transport.light_sampling import LightSampling
from olpm_bench.transport.mis import balance_weight
from olpm_bench.transport.ray_origins import RayOrigins
from olpm_bench.transport.settings import UNBOUNDED_DEPTH, InputError
from olpm_bench.transport.usable import usable, usable_ray
from olpm_bench.transport.window import HEAVIEST, HIGH, LEAST_SURVIVAL, LIGHTEST, LOW, Window

if TYPE_CHECKING:
    from olpm_bench.transport.emission import EmissionGuide

MOST_COPIES = 32                # of a particle that splits
LEVELS = 3                      # particles in waiting, each with its copies, before there is no more splitting
LANES = 1 << 13                 # particles traced side by side; a lane takes up the next when one has ended
DEPARTURES = 8                  # kept of an importon's path on average: its first ones; only proposals are learnt from them


@dataclass
class ParticleRays:
    """Particles as they leave an emitter or the camera [n]."""
    ray: mi.Ray3f
    weight: mi.Spectrum     # times 1 / n: the flux or importance of the particle; 0: it is not traced
    unit: mi.Float          # [1] mean luminance of `weight`: the total flux of the emitters
    unusable: int           # particles that were NaN, infinite or negative, and have weight 0 now


@dataclass
class Departures:
    """Importons that leave the scene towards lights at infinity, path by path.

    Each weight times 1 / (number of importons) estimates importance x radiance over direction and position [W/m^2 of the disk].
    """
    position: mi.Point3f    # [m] the vertex before, a point of the ray
    direction: mi.Vector3f  # [m] towards the light
    weight: mi.Float        # [m] luminance, > 0
    light: mi.UInt32        # [m] index in `EmissionGuide.lights`


@dataclass
class Particles:
    """Hits of particles; `place` lists those in use, lane by lane and path by path.

    Every hit has a place of its own, ``row * lanes + lane``, so the order does not depend on threads.  And
    not on the depth either: on-line learning remembers the last particles best, so they must not be the deepest.
    """
    position: mi.Float      # [rows * lanes * 4] position and weight
    direction: mi.Float     # [rows * lanes * 4] direction the particle came from, and length of its last segment
    normal: mi.Float        # [rows * lanes * 4] geometric normal on the incident side; of camera paths, who chose the direction
    place: mi.UInt32        # [hits]
    lanes: int
    departures: Departures | None = None
    unusable: int = 0       # paths that were ended, or vertices that teach nothing, for a NaN, infinite or negative value

    def __len__(self) -> int:
        return len(self.place)

    def read(self, place: mi.UInt32) -> tuple[mi.Point3f, mi.Float, mi.Vector3f, mi.Float, mi.Normal3f]:
        """Position, weight, direction, distance and normal of hits."""
        p, d, n = (dr.gather(mi.Vector4f, a, place) for a in (self.position, self.direction, self.normal))
        return mi.Point3f(p.x, p.y, p.z), p.w, mi.Vector3f(d.x, d.y, d.z), d.w, mi.Normal3f(n.x, n.y, n.z)

    def one_of(self, n: int) -> Particles:
        """One hit in n, evenly along the paths."""
        some = dr.arange(mi.UInt32, -(-len(self) // n)) * dr.opaque(mi.UInt32, n)
        return dataclasses.replace(self, place=dr.gather(mi.UInt32, self.place, some))

    def by_region(self, region: Callable[[np.ndarray], np.ndarray], n: int) -> np.ndarray:
        """Hits in each of n regions, and their effective number (sum w)^2 / sum w^2 [n, 2].

        Args:
            region: of positions [hits, 3], their indices.
        """
        p, weight, _, _, _ = self.read(self.place)
        index, w = region(np.stack([x.numpy() for x in p], 1)), weight.numpy().astype(float)
        count, total, squares = (np.bincount(index, x, n) for x in (np.ones(len(w)), w, w * w))
        return np.stack([count, total ** 2 / np.maximum(squares, np.finfo(float).tiny)], 1)


def emit_photons(scene: mi.Scene, sampler: mi.Sampler, lights: LightSampling | None = None) -> ParticleRays:
    """Rays that leave the emitters, weight = flux (radiance over density).

    Args:
        lights: of the scene, for those who have it.
    """
    lights = lights or LightSampling(scene)
    return evaluated(*lights.sample_photon(sampler.next_1d(), sampler.next_2d(), sampler.next_2d()))


def emit_importons(sensor: mi.Sensor, sampler: mi.Sampler) -> ParticleRays:
    """Rays through uniform points of the film, weight = importance 1."""
    ray, weight = sample_ray(sensor, 0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    return evaluated(ray, weight)


def evaluated(ray: mi.Ray3f, weight: mi.Spectrum) -> ParticleRays:
    """Rays and weights, computed; those that can't be used have weight 0 and are counted."""
    summable = usable(weight * dr.width(weight))
    found = summable & (usable_ray(ray) | (dr.max(weight) == 0))        # black lights may send rays nowhere
    weight = mi.Spectrum(dr.select(found, weight, 0))
    ray = mi.Ray3f(dr.select(found, ray.o, 0), dr.select(found, ray.d, mi.Vector3f(0, 0, 1)))
    dr.eval(ray, weight, found)
    unit = dr.mean(mi.luminance(weight))
    dr.eval(unit)
    return ParticleRays(ray, weight, unit, int(dr.count(~found)[0]))


@dataclass
class _Waiting:
    """Copies of a particle that was split: the segment that leads to the vertex where it was, and their share there."""
    o: mi.Point3f
    d: mi.Vector3f
    weight: mi.Spectrum
    depth: mi.UInt32        # vertices met before that vertex
    copies: mi.UInt32       # 0: nothing is waiting here


def _push(waiting: list[_Waiting], top: _Waiting, active: mi.Bool) -> list[_Waiting]:
    """The stack with `top` on it; its lowest level must be free."""
    return [dr.select(active, above, here) for above, here in zip([top, *waiting], waiting, strict=False)]


def _pop(waiting: list[_Waiting], active: mi.Bool) -> tuple[_Waiting, list[_Waiting]]:
    """One copy of what is on top, and the stack without it.

    Registers that move up and down: Dr.Jit 1.5.0's local memory overwrites other data.
    """
    top = waiting[0]
    others = [dataclasses.replace(top, copies=top.copies - 1), *waiting[1:]]
    emptied = active & (top.copies == 1)
    below = [*waiting[1:], dr.zeros(_Waiting)]
    return top, [dr.select(emptied, b, dr.select(active, o, w)) for b, o, w in zip(below, others, waiting, strict=True)]


@dr.syntax
def trace(scene: mi.Scene, rays: ParticleRays, sampler: mi.Sampler, guide: Guide | None, fraction: float, max_depth: int,
          mode: mi.TransportMode, window: Window | None = None, emission: EmissionGuide | None = None) -> Particles:
    """Trace particles through the scene and keep their hits.

    A weight window keeps particles alike, by roulette below it and by splitting above it.

    One kernel, of lanes that each trace their share of the paths one after another: a path that splits often keeps no
    others waiting.  Copies wait in a small stack of the lane; there is no split without room there, or in the
    lane's share of the buffers for all hits that may still follow.

    Args:
        rays: where the particles start.
        sampler: as wide as the rays.
        guide: the distributions that guide scattering: importance for photons, radiance for importons.
        max_depth: longest camera path; a particle's path joins a camera path by one segment at least.
        mode: `Importance` for photons (whose weights are then those of :mod:`~olpm_bench.transport.adjoint`), `Radiance` for
            importons.
        window: what to keep alike; None keeps the weights in the wide window of [L].
        emission: also keep how importons reach its lights, from the second vertex on: those that scatter there, and next-event
            estimates, without which none would find a directional light and few the sun (balance heuristic).

    Raises:
        InputError: more particles than 32 bits can count hits of.
    """
    n_paths = dr.width(rays.ray.o)
    last = (max_depth if max_depth >= 0 else UNBOUNDED_DEPTH) - 1     # last vertex at which a hit is of use
    lanes = min(n_paths, LANES)
    each = -(-n_paths // lanes)                                       # paths of a lane, rounded up
    hits = max(last - 1, 1)                                           # of a path that does not split, at most
    rows = 2 * hits * each
    if 4 * rows * lanes >= 2 ** 32:
        raise InputError(f"{n_paths} particles of up to {2 * hits} hits in one trace: at most {(2 ** 32 - 1) // (8 * hits)}")
    require(3 * 16 * rows * lanes, f"{n_paths} particles of up to {2 * hits} hits in one trace", "trace fewer")
    photons = mode == mi.TransportMode.Importance
    ctx, origins = mi.BSDFContext(mode), RayOrigins(scene)
    position, direction, normal = (dr.empty(mi.Float, 4 * rows * lanes) for _ in range(3))
    left_at, left_for = (dr.empty(mi.Float, 4 * (DEPARTURES * each * lanes if emission else 1)) for _ in range(2))
    # Opaque: counts are data, not code.
    lane, n, n_lanes = dr.arange(mi.UInt32, lanes), dr.opaque(mi.UInt32, n_paths), dr.opaque(mi.UInt32, lanes)
    capacity = dr.opaque(mi.UInt32, rows)
    unit = rays.unit
    seed = mi.UInt32(dr.gather(mi.Float, sampler.next_1d(), dr.opaque(mi.UInt32, 0)) * 2 ** 24)
    sampler = sampler.fork()
    sampler.seed(seed, lanes)

    path = mi.UInt32(lane)
    ray = mi.Ray3f(dr.gather(mi.Point3f, rays.ray.o, path), dr.gather(mi.Vector3f, rays.ray.d, path))
    weight = dr.gather(mi.Spectrum, rays.weight, path)
    depth = mi.UInt32(0)                            # vertices met so far
    count = mi.UInt32(0)                            # hits kept so far
    reserved = hits * ((n - 1 - lane) // n_lanes)   # room for the lane's further paths and for the copies in waiting
    waiting = [dr.zeros(_Waiting, lanes) for _ in range(LEVELS)]       # the last split first; unused: no copies
    met_before = mi.Bool(False)                     # the next vertex is one where a particle has been split
    left = mi.UInt32(0)                             # departures kept so far
    pdf_prev = mi.Float(0)                          # density with which the ray was chosen
    unusable = mi.UInt32(0)                         # paths that a NaN, infinite or negative value has ended
    active = mi.Bool(True)

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit = active & si.is_valid() & (dr.max(weight) > 0)
        depth[hit] += 1
        hit &= depth <= last
        bsdf = GuidedBSDF(si.bsdf(ray), si, guide, fraction, hit)

        # ---------------------- Keep the hit ----------------------
        first_met = hit & ~met_before
        keep = first_met & bsdf.smooth & (depth >= 2)
        place = count * n_lanes + lane
        n_incident = incident_normal(si)
        dr.scatter(position, mi.Vector4f(si.p.x, si.p.y, si.p.z, mi.luminance(weight)), place, keep)
        dr.scatter(direction, mi.Vector4f(-ray.d.x, -ray.d.y, -ray.d.z, si.t), place, keep)
        dr.scatter(normal, mi.Vector4f(n_incident.x, n_incident.y, n_incident.z, 0), place, keep)
        count[keep] += 1

        # ---------------------- Keep what leaves ----------------------
        if dr.hint(emission is not None, mode="scalar"):
            assert emission is not None
            # By next-event estimation or by the ray itself; a lane does one or the other.
            room_left = left < DEPARTURES * (path // n_lanes + 1)
            connect = keep & room_left
            ds, radiance = scene.sample_emitter_direction(si, sampler.next_2d(connect), True, connect)
            light = emission.index(ds.emitter)
            value, pdf = bsdf.eval_pdf(ctx, si.to_local(ds.d), connect & (ds.pdf > 0))
            mis = dr.select(ds.delta, 1, balance_weight(ds.pdf, pdf))
            connect &= (ds.pdf > 0) & (light < len(emission.lights))
            escape = active & ~si.is_valid() & (depth >= 2) & room_left
            ray_radiance, ray_mis = emission.escape(si, pdf_prev, escape)
            carried = mi.luminance(weight * dr.select(escape, ray_radiance * ray_mis, value * radiance * mis))
            leaves = (connect | escape) & (carried > 0) & dr.isfinite(carried)
            p, d = dr.select(escape, ray.o, si.p), dr.select(escape, ray.d, ds.d)
            dr.scatter(left_at, mi.Vector4f(p.x, p.y, p.z, carried), left * n_lanes + lane, leaves)
            dr.scatter(left_for, mi.Vector4f(d.x, d.y, d.z, dr.select(escape, 0, mi.Float(light))), left * n_lanes + lane, leaves)
            left[leaves] += 1

        # ---------------------- Weight window ----------------------
        relative = mi.luminance(weight) / unit
        low, high, least = mi.Float(LIGHTEST), mi.Float(HEAVIEST), mi.Float(0)
        if dr.hint(window is not None and bsdf.guided is not None, mode="scalar"):
            assert window is not None and bsdf.guided is not None
            value = dr.gather(mi.Float, window.value, bsdf.guided.record, bsdf.guided.found)
            known = value > 0
            relative = dr.select(known, mi.luminance(weight) * value / window.aim, relative)
            low, high, least = dr.select(known, LOW, low), dr.select(known, HIGH, high), dr.select(known, LEAST_SURVIVAL, 0)
        further = dr.select(first_met & (depth < last), last - depth, 0)        # hits to come of each copy
        room = mi.Float(capacity - count - reserved) / mi.Float(dr.maximum(further, 1))
        copies = dr.minimum(dr.round(relative), dr.minimum(MOST_COPIES, dr.floor(room)))
        split = (further > 0) & (relative > high) & (copies >= 2) & (waiting[LEVELS - 1].copies == 0)
        weight[split] /= copies
        waiting = _push(waiting, _Waiting(ray.o, ray.d, weight, depth - 1, mi.UInt32(copies) - 1), split)
        reserved[split] += (mi.UInt32(copies) - 1) * further
        light = first_met & (relative < low)
        survival = dr.select(light, dr.maximum(relative / low, least), 1)
        survives = sampler.next_1d(light) < survival
        weight /= survival

        # ---------------------- Scatter ----------------------
        scatter = hit & (~light | survives) & (depth < last)
        bs, bsdf_weight = bsdf.sample(ctx, sampler.next_1d(scatter), sampler.next_2d(scatter), scatter)
        if dr.hint(photons, mode="scalar"):
            bsdf_weight = adjoint.sample_weight(bsdf.bsdf, si, bs, bsdf_weight, scatter)
        d = si.to_world(bs.wo)
        # A sample without a direction has failed, as one of weight 0; `blendbsdf` seen from behind gives NaN for both.
        weight = dr.select(dr.all(dr.isfinite(d)), weight * bsdf_weight, 0)
        broken = scatter & ~usable(weight)
        unusable[broken] += 1
        alive = scatter & ~broken & (dr.max(weight) > 0)
        if dr.hint(emission is not None, mode="scalar"):
            pdf_prev = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), dr.largest(mi.Float), bs.pdf)
        ray = origins.spawn(si, d)

        # ---------------------- Go on, or with a copy in waiting, or with the next path ----------------------
        ended = active & ~alive
        resume = ended & (waiting[0].copies > 0)
        twin, waiting = _pop(waiting, resume)
        reserved[resume] -= last - 1 - twin.depth
        path[ended & ~resume] += n_lanes
        start = ended & ~resume & (path < n)
        reserved[start] -= hits
        ray.o = dr.select(resume, twin.o, dr.select(start, dr.gather(mi.Point3f, rays.ray.o, path, start), ray.o))
        ray.d = dr.select(resume, twin.d, dr.select(start, dr.gather(mi.Vector3f, rays.ray.d, path, start), ray.d))
        weight = dr.select(resume, twin.weight, dr.select(start, dr.gather(mi.Spectrum, rays.weight, path, start), weight))
        depth = dr.select(resume, twin.depth, dr.select(start, 0, depth))
        met_before = mi.Bool(resume)
        active &= alive | resume | start

    dr.eval(position, direction, normal, count, left_at, left_for, left, unusable)
    place = places(count, rows)
    departures = _departures(left_at, left_for, places(left, DEPARTURES * each)) if emission is not None else None
    return Particles(position, direction, normal, place, lanes, departures, int(dr.sum(unusable)[0]))


def places(count: mi.UInt32, rows: int) -> mi.UInt32:
    """Those in use, lane by lane, of `rows` places a lane."""
    entry = dr.arange(mi.UInt32, rows * len(count))
    lane, row = entry // rows, entry % rows
    used = dr.compress(row < dr.gather(mi.UInt32, count, lane))
    return dr.gather(mi.UInt32, row * dr.opaque(mi.UInt32, len(count)) + lane, used)


def _departures(left_at: mi.Float, left_for: mi.Float, place: mi.UInt32) -> Departures:
    p, d = dr.gather(mi.Vector4f, left_at, place), dr.gather(mi.Vector4f, left_for, place)
    departures = Departures(mi.Point3f(p.x, p.y, p.z), mi.Vector3f(d.x, d.y, d.z), mi.Float(p.w), mi.UInt32(d.w))
    dr.eval(departures)
    return departures
