"""Pixel variances, pooled over the passes of all cells."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from olpm_bench.bench import pixel_variance
from olpm_bench.bench.accumulator import Accumulator
from olpm_bench.bench.pixel_variance import CellImages
from olpm_bench.bench.results import Cell


def cells(passes: np.ndarray, spp: int = 1) -> CellImages:
    """The cells whose passes these are, (seeds, passes, h, w): grey, a second each."""
    images = []
    for of_cell in passes:
        image = Accumulator.empty(*of_cell.shape[1:])
        for x in of_cell:
            image.add(np.repeat(x[..., None], 3, axis=-1), spp)
        images.append(image)
    return CellImages(np.stack([i.mean for i in images]), np.stack([i.variance() for i in images]),
                      np.array([i.passes for i in images]), np.ones(len(images)))


def test_the_variance_of_rare_light_is_unbiased_with_three_seeds():
    """One pass of 100 has light: the variance over three images of 20 passes is mostly zero, its mean over pixels is right."""
    passes = 100.0 * (np.random.default_rng(1).random((3, 20, 40, 100)) < 0.01)
    pooled = cells(passes).pooled()
    truth = 100**2 * 0.01 * 0.99 / 20
    assert pooled.variance.mean() == pytest.approx(truth, rel=0.1)
    assert (pooled.cells, pooled.passes) == (3, 60)
    np.testing.assert_allclose(pooled.work, pooled.variance)


def test_effective_passes_count_those_that_met_light():
    passes = np.zeros((3, 20, 1, 4))
    passes[0, 3, 0, 1] = 7
    passes[:, 0, 0, 2] = 7
    passes[:, :, 0, 3] = 7
    np.testing.assert_allclose(cells(passes).pooled().effective_passes, [[0, 1, 3, 60]], rtol=0.05)


def test_time_weighs_the_variance_of_its_own_cell():
    passes = np.random.default_rng(2).random((2, 50, 3, 3)) * np.array([1, 3])[:, None, None, None]
    found = cells(passes)
    timed = CellImages(found.mean, found.variance, found.passes, np.array([4.0, 1.0]))
    np.testing.assert_allclose(timed.pooled().work, (4 * found.variance[0] + found.variance[1]) / 2)
    assert timed.pooled([1]).cells == 1
    np.testing.assert_allclose(timed.pooled([1]).work, found.variance[1])


def test_cells_of_a_single_pass_are_compared_with_each_other():
    x = np.random.default_rng(3).random((6, 1, 2, 2))
    pooled = cells(x).pooled()
    np.testing.assert_allclose(pooled.variance[..., 0], x[:, 0].var(axis=0, ddof=1))
    assert pooled.passes == 6 and np.isnan(cells(x[:1]).pooled().variance).all()


def test_older_cells_tell_their_passes_by_their_samples():
    def passes(variance: float = 1.0, **info: int) -> int:
        return pixel_variance.passes_of(Cell("a", "b", 0, info, [], Path("cell")), np.full((2, 2, 3), variance))
    assert passes(image_passes=9, spp=64, pass_spp=2) == 9
    assert passes(spp=64, pass_spp=2) == 32
    assert passes(spp=64) == 2
    assert passes(np.inf, spp=64, pass_spp=64) == 1
