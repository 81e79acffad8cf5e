"""The guided path tracer: THE core loop.  Read this first.

A unidirectional path tracer with next-event estimation, as Mitsuba's `path`.  Two things differ: it scatters through
:class:`~olpm_bench.transport.guided_bsdf.GuidedBSDF`, and it ends paths by their expected contribution
(:mod:`~olpm_bench.transport.roulette`).  Without a guide these are the BSDF and roulette on throughput, and this is `path`.
"""
from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from olpm_bench.transport import roulette
from olpm_bench.transport.camera_paths import CameraPaths
from olpm_bench.transport.camera_rays import CameraRays, paths_a_lane, sums_samples
from olpm_bench.transport.guided_bsdf import GuidedBSDF
from olpm_bench.transport.light_sampling import LightSampling
from olpm_bench.transport.mis import mis_weight, power_heuristic, relative_density
from olpm_bench.transport.scene_checks import Fingerprint, require_valid_box
from olpm_bench.transport.settings import IntegratorSettings

if TYPE_CHECKING:
    from olpm_bench.transport.guide import Guide


class GuidedPathIntegrator(mi.ad.integrators.common.ADIntegrator):
    """Path tracing guided by learnt directional distributions of incident radiance.

    Args:
        settings: depth, roulette and BSDF fraction.
        guide: from `olpm_bench.train` or `Guide.load`; None traces unguided.

    Emitters that the camera sees directly are black where the scene's own integrator says so, too, by `hide_emitters`.
    """

    def __init__(self, settings: IntegratorSettings | None = None, guide: Guide | None = None,
                 props: mi.Properties | None = None) -> None:
        super().__init__(props or mi.Properties("guided_path"))
        self.settings = settings or IntegratorSettings()
        self.guide = guide
        self.checked: tuple[mi.Scene, Guide | None] | None = None
        self.lights: LightSampling | None = None        # of the scene that was rendered last

    def light_sampling(self, scene: mi.Scene) -> LightSampling:
        """Of a scene, whose emitters and bounds are looked at once."""
        if self.lights is None or self.lights.scene != scene:
            self.lights = LightSampling(scene)
        return self.lights

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """An image, as `mi.render` asks for it."""
        sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        return self.render_paths(scene, sensor, seed, spp)

    def render_paths(self, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int,
                     log: CameraPaths | None = None) -> mi.TensorXf:
        """An image, and if asked for the vertices of its paths.

        Its samples are independent, whatever the scene's sampler: others round their number, and a lane takes several.

        Args:
            spp: samples a pixel; 0: as many as the scene asks for.
            log: keeps the vertices; of as many paths as the image has samples.
        """
        self._check(scene)
        film, spp = sensor.film(), spp or sensor.sampler().sample_count()
        with dr.suspend_grad():
            camera = CameraRays(sensor, spp, self.paths_a_lane(sensor, spp))
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(dr.opaque(mi.UInt32, seed), dr.width(camera.corner))
            film.prepare([])
            ray, importance, position = camera.next(sampler)
            L, valid, _ = self.walk(scene, sampler, ray, True, importance, camera, log)
            weight, alpha = camera.paths_a_lane, dr.select(valid, mi.Float(1), 0)
            if log is not None:
                dr.schedule(*log.arrays())
            if sums_samples(film):
                dr.eval(L)              # all at once: each part that is summed by itself would trace all paths
                L, position = camera.sum_pixels(L)
                weight, alpha = dr.opaque(mi.Float, spp), mi.Float(1)
            block = film.create_block()
            self._splat(block, film, position, L, weight, alpha, ray)
            film.put_block(block)
            return film.develop()

    def _check(self, scene: mi.Scene) -> None:
        """Once for each scene and guide: refuse what can only give wrong images, and warn of a guide that is of no use.

        Raises:
            InputError: the scene has lights at infinity and shapes without a valid box.
        """
        if self.checked is not None and self.checked[0] is scene and self.checked[1] is self.guide:
            return
        require_valid_box(scene)
        if self.guide is not None and self.guide.scene is not None:
            difference = Fingerprint.of(scene).difference(self.guide.scene)
            if difference is not None:
                warnings.warn(f"the guide was trained in another scene: this one has {difference}; the image is right, but "
                              "guided by what was learnt elsewhere", stacklevel=3)
        self.checked = scene, self.guide

    def paths_a_lane(self, sensor: mi.Sensor, spp: int) -> int:
        """How many samples of its pixel a lane takes: one without a guide, where more save nothing."""
        return 1 if self.guide is None else paths_a_lane(sensor, spp)

    @staticmethod
    def _splat(block, film, position, value, weight, alpha, ray):
        mi.ad.integrators.common.ADIntegrator._splat_to_block(block, film, position, value, weight, alpha, [], ray.wavelengths)

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Radiance along camera rays, for those who ask without a film."""
        L, valid, _ = self.walk(scene, sampler, ray, active)
        return L, valid, []

    @dr.syntax
    def walk(self, scene, sampler, ray, active, ray_weight=1, camera=None, log=None):
        """Trace the path of each ray, and the further ones of a lane; returns the sum of their radiance, whether the last hit
        anything, and their number of vertices.

        Args:
            ray_weight: importance that the camera gives each.
            camera: where they come from and further ones are to be had; its pixels are what the roulette looks at.
            log: keeps the vertices.
        """
        guide, fraction, rr_depth, window = self.guide, self.settings.fraction, self.settings.rr_depth, self.settings.window
        max_depth = self.settings.max_depth if self.settings.max_depth >= 0 else 0xFFFFFFFF
        estimate = guide.pixels if guide is not None and self.settings.roulette == "contribution" else None
        pixel = estimate.at(camera.uv) if estimate is not None and camera is not None else None
        paths = camera.paths_a_lane if camera is not None else 1
        end_paths, know_worth = self.settings.roulette != "none", pixel is not None
        worth = window * pixel if pixel is not None else mi.Float(0)        # what a path is worth to its pixel
        ctx, lights = mi.BSDFContext(), self.light_sampling(scene)
        hide_emitters = self.hide_emitters or getattr(scene.integrator(), "hide_emitters", False)

        ray = mi.Ray3f(ray)
        L = mi.Spectrum(0)                              # radiance carried to the camera
        beta = mi.Spectrum(ray_weight)                  # throughput of the path so far
        eta = mi.Float(1)                               # relative index of refraction along the path
        depth = mi.UInt32(0)                            # segments traced
        path, vertices = mi.UInt32(0), mi.UInt32(0)     # number of the lane's path, and vertices of those before it
        active = mi.Bool(active)
        si_prev = dr.zeros(mi.Interaction3f)            # the vertex the ray leaves, ...
        pdf_prev = mi.Float(1)                          # ... the density it was continued with,
        delta_prev = mi.Bool(True)                      # ... and whether that was a specular direction
        valid_ray = mi.Bool(not hide_emitters and scene.environment() is not None)

        while active:
            si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=(depth == 0), active=active)

            # ---------------------- Direct emission ----------------------
            ds = mi.DirectionSample3f(scene, si, si_prev)
            emitter_pdf = lights.pdf(si_prev, si, ds, active & ~delta_prev)
            visible = active & ~((depth == 0) & hide_emitters)
            emitted = ds.emitter.eval(si, visible) & visible
            nee = relative_density(pdf_prev, emitter_pdf)       # how densely next-event estimation finds it
            L += beta * power_heuristic(nee) * emitted
            if dr.hint(log is not None, mode="scalar"):
                log.arrive(path, depth, ray, si.t, emitted, nee, active)

            # Emitters on the surface are hit even at the last depth; everything below needs one more segment.
            active_next = active & si.is_valid() & (depth + 1 < max_depth)
            bsdf = GuidedBSDF(si.bsdf(ray), si, guide, fraction, active_next)

            # ---------------------- Emitter sampling ----------------------
            active_em = active_next & bsdf.smooth
            ds, weight_em = lights.sample(si, sampler.next_2d(active_em), active_em)
            active_em &= ds.pdf > 0

            # ------ Value of the emitter's direction, and the continuation ------
            value, pdf_em, bs, weight = bsdf.eval_pdf_sample(
                ctx, si.to_local(ds.d), sampler.next_1d(active_next), sampler.next_2d(active_next), active_next)
            mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf_em))
            found = value * weight_em & active_em
            reflected = found * mis_em
            L += beta * reflected
            if dr.hint(log is not None, mode="scalar"):
                log.light(path, depth, si, bsdf, ds, mi.luminance(weight_em) * mis_em, mi.luminance(found), active_em)

            # ---------------------- Roulette ----------------------
            survive = mi.Float(1)                       # probability of going on
            if dr.hint(end_paths, mode="scalar"):
                survive = roulette.by_throughput(beta * weight, eta * bs.eta, depth + 1 >= rr_depth)
            if dr.hint(know_worth, mode="scalar"):
                known = (bsdf.outgoing >= 0) & (depth > 0)
                survive = dr.select(known, roulette.by_contribution(beta, bsdf.outgoing, worth, depth), survive)
            active_next &= dr.max(weight) > 0
            survives = (survive == 1) | (sampler.next_1d(active_next & (survive < 1)) < survive)
            active_next &= survives
            weight = dr.select(active_next, weight / survive, 0)
            if dr.hint(log is not None, mode="scalar"):
                log.leave(path, depth, si, bsdf, bs, weight, survive, reflected, active & si.is_valid())

            # ---------------------- Update loop variables ----------------------
            ray = lights.origins.spawn(si, si.to_world(bs.wo))
            beta *= weight
            eta *= bs.eta
            si_prev = dr.detach(mi.Interaction3f(si), True)
            pdf_prev = bs.pdf
            delta_prev = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            valid_ray |= active & si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            depth[active & si.is_valid()] += 1
            active = active_next

            # ---------------------- The lane's next path ----------------------
            if dr.hint(paths > 1, mode="scalar"):
                begins = ~active & (path + 1 < paths)
                fresh, fresh_weight, _ = camera.next(sampler, begins)
                ray, beta, eta = dr.select(begins, fresh, ray), dr.select(begins, fresh_weight, beta), dr.select(begins, 1, eta)
                pdf_prev, delta_prev = dr.select(begins, 1, pdf_prev), delta_prev | begins
                vertices += dr.select(begins, depth, 0)
                depth, path = dr.select(begins, 0, depth), dr.select(begins, path + 1, path)
                active |= begins

        return L & valid_ray, valid_ray, vertices + depth

    def to_string(self) -> str:
        return f"GuidedPathIntegrator[{self.settings}, guide={self.guide}]"
