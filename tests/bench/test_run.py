"""Running experiments: what is resumed, redone, failed and interrupted.

Images are tiny and budgets in samples, so that nothing depends on the speed of the machine.
"""
from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from small_experiment import TOML, edit

from olpm_bench.bench import experiment_file, finished, plan, reference, run, summary
from olpm_bench.bench.cell import CellFailedError
from olpm_bench.bench.config import Experiment
from olpm_bench.bench.files import ResultError, require_inside
from olpm_bench.bench.lock import locked
from olpm_bench.bench.reference_file import Reference, write_reference
from olpm_bench.bench.results import Results
from olpm_bench.report import figures
from olpm_bench.transport import settings
from olpm_bench.transport.settings import InputError


@pytest.fixture
def experiment(tmp_path) -> Experiment:
    """An experiment with a (made up) reference in place."""
    (tmp_path / "test.toml").write_text(TOML)
    loaded = experiment_file.load(tmp_path / "test.toml")
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


def test_a_rerun_skips_what_is_complete(experiment, root, monkeypatch):
    assert run.run(experiment, root) == []
    assert all(cells(experiment, root))
    environment = json.loads((root / "test" / "env.json").read_text())
    assert environment["variant"] == "llvm_ad_rgb"
    assert all(cell.info["machine"].items() >= {k: environment[k] for k in ("cpu", "cores", "threads")}.items()
               for cell in cells(experiment, root))
    assert experiment_file.load(root / "test" / "experiment.toml").cells()[0].key == experiment.cells()[0].key
    monkeypatch.setattr(run, "measure", counted := Counted())
    assert run.run(experiment, root) == [] and counted.calls == 0


@pytest.mark.parametrize("waited, kept, flagged", [((0.5, 0.1), 0.1, False), ((0.5, 0.7), 0.5, True)])
def test_a_cell_on_a_busy_machine_is_measured_twice_and_then_flagged(experiment, root, monkeypatch, waited, kept,
                                                                     flagged):
    experiment.path.write_text(TOML.replace("spp = 11", "seconds = 0.2"))
    timed = experiment_file.load(experiment.path)
    shares = iter(waited)

    def measure(*args, original=run.measure, **kwargs):
        done = original(*args, **kwargs)
        return dataclasses.replace(done, info={**done.info, "wait_fraction": next(shares, 0.0)})
    monkeypatch.setattr(run, "measure", measure)
    assert run.run(timed, root) == []
    assert cells(timed, root)[0].info["wait_fraction"] == kept
    found = finished.read(timed, Results(root / "test"), run.references(timed, root))
    assert found.unreliable == (["Path tracing"] if flagged else [])
    assert ("Timings unreliable, the machine was busy: Path tracing." in figures.machines(found)) == flagged
    said = summary.notes(summary.summarise(found)["rows"])
    assert any("Path tracing: timings unreliable" in note for note in said) == flagged


def test_env_json_is_of_where_cells_were_made_and_scenes_are_loaded_for_those_alone(experiment, root, monkeypatch):
    path, scenes = root / "test" / "env.json", []
    monkeypatch.setattr(run.environment, "describe", lambda: {"schema_version": 1, "cpu": cpu})
    monkeypatch.setattr(run, "load_scene", lambda spec, load=run.load_scene: scenes.append(str(spec)) or load(spec))

    def written() -> str:
        assert run.run(experiment, root) == []
        return json.loads(path.read_text())["cpu"]
    cpu = "of a node"
    assert written() == "of a node" and len(scenes) == 1
    cpu = "of the login node"
    assert written() == "of a node" and len(scenes) == 1
    path.write_text("{")
    assert written() == "of the login node" and len(scenes) == 1        # broken: better than none
    cpu = "of another node"
    (cells(experiment, root)[1].folder / "cell.json").unlink()
    assert written() == "of another node" and len(scenes) == 2


