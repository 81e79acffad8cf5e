"""The null representation against closed forms."""
from __future__ import annotations

import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.particles import batch, lobes, vector
from representations.cosine import CosineLobe, cosine_pdf, sample_cosine


def test_pdf_in_closed_form() -> None:
    wo = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 1, 0], [0, 0.6, -0.8]], np.float32)
    assert np.allclose(cosine_pdf(vector(wo)), [1 / np.pi, 0.8 / np.pi, 0, 0])


def test_samples_follow_cosine() -> None:
    """cos^2(theta) of cosine-distributed directions is uniform."""
    wo, pdf = sample_cosine(mi.Point2f(np.random.default_rng(0).random((2, 100_000)).astype(np.float32)))
    z = np.array(wo.z, np.float64)
    assert np.allclose(pdf, z / np.pi)
    assert stats.kstest(z * z, "uniform").pvalue > 1e-3


def test_learns_nothing_but_counts() -> None:
    rng = np.random.default_rng(1)
    cosine = CosineLobe()
    state = cosine.init(2)
    for _ in range(2):
        state = cosine.update(state, batch([(lobes(n, rng), np.ones(n)) for n in (5, 7)]))
    assert np.array_equal(state.count, [10, 14])
