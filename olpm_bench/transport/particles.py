"""Trace photons and importons, and keep where they land.

A *photon* starts at an emitter and carries flux; an *importon* starts at the camera and carries importance.  Both
scatter through the same `GuidedBSDF` as camera paths: photons by the learnt importance, importons by the
learnt radiance [T 70-91].

Kept is every hit on a surface that is not purely specular, from the second vertex on: direct light and the points the
camera sees belong to next-event estimation [L].
"""
from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.guide import Guide
from olpm_bench.transport.guided_bsdf import GuidedBSDF
from olpm_bench.transport.settings import InputError

if TYPE_CHECKING:
    from olpm_bench.transport.emission import EmissionGuide

# The weight window [L], relative to the total flux of the emitters, or to 1 for importons.  Its lower end leaves nearly
# all particles alone: roulette on throughput kills exactly the guided ones, which carry little for a reason.
LIGHTEST, HEAVIEST = 1e-6, 2 + 1e-6
UNBOUNDED_DEPTH = 32            # particle paths end here when camera paths have no limit
DEPARTURES = 8                  # kept of an importon's path: its first ones; only proposals are learnt from them


@dataclass
class ParticleRays:
    """Particles as they leave an emitter or the camera [n]."""
    ray: mi.Ray3f
    weight: mi.Spectrum     # times 1 / n: the flux or importance of the particle
    unit: mi.Float          # [1] mean luminance of `weight`: the total flux of the emitters


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
    """Hits of particles; `place` lists those in use, path by path.

    Every hit of a path has a place of its own, ``row * n_paths + path``, so the order does not depend on threads.  And
    not on the depth either: on-line learning remembers the last particles best, so they must not be the deepest.
    """
    position: mi.Float      # [rows * n_paths * 4] position and weight
    direction: mi.Float     # [rows * n_paths * 4] direction the particle came from, and length of its last segment
    normal: mi.Float        # [rows * n_paths * 4] geometric normal on the incident side, unused
    place: mi.UInt32        # [hits]
    departures: Departures | None = None

    def __len__(self) -> int:
        return len(self.place)

    def read(self, place: mi.UInt32) -> tuple[mi.Point3f, mi.Float, mi.Vector3f, mi.Float, mi.Normal3f]:
        """Position, weight, direction, distance and normal of hits."""
        p, d, n = (dr.gather(mi.Vector4f, a, place) for a in (self.position, self.direction, self.normal))
        return mi.Point3f(p.x, p.y, p.z), p.w, mi.Vector3f(d.x, d.y, d.z), d.w, mi.Normal3f(n.x, n.y, n.z)


def emit_photons(scene: mi.Scene, sampler: mi.Sampler) -> ParticleRays:
    """Rays that leave the emitters, weight = flux (radiance over density).

    Raises:
        InputError: an emitter gives NaN, infinite or negative radiance.
    """
    ray, weight, _ = scene.sample_emitter_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True)
    return evaluated(ray, weight)


