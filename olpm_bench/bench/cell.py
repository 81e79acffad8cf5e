"""One cell: warm up, train, render until the budget is spent.

What is on the clock: making guides, training and rendering, evaluated and synchronised.  What is not: compilation
(every kernel is compiled before the clock starts, and what was missed is taken off and counted), accumulation,
checkpoints, files, progress.  Charged seconds are defined in :mod:`olpm_bench.bench.clock`.
"""
from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.bench import environment, metrics, probe
from olpm_bench.bench.accumulator import Accumulator
from olpm_bench.bench.clock import Clock
from olpm_bench.bench.config import CellSpec
from olpm_bench.bench.progress import activity
from olpm_bench.scenes import load as scene_load
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.settings import TrainingSettings
from olpm_bench.transport.training import PassStatistics, Training
from olpm_bench.transport.view import records_seen

PASSES = 24                 # rendering passes in a budget, at least: so it is met within 1/24
SHORTEST_PASS = 0.2         # [s]: below, the fixed cost of a pass shows
MAX_LANES = 2**24           # paths in flight: about 2 GB
REPEATS = 3                 # timings of a pass in the warm-up: the shortest counts, a single one may be ten times as long
WARM_UP_PATHS = 20_000      # photons and importons of the training that compiles the kernels

HALF_LEARNT = 1500          # particles of a record with which its guide leaves twice the variance that it can come down to

# 32-bit seeds of rendering passes: cells from 0, warm-up from 2^30, reference halves from 2^31 and 3 * 2^30.
PASSES_PER_SEED = 2**15
WARM_UP_SEED = 2**30


class CellFailedError(RuntimeError):
    """A cell that was run and cannot be used; the message is the reason."""


def pass_seed(seed: int, index: int) -> int:
    """Seed of rendering pass `index` of a cell: different for every (cell seed, pass), the same for every method."""
    if index >= PASSES_PER_SEED:
        raise CellFailedError(f"more than {PASSES_PER_SEED} passes; use a larger image or a smaller budget")
    return seed * PASSES_PER_SEED + index


def load_scene(spec: CellSpec) -> mi.Scene:
    """The scene of a cell.

    A Python warning says in one line what is not as a scene file says.

    Raises:
        SceneError: it cannot be used.
    """
    s, max_depth = spec.scene, spec.integrator.max_depth
    if s.file is None:
        return scene_load.load(s.name, s.arguments, s.width, s.height, max_depth)
    stated = probe.check(s.file, s.arguments)
    if (differences := stated.differences(s.width, s.height, max_depth)) is not None:
        warnings.warn(f"scene file {s.file}: {differences}", stacklevel=2)
    with activity(f"loading {s.file.name}: {stated.shapes:,} shapes"):
        return scene_load.load(s.file, s.arguments, s.width, s.height, max_depth)


# ---------------------------------------------------------------- kernels

class Kernels:
    """What Dr.Jit compiled since last asked."""

    def __init__(self) -> None:
        self.count, self.seconds = 0, 0.0

    @staticmethod
    @contextmanager
    def watched() -> Iterator[Kernels]:
        """Watch compilation while the body runs."""
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            yield Kernels()

    def compiled(self) -> float:
        """Seconds in the compiler since the last call; also adds to the totals."""
        jit = [k for k in dr.kernel_history([dr.KernelType.JIT]) if not k["cache_hit"]]
        seconds = sum(k["backend_time"] for k in jit) * 1e-3
        self.count += len(jit)
        self.seconds += seconds
        return seconds


def make_integrator(spec: CellSpec, guide: Guide | None) -> mi.Integrator:
    from olpm_bench.transport.path import GuidedPathIntegrator  # whose base class exists once a variant is set

    return GuidedPathIntegrator(spec.integrator, guide)


def render_pass(scene: mi.Scene, integrator: mi.Integrator, seed: int, spp: int) -> mi.TensorXf:
    """One pass, evaluated and finished (h, w, 3)."""
    image = mi.render(scene, integrator=integrator, seed=seed, spp=spp)  # type: ignore[arg-type]
    dr.eval(image)
    dr.sync_thread()
    return image


def to_numpy(image: mi.TensorXf) -> np.ndarray:
    return np.asarray(image.numpy(), dtype=np.float64)[..., :3]


