"""References: two independent halves that are resumed, saved whole, and agree with each other."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from olpm_bench.bench import cell, experiment_file, reference
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.lock import LockedError, locked
from olpm_bench.bench.reference_file import read_reference

TOML = """
title = "Test"
[budget]
spp = 1
[[scene]]
name = "cornell_box"
width = 16
height = 12
max_depth = 3
[[method]]
name = "Path tracing"
"""


@pytest.fixture
def experiment(tmp_path, monkeypatch):
    """Passes are of 4 samples and the clock says half a second each, whatever the machine."""
    class Ticks(cell.Clock):
        charged = 0.0

        def lap(self, *args):
            self.charged += 0.5
            return super().lap(*args)

    monkeypatch.setattr(reference, "Clock", Ticks)
    monkeypatch.setattr(reference, "_spp_of_pass", lambda *_: 4)
    (tmp_path / "test.toml").write_text(TOML)
    return experiment_file.load(tmp_path / "test.toml")


def read(folder: Path):
    return read_reference(folder, 16, 12)


def test_halves_are_made_and_resumed(experiment, tmp_path):
    folder = reference.improve(experiment, tmp_path, seconds=3)["cornell_box"]
    assert folder == tmp_path / "references" / experiment.reference_key(experiment.scene[0])
    first = read(folder)
    assert (first.meta["spp_a"], first.meta["spp_b"], first.meta["passes_a"], first.meta["seconds"]) == (12, 12, 3, 3.0)
    assert first.meta["estimator"] == "path, unguided" and first.meta["versions"]["mitsuba"]
    assert not np.array_equal(first.a, first.b)
    reference.improve(experiment, tmp_path, seconds=2)
    both = read(folder)
    assert (both.meta["spp_a"], both.meta["passes_b"], both.meta["seconds"]) == (20, 5, 5.0)
    other = reference.improve(experiment, tmp_path / "at once", seconds=5)["cornell_box"]
    np.testing.assert_allclose(read(other).a, both.a, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(read(other).b_variance, both.b_variance, rtol=1e-3, atol=1e-9)


def test_halves_agree_within_their_errors(experiment, tmp_path):
    """Mean of the squared Z scores of A - B over pixels and channels, which is 1 on average; 30 passes each."""
    r = read(reference.improve(experiment, tmp_path, seconds=30)["cornell_box"])
    variance = r.a_variance.astype(np.float64) + r.b_variance
    z2 = (r.a.astype(np.float64) - r.b) ** 2 / np.maximum(variance, 1e-9)
    assert 0.7 < z2[variance > 1e-9].mean() < 1.4


def test_an_interruption_keeps_what_is_there(experiment, tmp_path, monkeypatch):
    render, calls = cell.render_pass, []

    def interrupted(*args):
        calls.append(args)
        if len(calls) == 6:             # A B A B A, and Ctrl-C in B
            raise KeyboardInterrupt
        return render(*args)

    monkeypatch.setattr(cell, "render_pass", interrupted)
    with pytest.raises(KeyboardInterrupt):
        reference.improve(experiment, tmp_path, seconds=60)
    folder = tmp_path / "references" / experiment.reference_key(experiment.scene[0])
    kept = read(folder)
    assert (kept.meta["spp_a"], kept.meta["spp_b"]) == (12, 8)
    assert not (folder / "lock").exists()
    seeds = [args[2] for args in calls]
    assert len(set(seeds)) == 6
    monkeypatch.undo()


def test_a_broken_reference_is_not_overwritten(experiment, tmp_path):
    folder = reference.improve(experiment, tmp_path, seconds=2)["cornell_box"]
    (folder / "reference.exr").write_bytes(b"broken")
    with pytest.raises(ResultError, match=r"reference\.exr is broken"):
        reference.improve(experiment, tmp_path, seconds=2)
    assert (folder / "reference.exr").read_bytes() == b"broken"


def test_a_newer_reference_is_not_overwritten(experiment, tmp_path):
    folder = reference.improve(experiment, tmp_path, seconds=2)["cornell_box"]
    newer = json.dumps(json.loads((folder / "meta.json").read_text()) | {"schema_version": 2})
    (folder / "meta.json").write_text(newer)
    with pytest.raises(ResultError, match="newer"):
        reference.improve(experiment, tmp_path, seconds=2)
    assert (folder / "meta.json").read_text() == newer


def test_two_processes_do_not_improve_one_reference(experiment, tmp_path):
    with locked(tmp_path / "references" / experiment.reference_key(experiment.scene[0])), pytest.raises(LockedError):
        reference.improve(experiment, tmp_path, seconds=2)


def test_a_scene_with_a_reference_of_its_own_is_left_out(experiment, tmp_path):
    (tmp_path / "given.exr").write_bytes(b"")
    experiment.path.write_text(TOML.replace("max_depth = 3", 'max_depth = 3\nreference = "given.exr"'))
    assert reference.improve(experiment_file.load(experiment.path), tmp_path, seconds=1) == {}
