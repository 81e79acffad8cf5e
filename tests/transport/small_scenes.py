"""Small scenes with known answers, and the tests that compare images."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import numpy as np
from scipy import stats

from olpm_bench.check.small_scenes import RESOLUTION, blocks, box, camera, furnace, grey, lamp, passes, wall
from olpm_bench.check.verdict import sidak

__all__ = ["RESOLUTION", "assert_no_kernel_a_pass", "assert_same_expectation", "box", "camera", "furnace", "grey", "lamp",
           "passes", "wall"]


def assert_same_expectation(a: np.ndarray, b: np.ndarray, level: float = 0.01, size: int = 2) -> None:
    """Welch's t-test of each block of pixels' luminance, corrected for their number (Sidak); and one of the image means.

    Args:
        a, b: independent images [n, height, width, 3].
        level: probability that equal expectations fail.
        size: of the blocks, pixels along each side.
    """
    assert np.isfinite(a).all() and np.isfinite(b).all()
    x, y = blocks(a, size), blocks(b, size)
    flat = (x.std(0) < 1e-6 * x.mean()) & (y.std(0) < 1e-6 * x.mean())
    np.testing.assert_allclose(x[:, flat].mean(0), y[:, flat].mean(0), rtol=1e-4)
    p = stats.ttest_ind(x[:, ~flat], y[:, ~flat], equal_var=False).pvalue
    p = np.append(p, stats.ttest_ind(x.mean(1), y.mean(1), equal_var=False).pvalue)
    threshold = sidak(level, len(p))
    worst = int(np.argmin(p))
    assert p.min() >= threshold, (f"p = {p.min():.2e} < {threshold:.2e} at {worst} of {len(p)}; "
                                  f"means {a.mean():.5f} and {b.mean():.5f}")


def assert_no_kernel_a_pass(passes: Iterator[Any]) -> None:
    """Training passes after the third compile no large kernel each: counts, seeds, sizes and pass numbers are data, not code.

    Some are let pass, of more than a hundred launched: with an empty kernel cache Dr.Jit at times gives a large loop a second
    form, and it makes several of small ones over the records, of some milliseconds each, by how arrays lie in memory.
    """
    for _ in range(3):
        next(passes)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        n = sum(1 for _ in passes)
        history = dr.kernel_history([dr.KernelType.JIT])
    compiled = [k["operation_count"] for k in history if not k["cache_hit"]]
    assert len(history) > 100
    assert len(compiled) <= 30 and sum(count > 400 for count in compiled) < n, compiled
