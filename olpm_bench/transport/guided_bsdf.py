"""One-sample mixture of a BSDF and a guide: the only place where the two meet.

The continuation ray, the weight of next-event estimation and the weight of an emitter hit all take their density
from here, so sampler and weights cannot drift apart.  Particles scatter through the same class.

    p(wo) = c p_bsdf(wo) + (1 - c) p_guide(wo),    weight = f cos / p                          [T 76-77]

c is the BSDF *fraction*, learnt record by record or fixed; c = 1 where the BSDF is purely specular, or where the cache
holds no trained record.
A specular component of a mixed BSDF can't be hit by the guide and keeps c times its own probability.
"""
from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.mis import density

if TYPE_CHECKING:
    from olpm_bench.transport.guide import Guide, GuidedPoint


def incident_normal(si: mi.SurfaceInteraction3f) -> mi.Normal3f:
    """The geometric normal, turned to the side that `si.wi` is on."""
    return dr.mulsign(si.n, dr.dot(si.n, si.to_world(si.wi)))


class GuidedBSDF:
    """A BSDF at a surface point, with a BSDF's own verbs; without a guide it is the BSDF itself.

    Directions are in the local shading frame of `si`, densities per solid angle [1/sr].

    Args:
        bsdf: the BSDF to be mixed.
        si: the surface interaction; `si.wi` decides on which side of the surface the guide is asked.
        guide: the learnt distributions; None, or one without records, leaves the BSDF alone.
        fraction: probability c of sampling the BSDF where both can be used and the guide has not learnt it.
        active: lanes in use.

    Attributes:
        outgoing: mean radiance (luminance) that the record's surface returns, without next-event estimation; < 0: not known.
        reflected: and with it; 0: not known, see :func:`~olpm_bench.transport.camera_paths.wanted`.
        chosen_by_bsdf: of the last sample, the probability that the BSDF chose it, c p_bsdf / p; -1 where c = 1 or it failed.
    """

    def __init__(self, bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, guide: Guide | None, fraction: float,
                 active: mi.Bool = True) -> None:
        self.bsdf, self.si = bsdf, si
        self.smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        self.guided: GuidedPoint | None = None
        self.outgoing, self.reflected, self.chosen_by_bsdf = mi.Float(-1), mi.Float(0), mi.Float(-1)
        if guide is not None and guide.records:
            self.guided = guide.at(si.p, incident_normal(si), self.smooth)
            learnt = self.guided.fraction
            self.fraction = dr.select(self.guided.valid, dr.select(learnt > 0, learnt, fraction), 1)
            self.outgoing, self.reflected = self.guided.outgoing, self.guided.reflected

    def eval_pdf_sample(self, ctx: mi.BSDFContext, wo: mi.Vector3f, sample1: mi.Float, sample2: mi.Point2f,
                        active: mi.Bool) -> tuple[mi.Spectrum, mi.Float, mi.BSDFSample3f, mi.Spectrum]:
        """Value f cos and density of one direction, and a sample with its weight, as `mi.BSDF.eval_pdf_sample`."""
        if self.guided is None:
            return self.bsdf.eval_pdf_sample(ctx, self.si, wo, sample1, sample2, active)
        choose_bsdf, sample1 = self._choose(sample1)
        value, pdf, bs, weight = self.bsdf.eval_pdf_sample(ctx, self.si, wo, sample1, sample2, active)
        pdf = self._mixture_pdf(pdf, wo)
        return value, pdf, *self._one_sample(ctx, choose_bsdf, bs, weight, sample1, sample2, active)

    def sample(self, ctx: mi.BSDFContext, sample1: mi.Float, sample2: mi.Point2f,
               active: mi.Bool) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """A direction and its weight f cos / p, as `mi.BSDF.sample`."""
        if self.guided is None:
            return self.bsdf.sample(ctx, self.si, sample1, sample2, active)
        choose_bsdf, sample1 = self._choose(sample1)
        bs, weight = self.bsdf.sample(ctx, self.si, sample1, sample2, active & choose_bsdf)
        return self._one_sample(ctx, choose_bsdf, bs, weight, sample1, sample2, active)

    def eval_pdf(self, ctx: mi.BSDFContext, wo: mi.Vector3f, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Value f cos and density of one direction, as `mi.BSDF.eval_pdf`."""
        value, pdf = self.bsdf.eval_pdf(ctx, self.si, wo, active)
        return value, pdf if self.guided is None else self._mixture_pdf(pdf, wo)

    def _choose(self, sample1: mi.Float) -> tuple[mi.Bool, mi.Float]:
        """Spend one uniform number on the choice of technique, and make it uniform again for the technique."""
        choose_bsdf = sample1 < self.fraction
        rescaled = dr.select(choose_bsdf, sample1 / self.fraction, (sample1 - self.fraction) / (1 - self.fraction))
        return choose_bsdf, dr.minimum(rescaled, dr.one_minus_epsilon(mi.Float))

    def _mixture_pdf(self, bsdf_pdf: mi.Float, wo: mi.Vector3f) -> mi.Float:
        assert self.guided is not None
        guide_pdf, bsdf_pdf = density(self.guided.pdf(self.si.to_world(wo))), density(bsdf_pdf)
        return dr.select(self.guided.valid, dr.lerp(guide_pdf, bsdf_pdf, self.fraction), bsdf_pdf)

    def _one_sample(self, ctx: mi.BSDFContext, choose_bsdf: mi.Bool, bs: mi.BSDFSample3f, weight: mi.Spectrum,
                    sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
        """The BSDF's proposal or the guide's, weighted by the mixture."""
        # The guide's proposal; a failed one must carry nothing, though the BSDF may well have a value where it points.
        assert self.guided is not None
        d, found = self.guided.sample(sample1, sample2, active & ~choose_bsdf)
        wo = self.si.to_local(d)
        value, bsdf_pdf = self.bsdf.eval_pdf(ctx, self.si, wo, found)
        # The BSDF's proposal; a specular one is no density and is not mixed.
        specular = choose_bsdf & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        bsdf_pdf = density(dr.select(choose_bsdf, bs.pdf, bsdf_pdf))
        value = dr.select(choose_bsdf, weight * bsdf_pdf, value)

        bs.wo = dr.select(choose_bsdf, bs.wo, wo)
        bs.eta = dr.select(choose_bsdf, bs.eta, 1)      # on the record's side of the surface; only roulette reads it
        bs.sampled_type = dr.select(choose_bsdf, bs.sampled_type, mi.UInt32(+mi.BSDFFlags.GlossyReflection))
        bs.pdf = dr.select(specular, bsdf_pdf * self.fraction, self._mixture_pdf(bsdf_pdf, bs.wo))
        weight = dr.select(specular, weight / self.fraction, dr.select(bs.pdf > 0, value / bs.pdf, 0))
        self.chosen_by_bsdf = dr.select(self.guided.valid & (bs.pdf > 0), self.fraction * bsdf_pdf / bs.pdf, -1)
        return bs, weight & active
