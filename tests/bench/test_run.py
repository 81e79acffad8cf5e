"""Running cells: what is measured, resumed, redone, failed and interrupted.

Images are tiny and budgets in samples, so that nothing depends on the speed of the machine.
"""
from __future__ import annotations

import json
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from olpm_bench.bench import config, run
from olpm_bench.bench.clock import Lap
from olpm_bench.bench.config import Experiment
from olpm_bench.bench.results import Reference, ResultError, Results, locked, write_reference
from olpm_bench.bench.run import CellFailedError, WarmUp
from olpm_bench.transport.training import PassStatistics

TOML = """
title = "Test"
seeds = 2
[budget]
spp = 11
checkpoints = 3
[[scene]]
name = "cornell_box"
width = 16
height = 12
max_depth = 4
[[method]]
name = "Path tracing"
[[method]]
name = "Roulette"
integrator = { roulette = "throughput" }
"""


@pytest.fixture
def experiment(tmp_path) -> Experiment:
    """An experiment with a (made up) reference in place."""
    (tmp_path / "test.toml").write_text(TOML)
    loaded = config.load(tmp_path / "test.toml")
    grey = np.full((12, 16, 3), 0.5, np.float32)
    reference = Reference(grey, grey + 0.01, grey, grey, {"spp_a": 1, "spp_b": 1})
    write_reference(tmp_path / "results" / "references" / loaded.reference_key(loaded.scene[0]), reference)
    return loaded


@pytest.fixture
def root(tmp_path) -> Path:
    return tmp_path / "results"


class Counted:
    """`run.measure`, counting its calls."""

    def __init__(self, fail_at: int | None = None, error: BaseException | None = None) -> None:
        self.calls, self.fail_at, self.error, self.measure = 0, fail_at, error, run.measure

    def __call__(self, *args, **kwargs):
        self.calls += 1
        if self.calls == self.fail_at:
            raise self.error
        return self.measure(*args, **kwargs)


def cells(experiment: Experiment, root: Path) -> list:
    results = Results(root / "test")
    return [results.verified_cell(c.scene.name, c.method.name, c.seed) for c in experiment.cells()]


# ---------------------------------------------------------------- one cell

def test_a_cell_spends_its_samples_and_repeats_bit_for_bit(experiment):
    spec = experiment.cells()[0]
    scene = run.load_scene(spec)
    warm = run.warm_up(spec, scene)
    first, again = run.measure(spec, scene, warm), run.measure(spec, scene, warm)
    assert first.info["spp"] == 11 and first.trace[-1]["spp"] == 11 and len(first.trace) == len(first.checkpoints)
    assert [line["spp"] for line in first.trace] == sorted({line["spp"] for line in first.trace})
    np.testing.assert_array_equal(first.image["mean"], again.image["mean"])
    np.testing.assert_array_equal(first.checkpoints[-1], first.image["mean"])
    assert (first.image["count"] == 11).all() and np.isfinite(first.image["variance"]).all()
    assert first.info["records"] == 0 and first.info["train_seconds"] == 0 and first.info["passes"] == []
    assert first.info["compiled_on_the_clock"] == 0
    assert 0 < first.info["charged_seconds"] <= first.info["wall_seconds"] + 1e-9
    other = run.measure(experiment.cells()[2], scene, warm)         # another seed
    assert not np.array_equal(first.image["mean"], other.image["mean"])


def test_the_variance_layer_agrees_with_the_spread_over_seeds(tmp_path, monkeypatch):
    """Mean over pixels of 30 images' squared standard errors against their variance: ratio within 15 %."""
    (tmp_path / "test.toml").write_text(TOML.replace("seeds = 2", "seeds = 30").replace("spp = 11", "spp = 64"))
    specs = [s for s in config.load(tmp_path / "test.toml").cells() if s.method.name == "Path tracing"]
    monkeypatch.setattr(run, "PASSES", 4)
    scene = run.load_scene(specs[0])
    done = [run.measure(s, scene, WarmUp(0.0, 1.0)) for s in specs]
    spread = np.var([d.image["mean"] for d in done], axis=0, ddof=1).mean()
    assert np.mean([d.image["variance"] for d in done]) == pytest.approx(spread, rel=0.15)
    stderr = np.sqrt(np.mean([d.info["mean_stderr"] ** 2 for d in done]))
    assert stderr == pytest.approx(np.std([d.info["mean"] for d in done], ddof=1), rel=0.5)


