"""`fit` against closed forms, and what it says to bad input."""
from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import representations
from olpm_bench.bench.fit import fit

KEYS = ["mean_log_pdf", "zero_density_fraction", "mean_log_pdf_mixed", "second_moment", "integral",
        "seconds_per_particle", "bytes"]


def cosine_directions(n: int, seed: int) -> np.ndarray:
    """Distributed as cos / pi [n, 3]."""
    rng = np.random.default_rng(seed)
    r2, phi = rng.random(n), 2 * np.pi * rng.random(n)
    wo = np.stack([np.sqrt(r2) * np.cos(phi), np.sqrt(r2) * np.sin(phi), np.sqrt(1 - r2)], -1)
    return wo[wo[:, 2] > 1e-4].astype(np.float32)


def save(file: Path, wo: np.ndarray, **arrays: np.ndarray) -> Path:
    np.savez(file, **{"wo": wo, "weight": np.ones(len(wo), np.float32), **arrays})
    return file


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    held = cosine_directions(20_000, 1)
    return (save(tmp_path / "samples.npz", cosine_directions(600, 0)),
            save(tmp_path / "heldout.npz", held, pdf=held[:, 2].astype(np.float64) / np.pi))


def test_cosine_lobe_on_cosine_data(files: tuple[Path, Path]) -> None:
    """p = q: the second moment is 1 and E[ln p] = -1/2 - ln pi."""
    found = fit(representations.create("cosine"), *files)
    assert list(found) == KEYS
    assert found["second_moment"] == pytest.approx(1, abs=1e-5)
    assert found["integral"] == pytest.approx(1, abs=1e-5)
    assert found["mean_log_pdf"] == pytest.approx(-.5 - np.log(np.pi), abs=4 * .5 / 20_000**.5)
    assert found["mean_log_pdf_mixed"] == pytest.approx(found["mean_log_pdf"], abs=1e-5)
    assert found["zero_density_fraction"] == 0
    assert json.loads(json.dumps(found, allow_nan=False)) == found


@pytest.mark.parametrize("batches", [1, 5])
def test_mixture(files: tuple[Path, Path], batches: int) -> None:
    found = fit(representations.create("gaussian_mixture", components=4), *files, batches=batches, seed=3)
    again = fit(representations.create("gaussian_mixture", components=4), *files, batches=batches, seed=3)
    assert found["mean_log_pdf"] > -1.75 and 1 <= found["second_moment"] < 1.1
    assert .9 < found["integral"] <= 1 and found["seconds_per_particle"] > 0
    assert {**found, "seconds_per_particle": 0} == {**again, "seconds_per_particle": 0}


@dataclass
class CapState:
    size: Any


class Cap:
    """Half of the uniform density over z > 0.5 (a cap of pi steradians), and nothing elsewhere: integral 1/2."""

    def init(self, n_records: int, seed: int = 0, parallax: bool = False) -> CapState:
        return CapState(dr.zeros(mi.Float, n_records))

    def update(self, state: CapState, batch: Any, seed: int = 0) -> CapState:
        return state

    def sample(self, state: CapState, record: Any, sample1: Any, sample2: Any, active: Any = True,
               at: Any = None) -> Any:
        raise NotImplementedError("fit() never samples")

    def pdf(self, state: CapState, record: Any, wo: Any, active: Any = True, at: Any = None) -> Any:
        return dr.select(wo.z > .5, mi.Float(.5 / np.pi), 0)


def test_zero_densities_are_counted_and_the_integral_divided_out(files: tuple[Path, Path], tmp_path: Path) -> None:
    found = fit(Cap(), *files)
    with np.load(files[1]) as archive:
        wo, pdf = archive["wo"], archive["pdf"]
    q = .5 * wo[:, 2] / np.pi + .5 * (wo[:, 2] > .5) / np.pi
    assert found["mean_log_pdf"] is None
    assert found["zero_density_fraction"] == pytest.approx((wo[:, 2] <= .5).mean())
    assert found["integral"] == pytest.approx(.5, rel=1e-3)
    assert found["mean_log_pdf_mixed"] == pytest.approx(np.log(q).mean(), abs=1e-3)
    assert found["second_moment"] == pytest.approx((pdf / q).mean(), rel=1e-3)
    # Held-out weights weigh
    weight = (wo[:, 2] > .5).astype(np.float32)
    weighted = fit(Cap(), files[0], save(tmp_path / "weighted.npz", wo, pdf=pdf, weight=weight))
    assert weighted["second_moment"] == pytest.approx((weight * pdf / q).sum() / weight.sum(), rel=1e-3)


def test_the_scale_of_weights_does_not_matter(files: tuple[Path, Path], tmp_path: Path) -> None:
    """Not even where their sum is too large for any number."""
    jensen, expected, larger = representations.create("jensen"), {}, []
    expected = fit(jensen, *files)
    for file in files:
        with np.load(file) as archive:
            arrays = dict(archive)
        larger.append(save(tmp_path / f"larger_{file.name}", arrays.pop("wo"),
                           **arrays | {"weight": arrays["weight"].astype(np.float64) * 1e308}))
    found = fit(jensen, *larger)
    assert {**found, "seconds_per_particle": 0} == pytest.approx({**expected, "seconds_per_particle": 0})


WO = cosine_directions(10, 2)


@pytest.mark.parametrize(("arrays", "message"), [
    ({"weight": np.ones(9)}, r"'weight' has shape \(9,\); must be \(n,\) with n = 10"),
    ({"wo": WO[:, :2]}, r"'wo' has shape \(10, 2\); must be \(n, 3\)"),
    ({"wo": WO[:0], "weight": np.ones(0)}, "n = 1 or more"),
    ({"wo": np.float32(1)}, r"'wo' has shape \(\)"),
    ({"wo": np.where(np.arange(10)[:, None] == 3, np.nan, WO)}, "'wo' has 3 NaN or infinite entries"),
    ({"wo": WO * [1, 1, -1]}, "'wo' has 10 directions below the horizon"),
    ({"wo": 2 * WO}, "'wo' has 10 vectors that are not of unit length"),
    ({"weight": -np.ones(10)}, "'weight' has 10 negative entries"),
    ({"weight": np.zeros(10)}, "'weight' is zero everywhere"),
    ({"weight": np.array(["a"] * 10)}, "not an .npz file of directions"),
])
def test_bad_arrays(files: tuple[Path, Path], tmp_path: Path, arrays: dict[str, np.ndarray], message: str) -> None:
    bad = tmp_path / "bad.npz"
    np.savez(bad, **{"wo": WO, "weight": np.ones(10), **arrays})
    with pytest.raises(ValueError, match=message) as error:
        fit(representations.create("cosine"), bad, files[1])
    assert str(bad) in str(error.value) and "\n" not in str(error.value)


def test_bad_files(files: tuple[Path, Path], tmp_path: Path) -> None:
    cosine, text, single = representations.create("cosine"), tmp_path / "text.npz", tmp_path / "single.npy"
    text.write_text("not NumPy")
    np.save(single, WO)
    for samples, message in ((tmp_path / "none.npz", "there is no such file"), (text, "not a whole .npz"),
                             (single, "not a whole .npz"), (tmp_path, "there is no such file")):
        with pytest.raises(ValueError, match=message):
            fit(cosine, samples, files[1])
    with pytest.raises(ValueError, match="no array 'pdf'; it has wo, weight"):
        fit(cosine, files[0], files[0])
    for batches in (0, 100_000):
        with pytest.raises(ValueError, match=f"batches = {batches}: must be in 1 .. "):
            fit(cosine, *files, batches=batches)
