"""Results: round trips, atomic writes, refusal of newer and broken ones."""
from __future__ import annotations

import errno
import json
import shutil

import numpy as np
import pytest

from olpm_bench.bench import results as r
from olpm_bench.bench.exr import read_exr
from olpm_bench.bench.files import NewerSchemaError, ResultError, digest, read_json, write_json
from olpm_bench.bench.results import Cell, Results

rng = np.random.default_rng(7)


def image(h=5, w=7) -> np.ndarray:
    return rng.random((h, w, 3), dtype=np.float32)


def write_cell(results: Results, seed=0, checkpoints=2) -> Cell:
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
    assert read_exr(cell.folder / "image.exr")[1] == {"seed": 0}
    assert not [f for f in cell.folder.iterdir() if f.name.startswith(".")]


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


@pytest.mark.parametrize("name", ["image.exr", "checkpoints.exr", "trace.jsonl"])
def test_a_whole_file_of_another_cell_is_not_believed(tmp_path, name):
    results = Results(tmp_path)
    files = [write_cell(results, seed=seed, checkpoints=2 + seed).folder / name for seed in (0, 1)]
    swapped = [file.read_bytes() for file in reversed(files)]
    for seed, (file, content) in enumerate(zip(files, swapped, strict=True)):
        file.write_bytes(content)
        with pytest.raises(ResultError, match=rf"{seed}/{name} is broken: its digest is another"):
            results.read_cell("a scene", "GMM, K = 8", seed)


def test_images_must_be_of_the_right_size(tmp_path):
    results, names = Results(tmp_path), ("a scene", "GMM, K = 8", 0)
    write_cell(results)
    assert results.verified_cell(*names, (5, 7)) is not None
    for read in (lambda cell: cell.image(), lambda cell: cell.checkpoints()):
        with pytest.raises(ResultError, match=r"\.exr is broken: 7x5 pixels in place of 7x6"):
            read(results.read_cell(*names, (6, 7)))


@pytest.mark.parametrize("name", ["cell.json", "image.exr", "checkpoints.exr", "trace.jsonl"])
def test_no_digest_may_be_missing(tmp_path, name):
    results = Results(tmp_path)
    folder = write_cell(results).folder
    info = json.loads((folder / "cell.json").read_text())
    del info["digests"][name]
    write_json(folder / "cell.json", info)
    with pytest.raises(ResultError, match=rf"{name} is broken: its digest is another"):
        results.read_cell("a scene", "GMM, K = 8", 0)


def test_a_cell_in_the_folder_of_another_is_not_believed(tmp_path):
    results = Results(tmp_path)
    one, other = (write_cell(results, seed=seed).folder for seed in (0, 1))
    shutil.copytree(one, other, dirs_exist_ok=True)
    with pytest.raises(ResultError, match=r"1/cell\.json is of another cell"):
        results.read_cell("a scene", "GMM, K = 8", 1)
    info = json.loads((one / "cell.json").read_text())
    write_json(other / "cell.json", info | {"seed": 1})
    with pytest.raises(ResultError, match=r"1/cell\.json is broken: its digest is another"):
        results.read_cell("a scene", "GMM, K = 8", 1)


def test_cells_of_earlier_versions_are_read(tmp_path):
    """Their digest of cell.json left the key out."""
    file = write_cell(Results(tmp_path)).folder / "cell.json"
    info = json.loads(file.read_text())
    digests = info.pop("digests")
    older = digest(json.dumps({name: value for name, value in info.items() if name != "key"}, sort_keys=True).encode())
    assert "key" in info and older != digests["cell.json"]
    write_json(file, info | {"digests": digests | {"cell.json": older}})
    assert Results(tmp_path).verified_cell("a scene", "GMM, K = 8", 0) is not None
    write_json(file, info | {"charged_seconds": 2.5, "digests": digests | {"cell.json": older}})
    with pytest.raises(ResultError, match=r"cell\.json is broken: its digest is another"):
        Results(tmp_path).read_cell("a scene", "GMM, K = 8", 0)


def test_a_checkpoint_too_few_is_noticed(tmp_path):
    cell = write_cell(Results(tmp_path), checkpoints=3)
    trace = cell.folder / "trace.jsonl"
    trace.write_text("".join(trace.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(ResultError, match=r"trace\.jsonl is broken"):
        Results(tmp_path).verified_cell("a scene", "GMM, K = 8", 0)
    info = json.loads((cell.folder / "cell.json").read_text())
    info["digests"]["trace.jsonl"] = digest(trace.read_bytes())
    write_json(cell.folder / "cell.json", info)
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


# ---------------------------------------------------------------- writing


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
    assert read_json(folder / "failed.json")["reason"] == "3 pixels are NaN"
    assert {name: (folder / name).read_bytes() for name in before} == before
    write_cell(results)
    assert not (folder / "failed.json").exists() and results.verified_cell("a scene", "GMM, K = 8", 0) is not None
