"""References as they are stored: round trips, sizes, broken ones."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.bench.exr import write_exr
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.reference_file import Reference, find_reference, read_reference, write_reference

rng = np.random.default_rng(7)


def image(h=5, w=7) -> np.ndarray:
    return rng.random((h, w, 3), dtype=np.float32)


def test_a_reference_comes_back_as_it_was(tmp_path):
    reference = Reference(image(), image(), image(), image(), {"key": "k", "spp_a": 3, "spp_b": 1})
    write_reference(tmp_path / "k", reference)
    again = read_reference(find_reference("k", [tmp_path / "none", tmp_path]), 7, 5)
    np.testing.assert_array_equal(again.b_variance, reference.b_variance)
    np.testing.assert_allclose(again.mean, 0.75 * reference.a + 0.25 * reference.b, rtol=1e-5)
    assert again.noise_floor == pytest.approx(np.abs(reference.a - reference.b).mean() / 2, rel=1e-5)
    (tmp_path / "k" / "reference.exr").rename(tmp_path / "copy.exr")
    by_file = read_reference(tmp_path / "copy.exr", 7, 5)           # not its first half alone
    np.testing.assert_array_equal(by_file.mean, again.mean)


def test_a_foreign_reference_is_averaged_down_and_has_no_noise_floor(tmp_path):
    large = image(10, 14)
    write_exr(tmp_path / "foreign.exr", {"": large})
    reference = read_reference(tmp_path / "foreign.exr", 7, 5)
    np.testing.assert_allclose(reference.mean[1, 2], large[2:4, 4:6].mean(axis=(0, 1)), rtol=1e-6)
    assert reference.noise_floor is None
    with pytest.raises(ResultError, match=r"is 14x10, the experiment's image is 8x5"):
        read_reference(tmp_path / "foreign.exr", 8, 5)


HALVES = {name: image() for name in ("a.mean", "b.mean", "a.variance", "b.variance")}


@pytest.mark.parametrize("changes, header, words", [
    ({}, {}, "spp_a = None, must be the samples of a half"),
    ({}, {"spp_a": 3, "spp_b": 0}, "spp_b = 0, must be"), ({}, {"spp_a": "3", "spp_b": 3}, "spp_a = '3', must be"),
    ({}, {"spp_a": 10**400, "spp_b": 1}, "spp_a = 1000"),           # which NumPy would not take for a number
    ({"a.mean": image()[..., 0]}, {"spp_a": 3, "spp_b": 1}, "no finite RGB part 'a.mean'"),
    ({"b.variance": image()[..., 0]}, {"spp_a": 3, "spp_b": 1}, "no finite RGB part 'b.variance'")])
def test_halves_that_another_program_has_saved_again_are_refused(tmp_path, changes, header, words):
    write_exr(tmp_path / "saved.exr", HALVES | changes, header)
    with pytest.raises(ResultError, match=rf"saved\.exr is broken: {words}.* another program may have written it"):
        read_reference(tmp_path / "saved.exr", 7, 5)


def test_a_broken_reference_says_what_to_do(tmp_path):
    write_reference(tmp_path / "k", Reference(image(), image(), image(), image(), {"spp_a": 1, "spp_b": 1}))
    with pytest.raises(ResultError, match=r"is 7x5, the experiment's image is 8x5"):
        read_reference(tmp_path / "k", 8, 5)
    (tmp_path / "k" / "reference.exr").write_bytes(b"no EXR")
    with pytest.raises(ResultError, match=r"reference\.exr is broken"):
        read_reference(tmp_path / "k", 7, 5)
