"""`olpm-bench inspect`: the guides of an experiment at what one pixel sees, beside the truth.

Guides are not stored with cells: each is trained here as its cell trains it, which for budgets in samples is the very same guide
that its rendering began with.
For budgets in seconds the clock of a cell decided how many passes it got: as many as the stored cell had, if there is one, else
as many as fit into the budget's share here.
"""
from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench import scenes
from olpm_bench.bench import cell as cells
from olpm_bench.bench import environment, vertex
from olpm_bench.bench.clock import Clock
from olpm_bench.bench.config import CellSpec, ConfigError, Experiment
from olpm_bench.bench.files import SCHEMA_VERSION, require_inside, slug, write_json
from olpm_bench.bench.progress import Bar
from olpm_bench.bench.results import Results
from olpm_bench.bench.run import require_memory
from olpm_bench.report import figures, landings, records
from olpm_bench.report import inspect as picture
from olpm_bench.suggest import closest
from olpm_bench.transport.camera_paths import CameraPaths
from olpm_bench.transport.gather import GATHERS, Gathered, binned
from olpm_bench.transport.guide import MIN_PARTICLES, Guide
from olpm_bench.transport.particles import emit_photons, trace
from olpm_bench.transport.training import PassStatistics, Training
from olpm_bench.transport.view import records_seen
from olpm_bench.transport.window import by_contribution

IMAGE_PATHS = 2 ** 20       # of the image that shows where the pixel is


@dataclass
class Learnt:
    """A method's guide, what its last pass would bring to its records, where it comes from, and the passes of its training."""
    guide: Guide
    batches: dict[str, Gathered]        # by kind of particles
    source: str
    passes: list[PassStatistics] = field(default_factory=list)


def inspect(experiment: Experiment, folder: Path, pixels: Sequence[tuple[int, int]], *, scene: str | None = None,
            methods: Sequence[str] = (), seed: int | None = None, number: int | None = None, path_seed: int = 0, passes: int = 16,
            guides: Mapping[str, Path] | None = None) -> list[Path]:
    """Draw what each pixel meets, the records of each method, and where the particles of its training land, by room, if the
    scene is an embedded one that has several; returns the files written.

    The last method's guide guides the paths of the truth and of the image, which are unbiased with any; and it decides which
    share of direct light the truth has, see :mod:`olpm_bench.bench.vertex`.

    Args:
        folder: of the experiment's results, which may not exist; pictures go to `inspect` in it.
        pixels: (x, y) from the top left.
        scene: one of the experiment's; may be left out where there is one only.
        methods: some of the experiment's; by default `Experiment.shown`.
        seed: of the training; the experiment's first by default.
        number: of the vertex on the path that `path_seed` gives; the first that is not purely specular by default.
        passes: of the truth, `vertex.STRATA`^2 paths a bin each.
        guides: method -> file to read its guide from, in place of training.

    Raises:
        ConfigError: no such scene or method, or a pixel without such a vertex.
        InputError, OSError: a guide that can't be read or trained; a link that leads out of `folder`.
    """
    require_inside(folder / "inspect", folder)
    specs = _specs(experiment, scene, methods, experiment.seeds[0] if seed is None else seed)
    guided = [spec for spec in specs if spec.training is not None]
    files, name = dict(guides or {}), specs[0].scene.name
    known = [spec.method.name for spec in guided]
    for method in files:
        if method not in known:
            raise ConfigError(f"--guide {method}={files[method]}: no method {method!r} with a guide; "
                              f"known: {', '.join(known)}{closest(method, known)}")
    require_memory([spec for spec in guided if spec.method.name not in files])
    loaded = cells.load_scene(specs[0])
    vertices = {pixel: _vertex(loaded, pixel, specs[0].integrator.max_depth, number, path_seed) for pixel in pixels}
    learnt: dict[str, Learnt] = {}
    with Bar(len(guided) + len(vertices)) as bar:
        def progress(index: int, what: str) -> Callable[[float], None]:
            return lambda share: bar.at(index + share, what)

        for index, spec in enumerate(guided):
            method = spec.method.name
            learnt[method] = (_from_file(loaded, spec, files[method]) if method in files else
                              _train(loaded, spec, Results(folder), progress(index, f"training {method}")))
            guide = learnt[method].guide
            bar.say(f"{method}: {learnt[method].source}; {guide.records} records, {guide.trained:.0%} of them trained")
        last = guided[-1].method.name if guided else None
        best = learnt[last].guide if last is not None else None
        image = _image(loaded, (guided or specs)[-1], best)
        shown = records_seen(loaded, best).record if best is not None else None
        written = _records_maps(loaded, learnt, image, pixels, folder / "inspect" / slug(name))
        if rooms := _rooms(specs[0]):
            written += _by_room(learnt, rooms[0], folder / "inspect", slug(name))
        for index, (pixel, at) in enumerate(vertices.items()):
            truth = vertex.truth(loaded, at, specs[0].integrator, best, passes, seed=path_seed,
                                 on_pass=progress(len(guided) + index, f"truth at {pixel[0]},{pixel[1]}"))
            columns = [_column(loaded, spec, experiment.looks[spec.method.name], at, truth, learnt.get(spec.method.name))
                       for spec in specs]
            title = f"{name}, pixel {pixel[0]},{pixel[1]}: vertex {at.number}, on {at.shape}"
            bar.say(f"{title}; noise of a sample: {', '.join(f'{c.name} {c.sampled.deviation:.2f}' for c in columns)}")
            written += _write(picture.Page(title, image, shown, pixel, at, truth, columns, last), folder / "inspect", specs[0])
    return written


