"""One cell: what is measured, budgets, the end of training, seeds and checkpoints.

Images are tiny and budgets in samples, so that nothing depends on the speed of the machine.
"""
from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from small_experiment import TOML

from olpm_bench.bench import cell, config, experiment_file, metrics
from olpm_bench.bench.cell import CellFailedError, WarmUp
from olpm_bench.bench.clock import Lap
from olpm_bench.bench.config import Experiment
from olpm_bench.transport.training import PassStatistics


@pytest.fixture
def experiment(tmp_path) -> Experiment:
    (tmp_path / "test.toml").write_text(TOML)
    return experiment_file.load(tmp_path / "test.toml")


def test_a_cell_spends_its_samples_and_repeats_bit_for_bit(experiment):
    spec = experiment.cells()[0]
    scene = cell.load_scene(spec)
    warm = cell.warm_up(spec, scene)
    first, again = cell.measure(spec, scene, warm), cell.measure(spec, scene, warm)
    assert first.info["spp"] == 11 and first.trace[-1]["spp"] == 11 and len(first.trace) == len(first.checkpoints)
    assert [line["spp"] for line in first.trace] == sorted({line["spp"] for line in first.trace})
    np.testing.assert_array_equal(first.image["mean"], again.image["mean"])
    np.testing.assert_array_equal(first.checkpoints[-1], first.image["mean"])
    assert (first.image["count"] == 11).all() and np.isfinite(first.image["variance"]).all()
    assert first.info["records"] == 0 and first.info["train_seconds"] == 0 and first.info["passes"] == []
    assert first.info["training_ended"] is None
    # Of walls in colours, as of the errors and in the page's viewer: all channels weigh the same.
    assert first.info["mean"] == pytest.approx(first.image["mean"].mean(dtype=np.float64), rel=1e-6)
    assert first.info["mean"] != pytest.approx(metrics.luminance(first.image["mean"]).mean(), rel=0.01)
    assert first.info["compiled_on_the_clock"] == 0
    assert 0 < first.info["charged_seconds"] <= first.info["wall_seconds"] + 1e-9
    other = cell.measure(experiment.cells()[2], scene, warm)         # another seed
    assert not np.array_equal(first.image["mean"], other.image["mean"])


def test_the_variance_layer_agrees_with_the_spread_over_seeds(tmp_path, monkeypatch):
    """Mean over pixels of 30 images' squared standard errors against their variance: ratio within 15 %."""
    (tmp_path / "test.toml").write_text(TOML.replace("seeds = 2", "seeds = 30").replace("spp = 11", "spp = 64"))
    specs = [s for s in experiment_file.load(tmp_path / "test.toml").cells() if s.method.name == "Path tracing"]
    monkeypatch.setattr(cell, "PASSES", 4)
    scene = cell.load_scene(specs[0])
    done = [cell.measure(s, scene, WarmUp(0.0, 1.0)) for s in specs]
    spread = np.var([d.image["mean"] for d in done], axis=0, ddof=1).mean()
    assert np.mean([d.image["variance"] for d in done]) == pytest.approx(spread, rel=0.15)
    stderr = np.sqrt(np.mean([d.info["mean_stderr"] ** 2 for d in done]))
    assert stderr == pytest.approx(np.std([d.info["mean"] for d in done], ddof=1), rel=0.5)


def test_training_is_counted_apart(experiment):
    text = TOML + 'representation = { type = "cosine" }\n'
    text += "training = { passes = 1, photons = 500, importons = 100, camera_passes = 0 }\n"
    experiment.path.write_text(text)
    spec = experiment_file.load(experiment.path).cells()[1]
    scene = cell.load_scene(spec)
    done = cell.measure(spec, scene, cell.warm_up(spec, scene))
    assert done.info["train_seconds"] > 0 and done.info["records"] == done.guide.records > 0
    assert len(done.info["passes"]) == 1 and done.info["passes"][0]["photons"] == 500
    assert done.info["bytes_per_record"] > 0 and done.trace[0]["records"] == done.info["records"]
    assert done.info["charged_seconds"] == pytest.approx(done.info["train_seconds"] + done.info["render_seconds"])


