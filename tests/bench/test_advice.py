"""The sentences below the table: when they are said, and that each says what to do."""
from __future__ import annotations

import pytest

from olpm_bench.bench import advice

QUIET = {"overrun": 0.0, "training_passes": 3, "train_seconds": 3.9, "charged_seconds": 10.0, "gain_high": 1.2,
         "noise_floor": 0.01, "l1": 0.03, "worst_speed_up": 1.0}


def test_nothing_is_said_where_all_is_as_it_should_be():
    assert advice.sentences(QUIET) == []
    unguided = QUIET | {"training_passes": 0, "train_seconds": 0.0, "gain_high": 0.9, "worst_speed_up": None}
    assert advice.sentences(unguided) == []
    bare = QUIET | {"gain_high": None, "noise_floor": None, "l1": None, "worst_speed_up": None}
    assert advice.sentences(bare) == []


@pytest.mark.parametrize("change, said, advised", [
    ({"train_seconds": 4.5}, "45 % of this budget went into training", "a longer one favours guiding"),
    ({"gain_high": 0.9}, "guiding costs more here than it saves", "light that is harder to find, or a longer budget"),
    ({"overrun": 0.12}, "took 12 % more time than its budget", "a longer budget, or fewer photons"),
    ({"l1": 0.015}, "its L1 error is only 1.5 times the reference's noise", "go on with the reference"),
    ({"worst_speed_up": 0.5}, "0.5x as fast as the baseline", "compare at your own budget")])
def test_what_is_found_and_what_to_do(change, said, advised):
    sentence, = advice.sentences(QUIET | change)
    found, semicolon, remedy = sentence.partition("; ")
    assert semicolon and found.startswith(said) and advised in remedy


def test_the_share_of_training_means_nothing_for_a_budget_of_samples():
    assert advice.sentences(QUIET | {"train_seconds": 9.0, "overrun": None}) == []
