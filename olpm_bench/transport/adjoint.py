"""How light paths scatter: the adjoint of what Mitsuba's `path` computes at a surface.

A camera path that arrives along wi and goes on to wo asks the BSDF for  f(wi, wo) cos_s(wo),  with the cosine of the
shading normal.  A light path comes from the other end.  It asks the same BSDF with its directions exchanged, in radiance
mode, and puts the cosines of the geometric normal n in the place of the one that is part of the value:

    f*(wi, wo) cos = f(wo, wi) cos_s(wi) |n . wo| / |n . wi|                        (Veach 1997, section 5.3)

This holds for every BSDF, and needs neither the shading frame nor the index of refraction.  The usual formula is the BSDF
in importance mode times  |cos_s(wi) n.wo / (cos_s(wo) n.wi)|  (eq. 5.19).  It is wrong for `normalmap` and `bumpmap`,
whose frame is not that of the surface interaction, and for BSDFs that are not reciprocal: `hair`, `principledthin` and
some that were measured.

Specular components have no value to ask for.  Their samples in importance mode are weighted by the cosines of the normal
that reflected or refracted, which the two directions tell.  That leaves one error: a `normalmap` or `bumpmap` with its
shadowing function darkens a specular sample by the direction that it goes to, and not by the one that it came from.

A light path can't go where its own density is 0.  Behind a map of normals these are directions to the other side of the
surface, where `path` sees light that leaks through.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi


def eval_pdf(bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, wo: mi.Vector3f,
             active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
    """Of a light path that arrives along `si.wi` and leaves along `wo`.

    Args:
        wo: in the local shading frame of `si`.

    Returns:
        f* cos [1/sr], and the density with which a camera path that arrives along `wo` is scattered to `si.wi` [1/sr].
        Specular components have neither.
    """
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = wo
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(mi.TransportMode.Radiance), seen, si.wi, active)
    return value * _geometric_cosines(si, wo), pdf


def sample_weight(bsdf: mi.BSDFPtr, si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f, weight: mi.Spectrum,
                  active: mi.Bool) -> mi.Spectrum:
    """The factor f* cos / p of a light path that was scattered to `bs.wo`, in place of the sampler's own.

    Args:
        bs: the sample, `bs.pdf` being its density, also of a mixture with other techniques.
        weight: of the sample, from `sample` in importance mode.  Where it is 0 the sample has failed, and its density means
            nothing.  Specular samples are weighted by it, as they have no value to ask for.
    """
    finite = dr.all(dr.isfinite(bs.wo))                         # others have failed, too, whatever they weigh
    smooth = finite & (bs.pdf > 0) & ~dr.all(weight == 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    value, _ = eval_pdf(bsdf, si, bs.wo, active & smooth)
    specular = weight * _geometric_cosines(si, bs.wo) * _specular_cosines(si.wi, bs)
    return dr.select(smooth, value / bs.pdf, dr.select(finite, specular, 0))


def _geometric_cosines(si: mi.SurfaceInteraction3f, wo: mi.Vector3f) -> mi.Float:
    """|n . wo| / |n . wi|; 0 along the surface."""
    cos_i, cos_o = dr.abs(dr.dot(si.n, si.to_world(si.wi))), dr.abs(dr.dot(si.n, si.to_world(wo)))
    return dr.select(cos_i > 0, cos_o / cos_i, 0)


def _specular_cosines(wi: mi.Vector3f, bs: mi.BSDFSample3f) -> mi.Float:
    """|m . wi| / |m . wo|, m being the normal that reflected or refracted: by how much the solid angle of a beam grows, but for
    eta^2, which importance mode leaves out.

    The two directions tell m, which is along  wi + eta wo:  it need not be the shading normal of the surface interaction.
    0 where the two normals see the light's direction from different sides, which is where maps of normals reject a camera path.
    """
    m = wi + bs.eta * bs.wo
    cos_i, cos_o = dr.dot(m, wi), dr.dot(m, bs.wo)
    same_side = wi.z * m.z * cos_i > 0
    ratio = dr.select(same_side & (cos_o != 0), dr.abs(cos_i / cos_o), 0)
    return dr.select(dr.squared_norm(m) > 1e-10, ratio, 1)              # 1: what goes straight on