def _specs(experiment: Experiment, scene: str | None, methods: Sequence[str], seed: int) -> list[CellSpec]:
    """A scene's cells with one seed, in the order of the methods."""
    if scene is None and len(experiment.scene) > 1:
        raise ConfigError(f"{experiment.path}: which scene? --scene NAME, one of "
                          f"{', '.join(s.name for s in experiment.scene)}")
    known = [method.name for method in experiment.method]
    for method in methods:
        if method not in known:
            raise ConfigError(f"--method {method}: no such method in {experiment.path}; known: {', '.join(known)}"
                              + closest(method, known))
    shown = methods or [method.name for method in experiment.shown]
    cells = experiment.of_scenes([scene] if scene else []).model_copy(update={"seeds": [seed]}).cells()
    return [spec for spec in cells if spec.method.name in shown]


def _vertex(scene: mi.Scene, pixel: tuple[int, int], max_depth: int, number: int | None, seed: int) -> vertex.Vertex:
    where, found = f"pixel {pixel[0]},{pixel[1]}", None
    for found in vertex.trace(scene, scene.sensors()[0], pixel, max_depth, seed):
        if found.number == number or (number is None and found.smooth):
            break
    else:
        if found is None:
            raise ConfigError(f"{where} sees no surface that a path could go on from")
        if number is not None:
            raise ConfigError(f"{where}: the path with --path-seed {seed} has {found.number} vertices, no vertex {number}")
        raise ConfigError(f"{where}: the path with --path-seed {seed} meets only mirrors and glass")
    if not found.smooth:
        raise ConfigError(f"{where}: vertex {number}, on {found.shape}, is a mirror or glass: nothing is learnt there")
    return found


# ---------------------------------------------------------------- guides

def _train(scene: mi.Scene, spec: CellSpec, results: Results, on_progress: Callable[[float], None]) -> Learnt:
    """Train as the cell does."""
    assert spec.training is not None
    rooms = _rooms(spec)
    seconds = spec.budget.seconds
    cell = results.read_cell(spec.scene.name, spec.method.name, spec.seed) if seconds is not None else None
    clock, done, seen, told = Clock(count_wait=environment.uses_llvm()), list[PassStatistics](), 0.0, dict[str, None]()
    with cells.Kernels.watched() as kernels:
        with clock.lap("train", kernels.compiled):
            training = Training(scene, spec.method.representation or {}, spec.training, spec.integrator, spec.seed,
                                regions=(rooms[1], len(rooms[0])) if rooms else None)
            dr.sync_thread()
        passes, wanted = training.run(), training.passes
        if cell is not None:
            wanted = min(wanted, cell.info["training_passes"])
        while len(done) < wanted and (cell is not None or clock.charged < cells.end_of_training(
                spec.training.share, seconds, clock.charged, seen)):
            with clock.lap("train", kernels.compiled):
                statistics = next(passes)
                dr.sync_thread()
            seen = statistics.seen or seen
            done.append(statistics)
            told |= dict.fromkeys(statistics.warnings)
            on_progress(len(done) / wanted)
    source = f"trained with {len(done)} passes"
    if cell is not None:
        source += f", as its cell {cell.folder}"
        if cell.info.get("key") != spec.key:
            source += ", which was made with other settings or by another version"
    elif seconds is not None:
        source += f", as many as end training here, after {clock.charged:.1f} s (there is no cell to follow)"
    source += "".join(f"; {warning}" for warning in told)
    return Learnt(training.radiance, _last_pass(scene, spec, training.radiance, training), source, done)


def _rooms(spec: CellSpec) -> tuple[tuple[str, ...], Callable[[np.ndarray], np.ndarray]] | None:
    return None if spec.scene.file else scenes.rooms(spec.scene.name, spec.scene.arguments)


def _from_file(scene: mi.Scene, spec: CellSpec, path: Path) -> Learnt:
    guide = Guide.load(path, spec.method.representation_name)
    return Learnt(guide, _last_pass(scene, spec, guide), f"read from {path}")


