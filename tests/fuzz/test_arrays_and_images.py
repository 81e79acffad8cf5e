"""Guides, directions and images that are broken in any way: a whole one, or one line that says that it is not."""
from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from child import child
from hypothesis import given
from hypothesis import strategies as st
from mutations import NUMBERS, examples, mutated_bytes, tables

from olpm_bench.bench import fit
from olpm_bench.bench.exr import write_exr
from olpm_bench.transport import headroom
from olpm_bench.transport.cache import SPLIT, RecordCache
from olpm_bench.transport.guide import MIN_PARTICLES, Guide
from olpm_bench.transport.settings import InputError
from representations.interface import ParticleBatch

GUIDES = {"jensen": {"type": "jensen", "resolution": 2}, "hey": {"type": "hey", "cones": 4},
          "gaussian_mixture": {"type": "gaussian_mixture", "components": 2}}        # all but the first with parallax
HALVES = ("a.mean", "b.mean", "a.variance", "b.variance")       # of a reference


@pytest.fixture(scope="module")
def valid(tmp_path_factory) -> dict[str, bytes]:
    """Small guides with split cells and records that guide, directions, and an image."""
    folder = tmp_path_factory.mktemp("valid")
    rng = np.random.default_rng(0)
    p, n = (rng.normal(size=(3, 200)).astype(np.float32) for _ in range(2))
    for name, specification in GUIDES.items():
        guide = Guide(RecordCache(mi.ScalarBoundingBox3f(-1, 1), 0.2), specification, 0.5, parallax=name != "jensen")
        guide.grow(mi.Point3f(np.tanh(p)), dr.normalize(mi.Normal3f(n)), mi.Bool(True), 0)
        m = guide.records * MIN_PARTICLES
        wo, at = rng.uniform(0.1, 1, (3, m)).astype(np.float32), rng.uniform(-0.1, 0.1, (3, m)).astype(np.float32)
        guide.learn_particles(ParticleBatch.from_arrays(
            dr.normalize(mi.Vector3f(wo)), dr.ones(mi.Float, m), dr.arange(mi.UInt32, m) // MIN_PARTICLES, guide.records,
            dr.ones(mi.Float, m) if guide.parallax else None, mi.Vector3f(at) if guide.parallax else None), 0)
        assert guide.trained == 1
        guide.save(folder / f"{name}.npz")
    wo = rng.normal(size=(20, 3)) * (1, 1, 0) + (0, 0, 3)
    np.savez(folder / "directions.npz", wo=wo / np.linalg.norm(wo, axis=1, keepdims=True), weight=np.ones(20), pdf=np.ones(20))
    write_exr(folder / "image.exr", {"mean": rng.uniform(size=(6, 8, 3)).astype(np.float32), "count": np.ones((6, 8))}, {"a": 1})
    write_exr(folder / "halves.exr", {name: rng.uniform(size=(6, 8, 3)) for name in HALVES}, {"spp_a": 1, "spp_b": 2})
    return {file.stem: file.read_bytes() for file in folder.iterdir()}


@pytest.fixture(scope="module")
def process(valid, tmp_path_factory):
    folder = tmp_path_factory.mktemp("last")
    with child() as process:
        yield process
        for name, content in valid.items():
            assert judge(process, folder, name, content) == "ok", "after so many files it refuses whole ones"
        print(process)              # pytest -rP shows it


def judge(process, folder: Path, kind: str, content: bytes) -> str:
    """The file read by the child; returns whether it was whole."""
    kind = "image" if kind == "halves" else kind
    file = folder / f"broken.{'exr' if kind == 'image' else 'npz'}"
    file.write_bytes(content)
    answer = process.ask(kind, str(file))
    assert {"ok", "refused"} & answer.keys(), answer
    if "refused" in answer:
        assert str(file) in answer["refused"], answer
    return next(iter(answer))


def arrays_of(content: bytes) -> dict[str, np.ndarray]:
    with np.load(io.BytesIO(content)) as file:
        return dict(file)


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