@dataclass(frozen=True)
class WarmUp:
    """What compiling a method's kernels on a scene told."""
    compile_seconds: float
    spp_seconds: float          # charged time of one sample a pixel, guided by the small training of the warm-up


def warm_up(spec: CellSpec, scene: mi.Scene, guide: Guide | None = None) -> WarmUp:
    """Compile every kernel of a cell, with fewer particles: kernels depend on the structure and not on sizes."""
    with Kernels.watched() as kernels:
        if guide is None and spec.training is not None:
            small = dataclasses.replace(spec.training, passes=min(spec.training.passes, 4),
                                        photons=min(spec.training.photons, WARM_UP_PATHS),
                                        importons=min(spec.training.importons, WARM_UP_PATHS),
                                        camera_passes=min(spec.training.camera_passes, 4),
                                        camera_paths=min(spec.training.camera_paths, WARM_UP_PATHS))
            training = Training(scene, spec.method.representation or {}, small, spec.integrator, WARM_UP_SEED)
            for _ in training.run():
                pass
            guide = training.radiance
        integrator = make_integrator(spec, guide)
        for spp in (1, 2):      # dividing by 1 is a kernel of its own
            render_pass(scene, integrator, WARM_UP_SEED, spp)
        kernels.compiled()
        while True:
            times = []
            for _ in range(REPEATS):
                clock = Clock(count_wait=environment.uses_llvm())
                with clock.lap("render", kernels.compiled):
                    render_pass(scene, integrator, WARM_UP_SEED, spp)
                times.append(clock.charged)
            if min(times) > seconds_of_pass(spec) / 4 or 4 * spp > largest_pass(spec):
                return WarmUp(kernels.seconds, max(min(times), 1e-6) / spp)
            spp *= 4