def test_training_is_counted_apart(experiment):
    text = TOML + 'representation = { type = "cosine" }\n'
    text += "training = { passes = 1, photons = 500, importons = 100, camera_passes = 0 }\n"
    experiment.path.write_text(text)
    spec = config.load(experiment.path).cells()[1]
    scene = run.load_scene(spec)
    done = run.measure(spec, scene, run.warm_up(spec, scene))
    assert done.info["train_seconds"] > 0 and done.info["records"] == done.guide.records > 0
    assert len(done.info["passes"]) == 1 and done.info["passes"][0]["photons"] == 500
    assert done.info["bytes_per_record"] > 0 and done.trace[0]["records"] == done.info["records"]
    assert done.info["charged_seconds"] == pytest.approx(done.info["train_seconds"] + done.info["render_seconds"])


def test_a_budget_of_seconds_stops_at_the_first_pass_past_it(experiment, monkeypatch):
    """With a clock that says 0.1 s a pass."""
    experiment.path.write_text(TOML.replace("spp = 11", "seconds = 1"))
    spec = config.load(experiment.path).cells()[0]

    class Ticks(run.Clock):
        ticks = 0

        @property
        def total(self):
            lap = super().total
            lap.charged = 0.1 * self.ticks
            return lap

        def lap(self, *args):
            self.ticks += 1
            return super().lap(*args)

    monkeypatch.setattr(run, "Clock", Ticks)
    done = run.measure(spec, run.load_scene(spec), WarmUp(0.0, spp_seconds=0.1))
    assert done.info["spp"] == 2 * 10           # the shortest pass, 0.2 s, is 2 samples
    assert done.trace[-1]["seconds"] == pytest.approx(1.0) and len(done.trace) == 3


def test_one_slow_timing_does_not_make_passes_small(experiment, monkeypatch):
    """A first timing ten times as long as the others, as on a busy machine."""
    times = iter([1.0, 0.1, 0.12])

    class Slow(run.Clock):
        @contextmanager
        def lap(self, label, compiled=float):
            yield
            self.laps[label] = Lap(charged=next(times))

    monkeypatch.setattr(run, "Clock", Slow)
    monkeypatch.setattr(run, "render_pass", lambda *_: None)
    spec = experiment.cells()[0]
    assert run.warm_up(spec, None).spp_seconds == pytest.approx(0.1 / 2)


# ---------------------------------------------------------------- training in a budget

class Ticking(run.Clock):
    """Every lap takes a second."""

    @contextmanager
    def lap(self, label, compiled=float):
        yield
        self.laps[label] = self[label] + Lap(wall=1.0, cpu=1.0, charged=1.0)


class Passes:
    """A training of 2 particle passes and then camera passes of 4 samples a pixel, 3/4 of each spent tracing; the image of pass i
    has the value i, and records have seen `seen` particles more after each."""
    camera_spp = 4
    seen = 1000.0

    def __init__(self, scene, representation, settings, integrator, seed):
        self.settings, self.passes, self.learnt = settings, 2 + settings.camera_passes, 0
        self.radiance = SimpleNamespace(trained=1.0, records=9, particles=99, bytes_per_record=8)

    def run(self):
        for index in range(self.passes):
            yield self.camera_pass(index >= 2)

    def camera_pass(self, renders=True):
        index, self.learnt = self.learnt, self.learnt + 1
        image = SimpleNamespace(numpy=lambda: np.full((12, 16, 3), float(index))) if renders else None
        return PassStatistics(index, self.passes, spp=4 if renders else 0, seen=self.learnt * self.seen if renders else 0.0,
                              seconds={"trace": 0.3, "update": 0.1}, image=image)


