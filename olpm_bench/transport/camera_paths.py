"""Learning from camera paths: what the path tracer meets on its way teaches the guide [T 109: future work].

While paths are traced every vertex is kept: where it is, where it was left to, what it reflects by next-event
estimation, and by how much the continuation was weighted.  A second kernel then walks each path from its end,

    R_k = reflected_k + weight_k (emitted_{k+1} + R_{k+1}),

so that every vertex knows an estimate of the radiance that arrived along its continuation.  Three things are learnt:

* incident radiance, as particles of weight  L_i cos / p: like photons they estimate L_i cos, *without* the direct light
  that next-event estimation takes care of.  What it samples too rarely is learnt (`wanted`), from its own samples and from
  continuations that hit an emitter, by their MIS weights;
* the radiance that each record returns on the average, for the roulette;
* which share of it directions sampled by the BSDF bring, for the BSDF fraction.
"""
from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.guided_bsdf import GuidedBSDF, incident_normal
from olpm_bench.transport.headroom import require
from olpm_bench.transport.mis import power_heuristic
from olpm_bench.transport.particles import Particles, places
from olpm_bench.transport.settings import UNBOUNDED_DEPTH, InputError
from olpm_bench.transport.usable import usable

MOST_PATHS = 2 ** 18        # kept of a pass
BYTES = 144                 # of a vertex


def wanted(nee: mi.Float, value: mi.Float, reflected: mi.Float) -> mi.Float:
    """Share of an emitter's light that the guide should learn although next-event estimation samples it, too.

    One sample of each, weighted by the balance heuristic, has least variance where their densities add up to a multiple of
    the integrand F = f cos L.  With the multiple 1 / I, I the integral of F, that is  p_guide = max(F / I - p_nee, 0):  of F
    the share  max(1 - p_nee I / F, 0).  It is nearly 1 for the one patch of sky that shows between slats, where next-event
    estimation samples the whole sky, and 0 for a lamp in plain view.  (The path tracer weighs by the power heuristic, for which
    there is no such formula.)

    Args:
        nee: density of next-event estimation, relative to that with which the direction was sampled.
        value: F over that density.
        reflected: the integral of F, the radiance that the record reflects on the average; 0: not known.
    """
    return dr.select((reflected > 0) & (value > 0), dr.maximum(1 - nee * reflected / value, 0), 0)


def rows_of(max_depth: int) -> int:
    """Vertices of a path that are kept, at most."""
    return max((max_depth if max_depth >= 0 else UNBOUNDED_DEPTH) - 1, 1)


