"""EXRs of ours: what is written is what is read."""
from __future__ import annotations

import numpy as np

from olpm_bench.bench.exr import read_exr, write_exr


def test_exr_is_exact(tmp_path):
    pixels = np.float32([[[1e-30, 6.5e4, 1e20]]]) * np.ones((3, 2, 3), np.float32)
    write_exr(tmp_path / "x.exr", {"mean": pixels}, {"text": 'ä "b"', "number": 0.1})
    parts, header = read_exr(tmp_path / "x.exr")
    np.testing.assert_array_equal(parts["mean"], pixels)
    assert header == {"text": 'ä "b"', "number": 0.1}
