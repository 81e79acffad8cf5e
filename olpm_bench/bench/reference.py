"""References: converged images by Mitsuba's own unguided `path`, in two halves that share no random number.

Made bit by bit: passes go to half A and half B in turn, what is there is saved every half minute, and another call
goes on from it.  The halves give the noise floor below which no error can be measured.
"""
from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from olpm_bench.bench import cell, environment
from olpm_bench.bench.accumulator import Accumulator
from olpm_bench.bench.clock import Clock
from olpm_bench.bench.config import CellSpec, Experiment
from olpm_bench.bench.files import ResultError, read_json, require_inside
from olpm_bench.bench.lock import locked
from olpm_bench.bench.progress import Bar
from olpm_bench.bench.reference_file import Reference, find_reference, read_reference, write_reference
from olpm_bench.bench.run import reference_folders, reference_of
from olpm_bench.transport import headroom

ESTIMATOR = "path, unguided"
SAVE_SECONDS = 30.0
PASS_SECONDS = 1.0
LEAST_SECONDS = 300.0           # of a reference
TIMES_BUDGET = 25               # charged seconds of a reference over those of a cell: a fifth of its error, if that is unguided
SEEDS = {"a": 2**31, "b": 2**31 + 2**30}        # cells stay below 2^30


@dataclass
class Halves:
    """A reference in the making."""
    a: Accumulator
    b: Accumulator
    seconds: float = 0.0        # charged, over all calls

    @staticmethod
    def start(width: int, height: int, found: Path | None) -> Halves:
        """Empty, or what another call has left in a folder.

        Raises:
            ResultError: what is there is broken or newer.
        """
        if found is None:
            return Halves(Accumulator.empty(height, width), Accumulator.empty(height, width))
        r = read_reference(found, width, height)
        try:
            a = Accumulator.resume(r.a, r.a_variance, r.meta["spp_a"], r.meta["passes_a"])
            b = Accumulator.resume(r.b, r.b_variance, r.meta["spp_b"], r.meta["passes_b"])
            return Halves(a, b, r.meta["seconds"])
        except KeyError as error:
            raise ResultError(f"{found / 'meta.json'} is broken: no {error}; remove the folder") from None

    def reference(self, meta: dict[str, Any]) -> Reference:
        a, b = self.a, self.b
        meta = {**meta, "spp_a": a.spp, "spp_b": b.spp, "passes_a": a.passes, "passes_b": b.passes,
                "seconds": self.seconds, "noise": self.noise()}
        return Reference(a=a.mean.astype(np.float32), a_variance=a.variance().astype(np.float32),
                         b=b.mean.astype(np.float32), b_variance=b.variance().astype(np.float32), meta=meta)

    def __str__(self) -> str:
        return f"{self.a.spp} + {self.b.spp} spp in {self.seconds:.0f} s, noise {self.noise():.2%}"

    def noise(self) -> float:
        """Standard error of the mean of both halves over the image's mean."""
        brightness = self.a.mean.mean() + self.b.mean.mean()
        error = np.sqrt(self.a.variance() + self.b.variance()).mean()
        return float(error / brightness) if brightness > 0 else float("inf")


def seconds_for(experiment: Experiment) -> float:
    """Charged seconds that a reference of this experiment takes where nobody says how many."""
    return max(LEAST_SECONDS, TIMES_BUDGET * (experiment.budget.seconds or 0.0))


def to_make(experiment: Experiment, root: Path) -> dict[str, float]:
    """Scene name -> charged seconds that its reference still takes, of those that are missing or were interrupted.

    Raises:
        ResultError: a reference's meta.json is broken, or of a later version.
    """
    left = {}
    for scene in experiment.scene:
        if scene.reference is not None:
            continue
        found = reference_of(experiment, scene, root)
        seconds = _left(found) if found is not None else seconds_for(experiment)
        if seconds > 0:
            left[scene.name] = seconds
    return left


def _left(folder: Path) -> float:
    """Charged seconds that an interrupted reference was still to take; 0 if it was not interrupted."""
    meta = read_json(folder / "meta.json")
    return max(0.0, float(meta.get("wanted_seconds", 0.0)) - float(meta.get("seconds", 0.0)))


def make(experiment: Experiment, root: Path) -> None:
    """Make the references that `to_make` names, or go on with them.

    Raises:
        ResultError, SceneError, OSError: as `improve`.
    """
    for name, seconds in to_make(experiment, root).items():
        improve(experiment.of_scenes([name]), root, seconds)