@pytest.fixture
def trained(experiment, monkeypatch):
    """Budget and training, as in a TOML -> what measuring such a cell yields, with rendered passes of value 100."""
    def measured(budget: str, training: str, spp_seconds: float = 0.5):
        text = TOML.replace("spp = 11", budget) + f'representation = {{ type = "cosine" }}\ntraining = {{ {training} }}\n'
        experiment.path.write_text(text)
        return run.measure(config.load(experiment.path).cells()[1], None, WarmUp(0.0, spp_seconds))

    monkeypatch.setattr(run, "Clock", Ticking)
    monkeypatch.setattr(run, "Training", Passes)
    monkeypatch.setattr(run, "make_integrator", lambda spec, guide: None)
    monkeypatch.setattr(run, "render_pass", lambda *_: SimpleNamespace(numpy=lambda: np.full((12, 16, 3), 100.0)))
    return measured


def test_training_ends_at_its_share_and_its_second_half_enters(trained):
    done = trained("seconds = 20", "share = 0.4, camera_passes = 30")
    assert done.info["training_passes"] == 8                            # of 1 s each
    assert done.info["train_seconds"] == pytest.approx(8 - 4 * 0.75)    # passes 4 to 7 are images, 3/4 of their time rendering
    assert done.info["render_seconds"] == pytest.approx(12 + 4 * 0.75)
    assert done.info["charged_seconds"] == pytest.approx(20)
    assert done.info["spp"] == 4 * 4 + 12 * done.info["pass_spp"]
    expected = (4 * (4 + 5 + 6 + 7) + 100 * 12 * done.info["pass_spp"]) / done.info["spp"]
    np.testing.assert_allclose(done.image["mean"], expected, rtol=1e-6)
    assert done.trace[0]["seconds"] == 5 and done.trace[0]["spp"] == 4      # the first image is a training pass


def test_training_may_end_before_its_share(trained):
    done = trained("seconds = 20", "share = 0.9, camera_passes = 5")
    assert done.info["training_passes"] == 7 and done.info["charged_seconds"] == pytest.approx(20)


def test_without_blending_no_training_image_enters(trained):
    done = trained("seconds = 20", "share = 0.4, camera_passes = 30, blend = false")
    assert done.info["train_seconds"] == pytest.approx(8) and (done.image["mean"] == 100).all()


