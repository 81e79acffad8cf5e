"""Running means of records against NumPy, and the EM of the BSDF fraction."""
from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from olpm_bench.transport import estimates
from olpm_bench.transport.estimates import Estimates
from representations.interface import ParticleBatch

N = 40


def _batch(rng: np.random.Generator, scale: float, n: int = 2_000) -> ParticleBatch:
    wo = mi.Vector3f(0, 0, 1) + mi.Vector3f(np.zeros((3, n), np.float32))
    weight = rng.lognormal(0, 1, n) * scale
    return ParticleBatch.from_arrays(wo, mi.Float(weight), mi.UInt32(rng.integers(0, N - 1, n)), N)


def test_sums_by_record():
    batch = _batch(np.random.default_rng(0), 1)
    record, weight = batch.record.numpy(), batch.weight.numpy()
    n, total = estimates._visit_sums(batch.weight, batch.offset)
    np.testing.assert_array_equal(n.numpy(), np.bincount(record, minlength=N))
    np.testing.assert_allclose(total.numpy(), np.bincount(record, weight, N), rtol=1e-5)
    gamma = np.where(np.arange(len(weight)) % 3 == 0, -1, 0.25).astype(np.float32)
    most = mi.Float(np.full(N, 2, np.float32))
    either, bsdf = estimates._fraction_sums(batch.weight, mi.Float(gamma), batch.offset, most)
    guided = np.where(gamma >= 0, np.minimum(weight, 2), 0)
    np.testing.assert_allclose(either.numpy(), np.bincount(record, guided, N), rtol=1e-5)
    np.testing.assert_allclose(bsdf.numpy(), np.bincount(record, 0.25 * guided, N), rtol=1e-5)


def test_of_many_visits_some_in_even_spacing_count():
    n = 3 * estimates.MOST_VISITS + 5
    count, total = estimates._visit_sums(mi.Float(np.arange(n)), mi.UInt32(0, n))
    assert estimates.MOST_VISITS / 2 < count[0] <= estimates.MOST_VISITS
    assert total[0] / count[0] == pytest.approx(n / 2, rel=0.01)


def test_sources_teach_in_units_of_their_own_mean():
    """Photons carry flux and camera paths radiance: after normalisation both weigh 1 on the average."""
    rng, found = np.random.default_rng(1), Estimates.nothing(N)
    for _ in range(3):
        photons = found.normalise_particles(_batch(rng, 1e-6))
        paths = found.normalise_camera(_batch(rng, 1e3))
    for batch in (photons, paths):
        assert batch.weight.numpy().mean() == pytest.approx(1, rel=0.1)
    assert paths.weight.numpy().max() <= estimates.MOST
    assert found.particle_count.numpy().sum() == found.camera_count.numpy().sum() == 6_000
    assert found.particle_weight.numpy()[N - 1] == 0                      # a record without particles


def test_fraction_is_the_share_of_the_bsdf():
    """EM's fixed point: c = sum w gamma / sum w; wide of both ends, and the initial value where nothing is known."""
    found = Estimates.nothing(3)
    offset = mi.UInt32(0, 5_000, 10_000, 10_000)
    returned = mi.Float(np.ones(10_000, np.float32))
    gamma = mi.Float(np.repeat([0.3, 1.0], 5_000).astype(np.float32))
    for _ in range(5):
        found.learn(returned, gamma, 2 * returned, offset)
    np.testing.assert_allclose(found.fraction(0.5).numpy(), [0.3, 1 - estimates.FLOOR, 0.5], atol=0.01)
    np.testing.assert_allclose(found.returned.numpy(), [1, 1, 0], rtol=1e-5)
    np.testing.assert_allclose(found.reflected.numpy(), [2, 2, 0], rtol=1e-5)


def test_records_with_few_visits_ask_their_neighbours():
    found = Estimates.nothing(20)
    found.visits = mi.Float(np.r_[np.full(10, 100), np.zeros(10)].astype(np.float32))
    found.returned = mi.Float(np.r_[np.full(10, 2.5), np.zeros(10)].astype(np.float32))
    points = np.zeros((20, 6), np.float32)
    points[:, 0], points[:, 5] = np.r_[np.arange(10), np.arange(9.5, 10.5, 0.1)], 1
    outgoing = found.outgoing(points, 5.0).numpy()
    np.testing.assert_allclose(outgoing[:10], 2.5)
    assert set(np.round(outgoing[10:], 3)) <= {2.5, -1.0}
    assert outgoing[10] == 2.5 and outgoing[19] == -1


def test_nobody_asks_behind_a_wall():
    """A lit and a dark side, of eight records each, and one more on either that has had few visits."""
    found = Estimates.nothing(18)
    found.visits = mi.Float(np.r_[np.full(16, 100), 2, 2].astype(np.float32))
    found.returned = mi.Float(np.r_[np.full(8, 2.5), np.full(8, 0.1), 0, 0].astype(np.float32))
    points = np.zeros((18, 6), np.float32)
    points[:, 0], points[:, 5] = np.r_[np.arange(8), np.arange(8), 3.5, 3.5], np.r_[np.ones(8), -np.ones(8), 1, -1]
    np.testing.assert_allclose(found.outgoing(points, 5.0).numpy()[16:], [2.5 * 800 / 802, 0.1 * 800 / 802], rtol=0.03)


def test_one_heavy_estimate_does_not_make_the_others_light():
    def batch(*weights: float) -> ParticleBatch:
        wo = mi.Vector3f(0, 0, 1) + mi.Vector3f(np.zeros((3, len(weights)), np.float32))
        return ParticleBatch.from_arrays(wo, mi.Float(list(weights)), mi.UInt32([0] * len(weights)), 2)

    found = Estimates.nothing(2)
    found.normalise_camera(batch(*[1.0] * 999))
    heavy = found.normalise_camera(batch(1e6, 1.0))
    assert found.camera_weight[0] == pytest.approx((1000 + estimates.MOST) / 1001, rel=1e-4)
    np.testing.assert_allclose(heavy.weight.numpy(), np.array([estimates.MOST, 1]) / found.camera_weight[0], rtol=0.02)
