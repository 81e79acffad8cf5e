"""EXRs of ours: what is written is what is read."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.bench.exr import read_exr, write_exr
from olpm_bench.transport import headroom
from olpm_bench.transport.settings import InputError


def test_exr_is_exact(tmp_path):
    pixels = np.float32([[[1e-30, 6.5e4, 1e20]]]) * np.ones((3, 2, 3), np.float32)
    write_exr(tmp_path / "x.exr", {"mean": pixels}, {"text": 'ä "b"', "number": 0.1})
    parts, header = read_exr(tmp_path / "x.exr")
    np.testing.assert_array_equal(parts["mean"], pixels)
    assert header == {"text": 'ä "b"', "number": 0.1}


def test_images_larger_than_memory_are_refused_before_they_are_unpacked(tmp_path, monkeypatch):
    """A black image of 12 MB is a file of some kB."""
    path = tmp_path / "black.exr"
    write_exr(path, {"mean": np.zeros((1000, 1000, 3), np.float32)})
    assert path.stat().st_size < 100_000
    monkeypatch.setattr(headroom, "free", lambda: 3e7)
    with pytest.raises(InputError, match=r"black.exr: its images take about 0.036 GB, and 0.03 GB are free"):
        read_exr(path)
