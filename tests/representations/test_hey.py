"""Cones: geometry in closed form, radii against NumPy, and the reservoir."""
from __future__ import annotations

import numpy as np
import pytest
from asking import density, draw
from scipy import stats

import representations
from olpm_bench.check.particles import batch, lobes, uniform_directions
from olpm_bench.check.verdict import sidak
from representations.hey import FOOTPRINT, GRID, HeyCones
from representations.state import bytes_of


def radii(wo: np.ndarray) -> np.ndarray:
    """sin(half angle) of each particle's cone, from the text: splat 3 x 3 cells, r = min(240 Omega / N, cos theta)."""
    cell = np.clip(((wo[:, :2] + np.float32(1)) * np.float32(GRID / 2)).astype(int), 0, GRID - 1)
    grid = np.zeros((GRID, GRID))
    for x, y in cell:
        grid[max(y - 1, 0):y + 2, max(x - 1, 0):x + 2] += 1
    centre = (cell + 0.5) * 2 / GRID - 1
    with np.errstate(divide="ignore"):
        omega = 4 / GRID**2 / np.sqrt(np.maximum(1 - (centre**2).sum(1), 0))
    return np.minimum(FOOTPRINT * omega / grid[cell[:, 1], cell[:, 0]], wo[:, 2])


def numpy_density(wo: np.ndarray, weight: np.ndarray, queries: np.ndarray) -> np.ndarray:
    cosine = np.sqrt(1 - radii(wo).astype(np.float64) ** 2)
    inside = queries.astype(np.float64) @ wo.T.astype(np.float64) > cosine
    return (inside * (weight / (2 * np.pi * (1 - cosine)))).sum(1) / weight.sum()


def test_density_in_numpy() -> None:
    rng = np.random.default_rng(0)
    wo, weight = lobes(200, rng), rng.lognormal(size=200).astype(np.float32)
    hey = HeyCones()
    state = hey.update(hey.init(2), batch([(wo, weight), (wo[:0], weight[:0])]))
    queries = np.concatenate([uniform_directions(500, rng), wo])
    ours, theirs = density(hey, state, 0, queries), numpy_density(wo, weight, queries)
    assert np.isclose(ours, theirs, rtol=1e-3).mean() > 0.99       # but for queries on the rim of a cone, in float32
    assert np.allclose(density(hey, state, 1, queries), queries[:, 2] / np.pi)


@pytest.mark.parametrize("elevation", [90, 65, 28, 5, 0.5])
def test_cone_is_uniform_in_solid_angle(elevation: float) -> None:
    """1 - cos of the angle to the axis is uniform up to the cone's rim, and pdf = 1 / solid angle.

    28 degrees gives the widest cone (sine 0.48), where a disk passed off as a cone is wrong by 14 % from axis to rim.
    """
    axis = np.array([[np.cos(np.radians(elevation)), 0, np.sin(np.radians(elevation))]], np.float32)
    hey = HeyCones()
    state = hey.update(hey.init(1), batch([(axis, np.ones(1))]))
    height = 1 - np.sqrt(1 - float(radii(axis)[0]) ** 2)
    wo, pdf = draw(hey, state, 0, 100_000)
    assert (pdf > 0).mean() > 0.999
    assert np.allclose(pdf[pdf > 0], 1 / (2 * np.pi * height), rtol=1e-3)
    versine = ((wo.astype(np.float64) - axis) ** 2).sum(1) / 2
    assert stats.kstest(versine / height, "uniform").pvalue > sidak(1e-3, 5)


def test_reservoir_is_uniform() -> None:
    """Of 20 particles in 3 batches 4 are kept, each equally often; particles of zero weight don't compete."""
    hey, trials, sizes = HeyCones(cones=4), 500, (3, 7, 10)
    kept = np.zeros(20)
    for trial in range(trials):
        state, first = hey.init(1), 0
        for size in sizes:
            number = np.repeat(np.arange(first + 1, first + size + 1), 2)
            weight = np.where(np.arange(2 * size) % 2 == 0, number, 0)           # tells the particle's number
            state = hey.update(state, batch([(np.repeat([[0, 0, 1]], 2 * size, axis=0), weight)]), seed=trial)
            first += size
        index = np.array(state.weight).astype(int) - 1
        assert len(set(index)) == 4 and state.seen[0] == 20
        kept[index] += 1
    # Draws without replacement: the variance is smaller than Poisson's by (20 - 4) / (20 - 1).
    chi2 = ((kept - trials / 5) ** 2 / (trials / 5)).sum() * 19 / 16
    assert stats.chi2.sf(chi2, 19) > 1e-3


def test_memory_is_constant() -> None:
    rng = np.random.default_rng(2)
    hey = HeyCones()
    state = hey.init(3)
    for seed in range(5):
        state = hey.update(state, batch([(lobes(400, rng), np.ones(400))] * 3), seed)
        assert bytes_of(state) == 3 * (4 + 250 * 24)
    assert np.array_equal(state.seen, [2000] * 3)


def test_more_records_than_a_chunk() -> None:
    """The grids of 1024 records are held at once; the seam doesn't show."""
    rng = np.random.default_rng(3)
    wo, weight = lobes(60, rng), np.ones(60)
    hey = HeyCones(cones=60)
    state = hey.update(hey.init(1100), batch([(wo, weight)] * 1100))
    cone = np.array(state.cone).reshape(1100, -1)
    assert (cone == cone[0]).all()


@pytest.mark.parametrize("cones", [0, -1, 5000])
def test_bad_number_of_cones(cones: int) -> None:
    with pytest.raises(representations.RepresentationError, match=rf"cones = {cones}: must be in 1 \.\. 4096"):
        representations.create("hey", cones=cones)


def test_wrong_number_of_records() -> None:
    hey = HeyCones()
    with pytest.raises(ValueError, match="a batch of 1 records for a state of 2"):
        hey.update(hey.init(2), batch([(lobes(3, np.random.default_rng(4)), np.ones(3))]))
