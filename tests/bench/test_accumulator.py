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