@st.composite
def changed_arrays(draw: st.DrawFn, valid: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays one or two of which are missing, of other types, sizes or values."""
    arrays = dict(valid)
    for _ in range(draw(st.integers(1, 2))):
        name = draw(st.sampled_from(sorted(arrays)))
        array = arrays[name]
        how = draw(st.sampled_from(["delete", "type", "cut", "grow", "empty", "value", "value", "value", "reshape", "swap"]))
        if how == "delete":
            del arrays[name]
        elif how == "type":
            arrays[name] = array.astype(draw(st.sampled_from(["f8", "i8", "u1", "f2", "U8", "c16", ">f4"]))) \
                if array.dtype.kind != "U" else np.zeros(3)
        elif how == "cut":
            arrays[name] = array[:len(array) // 2] if array.ndim else np.array([array, array])
        elif how == "grow":
            arrays[name] = np.concatenate([array, array]) if array.ndim else np.array(2 ** 40)
        elif how == "empty":
            arrays[name] = np.zeros(0, array.dtype)
        elif how == "reshape":
            arrays[name] = array.reshape(1, *array.shape)
        elif how == "swap":
            arrays[name] = arrays[draw(st.sampled_from(sorted(arrays)))]
        elif name == "meta" and array is valid["meta"]:
            arrays[name] = np.array(json.dumps(draw(tables(json.loads(str(array))))))
        elif array.size:
            array = array.copy()
            with np.errstate(all="ignore"):
                array.flat[draw(st.integers(0, array.size - 1))] = np.array(draw(st.sampled_from(
                    [x for x in NUMBERS if array.dtype.kind == "f" or 0 <= x < 2**31]))).astype(array.dtype)
            arrays[name] = array
    return arrays


@examples(0.2)
@given(data=st.data(), name=st.sampled_from(list(GUIDES)))
def test_guides_whose_arrays_are_broken(process, valid, tmp_path_factory, data, name):
    arrays = data.draw(changed_arrays(arrays_of(valid[name])))
    judge(process, tmp_path_factory.getbasetemp(), "guide", packed(arrays))


@examples(0.1)
@given(data=st.data(), name=st.sampled_from([*GUIDES, "directions"]))
def test_archives_whose_bytes_are_broken(process, valid, tmp_path_factory, data, name):
    judge(process, tmp_path_factory.getbasetemp(), name, data.draw(mutated_bytes(valid[name], dictionary=(b"PK\x03\x04",))))


@examples(0.05)
@given(data=st.data())
def test_directions_whose_arrays_are_broken(process, valid, tmp_path_factory, data):
    arrays = data.draw(changed_arrays(arrays_of(valid["directions"])))
    judge(process, tmp_path_factory.getbasetemp(), "directions", packed(arrays))


@examples(0.1)
@given(data=st.data(), name=st.sampled_from(["image", "halves"]))
def test_images_whose_bytes_are_broken(process, valid, tmp_path_factory, data, name):
    judge(process, tmp_path_factory.getbasetemp(), name, data.draw(mutated_bytes(valid[name])))


@pytest.mark.parametrize("channels, header", [(3, {}), (3, {"spp_a": 0, "spp_b": 0}), (1, {"spp_a": 1, "spp_b": 1})])
def test_halves_of_a_reference_that_another_program_has_saved_again(process, tmp_path, channels, header):
    shape = (6, 8, 3)[:2 + channels // 3]
    write_exr(tmp_path / "halves.exr", {name: np.ones(shape, np.float32) for name in HALVES}, header)
    assert judge(process, tmp_path, "halves", (tmp_path / "halves.exr").read_bytes()) == "refused"


def test_what_is_whole_is_read(process, valid, tmp_path):
    for name, content in valid.items():
        assert judge(process, tmp_path, name, content) == "ok"
    assert judge(process, tmp_path, "guide", packed(arrays_of(valid["jensen"]))) == "ok"


def table(arrays: dict[str, np.ndarray], entry: int) -> dict[str, np.ndarray]:
    entries = arrays["cache.table_entries"].copy()
    entries[0] = entry
    return {"cache.table_entries": entries}


@pytest.mark.parametrize("change", [
    pytest.param(lambda a: table(a, 10**6), id="an entry for a record that is not there"),
    pytest.param(lambda a: table(a, SPLIT + 10**6), id="a cell split into a block that is not there"),
    pytest.param(lambda a: a | {"cache.table_used": a["cache.table_used"] + np.uint32(2**31)}, id="a place beyond the table"),
    pytest.param(lambda a: {"cache.table_size": np.array(10**15)}, id="a table larger than any memory"),
    pytest.param(lambda a: {"cache.cells_record": a["cache.cells_record"] + np.uint32(9999)}, id="a cell of no record"),
    pytest.param(lambda a: {"cache.bbox": np.full((2, 3), np.nan, np.float32)}, id="a box that is none"),
    pytest.param(lambda a: {"cache.bbox": np.float32([[-3e38] * 3, [3e38] * 3])}, id="a box whose size float32 cannot hold"),
    pytest.param(lambda a: {"cache.bbox": np.float32([[0] * 3, [1e-44] * 3])}, id="a box that is too small"),
    pytest.param(lambda a: {"cache.record_radius": np.array(0.0)}, id="records without extent"),
    pytest.param(lambda a: {"state.mass": a["state.mass"][:8]}, id="a state of fewer records"),
    pytest.param(lambda a: {"state.mass": a["state.mass"].astype(np.float64)}, id="a state of another type"),
    pytest.param(lambda a: {"pixels": np.zeros((0, 0), np.float32)}, id="an image without pixels"),
    pytest.param(lambda a: {"meta": np.array("[" * 10**5)}, id="JSON too deep"),
    pytest.param(lambda a: {"meta": np.array('{"format": 5, "representation": 3}')}, id="a representation that is no table"),
    pytest.param(lambda a: {"meta": np.array(str(a["meta"]).replace("resolution", "resolutions"))}, id="a parameter it has not"),
])
def test_guides_that_would_be_read_out_of_bounds(process, valid, tmp_path, change):
    arrays = arrays_of(valid["jensen"])
    assert judge(process, tmp_path, "guide", packed(arrays | change(arrays))) == "refused"


def test_archives_that_are_larger_than_any_memory_or_locked(process, tmp_path):
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999,), }"
    header = b"\x93NUMPY\x01\x00" + (len(header) + 1).to_bytes(2, "little") + header + b"\n"
    for kind in ("guide", "directions"):
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            archive.writestr("wo.npy", header)
        assert judge(process, tmp_path, kind, stream.getvalue()) == "refused"
        locked = stream.getvalue().replace(b"PK\x01\x02\x14\x03\x14\x00\x00", b"PK\x01\x02\x14\x03\x14\x00\x01")
        assert judge(process, tmp_path, kind, locked) == "refused"
        assert judge(process, tmp_path, kind, header) == "refused"


def test_archives_that_would_fill_the_memory_when_unpacked(tmp_path, monkeypatch):
    file = tmp_path / "zeros.npz"
    np.savez_compressed(file, wo=np.zeros((10**6, 3), np.float32), weight=np.zeros(10**6, np.float32))
    assert file.stat().st_size < 10**5
    monkeypatch.setattr(headroom, "free", lambda: 3e7)
    for read in (Guide.load, lambda path: fit._load(path, "wo", "weight")):
        with pytest.raises(InputError, match=r"zeros\.npz: its arrays take about 0\.032 GB, and 0\.03 GB are free"):
            read(file)
