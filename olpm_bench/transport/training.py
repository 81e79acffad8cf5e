"""Training: importons and photons teach each other where to go [T 70-91], and then camera paths where light comes from.

    for each particle pass:
        trace importons from the camera, guided by radiance      -> update the importance guide
        trace photons from the emitters, guided by importance    -> update the radiance guide
    for each camera pass:
        render an image, guided by radiance                      -> update the radiance guide
    render with the radiance guide

Each trace is followed by one gather and one on-line update, after which its particles are dropped: memory does not
grow with the number of passes.  The images of camera passes are unbiased, since a pass learns nothing before its end.
"""
from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport.bounds import surface_bounds
from olpm_bench.transport.cache import RecordCache
from olpm_bench.transport.camera_paths import CameraPaths
from olpm_bench.transport.emission import EmissionGuide, distant_lights
from olpm_bench.transport.gather import GATHERS, Gathered, by_record, pooled
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.particles import ParticleRays, Particles, emit_importons, emit_photons, trace
from olpm_bench.transport.roulette import PixelEstimate
from olpm_bench.transport.scene_checks import Fingerprint, require_valid_box
from olpm_bench.transport.seen_extent import SeenExtent
from olpm_bench.transport.settings import InputError, IntegratorSettings, TrainingSettings
from olpm_bench.transport.usable import require_usable
from olpm_bench.transport.view import records_seen
from olpm_bench.transport.window import by_contribution
from representations.interface import ParticleBatch

LITTLE = 0.05       # share of what the camera sees that is guided, below which `train` warns
SETTLE = 3          # gathers from which the records of a single batch find their radii, as on-line in as many passes, ...
ONE_OF = 4          # ... each of one particle in so many, with as many fewer neighbours