def _last_pass(scene: mi.Scene, spec: CellSpec, guide: Guide, training: Training | None = None) -> dict[str, Gathered]:
    """What one more pass of each kind would teach, traced with the guides as they are; they learn nothing from it.

    Photons only with the training, which also has the guide of importance.
    """
    s, max_depth, found = spec.training, spec.integrator.max_depth, {}
    assert s is not None
    seed = cells.WARM_UP_SEED + spec.seed
    if training is not None and s.passes:
        importance, mode = training.importance if s.schedule != "single_batch" else None, mi.TransportMode.Importance
        n, sampler = s.photons * (1 if importance else s.passes), mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed), n)
        rays = training.emission.emit(sampler) if training.emission is not None else emit_photons(scene, sampler)
        window, (_, told) = None, training.hits.get(mode, (0.0, 0.0))
        if s.weight_window == "contribution" and told and importance and importance.records and guide.records:
            window = by_contribution(importance, guide, told, rays.unit / dr.opaque(mi.Float, n))
        hits = trace(scene, rays, sampler, importance, s.fraction, max_depth, mode, window)
        if len(hits) and guide.records:
            found["photons"] = GATHERS[s.gather](guide.cache, hits, s.neighbours, s.parallax)
    if s.camera_passes and guide.records:
        pixels = spec.scene.width * spec.scene.height
        spp = 1 << max(0, round(np.log2(s.camera_paths / pixels)))          # as in training
        integrator: Any = cells.make_integrator(spec, guide)
        sensor = scene.sensors()[0]
        paths = CameraPaths(pixels, spp, max_depth, integrator.paths_a_lane(sensor, spp))
        dr.eval(integrator.render_paths(scene, sensor, seed, spp, paths))
        paths.propagate()
        if len(lessons := paths.lessons(paths.particles().place)):
            found["camera paths"] = binned(guide.cache, lessons, s.neighbours, s.parallax)
    return found


# ---------------------------------------------------------------- pictures

def _image(scene: mi.Scene, spec: CellSpec, guide: Guide | None) -> np.ndarray:
    spp = cells.power_of_two(IMAGE_PATHS / (spec.scene.width * spec.scene.height))
    return cells.to_numpy(cells.render_pass(scene, cells.make_integrator(spec, guide), cells.WARM_UP_SEED, spp))


def _records_maps(scene: mi.Scene, learnt: Mapping[str, Learnt], image: np.ndarray, pixels: Sequence[tuple[int, int]],
                  stem: Path) -> list[Path]:
    written = []
    for name, method in learnt.items():
        written.append(stem.with_name(f"{stem.name}_records_{slug(name)}.png"))
        records.records_map(records_seen(scene, method.guide), image, MIN_PARTICLES, written[-1], marks=pixels)
    return written


def _by_room(learnt: Mapping[str, Learnt], rooms: Sequence[str], out: Path, scene: str) -> list[Path]:
    written = []
    for name, method in learnt.items():
        if any(statistics.regions for statistics in method.passes):
            with figures.style():
                figures.save(landings.draw(method.passes, rooms), out, f"{scene}_particles_{slug(name)}")
            written.append(out / f"{scene}_particles_{slug(name)}.png")
    return written


def _column(scene: mi.Scene, spec: CellSpec, look: int, at: vertex.Vertex, truth: vertex.Truth,
            learnt: Learnt | None) -> picture.Column:
    density = vertex.density(scene, at, learnt.guide if learnt else None, spec.integrator.fraction, truth.bins)
    particles = {}
    if learnt is not None and density.record is not None:
        particles = {kind: vertex.particles(batch, learnt.guide, at, density.record) for kind, batch in learnt.batches.items()}
    return picture.Column(
        spec.method.name, look, density, vertex.fit(truth.incident, density.guide) if density.guide is not None else None,
        vertex.fit(truth.reflected, density.mixture), particles)


def _write(page: picture.Page, out: Path, spec: CellSpec) -> list[Path]:
    """The picture as PNG and PDF, and its figures as JSON."""
    name = f"{slug(spec.scene.name)}_{page.pixel[0]}_{page.pixel[1]}_vertex{page.vertex.number}"
    with figures.style():
        figures.save(picture.draw(page), out, name)
    methods = {c.name: {
        "record": c.density.record, "particles": c.density.particles, "radius": c.density.radius,
        "fraction": c.density.fraction, "learnt": c.learnt and dataclasses.asdict(c.learnt),
        "sampled": dataclasses.asdict(c.sampled)} for c in page.columns}
    write_json(out / f"{name}.json", {
        "schema_version": SCHEMA_VERSION, "scene": spec.scene.name, "pixel": page.pixel, "seed": spec.seed,
        "vertex": {"number": page.vertex.number, "position": page.vertex.p, "normal": page.vertex.frame[2],
                   "shape": page.vertex.shape},
        "truth": {"bins": page.truth.bins, "paths": page.truth.paths, "noise": page.truth.noise, "guide": page.guide},
        "methods": methods})
    return [out / f"{name}.{suffix}" for suffix in ("png", "pdf", "json")]