@pytest.mark.parametrize("while_rendering", ["true", "false"])
@pytest.mark.parametrize("spp", [1, 3, 11, 16, 37])
def test_budgets_in_samples_are_met_exactly(trained, spp, while_rendering):
    done = trained(f"spp = {spp}", f"camera_passes = 6, while_rendering = {while_rendering}")
    assert done.info["spp"] == spp == done.trace[-1]["spp"] and (done.image["count"] == spp).all()
    blended = min(spp // 4, 4)                                          # the second half of 8 passes, as far as there is room
    passes = done.info["training_passes"] - 8
    assert passes == ((spp - 4 * blended) // 4 if while_rendering == "true" else 0)


def test_the_guide_learns_on_while_rendering(trained):
    done = trained("seconds = 20", "share = 0.2, camera_passes = 30, while_rendering = true")
    assert done.info["training_passes"] == 20 and done.info["spp"] == 4 * 18       # 2 of 4 passes of training, all of rendering
    assert done.info["render_seconds"] == pytest.approx(18 * 0.75)


def test_automatic_training_follows_the_clock_and_the_particles(trained, monkeypatch):
    """With 1,000 particles a second X is 2 s: of 30 s, training takes sqrt(4 + 60) - 2 = 6 s."""
    monkeypatch.setattr(run, "HALF_LEARNT", 2000)
    assert trained("seconds = 30", 'share = "auto", camera_passes = 90').info["training_passes"] == 6
    monkeypatch.setattr(Passes, "seen", 1.0)
    assert trained("seconds = 30", 'share = "auto", camera_passes = 90').info["training_passes"] == 15


def test_the_automatic_end_of_training(monkeypatch):
    monkeypatch.setattr(run, "HALF_LEARNT", 2000)
    assert run.end_of_training("auto", None, 3.0, 1000.0) == run.end_of_training(0.3, None, 3.0, 0.0) == np.inf
    assert run.end_of_training(0.3, 20.0, 3.0, 1000.0) == 6
    ends = [run.end_of_training("auto", 60.0, t, 500 * t) for t in (1.0, 5.0, 20.0)]
    assert ends == pytest.approx([np.sqrt(16 + 4 * 60) - 4] * 3)        # the same whenever it is asked for
    T, X = 60.0, 4.0
    t = np.linspace(0.1, T - 0.1, 100_000)
    assert ends[0] == pytest.approx(t[np.argmin((1 + X / t) / (T - t))], abs=1e-2)
    assert run.end_of_training("auto", 60.0, 5.0, 0.0) == 30 >= run.end_of_training("auto", 60.0, 5.0, 1.0)


# ---------------------------------------------------------------- seeds, passes, checkpoints

def test_seeds_of_passes_never_meet():
    from olpm_bench.bench.reference import SEEDS

    last = run.pass_seed(config.MAX_SEED, run.PASSES_PER_SEED - 1)
    assert run.pass_seed(1, 0) == run.pass_seed(0, run.PASSES_PER_SEED - 1) + 1
    assert last < run.WARM_UP_SEED < SEEDS["a"] < SEEDS["b"] and SEEDS["b"] + 2**30 <= 2**32
    with pytest.raises(CellFailedError):
        run.pass_seed(0, run.PASSES_PER_SEED)


@pytest.mark.parametrize("n, power", [(0.3, 1), (1, 1), (3.9, 2), (4, 4), (1000, 512)])
def test_power_of_two(n, power):
    assert run.power_of_two(n) == power


def test_checkpoints_are_log_spaced():
    assert run.checkpoint_times(1, 16, 5) == pytest.approx([1, 2, 4, 8, 16])
    assert run.checkpoint_times(1, 16, 1) == [16]
    assert run.checkpoint_times(20, 16, 2) == pytest.approx([16, 16])


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-3])
def test_an_invalid_pixel_is_found_and_named(value):
    image = np.ones((4, 5, 3))
    run.check_pixels(image, "pass 7")
    image[2, 3, 1] = value
    with pytest.raises(CellFailedError, match=r"1 pixels .* x = 3, y = 2: .*, in pass 7"):
        run.check_pixels(image, "pass 7")


# ---------------------------------------------------------------- an experiment

def test_a_rerun_skips_what_is_complete(experiment, root, monkeypatch):
    assert run.run(experiment, root) == []
    assert all(cells(experiment, root))
    assert json.loads((root / "test" / "env.json").read_text())["variant"] == "llvm_ad_rgb"
    assert config.load(root / "test" / "experiment.toml").cells()[0].key == experiment.cells()[0].key
    monkeypatch.setattr(run, "measure", counted := Counted())
    assert run.run(experiment, root) == [] and counted.calls == 0


def test_changed_broken_and_missing_cells_are_redone(experiment, root, monkeypatch):
    run.run(experiment, root)
    done = cells(experiment, root)
    (done[0].folder / "image.exr").write_bytes(b"broken")
    (done[1].folder / "cell.json").unlink()
    (done[2].folder / "cell.json").write_text(json.dumps({**done[2].info, "key": "of other settings"}))
    monkeypatch.setattr(run, "measure", counted := Counted())
    assert run.run(experiment, root) == [] and counted.calls == 3
    assert [c.info["key"] for c in cells(experiment, root)] == [c.key for c in experiment.cells()]