def test_a_budget_of_seconds_stops_at_the_first_pass_past_it(experiment, monkeypatch):
    """With a clock that says 0.1 s a pass."""
    experiment.path.write_text(TOML.replace("spp = 11", "seconds = 1"))
    spec = experiment_file.load(experiment.path).cells()[0]

    class Ticks(cell.Clock):
        ticks = 0

        @property
        def total(self):
            lap = super().total
            lap.charged = 0.1 * self.ticks
            return lap

        def lap(self, *args):
            self.ticks += 1
            return super().lap(*args)

    monkeypatch.setattr(cell, "Clock", Ticks)
    done = cell.measure(spec, cell.load_scene(spec), WarmUp(0.0, spp_seconds=0.1))
    assert done.info["spp"] == 2 * 10           # the shortest pass, 0.2 s, is 2 samples
    assert done.trace[-1]["seconds"] == pytest.approx(1.0) and len(done.trace) == 3


def test_one_slow_timing_does_not_make_passes_small(experiment, monkeypatch):
    """A first timing ten times as long as the others, as on a busy machine."""
    times = iter([1.0, 0.1, 0.12])

    class Slow(cell.Clock):
        @contextmanager
        def lap(self, label, compiled=float):
            yield
            self.laps[label] = Lap(charged=next(times))

    monkeypatch.setattr(cell, "Clock", Slow)
    monkeypatch.setattr(cell, "render_pass", lambda *_: None)
    spec = experiment.cells()[0]
    assert cell.warm_up(spec, None).spp_seconds == pytest.approx(0.1 / 2)


# ---------------------------------------------------------------- training in a budget

class Ticking(cell.Clock):
    """Time passes as the stubs below say: a second a pass."""
    now = 0.0

    @contextmanager
    def lap(self, label, compiled=float):
        before = Ticking.now
        yield
        took = Ticking.now - before
        self.laps[label] = self[label] + Lap(wall=took, cpu=took, charged=took)


class Passes:
    """A training of 2 particle passes and then camera passes of 4 samples a pixel, 3/4 of each spent tracing; the image of pass i
    has the value i, and records have seen `seen` particles more after each."""
    camera_spp = 4
    seen = 1000.0
    construction = 0.0      # [s]

    def __init__(self, scene, representation, settings, integrator, seed):
        self.settings, self.passes, self.learnt = settings, 2 + settings.camera_passes, 0
        self.radiance = SimpleNamespace(trained=1.0, records=9, particles=99, bytes_per_record=8)
        Ticking.now += self.construction

    def run(self):
        for index in range(self.passes):
            yield self._pass(index, index >= 2)

    def camera_pass(self):
        return self._pass(self.passes, True)

    def _pass(self, index, renders):
        before, self.learnt = self.learnt, self.learnt + 1
        Ticking.now += 1
        image = SimpleNamespace(numpy=lambda: np.full((12, 16, 3), float(before))) if renders else None
        return PassStatistics(index, self.passes, spp=4 if renders else 0, seen=self.learnt * self.seen if renders else 0.0,
                              seconds={"trace": 0.3, "update": 0.1}, image=image)


@pytest.fixture
def trained(experiment, monkeypatch):
    """Budget and training, as in a TOML -> what measuring such a cell yields, with rendered passes of value 100."""
    def measured(budget: str, training: str, spp_seconds: float = 0.5):
        text = TOML.replace("spp = 11", budget) + f'representation = {{ type = "cosine" }}\ntraining = {{ {training} }}\n'
        experiment.path.write_text(text)
        return cell.measure(experiment_file.load(experiment.path).cells()[1], None, WarmUp(0.0, spp_seconds))

    def rendered(*_):
        Ticking.now += 1
        return SimpleNamespace(numpy=lambda: np.full((12, 16, 3), 100.0))

    monkeypatch.setattr(cell, "Clock", Ticking)
    monkeypatch.setattr(cell, "Training", Passes)
    monkeypatch.setattr(cell, "make_integrator", lambda spec, guide: None)
    monkeypatch.setattr(cell, "records_seen", lambda scene, guide: SimpleNamespace(guided=1.0))
    monkeypatch.setattr(cell, "render_pass", rendered)
    return measured


