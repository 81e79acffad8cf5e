"""The bias guard sees biases of the whole and of blocks, and cries wolf rarely where pixels are heavy-tailed."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_pixel_variance import cells

from olpm_bench.bench import bias
from olpm_bench.bench.results import Cell

SIZE, PASSES = (32, 48), 16


def means(passes: np.ndarray) -> bias.Means:
    """Of cells with these passes (seeds, passes, h, w)."""
    of_passes = passes.mean(axis=(2, 3))
    infos = [{"mean": x.mean(), "mean_stderr": x.std(ddof=1) / np.sqrt(len(x)) if len(x) > 1 else np.nan} for x in of_passes]
    of_seeds = [Cell("a", "b", i, info, [], Path("cell")) for i, info in enumerate(infos)]
    return bias.means(of_seeds, cells(passes))


def noisy(rng: np.random.Generator, seeds: int, sigma: float = 0.5) -> np.ndarray:
    return rng.normal(1, sigma, (seeds, PASSES, *SIZE))


@pytest.mark.parametrize("seeds", [3, 8])
def test_a_bias_of_one_block_is_seen_where_that_of_the_image_is_not(seeds):
    """A fifth of the light of 8 x 8 pixels is in the block below them: the mean of the image is right."""
    rng = np.random.default_rng(1)
    right, wrong = noisy(rng, seeds), noisy(rng, seeds)
    wrong[..., 8:16, 8:16] -= 0.2
    wrong[..., 16:24, 8:16] += 0.2
    found = bias.difference(means(right), means(wrong))
    assert found.apart > bias.APART
    assert found.block_bias_seen < 0.2 and found.bias_seen < 0.05
    assert bias.difference(means(right), means(noisy(rng, seeds))).apart < bias.APART


def test_the_bias_that_would_have_been_seen_is_seen():
    """Of the whole image; one of half that size is not."""
    rng = np.random.default_rng(2)
    right, other = noisy(rng, 6), noisy(rng, 6)
    seen = bias.difference(means(right), means(other)).bias_seen
    assert bias.difference(means(right), means(other * (1 + 1.3 * seen))).apart > bias.APART
    assert bias.difference(means(right), means(other * (1 + 0.5 * seen))).apart < bias.APART


def heavy(rng: np.random.Generator, family: str, shape: tuple[int, ...]) -> np.ndarray:
    """Passes of mean 1."""
    match family:
        case "exponential":
            return rng.exponential(1, shape)
        case "log-normal":
            return rng.lognormal(-(2.0**2) / 2, 2.0, shape)
        case "fireflies":
            return 0.5 + 5e3 * (rng.random(shape) < 1e-4)
        case "rare light":
            return 1e3 * (rng.random(shape) < 1e-3)
    return 0.5 * rng.pareto(1.5, shape)


@pytest.mark.parametrize("seeds", [3, 8])
@pytest.mark.parametrize("family", ["exponential", "log-normal", "fireflies", "rare light", "Pareto 1.5"])
def test_heavy_tails_are_no_bias(seeds, family):
    """Against an image that has all the light: at most 1 false alarm in 40, also for infinite variances."""
    rng, alarms = np.random.default_rng(3), 0
    for _ in range(40):
        quiet, tailed = noisy(rng, seeds, 0.1), heavy(rng, family, (seeds, PASSES, *SIZE))
        alarms += bias.difference(means(quiet), means(tailed)).apart > bias.APART
    assert alarms <= 1


def test_what_is_not_known_is_no_bias():
    rng = np.random.default_rng(4)
    alone = means(noisy(rng, 1)[:, :1])
    assert bias.difference(alone, means(noisy(rng, 3))).apart == 0
    assert np.isnan(bias.difference(alone, alone).block_bias_seen)


def test_black_images_agree():
    black = means(np.zeros((3, PASSES, *SIZE)))
    found = bias.difference(black, black)
    assert found.apart == 0 and np.isnan([found.bias_seen, found.block_bias_seen]).all()


def test_images_of_two_sizes_cannot_be_compared():
    rng = np.random.default_rng(5)
    with pytest.raises(ValueError, match="images must be of one size"):
        bias.difference(means(noisy(rng, 3)), means(noisy(rng, 3)[..., :16]))
