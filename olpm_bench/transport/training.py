"""Training: importons and photons teach each other where to go [T 70-91].

    for each training pass:
        trace importons from the camera, guided by radiance      -> update the importance guide
        trace photons from the emitters, guided by importance    -> update the radiance guide
    render with the radiance guide

Each trace is followed by one gather and one on-line update, after which its particles are dropped: memory does not
grow with the number of passes.
"""
from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport.cache import RecordCache
from olpm_bench.transport.gather import GATHERS
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.particles import ParticleRays, Particles, emit_importons, emit_photons, trace
from olpm_bench.transport.settings import InputError, TrainingSettings


@dataclass
class PassStatistics:
    """What one training pass did; seconds are wall time of evaluated work."""
    index: int
    passes: int
    photons: int = 0
    importons: int = 0
    stored: int = 0                 # photon hits
    kept: int = 0                   # photons that taught a record
    records: int = 0                # of the radiance guide
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("trace", "grow", "gather", "update"), 0.0))


def train(scene: mi.Scene, representation: str | dict[str, Any] = "gaussian_mixture",
          settings: TrainingSettings | None = None, *, max_depth: int = 13, seed: int = 0,
          sensor: mi.Sensor | None = None, on_pass: Callable[[PassStatistics], None] | None = None) -> Guide:
    """Train a guide for camera paths; see :class:`Training` for the arguments.

    Args:
        on_pass: called with the statistics of each pass.
    """
    training = Training(scene, representation, settings or TrainingSettings(), max_depth, seed, sensor)
    for statistics in training.run():
        if on_pass is not None:
            on_pass(statistics)
    return training.radiance


def check_traceable(scene: mi.Scene) -> None:
    """
    Raises:
        InputError: the scene has no emitter or no camera, or a participating medium, which we do not simulate.
    """
    if not scene.emitters():
        raise InputError("the scene has no emitter")
    if not scene.sensors():
        raise InputError("the scene has no camera")
    for shape in scene.shapes():
        if shape.is_medium_transition():
            raise InputError(f"shape '{shape.id()}' holds a participating medium; only surfaces can be guided")


def surface_bounds(scene: mi.Scene) -> mi.ScalarBoundingBox3f:
    """Box around all surfaces.

    Mitsuba 3.9.1 gives meshes that its loader merged from rectangles, and with them the scene, an invalid box.

    Raises:
        InputError: the scene has no surface.
    """
    bounds = mi.ScalarBoundingBox3f()
    for shape in scene.shapes():
        if shape.bbox().valid():
            bounds.expand(shape.bbox())
        elif shape.is_mesh():
            vertices = shape.vertex_positions_buffer().numpy().reshape(-1, 3).astype(float)
            bounds.expand(mi.ScalarPoint3f(*vertices.min(0)))
            bounds.expand(mi.ScalarPoint3f(*vertices.max(0)))
    if not bounds.valid():
        raise InputError("the scene has no surface to guide paths from")
    return bounds


class Training:
    """A radiance guide and an importance guide that learn from each other's particles.

    Args:
        scene: any Mitsuba scene with an emitter and a camera.
        representation: a registered name, or as in a TOML ``{"type": "gaussian_mixture", "components": 8}``.
        settings: passes, particles, gather, ...
        max_depth: of the paths to be guided.
        seed: everything random follows from it.
        sensor: the camera, from which importons start; the scene's first by default.

    Raises:
        InputError: the scene can't be guided; the message says why.
    """

    def __init__(self, scene: mi.Scene, representation: str | dict[str, Any], settings: TrainingSettings, max_depth: int,
                 seed: int = 0, sensor: mi.Sensor | None = None) -> None:
        check_traceable(scene)
        self.scene, self.settings, self.max_depth, self.seed = scene, settings, max_depth, seed
        specification = {"type": representation} if isinstance(representation, str) else dict(representation)
        self.radiance, self.importance = (Guide(RecordCache(surface_bounds(scene), settings.record_radius), specification)
                                          for _ in range(2))
        self.sensor = sensor or scene.sensors()[0]
        self.sampler = mi.load_dict({"type": "independent"})
        self.draws = 0                      # seeds used so far

    def run(self) -> Iterator[PassStatistics]:
        """Train as the settings say, one pass at each step."""
        step = {"interleaved": self._interleaved, "single_batch": self._single_batch}[self.settings.schedule]
        for index in range(1 if self.settings.schedule == "single_batch" and self.settings.passes else self.settings.passes):
            yield step(PassStatistics(index, self.settings.passes))

    def _interleaved(self, statistics: PassStatistics) -> PassStatistics:
        """Importons, then photons, each guided by what the other has learnt so far."""
        s = self.settings
        if s.importons:
            importons = self._trace(emit_importons, self.sensor, s.importons, self.radiance, mi.TransportMode.Radiance,
                                    statistics)
            self._learn(self.importance, importons, statistics)
            statistics.importons = s.importons
        return self._photons(s.photons, self.importance, statistics)

    def _single_batch(self, statistics: PassStatistics) -> PassStatistics:
        """All photons at once, unguided, and one fit [T 51-52]."""
        return self._photons(self.settings.photons * self.settings.passes, None, statistics)

    def _photons(self, n: int, importance: Guide | None, statistics: PassStatistics) -> PassStatistics:
        photons = self._trace(emit_photons, self.scene, n, importance, mi.TransportMode.Importance, statistics)
        statistics.kept = self._learn(self.radiance, photons, statistics)
        statistics.photons, statistics.stored = n, len(photons)
        statistics.records = self.radiance.records
        return statistics

    def _trace(self, emit: Callable[[Any, mi.Sampler], ParticleRays], source: mi.Scene | mi.Sensor, n: int, guide: Guide | None,
               mode: mi.TransportMode, statistics: PassStatistics) -> Particles:
        with _Seconds(statistics, "trace"):
            self.sampler.seed(dr.opaque(mi.UInt32, self._next_seed()), n)
            rays = emit(source, self.sampler)
            return trace(self.scene, rays, self.sampler, guide, self.settings.fraction, self.max_depth, mode)

    def _learn(self, guide: Guide, particles: Particles, statistics: PassStatistics) -> int:
        if len(particles) == 0:             # nothing of this pass has reached a second surface
            return 0
        with _Seconds(statistics, "grow"):
            p, weight, _, _, n = particles.read(particles.place)
            guide.grow(p, n, weight > 0, self._next_seed())
        with _Seconds(statistics, "gather"):
            batch = GATHERS[self.settings.gather](guide.cache, particles, self.settings.neighbours)
        with _Seconds(statistics, "update"):
            guide.learn(batch, self._next_seed())
        return len(batch)

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
