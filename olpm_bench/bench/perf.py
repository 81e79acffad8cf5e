"""What things cost: the figures behind `olpm-bench perf`.

CPU nanoseconds are summed over threads, so they hold on a machine with neighbours; seconds of a training pass are wall.
Runs of what is compared are interleaved, and the median of several is given.
"""
from __future__ import annotations

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import psutil

import representations
from olpm_bench import scenes
from olpm_bench.bench import probe
from olpm_bench.bench.cell import Kernels
from olpm_bench.scenes.load import load
from olpm_bench.transport import settings as options
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.training import Training
from representations.interface import ParticleBatch

REPEATS = 5
MAX_DEPTH = 13
PARTICLES: dict[str, Any] = {"photons": 300_000, "importons": 100_000}      # of a training pass
CAMERA_PATHS = 2 ** 17
RECORDS, EACH = 4096, 256                                   # of the on-line update: records, particles of each


def measure(scene: str = "door_ajar", width: int = 160, height: int = 90, spp: int = 32, passes: int = 20) -> dict[str, Any]:
    """All figures, as one JSON-serialisable object.

    Args:
        scene: embedded name or Mitsuba XML on which vertices and training passes are timed.
        spp: samples a pixel of the timed renders.
        passes: training passes with the mixture, of `PARTICLES` and of `CAMERA_PATHS`; at least 3, timed from the third on.
    """
    if scenes.is_file(scene):
        probe.check(Path(scene), {})
    loaded = load(scene, width=width, height=height, max_depth=MAX_DEPTH)
    figures: dict[str, Any] = {"scene": scene, "width": width, "height": height, "em_ns_per_particle": em_ns_per_particle()}
    training_passes(loaded, 4)                      # compiles what can be: also what only passes without new records do
    guide, seconds, misses, rss = training_passes(loaded, passes)
    figures |= {"pass_seconds": seconds, "recompiles_after_warmup": misses, "rss_mb_by_pass": rss}
    figures["pass_seconds_nearest"] = training_passes(loaded, min(passes, 5), gather="nearest")[1]
    training_passes(loaded, 1, 4)
    _, seconds, misses, rss = training_passes(loaded, 1, passes)
    figures |= {"camera_pass_seconds": seconds, "camera_recompiles_after_warmup": misses, "camera_rss_mb_by_pass": rss}
    guides: dict[str, Guide | None] = {"unguided": None, "gaussian_mixture": guide}
    for name in representations.names():
        if name not in guides:
            training = Training(loaded, name, options.training(passes=3, camera_passes=0, **PARTICLES),
                                options.integrator(max_depth=MAX_DEPTH))
            for _ in training.run():
                pass
            guides[name] = training.radiance
    vertex_ns = vertex_cost(loaded, guides, spp)
    figures["path_vertex_ns"], figures["unguided_vertex_ns"] = vertex_ns.pop("path"), vertex_ns.pop("unguided")
    figures["guided_vertex_ns"] = vertex_ns
    figures["guided_over_unguided"] = {name: ns / figures["unguided_vertex_ns"] for name, ns in vertex_ns.items()}
    figures["peak_rss_mb"] = _peak_rss_mb()
    figures["threads"] = dr.thread_count()
    return figures


def em_ns_per_particle() -> float:
    """One on-line update of the default mixture, all records trained before [CPU ns a particle]."""
    rng = np.random.default_rng(0)
    wo = rng.normal(size=(RECORDS * EACH, 3)) * (0.3, 0.3, 0.1) + (0.4, 0.2, 0.8)
    wo[:, 2] = np.abs(wo[:, 2])
    batch = ParticleBatch.from_arrays(mi.Vector3f((wo / np.linalg.norm(wo, axis=1, keepdims=True)).T), dr.ones(mi.Float, len(wo)),
                                      mi.UInt32(np.repeat(np.arange(RECORDS), EACH)), RECORDS)
    mixture = representations.create("gaussian_mixture")
    states = [mixture.update(mixture.init(RECORDS), batch)]
    dr.eval(states)

    def update() -> None:
        states[0] = mixture.update(states[0], batch)
        dr.eval(states[0])

    update()
    return float(np.median([_cpu_seconds(update) for _ in range(REPEATS)])) / len(batch) * 1e9


def training_passes(scene: mi.Scene, passes: int, camera_passes: int = 0,
                    gather: str = "binned") -> tuple[Guide, dict[str, float], int, list[float]]:
    """Train a mixture: the guide, median wall seconds of a pass by part, kernels compiled after pass 2, memory by pass.

    With camera passes these are timed, and not the particle passes before them.
    """
    settings = options.training(passes=passes, camera_passes=camera_passes, camera_paths=CAMERA_PATHS, gather=gather, **PARTICLES)
    training = Training(scene, "gaussian_mixture", settings, options.integrator(max_depth=MAX_DEPTH))
    seconds, rss, warm_up, first = [], [], 0, passes if camera_passes else 0
    with Kernels.watched() as kernels:
        for statistics in training.run():
            kernels.compiled()
            if statistics.index < first + 2:
                warm_up = kernels.count
            else:
                seconds.append(statistics.seconds)
            if statistics.index >= first:
                rss.append(psutil.Process().memory_info().rss / 2 ** 20)
    median = {part: float(np.median([s[part] for s in seconds])) for part in seconds[0]}
    median["total"] = float(np.median([sum(s.values()) for s in seconds]))
    return training.radiance, median, kernels.count - warm_up, rss


def vertex_cost(scene: mi.Scene, guides: dict[str, Guide | None], spp: int) -> dict[str, float]:
    """CPU ns a path vertex of the path tracer with each guide, and of Mitsuba's own `path`; all without roulette."""
    from olpm_bench.transport.path import GuidedPathIntegrator  # whose base class exists once a variant is set

    class VertexCounter(GuidedPathIntegrator):
        """Renders the number of vertices of each path."""

        def walk(self, *args, **kwargs):
            _, valid, vertices = super().walk(*args, **kwargs)
            return mi.Spectrum(mi.Float(vertices)), valid, vertices

    settings = options.IntegratorSettings(max_depth=MAX_DEPTH, roulette="none")
    integrators = {name: GuidedPathIntegrator(settings, guide) for name, guide in guides.items()}
    integrators["path"] = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "rr_depth": MAX_DEPTH})
    pixels = int(np.prod(scene.sensors()[0].film().crop_size()))
    vertices = {name: float(_render(scene, VertexCounter(settings, guide), 8, 0).mean()) * pixels * spp
                for name, guide in guides.items()}
    vertices["path"] = vertices["unguided"]
    times: dict[str, list[float]] = {name: [] for name in integrators}
    for repeat in range(REPEATS + 1):
        for name, integrator in integrators.items():
            seconds = _cpu_seconds(functools.partial(_render, scene, integrator, spp, repeat))
            if repeat:                                                      # the first one compiles
                times[name].append(seconds)
    return {name: float(np.median(t)) / vertices[name] * 1e9 for name, t in times.items()}


def _render(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> np.ndarray:
    return mi.render(scene, integrator=integrator, spp=spp, seed=seed).numpy()


def _cpu_seconds(work: Callable[[], Any]) -> float:
    dr.sync_thread()
    start = time.process_time()
    work()
    dr.sync_thread()
    return time.process_time() - start


def _peak_rss_mb() -> float:
    memory = psutil.Process().memory_info()
    try:
        import resource
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    except ImportError:                         # Windows has it in psutil
        return getattr(memory, "peak_wset", memory.rss) / 2 ** 20