def largest_pass(spec: CellSpec) -> int:
    """Samples a pixel that a pass may take for the sake of memory."""
    return max(1, MAX_LANES // (spec.scene.width * spec.scene.height))


def seconds_of_pass(spec: CellSpec) -> float:
    """Charged seconds that a rendering pass may take.  The warm-up times one of a quarter of them at least."""
    return max(SHORTEST_PASS, (spec.budget.seconds or 0) / PASSES)


def spp_of_pass(spec: CellSpec, warm: WarmUp | None = None) -> int:
    """Samples a pixel of each rendering pass: by timing for a budget in seconds, else by the experiment's file alone.

    A power of two: Mitsuba divides the lane's index by it, and other divisors make other kernels.
    """
    if spec.budget.seconds is None:
        spp = (spec.budget.spp or 0) / PASSES
    else:
        assert warm is not None
        spp = seconds_of_pass(spec) / warm.spp_seconds
    return power_of_two(min(spp, largest_pass(spec)))


def power_of_two(n: float) -> int:
    """The largest power of two <= n, at least 1."""
    return 1 << max(0, int(n).bit_length() - 1)


# ---------------------------------------------------------------- one cell

@dataclass
class Measurement:
    """What a cell yields.

    In `info`, `trained` is the share of the surfaces that the camera sees whose record guides paths, and `training_ended` are the
    charged seconds when the passes of training were done: more than `train_seconds`, which leave out the tracing of images that
    enter the result.  None without a guide, or training.
    """
    info: dict[str, Any]
    trace: list[dict[str, Any]]
    image: dict[str, np.ndarray]
    checkpoints: list[np.ndarray]
    guide: Guide | None = field(repr=False, default=None)


class _Cell:
    """A cell in the making: its clock, the image so far, and what it writes down on the way."""

    def __init__(self, spec: CellSpec, kernels: Kernels) -> None:
        self.spec, self.kernels = spec, kernels
        self.clock = Clock(count_wait=environment.uses_llvm())
        self.image = Accumulator.empty(spec.scene.height, spec.scene.width)
        self.brightness = Accumulator.empty(1, 1)
        self.training: list[dict[str, Any]] = []
        self.trace: list[dict[str, Any]] = []
        self.checkpoints: list[np.ndarray] = []
        self.targets: list[float] | None = None

    @property
    def spent(self) -> float:
        """Share of the budget; the rule to stop does not look at the image."""
        budget = self.spec.budget
        return self.image.spp / budget.spp if budget.spp is not None else self.clock.charged / (budget.seconds or 1)

    def prepare(self, scene: mi.Scene, settings: TrainingSettings) -> Training:
        """The training to come.  Its guides are made on the clock: a representation may work from the start."""
        with self.clock.lap("train", self.kernels.compiled):
            training = Training(scene, self.spec.method.representation or {}, settings, self.spec.integrator,
                                self.spec.seed)
            dr.sync_thread()
        return training

    def train(self, training: Training) -> Iterator[PassStatistics]:
        """Training passes, until all are done or their share of a budget in seconds is spent."""
        settings, seconds = training.settings, self.spec.budget.seconds
        passes, seen = training.run(), 0.0
        while self.clock.charged < (end := end_of_training(settings.share, seconds, self.clock.charged, seen)):
            late = self.clock.charged >= end / 2 if seconds is not None else 2 * len(self.training) >= training.passes
            if (statistics := self._learn(lambda: next(passes, None), late and settings.blend)) is None:
                break
            seen = statistics.seen or seen
            yield statistics

    def has_room(self, spp: int) -> bool:
        """Whether so many samples a pixel stay within a budget in samples."""
        return self.spec.budget.spp is None or self.image.spp + spp <= self.spec.budget.spp

    def render_and_learn(self, training: Training) -> None:
        """A rendering pass from which the guide goes on learning; there must be room for it."""
        self._learn(training.camera_pass, True)

    def render(self, scene: mi.Scene, integrator: mi.Integrator, spp: int) -> None:
        """A rendering pass of at most `spp` samples a pixel."""
        left = self.spec.budget.spp - self.image.spp if self.spec.budget.spp is not None else spp
        spp, seed = power_of_two(min(spp, left)), pass_seed(self.spec.seed, self.image.passes)
        with self.clock.lap("render", self.kernels.compiled):
            rendered = render_pass(scene, integrator, seed, spp)
        self._add(rendered, spp, f"the pass with seed {seed}")

    def _learn(self, learn: Callable[[], PassStatistics | None], enters: bool) -> PassStatistics | None:
        """A training pass.  The time of tracing an image that enters the result is booked as rendering."""
        before = self.clock["train"].charged
        with self.clock.lap("train", self.kernels.compiled):
            statistics = learn()
            dr.sync_thread()
        if statistics is None:
            return None
        self.training.append(statistics.as_dict())
        if statistics.image is None:
            return statistics
        if enters and self.has_room(statistics.spp):
            taken = self.clock["train"].charged
            self.clock.move((taken - before) / max(taken, 1e-9) * statistics.share("trace"), "train", "render")
            self._add(statistics.image, statistics.spp, f"training pass {statistics.index + 1}")
        return statistics           # of an image that is only learnt from, training has dropped what is invalid

    def _add(self, rendered: mi.TensorXf, spp: int, source: str) -> None:
        image = to_numpy(rendered)
        check_pixels(image, source)
        self.image.add(image, spp)
        self.brightness.add(np.full((1, 1, 1), metrics.mean(image)), spp)

    def checkpoint(self, guide: Guide | None) -> None:
        """Keep the image, if it is time to."""
        budget, total = self.spec.budget, self.clock.total
        limit = float(budget.spp or budget.seconds or 0)
        spent = self.spent * limit
        if self.targets is None:
            self.targets = checkpoint_times(spent, limit, budget.checkpoints)
        if spent >= limit or spent >= self.targets[0]:
            self.targets = [t for t in self.targets if t > spent]
            if budget.spp is not None and self.trace and self.trace[-1]["spp"] == self.image.spp:
                self.trace.pop()            # since then there was training only
                self.checkpoints.pop()
            self.trace.append({
                "seconds": total.charged, "train_seconds": self.clock["train"].charged,
                "render_seconds": self.clock["render"].charged, "wall_seconds": total.wall, "cpu_seconds": total.cpu,
                "spp": self.image.spp, "records": guide.records if guide else 0, "particles": guide.particles if guide else 0})
            self.checkpoints.append(self.image.mean.astype(np.float32))


def measure(spec: CellSpec, scene: mi.Scene, warm: WarmUp, guide: Guide | None = None,
            on_progress: Callable[[float, str], None] = lambda done, what: None) -> Measurement:
    """Train, and render until the budget is spent.

    Args:
        warm: from :func:`warm_up` of this scene and method in this process.
        guide: use it instead of training one.
        on_progress: called off the clock with the share of the budget spent.

    Raises:
        CellFailedError: a pixel that is NaN, infinite or negative.
    """
    spp, training, ended = spp_of_pass(spec, warm), None, None
    with Kernels.watched() as kernels:
        cell = _Cell(spec, kernels)
        if guide is None and spec.training is not None:
            training = cell.prepare(scene, spec.training)
            guide = training.radiance
            for statistics in cell.train(training):
                if cell.image.passes:
                    cell.checkpoint(guide)
                on_progress(min(1.0, cell.spent), f"training pass {statistics.index + 1} of {statistics.passes} at most")
            ended = cell.clock.charged if cell.training else None
        integrator = make_integrator(spec, guide)
        while cell.spent < 1 or cell.image.passes == 0:
            if training is not None and training.settings.while_rendering and cell.has_room(training.camera_spp):
                cell.render_and_learn(training)
            else:
                cell.render(scene, integrator, spp)
            cell.checkpoint(guide)
            on_progress(min(1.0, cell.spent), f"{cell.image.spp} spp")

    clock, total, image = cell.clock, cell.clock.total, cell.image
    info = {
        "key": spec.key, "spp": image.spp, "charged_seconds": total.charged, "train_seconds": clock["train"].charged,
        "render_seconds": clock["render"].charged, "compile_seconds": warm.compile_seconds + kernels.seconds,
        "compiled_on_the_clock": kernels.count, "wall_seconds": total.wall, "cpu_seconds": total.cpu,
        "paused_seconds": total.paused, "wait_seconds": total.wait,
        "wait_fraction": total.wait / total.wall if total.wall else 0.0,
        "trained": records_seen(scene, guide).guided if guide is not None else None, "training_ended": ended,
        "training_passes": sum(p["index"] < p["passes"] for p in cell.training),       # not those while rendering
        "warnings": list(dict.fromkeys(w for p in cell.training for w in p["warnings"])),
        "records": guide.records if guide is not None else 0, "particles": guide.particles if guide is not None else 0,
        "bytes_per_record": guide.bytes_per_record if guide is not None else 0,
        "mean": float(cell.brightness.mean[0, 0, 0]), "mean_stderr": math.sqrt(float(cell.brightness.variance()[0, 0, 0])),
        "pass_spp": spp, "image_passes": image.passes, "passes": cell.training,
    }
    h, w, _ = image.mean.shape
    layers = {"mean": image.mean, "variance": image.variance(), "count": np.full((h, w), image.spp, np.float32)}
    return Measurement(info, cell.trace, {k: v.astype(np.float32) for k, v in layers.items()}, cell.checkpoints, guide)


def end_of_training(share: float | Literal["auto"], seconds: float | None, spent: float, seen: float) -> float:
    """Charged seconds at which training ends; never, for a budget in samples.

    For "auto", records that have seen n particles are taken to guide with a variance V ~ 1 + HALF_LEARNT / n.  With n in
    proportion to the time t of training that is 1 + X / t, and V / (T - t) is least at  t = sqrt(X^2 + X T) - X:  half of a short
    budget T, about sqrt(X T) of a long one.  Neither the rule nor what it is told looks at the image.

    Args:
        share: as in `TrainingSettings`; seconds: the budget.
        spent: charged seconds of training so far.
        seen: particles that the records on the camera's paths have seen by then, on average; 0: not known.
    """
    if seconds is None:
        return math.inf
    if share != "auto":
        return share * seconds
    if seen == 0:
        return seconds / 2
    X = spent * HALF_LEARNT / seen
    return math.sqrt(X * X + X * seconds) - X


def checkpoint_times(first: float, last: float, n: int) -> list[float]:
    """Log-spaced times (or sample counts) from the first pass to the end of the budget."""
    return [float(t) for t in np.geomspace(min(max(first, 1e-3 * last), last), last, n)] if n > 1 else [last]


def check_pixels(image: np.ndarray, source: str) -> None:
    """
    Args:
        source: of the image, for the message.

    Raises:
        CellFailedError: a pixel is NaN, infinite or negative.
    """
    invalid = ~(np.isfinite(image) & (image >= 0)).all(axis=-1)
    if invalid.any():
        y, x = np.argwhere(invalid)[0]
        raise CellFailedError(f"{int(invalid.sum())} pixels are NaN, infinite or negative; the first is "
                              f"x = {x}, y = {y}: {image[y, x].tolist()}, in {source}")