class CameraPaths:
    """Vertices of the paths of one image, at most `max_depth` - 1 a path; those of `MOST_PATHS` paths in even spacing.

    As of :class:`Particles`, every vertex has a place of its own, ``row * n_paths + path``.  Paths are numbered sample by
    sample and not pixel by pixel: on-line learning remembers the last best, which should not be the bottom of the image.

    Args:
        pixels, spp, paths_a_lane: of the image.
        max_depth: longest path [segments]; -1: no limit, and vertices beyond `UNBOUNDED_DEPTH` are not kept.

    Raises:
        InputError: more vertices than there is memory for, or than 32 bits can count.
    """

    def __init__(self, pixels: int, spp: int, max_depth: int, paths_a_lane: int = 1) -> None:
        lanes = spp // paths_a_lane                                         # of a pixel
        lane = dr.arange(mi.UInt32, pixels * lanes)
        pixel = lane // dr.opaque(mi.UInt32, lanes)
        stride = -(-pixels * spp // MOST_PATHS)
        kept = (pixels + stride - 1) // stride
        self.n_paths = kept * spp
        self.rows = rows_of(max_depth)
        if 8 * self.rows * self.n_paths >= 2 ** 32:
            raise InputError(f"{self.n_paths} camera paths of up to {self.rows} vertices in one pass: at most "
                             f"{(2 ** 32 - 1) // (8 * self.rows)}; a smaller max_depth, fewer camera_paths")
        require(BYTES * self.rows * self.n_paths, f"the vertices of {self.n_paths} camera paths of up to {self.rows} each",
                "a smaller max_depth, fewer camera_paths")
        opaque = dr.opaque(mi.UInt32, stride)
        self.kept = pixel % opaque == 0
        first = (lane - pixel * dr.opaque(mi.UInt32, lanes)) * dr.opaque(mi.UInt32, paths_a_lane)
        self.a_sample = dr.opaque(mi.UInt32, kept)                          # paths of a sample of all pixels
        self.first = first * self.a_sample + pixel // opaque                # path of each lane; the next are `a_sample` apart
        self.n = dr.opaque(mi.UInt32, self.n_paths)
        size = 4 * self.rows * self.n_paths
        # Vertices, and in as many rows more what next-event estimation teaches at each
        self.position = dr.zeros(mi.Float, 2 * size)    # and weight of the radiance estimate, filled in by `propagate`
        self.direction = dr.empty(mi.Float, 2 * size)   # of the continuation, and its length
        self.normal = dr.empty(mi.Float, 2 * size)      # on the incident side; probability that the BSDF chose, or -1
        self.weight = dr.empty(mi.Float, size)          # f cos / (p q) with the probability q of survival, and cos / (p q)
        self.reflected = dr.empty(mi.Float, size)       # by next-event estimation; radiance returned by the continuation
        self.emitted = dr.zeros(mi.Float, size)         # what the continuation hit; how densely next-event estimation finds it
        self.count = dr.zeros(mi.UInt32, self.n_paths)  # vertices kept
        self.unusable = 0                               # of which `propagate` could not use so many

    def arrays(self) -> Iterator[mi.Float]:
        """What the kernel of the path tracer writes."""
        yield from (self.position, self.direction, self.normal, self.weight, self.reflected, self.emitted, self.count)

    def arrive(self, path: mi.UInt32, depth: mi.UInt32, ray: mi.Ray3f, t: mi.Float, emitted: mi.Spectrum,
               nee: mi.Float, active: mi.Bool) -> None:
        """The continuation of the vertex before the one at `depth` of the lane's path has arrived, after a distance t
        (infinity: nowhere), where light is emitted that next-event estimation finds `nee` times as densely."""
        active = active & self.kept & (depth > 0) & (depth <= self.rows)
        place = (depth - 1) * self.n + self.first + path * self.a_sample
        dr.scatter(self.direction, mi.Vector4f(ray.d.x, ray.d.y, ray.d.z, t), place, active)
        dr.scatter(self.emitted, mi.Vector4f(emitted.x, emitted.y, emitted.z, nee), place, active)

    def light(self, path: mi.UInt32, depth: mi.UInt32, si: mi.SurfaceInteraction3f, bsdf: GuidedBSDF, ds: mi.DirectionSample3f,
              weight: mi.Float, found: mi.Float, active: mi.Bool) -> None:
        """What next-event estimation has found at a vertex.

        Args:
            weight: L / p of the emitter's sample, MIS weight included; found: f cos L / p, without.
        """
        share = wanted(1, found, bsdf.reflected)
        active = active & self.kept & (depth < self.rows) & (share > 0) & ~ds.delta & usable(weight)
        place = (self.rows + depth) * self.n + self.first + path * self.a_sample
        n = incident_normal(si)
        weight = weight * share * dr.maximum(dr.dot(n, ds.d), 0)
        dr.scatter(self.position, mi.Vector4f(si.p.x, si.p.y, si.p.z, weight), place, active)
        far = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)      # as a ray that leaves the scene: see `arrive`
        dr.scatter(self.direction, mi.Vector4f(ds.d.x, ds.d.y, ds.d.z, dr.select(far, dr.inf, ds.dist)), place, active)
        dr.scatter(self.normal, mi.Vector4f(n.x, n.y, n.z, -1), place, active)

    def leave(self, path: mi.UInt32, depth: mi.UInt32, si: mi.SurfaceInteraction3f, bsdf: GuidedBSDF, bs: mi.BSDFSample3f,
              weight: mi.Spectrum, survive: mi.Float, reflected: mi.Spectrum, active: mi.Bool) -> None:
        """A vertex and its continuation, of which `weight` is 0 where roulette has ended the path.

        Where the BSDF is all specular the normal is 0: no record will be of use there.
        """
        active = active & self.kept & (depth < self.rows)
        path = self.first + path * self.a_sample
        place = depth * self.n + path
        n = dr.select(bsdf.smooth, incident_normal(si), 0)
        learnable = (dr.max(weight) > 0) & (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        cosine = dr.maximum(dr.dot(n, si.to_world(bs.wo)), 0)
        per_pdf = dr.select(learnable, cosine / (bs.pdf * survive), 0)
        dr.scatter(self.position, mi.Vector4f(si.p.x, si.p.y, si.p.z, 0), place, active)
        dr.scatter(self.normal, mi.Vector4f(n.x, n.y, n.z, bsdf.chosen_by_bsdf), place, active)
        dr.scatter(self.weight, mi.Vector4f(weight.x, weight.y, weight.z, per_pdf), place, active)
        dr.scatter(self.reflected, mi.Vector4f(reflected.x, reflected.y, reflected.z, bsdf.reflected / survive), place, active)
        dr.scatter(self.count, depth + 1, path, active)

    @dr.syntax
    def propagate(self) -> None:
        """From the end of each path to its start: the weight of radiance estimates, and the radiance returned.

        A vertex at which something is NaN, infinite or negative returns nothing and teaches nothing.
        """
        path = dr.arange(mi.UInt32, self.n_paths)
        left = dr.gather(mi.UInt32, self.count, path)
        radiance = mi.Spectrum(0)                       # R: of the vertex that the walk has come to
        unusable = mi.UInt32(0)                         # vertices
        while left > 0:
            left -= 1
            place = left * self.n + path
            weight = dr.gather(mi.Vector4f, self.weight, place)
            reflected = dr.gather(mi.Vector4f, self.reflected, place)
            emitted = dr.gather(mi.Vector4f, self.emitted, place)
            source, factor = mi.Spectrum(emitted.x, emitted.y, emitted.z), mi.Spectrum(weight.x, weight.y, weight.z)
            by_nee = mi.Spectrum(reflected.x, reflected.y, reflected.z)
            mis = power_heuristic(emitted.w)
            value = mi.luminance(factor * source)
            share = mis * dr.select(reflected.w > 0, wanted(emitted.w, value, reflected.w), 1)
            returned = factor * (source * mis + radiance)
            estimate = (mi.luminance(source) * share + mi.luminance(radiance)) * weight.w
            fine = usable(by_nee) & usable(returned) & usable(estimate)
            unusable += dr.select(fine, 0, 1)
            by_nee, returned = dr.select(fine, by_nee, 0), dr.select(fine, returned, 0)
            dr.scatter(self.position, dr.select(fine, estimate, 0), 4 * place + 3)
            dr.scatter(self.reflected, mi.Vector4f(by_nee.x, by_nee.y, by_nee.z, mi.luminance(returned)), place)
            radiance = by_nee + returned
        dr.eval(self.position, self.reflected, unusable)
        self.unusable = int(dr.sum(unusable)[0])

    def particles(self) -> Particles:
        """All vertices, path by path, as particles that carry the radiance that arrived (`propagate` comes first)."""
        return Particles(self.position, self.direction, self.normal, places(self.count, self.rows), self.n_paths,
                         unusable=self.unusable)

    def lessons(self, vertex: mi.UInt32) -> Particles:
        """The vertices at these places with what next-event estimation found at each: all that radiance is learnt from."""
        either = dr.arange(mi.UInt32, 2 * len(vertex))
        place = dr.gather(mi.UInt32, vertex, either // 2) + either % 2 * dr.opaque(mi.UInt32, self.rows * self.n_paths)
        place = dr.gather(mi.UInt32, place, dr.compress(dr.gather(mi.Float, self.position, 4 * place + 3) > 0))
        return Particles(self.position, self.direction, self.normal, place, self.n_paths)

    def returned(self, place: mi.UInt32) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Luminance returned by the continuation of vertices, the probability that the BSDF chose it, or -1, and luminance
        reflected in all."""
        reflected = dr.gather(mi.Vector4f, self.reflected, place)
        by_nee = mi.luminance(mi.Spectrum(reflected.x, reflected.y, reflected.z))
        return reflected.w, dr.gather(mi.Float, self.normal, 4 * place + 3), by_nee + reflected.w