def test_training_ends_at_its_share_and_its_second_half_enters(trained):
    done = trained("seconds = 20", "share = 0.4, camera_passes = 30")
    assert done.info["training_passes"] == 8 == done.info["training_ended"]     # of 1 s each
    assert done.info["train_seconds"] == pytest.approx(8 - 4 * 0.75)    # passes 4 to 7 are images, 3/4 of their time rendering
    assert done.info["render_seconds"] == pytest.approx(12 + 4 * 0.75)
    assert done.info["charged_seconds"] == pytest.approx(20)
    assert done.info["spp"] == 4 * 4 + 12 * done.info["pass_spp"]
    expected = (4 * (4 + 5 + 6 + 7) + 100 * 12 * done.info["pass_spp"]) / done.info["spp"]
    np.testing.assert_allclose(done.image["mean"], expected, rtol=1e-6)
    assert done.trace[0]["seconds"] == 5 and done.trace[0]["spp"] == 4      # the first image is a training pass


def test_what_a_representation_does_when_it_is_made_is_charged(trained, monkeypatch):
    """Its constructor and `init(0)` take 3 s here: of 8 s of training 5 are left for passes."""
    monkeypatch.setattr(Passes, "construction", 3.0)
    done = trained("seconds = 20", "share = 0.4, camera_passes = 30, blend = false")
    assert done.info["training_passes"] == 5
    assert done.info["train_seconds"] == pytest.approx(8)
    assert done.info["charged_seconds"] == pytest.approx(20)


def test_training_may_end_before_its_share(trained):
    done = trained("seconds = 20", "share = 0.9, camera_passes = 5")
    assert done.info["training_passes"] == 7 and done.info["charged_seconds"] == pytest.approx(20)


def test_training_without_a_pass_has_no_end(trained, monkeypatch):
    monkeypatch.setattr(Passes, "run", lambda self: iter(()))
    done = trained("seconds = 20", "share = 0.4")
    assert done.info["training_passes"] == 0 and done.info["training_ended"] is None


def test_without_blending_no_training_image_enters(trained):
    done = trained("seconds = 20", "share = 0.4, camera_passes = 30, blend = false")
    assert done.info["train_seconds"] == pytest.approx(8) and (done.image["mean"] == 100).all()