def test_changed_broken_and_missing_cells_are_redone(experiment, root, monkeypatch):
    run.run(experiment, root)
    done = cells(experiment, root)
    (done[0].folder / "image.exr").write_bytes(b"broken")
    (done[1].folder / "cell.json").unlink()
    edit(done[2].folder / "cell.json", key="of other settings")
    monkeypatch.setattr(run, "measure", counted := Counted())
    assert run.run(experiment, root) == [] and counted.calls == 3
    assert [c.info["key"] for c in cells(experiment, root)] == [c.key for c in experiment.cells()]


def test_cells_with_the_images_of_other_seeds_are_redone(experiment, root, monkeypatch):
    run.run(experiment, root)
    images = [cell.folder / "image.exr" for cell in cells(experiment, root) if cell.method == "Path tracing"]
    whole = [image.read_bytes() for image in images]
    for image, content in zip(images, reversed(whole), strict=True):
        image.write_bytes(content)
    monkeypatch.setattr(run, "measure", counted := Counted())
    assert run.run(experiment, root) == [] and counted.calls == 2 and [image.read_bytes() for image in images] == whole


def interrupted_while_tracing(by: BaseException) -> RuntimeError:
    error = RuntimeError("dr.while_loop(): encountered an exception (see above).")
    error.__cause__ = by
    return error


@pytest.mark.parametrize("error, seen", [
    (KeyboardInterrupt(), KeyboardInterrupt), (interrupted_while_tracing(KeyboardInterrupt()), KeyboardInterrupt),
    (interrupted_while_tracing(SystemExit(-1)), KeyboardInterrupt), (OSError(28, "No space left on device", "x"), OSError),
], ids=["Ctrl-C", "Ctrl-C in a loop", "preempted in a loop", "full disk"])
def test_an_interruption_loses_the_cell_in_hand_only(experiment, root, monkeypatch, error, seen):
    monkeypatch.setattr(run, "measure", Counted(fail_at=3, error=error))
    with pytest.raises(seen):
        run.run(experiment, root)
    assert [c is not None for c in cells(experiment, root)] == [True, True, False, False]
    assert not [f for f in root.rglob("*") if f.name == "lock" or ".tmp" in f.name]
    monkeypatch.undo()
    monkeypatch.setattr(run, "measure", counted := Counted())
    assert run.run(experiment, root) == [] and counted.calls == 2


@pytest.mark.parametrize("error", [CellFailedError("3 pixels are NaN"), RuntimeError("jit:\n failure"),
                                   InputError("the records take about 9 GB, and 3 GB are free: fewer of them"),
                                   MemoryError("Unable to allocate 8 PiB")])
def test_a_failed_cell_is_named_and_the_others_are_run(experiment, root, monkeypatch, error):
    monkeypatch.setattr(run, "measure", Counted(fail_at=2, error=error))
    problems = run.run(experiment, root)
    reason = " ".join(str(error).split())
    assert problems == [f"cornell_box / Roulette / seed 0: {reason}"]
    assert [c is not None for c in cells(experiment, root)] == [True, False, True, True]
    failed = Results(root / "test").cell_folder("cornell_box", "Roulette", 0) / "failed.json"
    assert json.loads(failed.read_text())["reason"] == reason


def test_errors_of_other_peoples_code_fail_its_cells_and_our_own_end_the_run(experiment, root, tmp_path, monkeypatch):
    code = "class Theirs:\n    def init(self, n_records, seed=0, parallax=False):\n        return {}['x']\n"
    (tmp_path / "theirs.py").write_text(code)
    theirs = f'[[method]]\nname = "Theirs"\nrepresentation = {{ type = "{tmp_path}/theirs.py:Theirs" }}\n'
    experiment.path.write_text(TOML + theirs)
    loaded = experiment_file.load(experiment.path)
    assert run.run(loaded, root) == [f"cornell_box / Theirs / seed {seed}: KeyError: 'x'" for seed in (0, 1)]
    assert [c is not None for c in cells(loaded, root)] == [True, True, False] * 2
    failed = Results(root / "test").cell_folder("cornell_box", "Theirs", 1) / "failed.json"
    assert json.loads(failed.read_text())["reason"] == "KeyError: 'x'"
    cells(experiment, root)[0].folder.joinpath("cell.json").unlink()
    monkeypatch.setattr(run, "measure", Counted(fail_at=1, error=KeyError("x")))
    with pytest.raises(KeyError):
        run.run(experiment, root)


