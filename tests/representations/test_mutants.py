"""Every representation that is broken on purpose is rejected, and by the check that should do so."""
from __future__ import annotations

import inspect

import elusive_mutants
import mutants
import pytest
from asking import RENDERS

from olpm_bench.check import suite

CAUGHT_BY = mutants.CAUGHT_BY | elusive_mutants.CAUGHT_BY


def outcome(mutant: type, check: str) -> suite.Outcome:
    subject = suite.Subject({"type": f"{inspect.getfile(mutant)}:{mutant.__name__}"})
    found, = suite.run(subject, suite.named([check]))
    return found


def test_every_check_rejects_something() -> None:
    assert set(CAUGHT_BY.values()) == {check.name for check in suite.CHECKS}


@pytest.mark.parametrize(("mutant", "check"), [
    pytest.param(mutant, check, marks=[pytest.mark.slow] * (check in RENDERS), id=f"{mutant.__name__}-{check}")
    for mutant, check in CAUGHT_BY.items()])
def test_a_mutant_is_rejected(mutant: type, check: str) -> None:
    verdict = outcome(mutant, check).verdict
    assert not verdict.passed
    assert (verdict.measure == "error") == (mutant in (mutants.FailsToRun, mutants.EndsTheProcess)), verdict.worst
