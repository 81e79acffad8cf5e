"""Comparisons of samples with densities: their p-values are uniform if nothing is wrong, and what they find."""
from __future__ import annotations

import elusive_mutants
import mutants
import numpy as np
import pytest
from scipy import stats

from olpm_bench.check import many_records, population, samples
from olpm_bench.check.particles import equal, lobes, nothing, uniform_directions
from olpm_bench.check.trained import Trained
from olpm_bench.check.verdict import PValues
from representations.cosine import CosineLobe
from representations.hey import HeyCones
from representations.jensen import JensenHistogram

SEEDS, LEVEL = 24, 1e-3


@pytest.fixture
def p_values(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[float]]:
    """All p-values that the checks find, by what their words begin with; nothing is forgiven, and there are fewer samples."""
    found: dict[str, list[float]] = {"sum": [], "lanes": [], "blocks": [], "bins": [], "cells": []}

    def add(self, p, words, picture=None):
        kind = next((k for k in found if f" {k} of" in words), "sum" if "differ by" in words else "bins")
        found[kind].append(p)
        self.found.append((p, words, picture))

    monkeypatch.setattr(PValues, "add", add)
    monkeypatch.setattr(samples, "ROUNDING", 0.0)
    monkeypatch.setattr(population, "FEW", 1 << 13)
    monkeypatch.setattr(population, "SAMPLES", 1 << 13)
    monkeypatch.setattr(many_records, "RECORDS", 1 << 14)
    return found


def small_population(seed: int) -> population.Population:
    rng = np.random.default_rng(seed)
    particles = [nothing(), nothing(), equal(lobes(1, rng)), equal(lobes(9, rng)), equal(lobes(200, rng))]
    return population.Population(["untrained", "untrained", "one", "nine", "many"], [particles], seed)


@pytest.mark.parametrize("representation", [CosineLobe(), JensenHistogram()], ids=["cosine", "jensen"])
def test_p_values_are_uniform_if_nothing_is_wrong(representation, p_values) -> None:
    """Those of sums, lanes and blocks; those of bins and cells are no smaller (they are of bounds on variance and tail)."""
    for seed in range(SEEDS):
        samples.follow_pdf(Trained(representation, small_population(seed)), 0.01)
        if seed % 3 == 0:
            many_records.are_right(representation, seed, 0.01)
    for kind in ("sum", "lanes", "blocks"):
        assert stats.kstest(p_values[kind], "uniform").pvalue > LEVEL, (kind, np.sort(p_values[kind]))
    assert len(p_values["sum"]) == 4 * SEEDS + 3 * (SEEDS // 3)
    assert stats.kstest(p_values["bins"], "uniform", alternative="greater").pvalue > LEVEL
    assert min(p_values["cells"]) * len(p_values["cells"]) > LEVEL      # they are tested at the smallest p of many


def test_bins_at_the_rim_of_a_lobe_raise_no_alarm(p_values) -> None:
    """There the pdf may be a hundred times the proposals', and one of these, or none, faces hundreds of samples."""
    rng = np.random.default_rng(0)
    ten_identical = [equal(np.repeat(uniform_directions(1, rng), 10, axis=0)) for _ in range(256)]
    records = population.Population(["ten identical"] * len(ten_identical), [ten_identical], 0)
    samples.follow_pdf(Trained(HeyCones(), records), 0.01)
    assert min(p_values["bins"]) > LEVEL / len(ten_identical)
    assert stats.kstest(p_values["bins"], "uniform", alternative="greater").pvalue > LEVEL


def test_two_percent_are_found_in_few_samples(p_values) -> None:
    """Of 16,384 samples by their sum, and no bin shows it; of some 70,000 in many records."""
    samples.follow_pdf(Trained(mutants.UntrainedTwoPercent(), small_population(0)), 0.01)
    assert p_values["sum"][0] < 1e-9 and min(p_values["bins"]) > 1e-3
    many_records.are_right(mutants.UntrainedTwoPercent(), 0, 0.01)
    assert p_values["sum"][-1] < 1e-4 and min(p_values["bins"]) > 1e-3


@pytest.mark.parametrize("points", [2, 3, 5, 50])
def test_tosses_of_a_fair_coin_raise_no_alarm(points: int) -> None:
    """At levels that matter, of the smallest of hundreds of p-values, they are no more frequent than stated."""
    rng, cells, trials = np.random.default_rng(points), 20, 100_000
    uneven = (2 * rng.binomial(points, 0.5, (trials, cells)) - points) ** 2 / points
    mean, variance = cells, cells * (2 - 2 / points)
    p = stats.chi2.sf(uneven.sum(1) * 2 * mean / variance, 2 * mean**2 / variance)
    for level in (1e-2, 1e-3, 1e-4):
        assert stats.binomtest(int((p < level).sum()), trials, level, "greater").pvalue > LEVEL


def test_slivers_that_are_never_sampled_are_found_at_a_fine_scale_only() -> None:
    """They hold 3 % of the mass, spread over all bins of little mass; the sums and the bins of 1/16 don't show them."""
    outcome = samples.follow_pdf(Trained(elusive_mutants.PlaceByTheChoice(), population.population(0)), 1e-5)
    assert not outcome.passed and "cells of 1/32 of the square's edge" in outcome.worst
