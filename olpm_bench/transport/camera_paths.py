"""Learning from camera paths: what the path tracer meets on its way teaches the guide [T 109: future work].

While paths are traced every vertex is kept: where it is, where it was left to, what it reflects by next-event
estimation, and by how much the continuation was weighted.  A second kernel then walks each path from its end,

    R_k = reflected_k + weight_k (emitted_{k+1} + R_{k+1}),

so that every vertex knows an estimate of the radiance that arrived along its continuation.  Three things are learnt:

* incident radiance, as particles of weight  L_i cos / p: like photons they estimate L_i cos, *without* the
  share that next-event estimation will take care of (its own samples, and the MIS weight of emitters that were hit);
* the radiance that each record returns on the average, for the roulette;
* which share of it directions sampled by the BSDF bring, for the BSDF fraction.
"""
from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.guided_bsdf import GuidedBSDF
from olpm_bench.transport.particles import UNBOUNDED_DEPTH, Particles, places

MOST_PATHS = 2 ** 18        # kept of a pass; a vertex takes 96 bytes


class CameraPaths:
    """Vertices of the paths of one image, at most `max_depth` - 1 a path; those of `MOST_PATHS` paths in even spacing.

    As of :class:`Particles`, every vertex has a place of its own, ``row * n_paths + path``.  Paths are numbered sample by
    sample and not pixel by pixel: on-line learning remembers the last best, which should not be the bottom of the image.

    Args:
        pixels, spp, paths_a_lane: of the image.
        max_depth: longest path [segments]; -1: no limit, and vertices beyond `UNBOUNDED_DEPTH` are not kept.
    """

    def __init__(self, pixels: int, spp: int, max_depth: int, paths_a_lane: int = 1) -> None:
        lanes = spp // paths_a_lane                                         # of a pixel
        lane = dr.arange(mi.UInt32, pixels * lanes)
        pixel = lane // dr.opaque(mi.UInt32, lanes)
        stride = -(-pixels * spp // MOST_PATHS)
        kept = (pixels + stride - 1) // stride
        self.n_paths = kept * spp
        self.rows = max((max_depth if max_depth >= 0 else UNBOUNDED_DEPTH) - 1, 1)
        opaque = dr.opaque(mi.UInt32, stride)
        self.kept = pixel % opaque == 0
        first = (lane - pixel * dr.opaque(mi.UInt32, lanes)) * dr.opaque(mi.UInt32, paths_a_lane)
        self.a_sample = dr.opaque(mi.UInt32, kept)                          # paths of a sample of all pixels
        self.first = first * self.a_sample + pixel // opaque                # path of each lane; the next are `a_sample` apart
        self.n = dr.opaque(mi.UInt32, self.n_paths)
        size = 4 * self.rows * self.n_paths
        self.position = dr.empty(mi.Float, size)        # and weight of the radiance estimate, filled in by `propagate`
        self.direction = dr.empty(mi.Float, size)       # of the continuation, and its length
        self.normal = dr.empty(mi.Float, size)          # on the incident side; probability that the BSDF chose, or -1
        self.weight = dr.empty(mi.Float, size)          # f cos / (p q) with the probability q of survival, and cos / (p q)
        self.reflected = dr.empty(mi.Float, size)       # by next-event estimation; radiance returned by the continuation
        self.emitted = dr.zeros(mi.Float, size)         # what the continuation hit, MIS weight included; unused
        self.count = dr.zeros(mi.UInt32, self.n_paths)  # vertices kept

    def arrays(self) -> Iterator[mi.Float]:
        """What the kernel of the path tracer writes."""
        yield from (self.position, self.direction, self.normal, self.weight, self.reflected, self.emitted, self.count)

    def arrive(self, path: mi.UInt32, depth: mi.UInt32, ray: mi.Ray3f, t: mi.Float, emitted: mi.Spectrum,
               active: mi.Bool) -> None:
        """The continuation of the vertex before the one at `depth` of the lane's path has arrived, after a distance t
        (infinity: nowhere)."""
        active = active & self.kept & (depth > 0) & (depth <= self.rows)
        place = (depth - 1) * self.n + self.first + path * self.a_sample
        dr.scatter(self.direction, mi.Vector4f(ray.d.x, ray.d.y, ray.d.z, t), place, active)
        dr.scatter(self.emitted, mi.Vector4f(emitted.x, emitted.y, emitted.z, 0), place, active)

    def leave(self, path: mi.UInt32, depth: mi.UInt32, si: mi.SurfaceInteraction3f, bsdf: GuidedBSDF, bs: mi.BSDFSample3f,
              weight: mi.Spectrum, survive: mi.Float, reflected: mi.Spectrum, active: mi.Bool) -> None:
        """A vertex and its continuation, of which `weight` is 0 where roulette has ended the path."""
        active = active & self.kept & (depth < self.rows)
        path = self.first + path * self.a_sample
        place = depth * self.n + path
        n = dr.mulsign(si.n, dr.dot(si.n, si.to_world(si.wi)))
        learnable = (dr.max(weight) > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        cosine = dr.maximum(dr.dot(n, si.to_world(bs.wo)), 0)
        per_pdf = dr.select(learnable, cosine / (bs.pdf * survive), 0)
        dr.scatter(self.position, mi.Vector4f(si.p.x, si.p.y, si.p.z, 0), place, active)
        dr.scatter(self.normal, mi.Vector4f(n.x, n.y, n.z, bsdf.chosen_by_bsdf), place, active)
        dr.scatter(self.weight, mi.Vector4f(weight.x, weight.y, weight.z, per_pdf), place, active)
        dr.scatter(self.reflected, mi.Vector4f(reflected.x, reflected.y, reflected.z, 0), place, active)
        dr.scatter(self.count, depth + 1, path, active)

    @dr.syntax
    def propagate(self) -> None:
        """From the end of each path to its start: the weight of radiance estimates, and the radiance returned."""
        path = dr.arange(mi.UInt32, self.n_paths)
        left = dr.gather(mi.UInt32, self.count, path)
        radiance = mi.Spectrum(0)                       # R: of the vertex that the walk has come to
        while left > 0:
            left -= 1
            place = left * self.n + path
            weight = dr.gather(mi.Vector4f, self.weight, place)
            reflected = dr.gather(mi.Vector4f, self.reflected, place)
            emitted = dr.gather(mi.Vector4f, self.emitted, place)
            incident = mi.Spectrum(emitted.x, emitted.y, emitted.z) + radiance
            returned = mi.Spectrum(weight.x, weight.y, weight.z) * incident
            dr.scatter(self.position, mi.luminance(incident) * weight.w, 4 * place + 3)
            dr.scatter(self.reflected, mi.luminance(returned), 4 * place + 3)
            radiance = mi.Spectrum(reflected.x, reflected.y, reflected.z) + returned
        dr.eval(self.position, self.reflected)

    def particles(self) -> Particles:
        """All vertices, path by path, as particles that carry the radiance that arrived (`propagate` comes first)."""
        return Particles(self.position, self.direction, self.normal, places(self.count, self.rows), self.n_paths)

    def returned(self, place: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        """Luminance returned by the continuation of vertices, and the probability that the BSDF chose it, or -1."""
        return dr.gather(mi.Float, self.reflected, 4 * place + 3), dr.gather(mi.Float, self.normal, 4 * place + 3)