@pytest.mark.parametrize("while_rendering", ["true", "false"])
@pytest.mark.parametrize("spp", [1, 3, 8, 11, 16, 37])
def test_budgets_in_samples_are_met_exactly(trained, spp, while_rendering):
    done = trained(f"spp = {spp}", f"camera_passes = 6, while_rendering = {while_rendering}")
    assert done.info["spp"] == spp == done.trace[-1]["spp"] and (done.image["count"] == spp).all()
    assert (np.diff([line["spp"] for line in done.trace]) > 0).all() and len(done.trace) == len(done.checkpoints)
    blended = min(spp // 4, 4)                                          # the second half of 8 passes, as far as there is room
    assert done.info["training_passes"] == 8
    assert len(done.info["passes"]) - 8 == ((spp - 4 * blended) // 4 if while_rendering == "true" else 0)


def test_the_guide_learns_on_while_rendering(trained):
    done = trained("seconds = 20", "share = 0.2, camera_passes = 30, while_rendering = true")
    assert (done.info["training_passes"], len(done.info["passes"])) == (4, 20)
    assert done.info["spp"] == 4 * 18               # 2 of 4 passes of training, all of rendering
    assert done.info["render_seconds"] == pytest.approx(18 * 0.75)


def test_automatic_training_follows_the_clock_and_the_particles(trained, monkeypatch):
    """With 1,000 particles a second X is 2 s: of 30 s, training takes sqrt(4 + 60) - 2 = 6 s."""
    monkeypatch.setattr(cell, "HALF_LEARNT", 2000)
    assert trained("seconds = 30", 'share = "auto", camera_passes = 90').info["training_passes"] == 6
    monkeypatch.setattr(Passes, "seen", 1.0)
    assert trained("seconds = 30", 'share = "auto", camera_passes = 90').info["training_passes"] == 15


def test_the_automatic_end_of_training(monkeypatch):
    monkeypatch.setattr(cell, "HALF_LEARNT", 2000)
    assert cell.end_of_training("auto", None, 3.0, 1000.0) == cell.end_of_training(0.3, None, 3.0, 0.0) == np.inf
    assert cell.end_of_training(0.3, 20.0, 3.0, 1000.0) == 6
    ends = [cell.end_of_training("auto", 60.0, t, 500 * t) for t in (1.0, 5.0, 20.0)]
    assert ends == pytest.approx([np.sqrt(16 + 4 * 60) - 4] * 3)        # the same whenever it is asked for
    T, X = 60.0, 4.0
    t = np.linspace(0.1, T - 0.1, 100_000)
    assert ends[0] == pytest.approx(t[np.argmin((1 + X / t) / (T - t))], abs=1e-2)
    assert cell.end_of_training("auto", 60.0, 5.0, 0.0) == 30 >= cell.end_of_training("auto", 60.0, 5.0, 1.0)


# ---------------------------------------------------------------- seeds, passes, checkpoints

def test_seeds_of_passes_never_meet():
    from olpm_bench.bench.reference import SEEDS

    last = cell.pass_seed(config.MAX_SEED, cell.PASSES_PER_SEED - 1)
    assert cell.pass_seed(1, 0) == cell.pass_seed(0, cell.PASSES_PER_SEED - 1) + 1
    assert last < cell.WARM_UP_SEED < SEEDS["a"] < SEEDS["b"] and SEEDS["b"] + 2**30 <= 2**32
    with pytest.raises(CellFailedError):
        cell.pass_seed(0, cell.PASSES_PER_SEED)


@pytest.mark.parametrize("n, power", [(0.3, 1), (1, 1), (3.9, 2), (4, 4), (1000, 512)])
def test_power_of_two(n, power):
    assert cell.power_of_two(n) == power


def test_checkpoints_are_log_spaced():
    assert cell.checkpoint_times(1, 16, 5) == pytest.approx([1, 2, 4, 8, 16])
    assert cell.checkpoint_times(1, 16, 1) == [16]
    assert cell.checkpoint_times(20, 16, 2) == pytest.approx([16, 16])


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e-3])
def test_an_invalid_pixel_is_found_and_named(value):
    image = np.ones((4, 5, 3))
    cell.check_pixels(image, "pass 7")
    image[2, 3, 1] = value
    with pytest.raises(CellFailedError, match=r"1 pixels .* x = 3, y = 2: .*, in pass 7"):
        cell.check_pixels(image, "pass 7")


@pytest.mark.parametrize("enters", [True, False])
def test_an_invalid_pixel_of_a_training_image_fails_a_cell_whose_result_it_enters(experiment, monkeypatch, enters):
    text = TOML + 'representation = { type = "cosine" }\n'
    training = f"passes = 0, camera_passes = 2, camera_paths = 200, blend = {str(enters).lower()}"
    experiment.path.write_text(f"{text}training = {{ {training} }}\n")
    spec, learn = experiment_file.load(experiment.path).cells()[1], cell.Training._camera_pass

    def broken(self, statistics):
        done = learn(self, statistics)
        done.image = done.image * np.nan
        return done

    monkeypatch.setattr(cell.Training, "_camera_pass", broken)
    scene, warm = cell.load_scene(spec), WarmUp(0.0, 1.0)
    if enters:          # that of the second half
        with pytest.raises(CellFailedError, match="in training pass 2"):
            cell.measure(spec, scene, warm)
    else:
        done = cell.measure(spec, scene, warm)
        assert done.info["training_passes"] == 2 and np.isfinite(done.image["mean"]).all()
