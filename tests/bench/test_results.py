"""Files of results: round trips, atomic writes, refusal of newer and broken ones."""
from __future__ import annotations

import errno
import json

import numpy as np
import pytest

from olpm_bench.bench import results as r
from olpm_bench.bench.results import Accumulator, NewerSchemaError, Reference, ResultError, Results

rng = np.random.default_rng(7)


def image(h=5, w=7) -> np.ndarray:
    return rng.random((h, w, 3), dtype=np.float32)


def write_cell(results: Results, seed=0, checkpoints=2) -> r.Cell:
    layers = {"mean": image(), "variance": np.full((5, 7, 3), np.inf), "count": np.full((5, 7), 8)}
    trace = [{"seconds": i + 0.5, "spp": i} for i in range(checkpoints)]
    return results.write_cell("a scene", "GMM, K = 8", seed, {"key": "k", "mean_stderr": float("inf")}, trace, layers,
                              [image() for _ in trace], {"seed": seed})


# ---------------------------------------------------------------- round trips

def test_a_cell_comes_back_as_it_was(tmp_path):
    results = Results(tmp_path)
    write_cell(results)
    cell = results.verified_cell("a scene", "GMM, K = 8", 0)
    assert cell.folder == tmp_path / "cells" / "a-scene" / "GMM-K-8" / "0"
    assert cell.info["key"] == "k" and cell.info["mean_stderr"] is None and cell.info["schema_version"] == 1
    assert [line["spp"] for line in cell.trace] == [0, 1]
    parts = cell.image()
    assert parts["mean"].shape == (5, 7, 3) and parts["count"].shape == (5, 7, 1) and np.isinf(parts["variance"]).all()
    assert len(cell.checkpoints()) == 2
    assert r.read_exr(cell.folder / "image.exr")[1] == {"seed": 0}
    assert not [f for f in cell.folder.iterdir() if f.name.startswith(".")]


def test_exr_is_exact(tmp_path):
    pixels = np.float32([[[1e-30, 6.5e4, 1e20]]]) * np.ones((3, 2, 3), np.float32)
    r.write_exr(tmp_path / "x.exr", {"mean": pixels}, {"text": 'ä "b"', "number": 0.1})
    parts, header = r.read_exr(tmp_path / "x.exr")
    np.testing.assert_array_equal(parts["mean"], pixels)
    assert header == {"text": 'ä "b"', "number": 0.1}


def test_json_has_no_nan(tmp_path):
    r.write_json(tmp_path / "x.json", {"schema_version": 1, "a": float("nan"), "b": [np.float32("inf"), np.int64(3)]})
    assert r.read_json(tmp_path / "x.json") == {"schema_version": 1, "a": None, "b": [None, 3]}


def test_a_reference_comes_back_as_it_was(tmp_path):
    reference = Reference(image(), image(), image(), image(), {"key": "k", "spp_a": 3, "spp_b": 1})
    r.write_reference(tmp_path / "k", reference)
    again = r.read_reference(r.find_reference("k", [tmp_path / "none", tmp_path]), 7, 5)
    np.testing.assert_array_equal(again.b_variance, reference.b_variance)
    np.testing.assert_allclose(again.mean, 0.75 * reference.a + 0.25 * reference.b, rtol=1e-5)
    assert again.noise_floor == pytest.approx(np.abs(reference.a - reference.b).mean() / 2, rel=1e-5)


def test_a_foreign_reference_is_averaged_down_and_has_no_noise_floor(tmp_path):
    large = image(10, 14)
    r.write_exr(tmp_path / "foreign.exr", {"": large})
    reference = r.read_reference(tmp_path / "foreign.exr", 7, 5)
    np.testing.assert_allclose(reference.mean[1, 2], large[2:4, 4:6].mean(axis=(0, 1)), rtol=1e-6)
    assert reference.noise_floor is None
    with pytest.raises(ResultError, match=r"is 14x10, the experiment's image is 8x5"):
        r.read_reference(tmp_path / "foreign.exr", 8, 5)


# ---------------------------------------------------------------- what is refused