def test_a_cell_in_other_hands_is_left_alone(experiment, root):
    with locked(Results(root / "test").cell_folder("cornell_box", "Roulette", 1)):
        problems = run.run(experiment, root)
    assert len(problems) == 1 and "held by process" in problems[0]
    assert problems[0].startswith("cornell_box / Roulette / seed 1: ")
    assert run.run(experiment, root) == []


@pytest.mark.parametrize("link", ["test", "test/cells", "test/cells/cornell_box/Roulette/1", "references"])
def test_no_link_leads_out_of_the_results_folder(experiment, tmp_path, root, link):
    (unfinished := tmp_path / "elsewhere" / "cells" / ".notes.tmp").mkdir(parents=True)
    if link == "references":
        (root / link).rename(root / "kept")
    (root / link).parent.mkdir(parents=True, exist_ok=True)
    (root / link).symlink_to(unfinished.parent)
    with pytest.raises(ResultError, match=rf"{link}.* is {tmp_path}/elsewhere/cells.*, by a link that leads out of {root}: "):
        reference.improve(experiment, root, 1) if link == "references" else run.run(experiment, root)
    assert [*(tmp_path / "elsewhere").rglob("*")] == [unfinished.parent, unfinished]
    (tmp_path / "linked").symlink_to(root)          # it may be one itself, and links may stay in it
    require_inside(tmp_path / "linked" / "other" / "cells", root)
    (root / "inside").symlink_to(root / "kept")
    require_inside(root / "inside" / "1", root)


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
    found = plan.plan(experiment, root)
    assert len(found.todo) == 4 and found.hours is None and 0 < found.gigabytes < 2 and not found.refusals
    run.run(experiment, root)
    assert plan.plan(experiment, root).todo == []
    experiment.path.write_text(TOML.replace("spp = 11", "seconds = 900"))
    assert plan.plan(experiment_file.load(experiment.path), root).hours == 1.0


@pytest.mark.parametrize("preset, schedule", [("best", "interleaved"), ("paper2014", "single_batch")])
def test_the_memory_of_ten_million_photons(experiment, preset, schedule):
    """At most: closed rooms keep 11 hits of each, splitting twice as many; a gather of the nearest takes 130 bytes a hit."""
    plain = dataclasses.replace(experiment.cells()[0], integrator=settings.integrator(max_depth=13))

    def memory(**changes) -> float:
        changes = {"schedule": schedule, "passes": 1, "importons": 0, "camera_passes": 0, **changes}
        return run.memory(dataclasses.replace(plain, training=settings.training(preset, **changes)))
    assert 12 < memory(photons=10**7) < 24
    assert memory(photons=10**6) == pytest.approx(0.9 * run.memory(plain) + 0.1 * memory(photons=10**7))
    at_once, of_both = (10**7, 10**6) if schedule == "single_batch" else (10**6, 2 * 10**6)
    assert memory(photons=10**6, passes=10) == memory(photons=at_once) and memory(passes=0) == run.memory(plain)
    assert memory(photons=10**6, importons=10**6) == memory(photons=of_both)


def test_the_committed_references_are_found(experiment, tmp_path, root):
    """`<folder of the TOML>/../results/references` serves whatever `--results` is."""
    (tmp_path / "experiments").mkdir()
    experiment.path.rename(tmp_path / "experiments" / "test.toml")
    moved = experiment_file.load(tmp_path / "experiments" / "test.toml")
    found = run.references(moved, tmp_path / "elsewhere")["cornell_box"]
    assert found.noise_floor == pytest.approx(0.005, rel=1e-4)