def improve(experiment: Experiment, root: Path, seconds: float) -> dict[str, Path]:
    """Make, or go on with, the reference of every scene that does not name one.

    Args:
        root: the `--results` folder; references go to `root/references`.
        seconds: charged seconds to spend on each scene.

    Returns:
        Scene name -> reference folder.

    Raises:
        ResultError: one that is there is broken or newer, another process is at work on it, or a link leads out of `root`.
        SceneError, OSError: a scene cannot be used; a file cannot be written.
    """
    specs = {spec.scene.name: spec for spec in experiment.cells() if spec.scene.reference is None}
    made = {}
    with Bar(seconds * len(specs)) as bar:
        for index, (name, spec) in enumerate(specs.items()):
            made[name] = _improve(spec, experiment, root, seconds, bar, index * seconds)
    return made


def _improve(spec: CellSpec, experiment: Experiment, root: Path, seconds: float, bar: Bar, done: float) -> Path:
    key = spec.reference_key
    folder = root / "references" / key
    require_inside(folder, root)
    with locked(folder) as alive:
        halves = Halves.start(spec.scene.width, spec.scene.height,
                              find_reference(key, reference_folders(experiment, root)))
        pixels = spec.scene.width * spec.scene.height
        headroom.require(pixels * 3 * 8 * 8, f"the halves of a reference of {pixels} pixels", "a smaller image")
        scene = cell.load_scene(spec)
        integrator = mi.load_dict({"type": "path", "max_depth": experiment.max_depth(spec.scene), "rr_depth": 5,
                                   "hide_emitters": scene.integrator().hide_emitters})
        meta = {"key": key, "scene": spec.scene.name, "width": spec.scene.width, "height": spec.scene.height,
                "max_depth": experiment.max_depth(spec.scene), "parameters": spec.scene.resolved_arguments(),
                "wanted_seconds": halves.seconds + seconds,         # more than "seconds" if this is interrupted
                "estimator": ESTIMATOR, "versions": environment.versions(), "commit": environment.commit()}
        spp = _spp_of_pass(spec, scene, integrator, seconds)
        clock, saved = Clock(count_wait=environment.uses_llvm()), time.monotonic()
        before, resumed = halves.seconds, halves.a.passes + halves.b.passes
        try:
            while clock.charged < seconds or min(halves.a.passes, halves.b.passes) < 2:
                for half, seed in ((halves.a, SEEDS["a"]), (halves.b, SEEDS["b"])):
                    with clock.lap("render"):
                        rendered = cell.render_pass(scene, integrator, seed + half.passes, spp)
                    image = cell.to_numpy(rendered)
                    cell.check_pixels(image, f"the pass with seed {seed + half.passes}")
                    half.add(image, spp)
                alive()
                halves.seconds = before + clock.charged
                bar.at(done + clock.charged, f"{spec.scene.name}: {halves}")
                if time.monotonic() - saved > SAVE_SECONDS:
                    alive(at_once=True)
                    write_reference(folder, halves.reference(meta))
                    saved = time.monotonic()
        finally:                # also when interrupted: what is there is a valid reference
            if min(halves.a.passes, halves.b.passes) >= 2 and halves.a.passes + halves.b.passes > resumed:
                alive(at_once=True)         # who was silent for too long does not write over another's
                write_reference(folder, halves.reference(meta))
    bar.say(f"{spec.scene.name}: {halves}, floor mean|A-B|/2 = {halves.reference(meta).noise_floor:.3g}: {folder}")
    return folder


def _spp_of_pass(spec: CellSpec, scene: mi.Scene, integrator: mi.Integrator, seconds: float) -> int:
    """Compile, and find the samples a pixel of a pass of about a second (less for short budgets)."""
    spp, limit = 1, cell.power_of_two(cell.largest_pass(spec))
    target = min(PASS_SECONDS, seconds / 8)
    while True:
        cell.render_pass(scene, integrator, cell.WARM_UP_SEED, spp)          # compiles
        start = time.perf_counter()
        cell.render_pass(scene, integrator, cell.WARM_UP_SEED + 1, spp)
        elapsed = time.perf_counter() - start
        if elapsed > target / 4 or spp >= limit:
            return cell.power_of_two(min(limit, spp * target / max(elapsed, 1e-6)))
        spp = min(4 * spp, limit)