def test_what_is_missing_or_broken_is_named(tmp_path):
    results = Results(tmp_path)
    assert results.read_cell("s", "m", 0) is None
    folder = write_cell(results).folder
    names = ("a scene", "GMM, K = 8", 0)
    for name in ("image.exr", "checkpoints.exr", "trace.jsonl", "cell.json"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: len(whole) * 2 // 3])
        with pytest.raises(ResultError, match=name.replace(".", r"\.")):
            results.verified_cell(*names)
        (folder / name).write_bytes(whole)
    assert results.verified_cell(*names) is not None


def test_a_checkpoint_too_few_is_noticed(tmp_path):
    cell = write_cell(Results(tmp_path), checkpoints=3)
    trace = cell.folder / "trace.jsonl"
    trace.write_text("".join(trace.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(ResultError, match=r"trace\.jsonl is broken"):
        Results(tmp_path).verified_cell("a scene", "GMM, K = 8", 0)
    info = json.loads((cell.folder / "cell.json").read_text())
    r.write_json(cell.folder / "cell.json", info | {"digests": {}})          # of an older version
    with pytest.raises(ResultError, match="3 images for 2 checkpoints"):
        Results(tmp_path).verified_cell("a scene", "GMM, K = 8", 0)


@pytest.mark.parametrize("name", ["summary.json", "env.json", "experiment.toml"])
def test_a_newer_folder_is_refused(tmp_path, name):
    (tmp_path / name).write_text("schema_version = 2" if name.endswith("toml") else '{"schema_version": 2}')
    with pytest.raises(NewerSchemaError, match=r"schema_version = 2 is newer .* reads up to 1"):
        Results(tmp_path)


def test_a_newer_cell_is_refused(tmp_path):
    cell = write_cell(Results(tmp_path))
    (cell.folder / "cell.json").write_text(json.dumps({**cell.info, "schema_version": 2}))
    with pytest.raises(NewerSchemaError):
        Results(tmp_path).read_cell("a scene", "GMM, K = 8", 0)


def test_a_broken_reference_says_what_to_do(tmp_path):
    r.write_reference(tmp_path / "k", Reference(image(), image(), image(), image(), {"spp_a": 1, "spp_b": 1}))
    with pytest.raises(ResultError, match=r"is 7x5, the experiment's image is 8x5"):
        r.read_reference(tmp_path / "k", 8, 5)
    (tmp_path / "k" / "reference.exr").write_bytes(b"no EXR")
    with pytest.raises(ResultError, match=r"reference\.exr is broken"):
        r.read_reference(tmp_path / "k", 7, 5)


# ---------------------------------------------------------------- writing

def test_a_failed_write_leaves_what_was_there(tmp_path):
    r.write_text(tmp_path / "x", "old")
    with pytest.raises(KeyError), r.replacing(tmp_path / "x") as beside:
        beside.write_text("half of the ne")
        raise KeyError
    assert (tmp_path / "x").read_text() == "old" and [f.name for f in tmp_path.iterdir()] == ["x"]


@pytest.fixture
def full_disk(monkeypatch):
    """From the call on, EXR files cannot be written."""
    import OpenEXR

    class Full:
        def __init__(self, *_):
            pass

        def write(self, name):
            raise RuntimeError(f'Failed to write pixel data to image file "{name}". No space left on device.')

    return lambda: monkeypatch.setattr(OpenEXR, "File", Full)


def test_a_full_disk_is_an_oserror_and_the_cell_stays_incomplete(tmp_path, monkeypatch, full_disk):
    results = Results(tmp_path)
    write_cell(results, seed=0)
    full_disk()
    with pytest.raises(OSError) as error:
        write_cell(results, seed=1)
    monkeypatch.undo()
    assert error.value.errno == errno.ENOSPC and "image.exr" in error.value.filename
    assert results.verified_cell("a scene", "GMM, K = 8", 0) is not None
    assert results.verified_cell("a scene", "GMM, K = 8", 1) is None
    assert not list(tmp_path.rglob("*.tmp*"))


def test_a_complete_cell_outlives_the_failure_of_its_successor(tmp_path, monkeypatch, full_disk):
    """A disk that is full while images or cell.json are written, and a run that fails: all that was there stays."""
    results = Results(tmp_path)
    folder = write_cell(results).folder
    before = {f.name: f.read_bytes() for f in folder.iterdir()}

    def full(path, value):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    for fill in (full_disk, lambda: monkeypatch.setattr(r, "write_json", full)):
        fill()
        with pytest.raises(OSError, match="No space left"):
            write_cell(results)
        monkeypatch.undo()
        assert {f.name: f.read_bytes() for f in folder.iterdir()} == before
    results.write_failure("a scene", "GMM, K = 8", 0, "3 pixels are NaN")
    assert r.read_json(folder / "failed.json")["reason"] == "3 pixels are NaN"
    assert {name: (folder / name).read_bytes() for name in before} == before
    write_cell(results)
    assert not (folder / "failed.json").exists() and results.verified_cell("a scene", "GMM, K = 8", 0) is not None


# ---------------------------------------------------------------- mean and variance of passes

def test_passes_of_different_sizes_give_an_unbiased_variance():
    """Var(mean) = sigma^2 / N from passes of 1, 2, 4 and 8 samples: mean of 20000 trials within 4 standard errors."""
    sizes, trials = (1, 2, 4, 8), 20_000
    accumulator = Accumulator.empty(1, trials)
    samples = np.random.default_rng(3).exponential(2.0, (sum(sizes), 1, trials, 3))
    first = 0
    for n in sizes:
        accumulator.add(samples[first:first + n].mean(axis=0), n)
        first += n
    np.testing.assert_allclose(accumulator.mean, samples.mean(axis=0), rtol=1e-12)
    variance, truth = accumulator.variance(), 4.0 / sum(sizes)
    assert abs(variance.mean() - truth) < 4 * variance.std() / np.sqrt(variance.size)


def test_one_pass_has_no_variance_to_show():
    accumulator = Accumulator.empty(2, 2)
    accumulator.add(np.ones((2, 2, 3)), 4)
    assert np.isinf(accumulator.variance()).all()


def test_an_accumulator_goes_on_where_it_was():
    passes = np.random.default_rng(5).random((6, 2, 3, 3))
    whole, first = Accumulator.empty(2, 3), Accumulator.empty(2, 3)
    for i, x in enumerate(passes):
        whole.add(x, 2)
        if i < 3:
            first.add(x, 2)
    resumed = Accumulator.resume(first.mean, first.variance(), first.spp, first.passes)
    for x in passes[3:]:
        resumed.add(x, 2)
    np.testing.assert_allclose(resumed.mean, whole.mean)
    np.testing.assert_allclose(resumed.variance(), whole.variance())