def emit_importons(sensor: mi.Sensor, sampler: mi.Sampler) -> ParticleRays:
    """Rays through uniform points of the film, weight = importance 1."""
    ray, weight = sensor.sample_ray(0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
    return evaluated(ray, weight)


def evaluated(ray: mi.Ray3f, weight: mi.Spectrum) -> ParticleRays:
    """Rays and weights, computed.

    Raises:
        InputError: an emitter gives NaN, infinite or negative radiance.
    """
    invalid = dr.count(~dr.all(dr.isfinite(weight) & (weight >= 0)))[0]
    if invalid:
        raise InputError(f"{invalid} of {dr.width(weight)} emitted particles have a NaN, infinite or negative weight: "
                         "check the scene's emitters and their textures")
    unit = dr.mean(mi.luminance(weight))
    rays = ParticleRays(mi.Ray3f(ray), mi.Spectrum(weight), unit)
    dr.eval(rays)
    return rays


@dr.syntax
def trace(scene: mi.Scene, rays: ParticleRays, sampler: mi.Sampler, guide: Guide | None, fraction: float, max_depth: int,
          mode: mi.TransportMode, emission: EmissionGuide | None = None) -> Particles:
    """Trace particles through the scene and keep their hits.

    A particle heavier than the window is split in two at every vertex it meets.  A path holds at most one
    twin in waiting and traces it when it ends; with one waiting already, or no room for its hits, there is no split
    (our choice: one kernel, no queue).

    Args:
        rays: where the particles start.
        guide: the distributions that guide scattering: importance for photons, radiance for importons.
        max_depth: longest camera path; a particle's path joins a camera path by one segment at least.
        mode: `Importance` for photons (which then correct for shading normals), `Radiance` for importons.
        emission: also keep how importons reach its lights, from the second vertex on: those that scatter there, and next-event
            estimates, without which none would find a directional light and few the sun (balance heuristic).

    Raises:
        InputError: more particles than 32 bits can count hits of.
    """
    n_paths = dr.width(rays.ray.o)
    last = (max_depth if max_depth >= 0 else UNBOUNDED_DEPTH) - 1     # last vertex at which a hit is of use
    rows = 2 * max(last - 1, 1)                                       # of a path and its twins
    if 4 * rows * n_paths >= 2 ** 32:
        raise InputError(f"{n_paths} particles of up to {rows} hits in one trace: at most {(2 ** 32 - 1) // (4 * rows)}")
    photons = mode == mi.TransportMode.Importance
    ctx = mi.BSDFContext(mode)
    position, direction, normal = (dr.empty(mi.Float, 4 * rows * n_paths) for _ in range(3))
    left_at, left_for = (dr.empty(mi.Float, 4 * (DEPARTURES * n_paths if emission else 1)) for _ in range(2))
    path, n = dr.arange(mi.UInt32, n_paths), dr.opaque(mi.UInt32, n_paths)     # opaque: counts are data, not code
    unit = rays.unit

    ray = mi.Ray3f(rays.ray)
    weight = mi.Spectrum(rays.weight)
    depth = mi.UInt32(0)                            # vertices met so far
    count = mi.UInt32(0)                            # hits kept so far
    active = dr.max(weight) > 0
    # The twin in waiting: the ray that leads to the vertex where it was split, and its share of the weight there.
    twin_ray, twin_weight, twin_depth, twin = dr.zeros(mi.Ray3f, n_paths), mi.Spectrum(0), mi.UInt32(0), mi.Bool(False)
    met_before = mi.Bool(False)                     # the next vertex is one where a twin was split off
    left = mi.UInt32(0)                             # departures kept so far
    pdf_prev = mi.Float(0)                          # density with which the ray was chosen

    while active:
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        hit = active & si.is_valid()
        depth[hit] += 1
        hit &= depth <= last
        bsdf = GuidedBSDF(si.bsdf(ray), si, guide, fraction, hit)

        # ---------------------- Keep the hit ----------------------
        keep = hit & bsdf.smooth & (depth >= 2) & ~met_before
        place = count * n + path
        n_incident = dr.mulsign(si.n, -dr.dot(si.n, ray.d))
        dr.scatter(position, mi.Vector4f(si.p.x, si.p.y, si.p.z, mi.luminance(weight)), place, keep)
        dr.scatter(direction, mi.Vector4f(-ray.d.x, -ray.d.y, -ray.d.z, si.t), place, keep)
        dr.scatter(normal, mi.Vector4f(n_incident.x, n_incident.y, n_incident.z, 0), place, keep)
        count[keep] += 1

        # ---------------------- Keep what leaves ----------------------
        if dr.hint(emission is not None, mode="scalar"):
            assert emission is not None
            # By next-event estimation or by the ray itself; a lane does one or the other.
            connect = keep & (left < DEPARTURES)
            ds, radiance = scene.sample_emitter_direction(si, sampler.next_2d(connect), True, connect)
            light = emission.index(ds.emitter)
            value, pdf = bsdf.eval_pdf(ctx, si.to_local(ds.d), connect & (ds.pdf > 0))
            mis = dr.select(ds.delta, 1, ds.pdf / (ds.pdf + pdf))
            connect &= (ds.pdf > 0) & (light < len(emission.lights))
            escape = active & ~si.is_valid() & (depth >= 2) & (left < DEPARTURES)
            ray_radiance, ray_mis = emission.escape(si, pdf_prev, escape)
            carried = mi.luminance(weight * dr.select(escape, ray_radiance * ray_mis, value * radiance * mis))
            leaves = (connect | escape) & (carried > 0) & dr.isfinite(carried)
            p, d = dr.select(escape, ray.o, si.p), dr.select(escape, ray.d, ds.d)
            dr.scatter(left_at, mi.Vector4f(p.x, p.y, p.z, carried), left * n + path, leaves)
            dr.scatter(left_for, mi.Vector4f(d.x, d.y, d.z, dr.select(escape, 0, mi.Float(light))), left * n + path, leaves)
            left[leaves] += 1

        # ---------------------- Weight window ----------------------
        relative = mi.luminance(weight) / unit
        room = count + 2 * (last - depth) <= rows           # for what the particle and its twin may still leave
        split = hit & ~twin & (relative > HEAVIEST) & (depth < last) & room
        weight[split] *= 0.5
        twin_ray = dr.select(split, ray, twin_ray)
        twin_weight = dr.select(split, weight, twin_weight)
        twin_depth = dr.select(split, depth - 1, twin_depth)
        twin |= split
        light = hit & (relative < LIGHTEST)
        survives = sampler.next_1d(light) * LIGHTEST < relative
        weight[light] *= LIGHTEST / relative

        # ---------------------- Scatter ----------------------
        scatter = hit & (~light | survives) & (depth < last)
        bs, bsdf_weight = bsdf.sample(ctx, sampler.next_1d(scatter), sampler.next_2d(scatter), scatter)
        d = si.to_world(bs.wo)
        weight *= bsdf_weight
        if dr.hint(photons, mode="scalar"):
            # Shading normals make the BSDF asymmetric (Veach 1997, eq. 5.19); no light leaks through the surface.
            wi_n, wo_n = dr.dot(si.n, -ray.d), dr.dot(si.n, d)
            cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(bs.wo)
            same_side = (wi_n * cos_i > 0) & (wo_n * cos_o > 0)
            weight *= dr.select(same_side, dr.abs(cos_i * wo_n / (cos_o * wi_n)), 0)
        alive = scatter & (dr.max(weight) > 0)
        if dr.hint(emission is not None, mode="scalar"):
            pdf_prev = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), dr.largest(mi.Float), bs.pdf)

        # ---------------------- Go on, or with the twin ----------------------
        next_ray = si.spawn_ray(d)
        resume = active & ~alive & twin
        ray = dr.select(resume, twin_ray, next_ray)
        weight = dr.select(resume, twin_weight, weight)
        depth = dr.select(resume, twin_depth, depth)
        twin &= ~resume
        met_before = mi.Bool(resume)
        active &= alive | resume

    dr.eval(position, direction, normal, count, left_at, left_for, left)
    place = _places(count, rows)
    departures = _departures(left_at, left_for, _places(left, DEPARTURES)) if emission is not None else None
    return Particles(position, direction, normal, place, departures)


def _places(count: mi.UInt32, rows: int) -> mi.UInt32:
    """Those in use, path by path, of `rows` places a path."""
    entry = dr.arange(mi.UInt32, rows * len(count))
    path, row = entry // rows, entry % rows
    used = dr.compress(row < dr.gather(mi.UInt32, count, path))
    return dr.gather(mi.UInt32, row * dr.opaque(mi.UInt32, len(count)) + path, used)


def _departures(left_at: mi.Float, left_for: mi.Float, place: mi.UInt32) -> Departures:
    p, d = dr.gather(mi.Vector4f, left_at, place), dr.gather(mi.Vector4f, left_for, place)
    departures = Departures(mi.Point3f(p.x, p.y, p.z), mi.Vector3f(d.x, d.y, d.z), mi.Float(p.w), mi.UInt32(d.w))
    dr.eval(departures)
    return departures
