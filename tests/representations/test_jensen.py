"""The histogram against one made by NumPy."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from asking import density, states_equal
from scipy import stats

import representations
from olpm_bench.check.particles import batch, lobes, uniform_directions, vector
from olpm_bench.check.verdict import sidak
from representations.jensen import JensenHistogram
from representations.square import from_hemisphere


def numpy_histogram(wo: np.ndarray, weight: np.ndarray, resolution: int = 16) -> np.ndarray:
    """Density per bin [1/sr], in the order [y, x]."""
    s = np.array(from_hemisphere(vector(wo)))
    mass = np.histogram2d(s[1], s[0], bins=resolution, range=[[0, 1], [0, 1]], weights=weight.astype(np.float64))[0]
    return mass / mass.sum() * resolution**2 / (2 * np.pi)


@pytest.mark.parametrize("resolution", [1, 5, 16])
def test_is_the_histogram(resolution: int) -> None:
    """In several batches and for several records."""
    rng = np.random.default_rng(0)
    particles = [[(lobes(n, rng), rng.lognormal(sigma=2, size=n)) for n in (300, 0, 50)] for _ in range(3)]
    jensen = JensenHistogram(resolution)
    state = jensen.init(3)
    for b in particles:
        state = jensen.update(state, batch(b))
    queries = uniform_directions(2000, rng)
    x, y = np.clip((np.array(from_hemisphere(vector(queries))) * resolution).astype(int), 0, resolution - 1)
    for record in (0, 2):
        wo, weight = (np.concatenate([b[record][i] for b in particles]) for i in (0, 1))
        assert np.allclose(density(jensen, state, record, queries), numpy_histogram(wo, weight, resolution)[y, x], rtol=1e-5)
    assert np.allclose(density(jensen, state, 1, queries), queries[:, 2] / np.pi)


def test_integral_is_one() -> None:
    """Exactly: one query in the middle of each bin."""
    rng = np.random.default_rng(1)
    jensen = JensenHistogram()
    state = jensen.update(jensen.init(1), batch([(lobes(1000, rng), 10 ** rng.uniform(-6, 6, 1000))]))
    assert np.isclose(np.sum(state.mass), state.cumulative[255], rtol=1e-5)


def test_every_corner_of_the_random_numbers_hits_a_filled_bin() -> None:
    """First and last bin, and the largest float below 1 in every argument."""
    ends = np.float32([0, 2**-24, 0.5, 1 - 2**-24])
    u = np.stack(np.meshgrid(ends, ends, ends)).reshape(3, -1)
    jensen = JensenHistogram()
    for filled in ([0], [255], [15, 240], [0, 100, 255], [7, 8]):
        for scale in (1e-20, 1, 1e20):
            mass = np.zeros(256, np.float32)
            mass[filled] = scale * np.linspace(1, 2, len(filled))
            state = type(jensen.init(1))(mass=mi.Float(mass), cumulative=mi.Float(np.cumsum(mass)))
            _, pdf = jensen.sample(state, dr.zeros(mi.UInt32, u.shape[1]), mi.Float(u[0]), mi.Point2f(u[1], u[2]))
            middle = (u[1:] == 0.5).all(0)          # rounding can't carry these over the edge of the bin
            assert (np.array(pdf)[middle] > 0).all() and np.isfinite(pdf).all()


def test_uniform_inside_a_bin() -> None:
    rng = np.random.default_rng(2)
    jensen = JensenHistogram()
    state = jensen.update(jensen.init(1), batch([(uniform_directions(1, rng), np.ones(1))]))
    wo, _ = jensen.sample(state, dr.zeros(mi.UInt32, 50_000), mi.Float(rng.random(50_000)), mi.Point2f(rng.random((2, 50_000))))
    s = np.array(from_hemisphere(wo), np.float64) * 16 % 1
    for axis in s:
        assert stats.kstest(axis, "uniform").pvalue > sidak(1e-3, 2)


def test_a_million_particles_over_twelve_decades() -> None:
    """Sums are exact to float32, and repeat bit for bit although threads share the bins."""
    rng = np.random.default_rng(3)
    n = 1_000_000
    wo, weight = uniform_directions(n, rng), (10 ** rng.uniform(-6, 6, n)).astype(np.float32)
    jensen = JensenHistogram()
    b = batch([(wo, weight)])
    states = [jensen.update(jensen.init(1), b) for _ in range(3)]
    dr.eval(states)
    assert all(states_equal(states[0], s) for s in states[1:])
    expected = numpy_histogram(wo, weight).ravel()
    s = np.array(from_hemisphere(vector(wo[:1000])))
    x, y = (s * 16).astype(int)
    assert np.allclose(density(jensen, states[0], 0, wo[:1000]), expected[y * 16 + x], rtol=1e-5)


def test_many_equal_batches_don_t_drift() -> None:
    """Adding 0.1 a hundred times a thousand keeps the ratio of two bins."""
    jensen = JensenHistogram()
    wo = np.array([[0.1, 0.2, 0.97]] * 3000 + [[-0.6, 0.3, 0.74]] * 1000, np.float32)
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    state, b = jensen.init(1), batch([(wo, np.full(4000, 0.1))])
    for _ in range(100):
        state = jensen.update(state, b)
        dr.eval(state)
    pdf = density(jensen, state, 0, wo[[0, -1]])
    assert np.isclose(pdf[0] / pdf[1], 3, rtol=1e-5)


@pytest.mark.parametrize("resolution", [0, -3, 257])
def test_bad_resolution(resolution: int) -> None:
    with pytest.raises(representations.RepresentationError, match=rf"resolution = {resolution}: must be in 1 \.\. 256"):
        representations.create("jensen", resolution=resolution)


def test_wrong_number_of_records() -> None:
    jensen = JensenHistogram()
    with pytest.raises(ValueError, match="a batch of 1 records for a state of 2"):
        jensen.update(jensen.init(2), batch([(lobes(3, np.random.default_rng(4)), np.ones(3))]))
