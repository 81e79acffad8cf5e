"""Hundreds of batches: what grows, fades or overflows so slowly that a few batches don't show it."""
from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from olpm_bench.check import density, samples
from olpm_bench.check.particles import Particles, equal, nothing, uniform_directions
from olpm_bench.check.population import Population
from olpm_bench.check.trained import Trained
from olpm_bench.check.trials import Trials, both
from olpm_bench.check.verdict import Failure, Verdict, exact, sidak, worst_of
from representations.state import append, bytes_of

BATCHES = 260               # more than a number of 8 bits counts, and than what halves with each batch leaves of a float32
EARLY = 40                  # batches after which what learners know is compared
LESSONS, EACH = 4, 2        # different batches, which come again and again, and particles of each learner in one
LEARNERS = 4                # records that go on learning
SLACK = 0.05                # nats that a learner's own particles may become less likely, though they come again and again


@both
def last(trials: Trials, level: float) -> Verdict:
    """After hundreds of batches, records that had no particle in them are as they were; of those that had, samples follow the
    pdf, which integrates to 1, and knows its particles as well as early on.
    """
    rng, idle = trials.records.rng(18), [nothing()] * trials.n
    lessons: list[list[Particles]] = [[equal(uniform_directions(EACH, rng)) for _ in range(LEARNERS)] for _ in range(LESSONS)]
    learners = Population(["learning for long"] * LEARNERS, lessons, trials.seed, None, trials.parallax)
    before = append(trials.init(LEARNERS, trials.seed), trials.train(trials.batches))
    given = [trials.batch(lesson + idle) for lesson in lessons]
    state, known = before, []
    for index in range(BATCHES):
        state = trials.representation.update(state, given[index % LESSONS], trials.seed + index)
        dr.eval(state)
        if index + 1 in (EARLY, BATCHES):
            known.append(_known(Trained(trials.representation, learners, state)))
    found = trials.differences(f"after {BATCHES} batches for other records", state, before, new_at=LEARNERS, old_at=LEARNERS)
    size, at_first = bytes_of(state), bytes_of(before)
    if size != at_first and not trials.grows:
        found.append(Failure(1, f"{size} bytes of {LEARNERS + trials.n} records after {BATCHES} batches, {at_first} before"))
    lost = known[0] - known[1]
    if not lost.max() < SLACK:
        words = (f"of {learners.name(int(lost.argmax()))}, the same particles are {lost.max():.3g} nats less likely after "
                 f"{BATCHES} batches of them than after {EARLY}")
        found.append(Failure(1, words))
    trained, part = Trained(trials.representation, learners, state), sidak(level, 2)
    note = f"{BATCHES} batches, {LEARNERS} records that learn and {trials.n} that don't"
    for verdict in (exact(found, "answers that differ"), density.is_valid(trained)):
        if not verdict.passed:
            return replace(verdict, note=note)
    return replace(worst_of({"": density.integral(trained, part), "by samples": samples.follow_pdf(trained, part)}), note=note)



def _known(trained: Trained) -> Any:
    """Mean ln q of each record's particles, q = (cos / pi + pdf) / 2 [n_records]."""
    records, found = trained.records, []
    for record in range(len(records)):
        wo = records.proposals.around(record)
        pdf = trained.density(np.full(len(wo), record), wo)
        found.append(np.log((wo[:, 2] / np.pi + pdf) / 2).mean())
    return np.array(found)
