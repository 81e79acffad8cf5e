"""`olpm-bench compare`: every metric of two images, as a table and as JSON, and what it refuses."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from olpm_bench.bench import metrics
from olpm_bench.bench.exr import write_exr
from olpm_bench.bench.reference_file import Reference, write_reference
from olpm_bench.cli import app

RNG = np.random.default_rng(11)
TRUTH = RNG.gamma(2.0, 0.3, (16, 24, 3)).astype(np.float32)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """a.exr with less noise than b.exr, the truth r.exr."""
    monkeypatch.chdir(tmp_path)
    for name, sigma in (("a", 0.01), ("b", 0.2)):
        noisy = np.maximum(TRUTH + RNG.normal(0, sigma, TRUTH.shape), 0).astype(np.float32)
        write_exr(tmp_path / f"{name}.exr", {"variance": noisy * 0, "mean": noisy})
    write_exr(tmp_path / "r.exr", {"": TRUTH})
    return tmp_path


def call(*arguments: object):
    return CliRunner().invoke(app, ["compare", *map(str, arguments)])


def image(path: Path) -> np.ndarray:
    from olpm_bench.bench.exr import read_exr
    return read_exr(path)[0]["mean"]


def test_every_metric_of_both_images_against_a_reference(folder):
    result = call("a.exr", "b.exr", "--reference", "r.exr", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["reference"] == "r.exr" and [shown["image"] for shown in found["images"]] == ["a.exr", "b.exr"]
    for shown in found["images"]:
        assert list(shown) == ["image", *metrics.METRICS, "invalid_pixels"]
        for name, metric in metrics.METRICS.items():
            assert shown[name] == pytest.approx(metric(image(folder / shown["image"]), TRUTH), rel=1e-12)
    assert all(found["images"][0][name] < found["images"][1][name] for name in metrics.METRICS)


def test_without_a_reference_the_second_image_is_it(folder):
    found = json.loads(call("a.exr", "b.exr", "--json").stdout)
    assert found["reference"] == "b.exr" and [shown["image"] for shown in found["images"]] == ["a.exr"]
    assert found["images"][0]["l1"] == pytest.approx(metrics.l1(image(folder / "a.exr"), image(folder / "b.exr")))


def test_the_table_has_a_line_for_each_metric(folder):
    result = call("a.exr", "b.exr", "--reference", "r.exr")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[0].split() == ["metric", "a.exr", "b.exr"] and lines[-1] == "against r.exr"
    assert [line.split()[0] for line in lines[1:-1]] == list(metrics.METRICS)


def test_a_folder_of_references_and_a_larger_one(folder):
    write_reference(folder / "reference", Reference(TRUTH, TRUTH.copy(), TRUTH, TRUTH, {"spp_a": 1, "spp_b": 1}))
    write_exr(folder / "large.exr", {"": np.repeat(np.repeat(TRUTH, 2, axis=0), 2, axis=1)})
    expected = json.loads(call("a.exr", "b.exr", "--reference", "r.exr", "--json").stdout)["images"]
    for reference in ("reference", "large.exr"):
        found = json.loads(call("a.exr", "b.exr", "--reference", reference, "--json").stdout)["images"]
        assert found[1]["relmse"] == pytest.approx(expected[1]["relmse"], rel=1e-5)


def test_invalid_pixels_are_counted_and_never_repaired(folder):
    broken = image(folder / "a.exr").copy()
    broken[2, 3, 0], broken[4, 5, 1] = np.nan, -1
    write_exr(folder / "a.exr", {"mean": broken})
    found = json.loads(call("a.exr", "r.exr", "--json").stdout)["images"][0]
    assert found["invalid_pixels"] == 2 and all(found[name] is None for name in metrics.METRICS)
    assert "a.exr: 2 pixels are NaN, infinite or negative" in call("a.exr", "r.exr").stdout


def test_a_black_reference_costs_flip_and_the_table_stays(folder):
    write_exr(folder / "black.exr", {"": 0 * TRUTH})
    found = json.loads(call("a.exr", "b.exr", "--reference", "black.exr", "--json").stdout)
    assert [shown["flip"] for shown in found["images"]] == [None, None] and found["flip_exposures"] is None
    assert all(shown["l1"] > 0 for shown in found["images"])
    result = call("a.exr", "b.exr", "--reference", "black.exr")
    assert result.exit_code == 0 and ["flip", "-", "-"] in [line.split() for line in result.stdout.splitlines()]


def test_a_metric_that_fails_is_named_below_the_table(folder, monkeypatch):
    def fails(x, r):
        raise ValueError("too dark")
    monkeypatch.setitem(metrics.METRICS, "flip", fails)
    result = call("a.exr", "b.exr", "--reference", "r.exr")
    assert result.exit_code == 0 and "flip has no value: too dark" in result.stdout


def test_the_exposures_of_flip_are_recorded(folder):
    found = json.loads(call("a.exr", "r.exr", "--json").stdout)["flip_exposures"]
    assert found["start"] < found["stop"] and found["count"] == int(np.ceil(found["stop"] - found["start"]))


@pytest.mark.parametrize("arguments, words", [
    (("a.exr", "small.exr"), ["a.exr is 24x16, small.exr is 12x8", "one size"]),
    (("a.exr", "b.exr", "--reference", "small.exr"), ["small.exr is 12x8"]),
    (("a.exr", "missing.exr"), ["missing.exr: there is no such file"]),
    (("a.exr", "text.exr"), ["text.exr is broken"]),
    (("grey.exr", "a.exr"), ["grey.exr has no RGB image"]),
    (("a.exr", "b.exr", "--reference", "empty"), ["meta.json: there is no such file"]),
])
def test_bad_input_is_one_line_and_exit_code_2(folder, arguments, words):
    write_exr(folder / "small.exr", {"": TRUTH[::2, ::2]})
    write_exr(folder / "grey.exr", {"": TRUTH[..., 0]})
    (folder / "text.exr").write_text("no EXR")
    (folder / "empty").mkdir()
    result = call(*arguments)
    assert result.exit_code == 2 and result.stdout == ""
    assert len(result.stderr.splitlines()) == 1 and all(word in result.stderr for word in words)