def interrupted_while_tracing() -> RuntimeError:
    error = RuntimeError("dr.while_loop(): encountered an exception (see above).")
    error.__cause__ = KeyboardInterrupt()
    return error


@pytest.mark.parametrize("error, seen", [
    (KeyboardInterrupt(), KeyboardInterrupt), (interrupted_while_tracing(), KeyboardInterrupt),
    (OSError(28, "No space left on device", "x"), OSError),
], ids=["Ctrl-C", "Ctrl-C in a loop", "full disk"])
def test_an_interruption_loses_the_cell_in_hand_only(experiment, root, monkeypatch, error, seen):
    monkeypatch.setattr(run, "measure", Counted(fail_at=3, error=error))
    with pytest.raises(seen):
        run.run(experiment, root)
    assert [c is not None for c in cells(experiment, root)] == [True, True, False, False]
    assert not [f for f in root.rglob("*") if f.name == "lock" or ".tmp" in f.name]
    monkeypatch.undo()
    monkeypatch.setattr(run, "measure", counted := Counted())
    assert run.run(experiment, root) == [] and counted.calls == 2


@pytest.mark.parametrize("error", [CellFailedError("3 pixels are NaN"), RuntimeError("jit:\n failure")])
def test_a_failed_cell_is_named_and_the_others_are_run(experiment, root, monkeypatch, error):
    monkeypatch.setattr(run, "measure", Counted(fail_at=2, error=error))
    problems = run.run(experiment, root)
    reason = " ".join(str(error).split())
    assert problems == [f"cornell_box / Roulette / seed 0: {reason}"]
    assert [c is not None for c in cells(experiment, root)] == [True, False, True, True]
    failed = Results(root / "test").cell_folder("cornell_box", "Roulette", 0) / "failed.json"
    assert json.loads(failed.read_text())["reason"] == reason


def test_a_cell_in_other_hands_is_left_alone(experiment, root):
    with locked(Results(root / "test").cell_folder("cornell_box", "Roulette", 1)):
        problems = run.run(experiment, root)
    assert len(problems) == 1 and "held by process" in problems[0]
    assert problems[0].startswith("cornell_box / Roulette / seed 1: ")
    assert run.run(experiment, root) == []


def test_a_missing_reference_is_noticed_before_the_first_cell(experiment, tmp_path):
    line = r"cornell_box has no reference .*; make it with: olpm-bench reference .*test\.toml"
    with pytest.raises(ResultError, match=line):
        run.run(experiment, tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()


def test_results_of_a_newer_version_are_left_alone(experiment, root):
    run.run(experiment, root)
    cell = cells(experiment, root)[0]
    newer = json.dumps({**cell.info, "schema_version": 9})
    (cell.folder / "cell.json").write_text(newer)
    with pytest.raises(ResultError, match="newer"):
        run.run(experiment, root)
    assert (cell.folder / "cell.json").read_text() == newer


def test_a_plan_counts_what_is_left(experiment, root):
    plan = run.plan(experiment, root)
    assert len(plan["todo"]) == 4 and plan["hours"] is None and 0 < plan["gigabytes"] < 2
    run.run(experiment, root)
    assert run.plan(experiment, root)["todo"] == []
    experiment.path.write_text(TOML.replace("spp = 11", "seconds = 900"))
    assert run.plan(config.load(experiment.path), root)["hours"] == 1.0


def test_the_committed_references_are_found(experiment, tmp_path, root):
    """`<folder of the TOML>/../results/references` serves whatever `--results` is."""
    (tmp_path / "experiments").mkdir()
    experiment.path.rename(tmp_path / "experiments" / "test.toml")
    moved = config.load(tmp_path / "experiments" / "test.toml")
    found = run.references(moved, tmp_path / "elsewhere")["cornell_box"]
    assert found.noise_floor == pytest.approx(0.005, rel=1e-4)
