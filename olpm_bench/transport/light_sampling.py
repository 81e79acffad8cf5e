"""Next-event estimation, the density with which it finds a direction, and the photons of area lights.

All come from Mitsuba, unless its densities are not those of its samples.  On a mesh with smooth vertex
normals Mitsuba 3.9.1 samples a point uniformly by area, and turns that into a density per solid angle by
the *interpolated* normal n_s:

    p_A r^2 / |cos n_s|         in place of         p_A r^2 / |cos n_g|

It does so in the weight L / p of the sample and in the density of a hit; if the lamp has a texture, only in
that of a hit.  So `path` is wrong by whatever share light sampling has, and no MIS weight mends that.  In
scenes with such lamps we trace the ray of a light sample to the lamp.  What it hits says how bright and how
dense the sample is, by the same function as for a hit that the BSDF has found.  Which way a lamp shines
remains for its interpolated normal to say.

Photons leave such a lamp in proportion to cos n_s, too, where they should to cos n_g.  No image depends on
them, but they would teach guides wrong shares.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.mis import density
from olpm_bench.transport.ray_origins import RayOrigins

FLAT = 1 - 1e-5         # cosine between face and vertex normals of flat lamps: 0.26 degrees


def has_smooth_normals(shape: mi.Shape) -> bool:
    """Whether a shape is a mesh some of whose vertex normals are not those of its faces."""
    if not shape.is_mesh() or not shape.has_vertex_normals() or shape.has_face_normals():
        return False
    face = dr.arange(mi.UInt32, shape.face_count())
    normal = shape.face_normal(face)
    smooth = mi.Bool(False)
    for corner in shape.face_indices(face):
        smooth |= dr.abs(dr.dot(normal, dr.normalize(shape.vertex_normal(corner)))) < FLAT
    return bool(dr.any(smooth)[0])


class LightSampling:
    """Samples the emitters of a scene: directions to them from its surfaces, and photons.

    Attributes:
        origins: where rays start.
        smooth: whether there is an area light with smooth vertex normals.
        as_mitsuba: whether all that Mitsuba samples is right for this scene.
    """

    def __init__(self, scene: mi.Scene) -> None:
        self.scene = scene
        self.origins = RayOrigins(scene)
        self.smooth = any(shape.is_emitter() and has_smooth_normals(shape) for shape in scene.shapes())
        self.as_mitsuba = not self.smooth and self.origins.offset is None

    # ---------------------- From surfaces ----------------------

    def sample(self, si: mi.SurfaceInteraction3f, sample: mi.Point2f,
               active: mi.Bool) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """A direction to an emitter, and radiance over density; density and that are 0 if it is not seen."""
        if self.as_mitsuba:
            return self.scene.sample_emitter_direction(si, sample, True, active)
        ds, weight = self.scene.sample_emitter_direction(si, sample, False, active)
        active = active & (ds.pdf > 0)
        ray = self.origins.spawn_to(si, ds.p)
        if self.smooth:
            seen, pdf, weight = self._trace(si, ray, ds, weight, active)
        else:
            seen, pdf = active & ~self.scene.ray_test(ray, active), ds.pdf
        ds.pdf = dr.select(seen, pdf, 0)
        return ds, weight & seen

    def _trace(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, ds: mi.DirectionSample3f,
               weight: mi.Spectrum, active: mi.Bool) -> tuple[mi.Bool, mi.Float, mi.Spectrum]:
        """Whether a light sample is seen, its density and its weight, by what its ray hits.

        Args:
            ray: from `si` towards the sample, which ends just in front of it.
        """
        end = mi.Float(ray.maxt)
        ray.maxt = dr.largest(mi.Float)
        hit = self.scene.ray_intersect(ray, mi.RayFlags.All, coherent=False, active=active)
        on_surface = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Surface)
        arrives = active & on_surface & (hit.emitter(self.scene) == ds.emitter)
        found = mi.DirectionSample3f(self.scene, hit, si)
        pdf = density(self.pdf(si, hit, found, arrives))
        hit_weight = dr.select(pdf > 0, found.emitter.eval(hit, arrives) / pdf, 0)
        seen = active & (hit.t >= end) & (~on_surface | (pdf > 0))
        return seen, dr.select(on_surface, pdf, ds.pdf), dr.select(on_surface, hit_weight, weight)

    def pdf(self, ref: mi.Interaction3f, si: mi.SurfaceInteraction3f, ds: mi.DirectionSample3f,
            active: mi.Bool) -> mi.Float:
        """Density with which `sample` at `ref` finds the direction in which `si` is seen [1/sr].

        Odd values are left as they come from Mitsuba, for :mod:`~olpm_bench.transport.mis`.

        Args:
            ds: of `si`, as seen from `ref`; its normal is set to the one that counts.
        """
        if self.smooth:
            # Uniform lamps are sampled all over and shine where n_s faces; textures are sampled where n_g does.
            textured = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
            sides = dr.dot(si.n, ds.d) * dr.dot(si.sh_frame.n, ds.d)
            ds.n = dr.select(textured, si.n, mi.Normal3f(dr.mulsign(mi.Vector3f(si.n), sides)))
        return self.scene.pdf_emitter_direction(ref, ds, active)

    # ---------------------- Photons ----------------------

    def sample_photon(self, sample1: mi.Float, sample2: mi.Point2f,
                      sample3: mi.Point2f) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray that leaves any of the emitters, and its flux: radiance over density."""
        if self.as_mitsuba:
            ray, weight, _ = self.scene.sample_emitter_ray(0.0, sample1, sample2, sample3, True)
            return ray, weight
        index, choice, sample1 = self.scene.sample_emitter(sample1, True)
        emitter = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index)
        ray, weight = self.sample_ray(emitter, sample1, sample2, sample3, mi.Bool(True))
        return ray, weight * choice

    def sample_ray(self, emitter: mi.EmitterPtr, sample1: mi.Float, sample2: mi.Point2f, sample3: mi.Point2f,
                   active: mi.Bool) -> tuple[mi.Ray3f, mi.Spectrum]:
        """A ray that leaves a given emitter, and its flux, as `mi.Emitter.sample_ray`."""
        ray, weight = emitter.sample_ray(0.0, sample1, sample2, sample3, active)
        if self.as_mitsuba:
            return ray, weight
        flags = emitter.flags()
        delta = mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        shines = active & mi.has_flag(flags, mi.EmitterFlags.Surface) & ~delta
        # A short ray down to the point of the lamp tells its geometric normal.
        ps, area = emitter.sample_position(0.0, sample2, shines)
        above = self.origins.spawn(mi.Interaction3f(0, 0, ray.wavelengths, ps.p, ps.n), ps.n)
        down = mi.Ray3f(above.o, -mi.Vector3f(ps.n))
        si = self.scene.ray_intersect(down, mi.RayFlags.All, coherent=False, active=shines)
        # Directions are sampled about the interpolated normal, with density cos n_s / pi.
        si.wi = mi.warp.square_to_cosine_hemisphere(sample3)
        d = si.to_world(si.wi)
        cos_s, cos_g = mi.Frame3f.cos_theta(si.wi), dr.abs(dr.dot(si.n, d))
        found = shines & si.is_valid() & (si.emitter(self.scene) == emitter) & (cos_s > 0)
        flux = dr.select(found, emitter.eval(si, found) * (dr.pi * area * cos_g / cos_s), 0)
        leaving = self.origins.spawn(si, d)
        ray.o = dr.select(shines, leaving.o, ray.o)
        ray.d = dr.select(shines, leaving.d, ray.d)
        return ray, dr.select(shines, flux, weight)
