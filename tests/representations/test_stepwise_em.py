"""Stepwise EM against a float64 transcript of its equations, and its start."""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from representations.gaussian_mixture import GaussianMixture
from representations.stepwise_em import EXPONENT, INITIAL_VISITS, M_STEP_EVERY, Lobes, Particle, Statistics, exp2_negative

A, B, V, ALPHA, FLOOR, CLAMP = 2.01, 5e-5, 1.01, 0.7, 1e-7, 10.0        # the defaults


@dataclass
class Transcript:
    """The mixture and statistics of one record, as the paper writes them: sums of w, w gamma, w gamma s, w gamma s s^T."""
    pi: np.ndarray          # [K]
    mu: np.ndarray          # [K, 2]
    sigma: np.ndarray       # [K, 2, 2]
    wbar: float
    u: np.ndarray           # [K]
    m: np.ndarray           # [K, 2]
    S: np.ndarray           # [K, 2, 2]
    near: np.ndarray        # [K]
    squares: float          # sum of the squared shares of the particles
    k: int

    def log_joint(self, s: np.ndarray) -> np.ndarray:
        d = s - self.mu
        q = np.einsum("ki,kij,kj->k", d, np.linalg.inv(self.sigma), d)
        return np.log(self.pi) - 0.5 * q - 0.5 * np.log(np.linalg.det(self.sigma)) - np.log(2 * np.pi)

    def sweep(self, points: np.ndarray, weights: np.ndarray, limit: float = np.inf) -> float:
        """One pass over the particles; the mean log likelihood seen on the way."""
        total, mass = 0.0, 1e-300
        for begin in range(0, len(points), M_STEP_EVERY):
            reference = self.wbar
            for s, w in zip(points[begin:begin + M_STEP_EVERY], weights[begin:begin + M_STEP_EVERY], strict=True):
                if w == 0:
                    continue
                w = min(w, CLAMP * reference)
                joint = self.log_joint(s)
                log_p = np.logaddexp.reduce(joint)
                gamma = np.exp(joint - log_p)
                total += w / reference * log_p
                mass += w / reference
                eta = (self.k + 1) ** -ALPHA
                self.wbar = (1 - eta) * self.wbar + eta * w
                self.u = (1 - eta) * self.u + eta * w * gamma
                self.m = (1 - eta) * self.m + eta * w * gamma[:, None] * s
                self.S = (1 - eta) * self.S + eta * w * gamma[:, None, None] * np.outer(s, s)
                self.near = (1 - eta) * self.near + eta * w * gamma * s[0]          # 1 / distance = x: see Rows
                self.k += 1
                share = eta * w / self.wbar
                self.squares = (1 - share) ** 2 * self.squares + share ** 2
            self.maximise(min(1 / self.squares, limit))
        return total / mass

    def maximise(self, n: float) -> None:
        self.mu = self.m / self.u[:, None]
        cross = np.einsum("ki,kj->kij", self.m, self.mu)
        D = self.S - cross - cross.transpose(0, 2, 1) + np.einsum("k,ki,kj->kij", self.u, self.mu, self.mu)
        b = B * max((2 * self.k ** ALPHA - 1) * self.squares, 1) ** 2
        self.sigma = (b * np.eye(2) + n * D / self.wbar) / ((A - 2) + n * self.u / self.wbar)[:, None, None]
        values, vectors = np.linalg.eigh(self.sigma)
        self.sigma = np.einsum("kij,kj,klj->kil", vectors, np.maximum(values, FLOOR), vectors)
        self.pi = (n * self.u / self.wbar + (V - 1)) / (n + len(self.u) * (V - 1))


def transcript_of(lobes: Lobes, statistics: Statistics, record: int) -> Transcript:
    """The paper's sums, from the moments about the means that we keep."""
    weight, x, y, r_xx, r_xy, r_yy = (np.array(getattr(lobes, f), np.float64)[:, record]
                                      for f in ("weight", "mean_x", "mean_y", "r_xx", "r_xy", "r_yy"))
    mass, d_xx, d_xy, d_yy, near = (np.array(getattr(statistics, f), np.float64)[:, record]
                                    for f in ("mass", "d_xx", "d_xy", "d_yy", "near"))
    R = np.stack([np.stack([r_xx, r_xy], -1), np.stack([0 * r_yy, r_yy], -1)], -2) / np.sqrt(EXPONENT)
    mu, wbar = np.stack([x, y], -1), float(np.array(statistics.mean_weight)[record])
    D = np.stack([np.stack([d_xx, d_xy], -1), np.stack([d_xy, d_yy], -1)], -2)
    second = D + mass[:, None, None] * np.einsum("ki,kj->kij", mu, mu)
    return Transcript(weight, mu, np.linalg.inv(np.einsum("kji,kjl->kil", R, R)), wbar, wbar * mass, wbar * mass[:, None] * mu,
                      wbar * second, wbar * near, float(np.array(statistics.squares)[record]),
                      int(np.array(statistics.visits)[record]))


