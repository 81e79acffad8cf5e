"""Mean and variance of passes."""
from __future__ import annotations

import numpy as np

from olpm_bench.bench.accumulator import Accumulator


def test_passes_of_different_sizes_give_an_unbiased_variance():
    """Var(mean) = sigma^2 / N from passes of 1, 2, 4 and 8 samples: mean of 20000 trials within 4 standard errors."""
    sizes, trials = (1, 2, 4, 8), 20_000
    accumulator = Accumulator.empty(1, trials)
    samples = np.random.default_rng(3).exponential(2.0, (sum(sizes), 1, trials, 3))
    first = 0
    for n in sizes:
        accumulator.add(samples[first:first + n].mean(axis=0), n)
        first += n
    np.testing.assert_allclose(accumulator.mean, samples.mean(axis=0), rtol=1e-12)
    variance, truth = accumulator.variance(), 4.0 / sum(sizes)
    assert abs(variance.mean() - truth) < 4 * variance.std() / np.sqrt(variance.size)


def test_one_pass_has_no_variance_to_show():
    accumulator = Accumulator.empty(2, 2)
    accumulator.add(np.ones((2, 2, 3)), 4)
    assert np.isinf(accumulator.variance()).all()


def test_an_accumulator_goes_on_where_it_was():
    passes = np.random.default_rng(5).random((6, 2, 3, 3))
    whole, first = Accumulator.empty(2, 3), Accumulator.empty(2, 3)
    for i, x in enumerate(passes):
        whole.add(x, 2)
        if i < 3:
            first.add(x, 2)
    resumed = Accumulator.resume(first.mean, first.variance(), first.spp, first.passes)
    for x in passes[3:]:
        resumed.add(x, 2)
    np.testing.assert_allclose(resumed.mean, whole.mean)
    np.testing.assert_allclose(resumed.variance(), whole.variance())


def test_noisier_passes_of_another_size_count_by_their_own_noise():
    """Four passes of 8 samples with variance 4 each, as of a guide that still learns, then sixteen of 2 with variance 1.

    The variance of the mean is (32 x 4 + 32 x 1) / 64^2.  That of equal samples would be 40 % too small.
    """
    rng, trials = np.random.default_rng(4), 20_000
    accumulator = Accumulator.empty(1, trials)
    for size, variance in [(8, 4.0)] * 4 + [(2, 1.0)] * 16:
        accumulator.add(rng.normal(1, np.sqrt(variance / size), (1, trials, 3)), size)
    truth = (32 * 4.0 + 32 * 1.0) / 64**2
    assert 0.92 * truth < accumulator.variance().mean() < 1.02 * truth