@dataclass
class PassStatistics:
    """What one training pass did; seconds are wall time of evaluated work."""
    index: int
    passes: int
    photons: int = 0
    importons: int = 0
    spp: int = 0                    # of the image that a camera pass rendered
    stored: int = 0                 # hits of photons, or vertices of camera paths
    kept: int = 0                   # of which taught a record; those that taught several count for each
    unusable: int = 0               # particles and vertices left out, since a value was NaN, infinite or negative
    records: int = 0                # of the radiance guide
    regions: dict[str, np.ndarray] = field(default_factory=dict)    # where a caller names them: `Particles.by_region`
    seen: float = 0.0               # particles seen so far by the records that camera paths met, on average
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("trace", "grow", "gather", "update"), 0.0))
    warnings: list[str] = field(default_factory=list)               # what could not be learnt; images stay right
    image: mi.TensorXf | None = field(default=None, repr=False)

    def share(self, part: str) -> float:
        """Of the seconds, those that a part took."""
        return self.seconds[part] / max(sum(self.seconds.values()), 1e-9)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: all but the image."""
        plain = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "image"}
        return plain | {"regions": {kind: counts.tolist() for kind, counts in self.regions.items()}}


def train(scene: mi.Scene, representation: str | dict[str, Any] = "gaussian_mixture",
          settings: TrainingSettings | None = None, integrator: IntegratorSettings | None = None, *, seed: int = 0,
          sensor: mi.Sensor | None = None, on_pass: Callable[[PassStatistics], None] | None = None) -> Guide:
    """Train a guide for camera paths; see :class:`Training` for the arguments.

    What could not be learnt is told as Python warnings, once each; the image is right without it.

    Args:
        on_pass: called with the statistics of each pass.
    """
    told: set[str] = set()
    training = Training(scene, representation, settings or TrainingSettings(), integrator or IntegratorSettings(), seed, sensor)
    for statistics in training.run():
        for message in statistics.warnings:
            if message not in told:
                warnings.warn(message, stacklevel=2)
            told.add(message)
        if on_pass is not None:
            on_pass(statistics)
    if training.radiance.records and (guided := records_seen(scene, training.radiance, sensor).guided) < LITTLE:
        warnings.warn(f"{guided:.1%} of what the camera sees is guided: too few particles, or light does not enter there",
                      stacklevel=2)
    return training.radiance


def check_traceable(scene: mi.Scene) -> None:
    """
    Raises:
        InputError: the scene has no emitter or no camera, a participating medium, which we do not simulate, or lights at
            infinity and shapes without a valid box.
    """
    if not scene.emitters():
        raise InputError("the scene has no emitter")
    if not scene.sensors():
        raise InputError("the scene has no camera")
    for shape in scene.shapes():
        if shape.is_medium_transition():
            raise InputError(f"shape '{shape.id()}' holds a participating medium; only surfaces can be guided")
    require_valid_box(scene)


class Training:
    """A radiance guide and an importance guide that learn from each other's particles.

    Args:
        scene: any Mitsuba scene with an emitter and a camera.
        representation: a registered name, or as in a TOML ``{"type": "gaussian_mixture", "components": 8}``.
        settings: passes, particles, gather, ...
        integrator: that will use the guide: depth, roulette and fraction of the camera passes.
        seed: everything random follows from it.
        sensor: the camera, from which importons start; the scene's first by default.
        regions: of positions [n, 3], the index of their region, and the number of regions: for the statistics.

    Raises:
        InputError: the scene can't be guided; the message says why.
    """

    def __init__(self, scene: mi.Scene, representation: str | dict[str, Any], settings: TrainingSettings,
                 integrator: IntegratorSettings, seed: int = 0, sensor: mi.Sensor | None = None,
                 regions: tuple[Callable[[np.ndarray], np.ndarray], int] | None = None) -> None:
        from olpm_bench.transport.path import GuidedPathIntegrator  # whose base class exists once a variant is set

        check_traceable(scene)
        self.scene, self.settings, self.max_depth, self.seed = scene, settings, integrator.max_depth, seed
        specification = {"type": representation} if isinstance(representation, str) else dict(representation)
        self.sensor = sensor or scene.sensors()[0]
        self.bounds = bounds = surface_bounds(scene)
        self.seen = SeenExtent.of(scene, self.sensor, self.max_depth, bounds, settings.record_radius)
        cache = partial(RecordCache, self.seen.covered, settings.record_radius, self.seen.scale)
        self.radiance = Guide(cache(), specification, integrator.fraction if settings.learn_fraction else None,
                              settings.parallax, settings.learn_direct, settings.inherit)
        self.radiance.scene = Fingerprint.of(scene)
        self.importance = Guide(cache(), specification, parallax=settings.parallax, inherit=settings.inherit)
        self.integrator = GuidedPathIntegrator(integrator, self.radiance)
        self.luminance: np.ndarray | None = None        # of the mean of all camera passes so far (h, w), ...
        self.spp = 0                                    # ... and their samples a pixel
        self.emission = EmissionGuide(scene, bounds, settings.emission_fraction) if (
            settings.emission == "guided" and settings.schedule != "single_batch" and distant_lights(scene)) else None
        self.regions = regions
        film = self.sensor.film()
        self.pixels = int(np.prod(film.crop_size() + 2 * film.rfilter().border_size() * film.sample_border()))
        self.camera_spp = 1 << max(0, round(np.log2(settings.camera_paths / self.pixels)))      # of a camera pass
        self.sampler = mi.load_dict({"type": "independent"})
        self.draws = 0                      # seeds used so far
        particles = {"interleaved": [self._interleaved], "importons_first": [self._importons, self._photons],
                     "single_batch": [self._single_batch]}[settings.schedule]
        times = min(settings.passes, 1) if settings.schedule == "single_batch" else settings.passes
        self.steps = [(step, times) for step in particles] + [(self._camera_pass, settings.camera_passes)]
        # Of photons and importons: hits a particle leaves in their first pass, and what the window is told for as many.
        self.hits: dict[mi.TransportMode, tuple[float, float]] = {}

    def run(self) -> Iterator[PassStatistics]:
        """Train as the settings say, one pass at each step.  Who stops early has a guide as good as the passes done."""
        for index, step in enumerate(step for step, times in self.steps for _ in range(times)):
            said = [*self._out_of_scale(), *self.seen.warnings(self.radiance.cache.radius)] if index == 0 else []
            yield step(PassStatistics(index, self.passes, warnings=said))

    def _out_of_scale(self) -> list[str]:
        """What to tell of a scene that is too far from the origin for single precision."""
        warning = self.integrator.light_sampling(self.scene).origins.warning()
        return [warning] if warning else []

    @property
    def passes(self) -> int:
        """Of particles and of camera paths together."""
        return sum(times for _, times in self.steps)

    def camera_pass(self) -> PassStatistics:
        """One more pass of camera paths, after or beside those of `run`."""
        return self._camera_pass(PassStatistics(self.passes, self.passes))

    def _interleaved(self, statistics: PassStatistics) -> PassStatistics:
        """Importons, then photons, each guided by what the other has learnt so far."""
        self._importons(statistics)
        return self._photons(statistics)

    def _importons(self, statistics: PassStatistics) -> PassStatistics:
        if n := self.settings.importons:
            importons = self._trace(partial(emit_importons, self.sensor), n, self.radiance, self.importance,
                                    mi.TransportMode.Radiance, statistics)
            self._learn(self.importance, importons, n, statistics)
            if self.emission is not None and importons.departures is not None:
                with _Seconds(statistics, "update"):
                    self.emission.learn(importons.departures, self._next_seed())
            statistics.importons = n
        return statistics

    def _photons(self, statistics: PassStatistics) -> PassStatistics:
        if self.emission is not None and (unguided := self.emission.unguided):
            statistics.warnings.append(f"too few importons leave towards {unguided} of {len(self.emission.lights)} lights at "
                                       "infinity: their photons start as the emitters sample them")
        return self._learn_photons(self.settings.photons, self.importance, statistics)

    def _single_batch(self, statistics: PassStatistics) -> PassStatistics:
        """All photons at once, unguided, and one fit [T 51-52]."""
        return self._learn_photons(self.settings.photons * self.settings.passes, None, statistics)

    def _learn_photons(self, n: int, importance: Guide | None, statistics: PassStatistics) -> PassStatistics:
        lights = self.integrator.light_sampling(self.scene)
        unguided = partial(emit_photons, self.scene, lights=lights)
        emit = self.emission.emit if self.emission is not None else unguided
        photons = self._trace(emit, n, importance, self.radiance, mi.TransportMode.Importance, statistics)
        statistics.kept = self._learn(self.radiance, photons, n, statistics)
        statistics.photons, statistics.stored = n, len(photons)
        statistics.records = self.radiance.records
        return statistics

    def _trace(self, emit: Callable[[mi.Sampler], ParticleRays], n: int, guide: Guide | None, own: Guide,
               mode: mi.TransportMode, statistics: PassStatistics) -> Particles:
        """Particles that `guide` guides and `own` will learn from."""
        with _Seconds(statistics, "trace"):
            self.sampler.seed(dr.opaque(mi.UInt32, self._next_seed()), n)
            rays = emit(self.sampler)
            window, (wanted, told) = None, self.hits.get(mode, (0.0, 0.0))
            if self.settings.weight_window == "contribution" and told and guide is not None and guide.records and own.records:
                window = by_contribution(guide, own, told, rays.unit / dr.opaque(mi.Float, n))
            emission = self.emission if mode == mi.TransportMode.Radiance else None
            particles = trace(self.scene, rays, self.sampler, guide, self.settings.fraction, self.max_depth, mode, window,
                              emission)
            if len(particles):
                left = len(particles) / n
                self.hits[mode] = (wanted, told * wanted / left) if window else (left, left)
        kind = "photons" if mode == mi.TransportMode.Importance else "importons"
        self._count_unusable(rays.unusable + particles.unusable, n, kind, statistics)
        if rays.unit[0] == 0:
            statistics.warnings.append(f"the {kind} carry nothing: the emitters have no power")
        elif len(particles) == 0:
            statistics.warnings.append(f"none of {n} {kind} met a second surface: nothing is learnt from them")
        if self.regions is not None:
            statistics.regions[kind] = particles.by_region(*self.regions)
        return particles

    def _count_unusable(self, unusable: int, n: int, what: str, statistics: PassStatistics) -> None:
        """
        Raises:
            InputError: most of n are unusable.
        """
        statistics.unusable += unusable
        if warning := require_usable(unusable, n, what):
            statistics.warnings.append(warning)

    def _learn(self, guide: Guide, particles: Particles, emitted: int, statistics: PassStatistics) -> int:
        if len(particles) == 0:             # nothing of this pass has reached a second surface
            return 0
        if self.settings.shrink and self.settings.schedule == "single_batch":
            some, fewer = particles.one_of(ONE_OF), max(1, self.settings.neighbours // ONE_OF)
            for _ in range(SETTLE):         # there is no next pass in which records could be smaller
                guide.measure(self._gather(guide, some, fewer, statistics))
        batch = self._gather(guide, particles, self.settings.neighbours, statistics)
        with _Seconds(statistics, "update"):
            if len(batch):
                guide.learn_fluence(batch, emitted)
            guide.learn_particles(batch, self._next_seed())
            if self.settings.shrink:
                guide.measure(batch)
        return len(batch)

    def _gather(self, guide: Guide, particles: Particles, neighbours: int, statistics: PassStatistics) -> Gathered:
        """The particles of each record, when records have shrunk to what the last batch asked for, and new ones are added."""
        with _Seconds(statistics, "grow"):
            p, weight, _, _, n = particles.read(particles.place)
            if self.settings.shrink:
                guide.shrink()
            self._grow(guide, p, n, (weight > 0) & self._of_use(guide, p, n), statistics)
        with _Seconds(statistics, "gather"):
            return GATHERS[self.settings.gather](guide.cache, particles, neighbours, self.settings.parallax)

    def _of_use(self, guide: Guide, p: mi.Point3f, n: mi.Normal3f) -> mi.Bool:
        """Where particles may add records to a guide: photons, outside the seen box, only where importons have been."""
        if guide is self.importance or not self.importance.records:
            return mi.Bool(True)
        return self.seen.contains(p) | self.importance.cache.lookup(p, n, mi.Bool(True))[2]

    def _grow(self, guide: Guide, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool, statistics: PassStatistics) -> None:
        guide.grow(p, n, active, self._next_seed())
        if guide.cache.full:
            statistics.warnings.append(f"{guide.records} records, the most there can be: the rest of the surfaces stays "
                                       "unguided; make record_radius larger")

    def _camera_pass(self, statistics: PassStatistics) -> PassStatistics:
        """Render an image with the guide as it is, and learn from its paths."""
        spp = self.camera_spp
        paths = CameraPaths(self.pixels, spp, self.max_depth, self.integrator.paths_a_lane(self.sensor, spp))
        with _Seconds(statistics, "trace"):
            image = self.integrator.render_paths(self.scene, self.sensor, self._next_seed(), spp, paths)
            dr.eval(image)
            paths.propagate()
        vertices, guide = paths.particles(), self.radiance
        if len(vertices):
            self._count_unusable(vertices.unusable, len(vertices), "vertices of camera paths", statistics)
            with _Seconds(statistics, "grow"):
                p, _, _, _, n = vertices.read(vertices.place)
                self._grow(guide, p, n, dr.squared_norm(n) > 0, statistics)         # not where all is specular
            with _Seconds(statistics, "gather"):
                batch = ParticleBatch.empty(guide.records)
                if self.settings.learn_radiance:
                    batch = pooled(guide.cache, paths.lessons(vertices.place), self.settings.neighbours, self.settings.parallax)
                place, offset = by_record(guide.cache, vertices)
            if len(place):          # a record serves some of them
                with _Seconds(statistics, "update"):
                    guide.learn_camera(batch, *paths.returned(place), offset, self._next_seed())
                statistics.seen = float(np.mean(guide.count.numpy()[np.diff(offset.numpy().astype(np.int64)) > 0]))
            statistics.kept = len(batch)
        else:
            statistics.warnings.append("the camera sees no surface: there is nothing to guide")
        self._estimate_pixels(image, spp, statistics)
        if len(vertices) and not np.any(self.luminance):
            statistics.warnings.append("no camera path has met light: it may not enter what the camera sees")
        statistics.spp, statistics.stored, statistics.image = spp, len(vertices), image
        statistics.records = guide.records
        return statistics

    def _estimate_pixels(self, image: mi.TensorXf, spp: int, statistics: PassStatistics) -> None:
        """Tell the guide what pixels are worth, from all camera passes so far."""
        grey = mi.Bitmap(image).convert(mi.Bitmap.PixelFormat.Y, mi.Struct.Type.Float32, srgb_gamma=False)
        luminance = np.array(grey, np.float64).reshape(image.shape[:2])
        invalid = ~np.isfinite(luminance)
        if invalid.any():           # one would be in every pixel's estimate
            statistics.warnings.append(f"{invalid.sum()} pixels of a training image are NaN or infinite: look for such values in "
                                       "the scene's textures and lights")
            luminance[invalid] = 0
        before = 0.0 if self.luminance is None else self.luminance
        self.spp += spp
        self.luminance = before + (luminance - before) * spp / self.spp
        self.radiance.pixels = PixelEstimate(self.luminance)

    def _next_seed(self) -> int:
        self.draws += 1
        return int(np.random.SeedSequence((self.seed, self.draws)).generate_state(1)[0])


class _Seconds:
    """Add the wall time of a block, with all its work evaluated, to a pass's statistics."""

    def __init__(self, statistics: PassStatistics, part: str) -> None:
        self.statistics, self.part = statistics, part

    def __enter__(self) -> None:
        self.start = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        dr.sync_thread()
        self.statistics.seconds[self.part] += time.perf_counter() - self.start