def points_and_weights(n_records: int, n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Three clusters, one as narrow as the sun, and a base; log-normal weights with zeros among them."""
    rng = np.random.default_rng(seed)
    which = rng.integers(0, 4, (n_records, n))
    centre, width = np.array([[.3, .4], [.7, .2], [.6, .8], [.5, .5]]), np.array([.05, .001, .02, .25])
    points = np.clip(centre[which] + width[which][..., None] * rng.normal(size=(n_records, n, 2)), 0, 1)
    weights = rng.lognormal(0, 1, (n_records, n)) * (rng.random((n_records, n)) > 0.1)
    return points.astype(np.float32), weights.astype(np.float32)


class Rows:
    """Particles of each record in an ordinary object: i -> (x, y, weight, 1 / distance = x) of each lane."""

    def __init__(self, points: np.ndarray, weights: np.ndarray) -> None:
        self.lanes, self.n = weights.shape
        self.data = [mi.Float(np.ascontiguousarray(a).ravel()) for a in (points[..., 0], points[..., 1], weights, points[..., 0])]

    def __call__(self, i: mi.UInt32) -> Particle:
        index = dr.arange(mi.UInt32, self.lanes) * self.n + i
        return tuple(dr.gather(mi.Float, a, index) for a in self.data)      # type: ignore[return-value]


def compare(expected: Transcript, lobes: Lobes, statistics: Statistics, record: int) -> None:
    found = transcript_of(lobes, statistics, record)
    assert found.k == expected.k
    assert np.allclose(found.wbar, expected.wbar, rtol=1e-4)
    assert np.allclose(found.near, expected.near, rtol=2e-3, atol=1e-4 * expected.wbar)
    assert np.allclose(found.pi, expected.pi, rtol=2e-3, atol=1e-4)
    scale = np.sqrt(np.einsum("kii->k", expected.sigma))
    assert np.abs((found.mu - expected.mu) / scale[:, None]).max() < 1e-2
    assert np.abs((found.sigma - expected.sigma) / scale[:, None, None] ** 2).max() < 1e-2


N_RECORDS, N = 3, 400


@pytest.fixture(scope="module")
def start() -> tuple[GaussianMixture, Rows, Lobes, Statistics]:
    mixture = GaussianMixture(max_sweeps=3, tolerance=0)
    rows = Rows(*points_and_weights(N_RECORDS, N, 0))
    lobes, statistics = mixture.em.start(rows, dr.full(mi.UInt32, N, N_RECORDS), dr.full(mi.Float, 1.5, N_RECORDS),
                                         mi.PCG32(N_RECORDS), parallax=True)
    dr.eval(lobes, statistics)
    return mixture, rows, lobes, statistics


def test_online_sweep_follows_the_equations(start: tuple[GaussianMixture, Rows, Lobes, Statistics]) -> None:
    mixture, rows, lobes, statistics = start
    expected = [transcript_of(lobes, statistics, r) for r in range(N_RECORDS)]
    points, weights = points_and_weights(N_RECORDS, N, 0)
    found = mixture.em.online(rows, mi.UInt32([N, N - 3, 0]), lobes, statistics)
    for record, n in enumerate((N, N - 3, 0)):
        expected[record].sweep(points[record, :n].astype(np.float64), weights[record, :n].astype(np.float64))
        compare(expected[record], *found, record)


def test_first_fit_follows_the_equations(start: tuple[GaussianMixture, Rows, Lobes, Statistics]) -> None:
    """Three sweeps, with n = min(k, N), from the start that the same random numbers give."""
    mixture = start[0]
    points, weights = points_and_weights(N_RECORDS, N, 1)
    rows, positive = Rows(points, weights), np.count_nonzero(weights, axis=1)
    count, limit = dr.full(mi.UInt32, N, N_RECORDS), mi.Float(positive.astype(np.float32))
    found = mixture.em.first_fit(rows, count, limit, mi.PCG32(N_RECORDS), parallax=True)
    mean = []
    for w, n in zip(weights.astype(np.float64), positive, strict=True):
        cut = np.inf
        for _ in range(4):
            cut = np.minimum(w, CLAMP * cut).sum() / n
        mean.append(cut)
    lobes, statistics = mixture.em.start(rows, count, mi.Float(mean), mi.PCG32(N_RECORDS), parallax=True)
    for record in range(N_RECORDS):
        expected = transcript_of(lobes, statistics, record)
        assert expected.k == INITIAL_VISITS
        for _ in range(3):
            expected.sweep(points[record].astype(np.float64), weights[record].astype(np.float64), positive[record])
        compare(expected, *found, record)


def test_statistics_stay_normalised(start: tuple[GaussianMixture, Rows, Lobes, Statistics]) -> None:
    mixture, rows, lobes, statistics = start
    for _ in range(20):
        lobes, statistics = mixture.em.online(rows, dr.full(mi.UInt32, N, N_RECORDS), lobes, statistics)
        dr.eval(lobes, statistics)
    assert np.allclose(np.array(statistics.mass).sum(0), 1, atol=1e-4)
    assert np.allclose(np.array(lobes.weight).sum(0), 1, atol=1e-4)


def test_the_start_separates_clusters() -> None:
    """k-means++ takes a particle of each of seven distant clusters nearly always; the eighth component is wide."""
    centres = np.array([[.1, .1], [.1, .9], [.9, .1], [.9, .9], [.5, .1], [.5, .9], [.1, .5]])
    rng = np.random.default_rng(3)
    n_records = 64
    which = rng.integers(0, 7, (n_records, 140))
    points = (centres[which] + 0.002 * rng.normal(size=(n_records, 140, 2))).astype(np.float32)
    lobes, _ = GaussianMixture().em.start(Rows(points, np.ones((n_records, 140), np.float32)), dr.full(mi.UInt32, 140, n_records),
                                          dr.full(mi.Float, 1, n_records), mi.PCG32(n_records))
    means = np.stack([np.array(lobes.mean_x), np.array(lobes.mean_y)], -1)[:7].transpose(1, 0, 2)      # [record, 7, 2]
    nearest = np.linalg.norm(means[:, :, None] - centres, axis=-1).argmin(-1)
    distinct = np.array([len(set(row)) for row in nearest])
    assert (distinct == 7).mean() > 0.9 and distinct.min() >= 6
    assert (np.array(lobes.r_xx)[7] < np.array(lobes.r_xx)[:7].min(0)).all()


def test_no_lobe_dies_of_cancellation() -> None:
    """A disk of the sun's size, on-line for long: the covariance stays that of the disk."""
    rng = np.random.default_rng(4)
    radius = 1.74e-3                            # of the sun's disk on the square: variance radius^2 / 4
    mixture = GaussianMixture(components=2)

    def rows(n: int) -> Rows:
        r, phi = radius * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
        points = np.array([.83, .71]) + np.stack([r * np.cos(phi), r * np.sin(phi)], -1)
        return Rows(points[None].repeat(2, 0).astype(np.float32), np.ones((2, n), np.float32))

    lobes, statistics = mixture.em.first_fit(rows(300), dr.full(mi.UInt32, 300, 2), dr.full(mi.Float, 300, 2), mi.PCG32(2),
                                             parallax=True)
    for _ in range(20):
        lobes, statistics = mixture.em.online(rows(1000), dr.full(mi.UInt32, 1000, 2), lobes, statistics)
        dr.eval(lobes, statistics)
    found = transcript_of(lobes, statistics, 0)
    variance = np.einsum("k,kii->", found.pi, found.sigma) / 2 + np.einsum("k,ki->", found.pi, (found.mu - [.83, .71])**2) / 2
    assert np.isclose(variance, radius**2 / 4, rtol=0.1)


def test_fast_exponential() -> None:
    x = np.linspace(-126, 0, 100_003, dtype=np.float32)
    y = np.array(exp2_negative(mi.ArrayXf([mi.Float(x)]))[0], np.float64)
    assert np.abs(y / np.exp2(x.astype(np.float64)) - 1).max() < 5e-7
    below = np.array(exp2_negative(mi.ArrayXf([mi.Float([-127, -1e10, -np.inf])]))[0])
    assert (below >= 0).all() and (below < 2e-38).all()
