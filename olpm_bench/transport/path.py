"""The guided path tracer: THE core loop.  Read this first.

A unidirectional path tracer with next-event estimation, as Mitsuba's `path`; the one difference is that it scatters
through :class:`~olpm_bench.transport.guided_bsdf.GuidedBSDF`.  Without a guide that is the BSDF, and this is `path`.
"""
from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.guided_bsdf import GuidedBSDF
from olpm_bench.transport.settings import IntegratorSettings

if TYPE_CHECKING:
    from olpm_bench.transport.guide import Guide


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic for a sample of technique a (Veach 1997); 0 where technique a can't make it.

    By the ratio of the densities: their squares overflow where a rough interface is nearly specular.
    """
    return dr.select(pdf_a > 0, dr.rcp(1 + dr.square(pdf_b / pdf_a)), 0)


class GuidedPathIntegrator(mi.SamplingIntegrator):
    """Path tracing guided by learnt directional distributions of incident radiance.

    Args:
        settings: depth, roulette and BSDF fraction.
        guide: from `olpm_bench.train` or `Guide.load`; None traces unguided.
    """

    def __init__(self, settings: IntegratorSettings | None = None, guide: Guide | None = None,
                 props: mi.Properties | None = None) -> None:
        super().__init__(props or mi.Properties("guided_path"))
        self.settings = settings or IntegratorSettings()
        self.guide = guide

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Radiance along camera rays, as Mitsuba asks for it."""
        L, valid, _ = self.walk(scene, sampler, ray, active)
        return L, valid, []

    @dr.syntax
    def walk(self, scene, sampler, ray, active):
        """Trace paths; returns their radiance, whether they hit anything, and their number of vertices."""
        max_depth = self.settings.max_depth if self.settings.max_depth >= 0 else 0xFFFFFFFF
        rr_depth = self.settings.rr_depth if self.settings.roulette == "throughput" else 0xFFFFFFFF
        fraction, guide = self.settings.fraction, self.guide
        ctx = mi.BSDFContext()

        ray = mi.Ray3f(ray)
        L = mi.Spectrum(0)                              # radiance carried to the camera
        beta = mi.Spectrum(1)                           # throughput of the path so far
        eta = mi.Float(1)                               # relative index of refraction along the path
        depth = mi.UInt32(0)                            # segments traced
        active = mi.Bool(active)
        si_prev = dr.zeros(mi.Interaction3f)            # the vertex the ray leaves, ...
        pdf_prev = mi.Float(1)                          # ... the density it was continued with,
        delta_prev = mi.Bool(True)                      # ... and whether that was a specular direction
        valid_ray = mi.Bool(not self.hide_emitters and scene.environment() is not None)

        while active:
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=(depth == 0), active=active)

            # ---------------------- Direct emission ----------------------
            ds = mi.DirectionSample3f(scene, si, si_prev)
            emitter_pdf = scene.pdf_emitter_direction(si_prev, ds, active & ~delta_prev)
            visible = active & ~((depth == 0) & self.hide_emitters)
            L[visible] += beta * mis_weight(pdf_prev, emitter_pdf) * ds.emitter.eval(si, visible)

            # Emitters on the surface are hit even at the last depth; everything below needs one more segment.
            active_next = active & si.is_valid() & (depth + 1 < max_depth)
            bsdf = GuidedBSDF(si.bsdf(ray), si, guide, fraction, active_next)

            # ---------------------- Emitter sampling ----------------------
            active_em = active_next & bsdf.smooth
            ds, weight_em = scene.sample_emitter_direction(si, sampler.next_2d(active_em), True, active_em)
            active_em &= ds.pdf != 0

            # ------ Value of the emitter's direction, and the continuation ------
            value, pdf_em, bs, weight = bsdf.eval_pdf_sample(
                ctx, si.to_local(ds.d), sampler.next_1d(active_next), sampler.next_2d(active_next), active_next)
            mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf_em))
            L[active_em] += beta * value * weight_em * mis_em

            # ---------------------- Update loop variables ----------------------
            ray = si.spawn_ray(si.to_world(bs.wo))
            beta *= weight
            eta *= bs.eta
            si_prev = dr.detach(mi.Interaction3f(si), True)
            pdf_prev = bs.pdf
            delta_prev = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            valid_ray |= active & si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            depth[active & si.is_valid()] += 1

            # ---------------------- Stopping criterion ----------------------
            beta_max = dr.max(beta)
            active = active_next & (beta_max != 0)
            survive = dr.minimum(beta_max * dr.square(eta), 0.95)       # cancels the eta^2 of refraction
            roulette = active & (depth >= rr_depth)
            survives = sampler.next_1d(roulette) < survive
            beta[roulette] *= dr.rcp(survive)
            active &= ~roulette | survives

        return L & valid_ray, valid_ray, depth

    def to_string(self) -> str:
        return f"GuidedPathIntegrator[{self.settings}, guide={self.guide}]"
