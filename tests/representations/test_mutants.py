"""Every representation that is broken on purpose is rejected, and by the check that should do so."""
from __future__ import annotations

from pathlib import Path

import mutants
import pytest
from asking import RENDERS

from olpm_bench.check import suite


def outcome(mutant: type, check: str) -> suite.Outcome:
    subject = suite.Subject({"type": f"{Path(mutants.__file__)}:{mutant.__name__}"})
    found, = suite.run(subject, suite.named([check]))
    return found


def test_every_check_rejects_something() -> None:
    assert set(mutants.CAUGHT_BY.values()) == {check.name for check in suite.CHECKS}


@pytest.mark.parametrize(("mutant", "check"), [
    pytest.param(mutant, check, marks=[pytest.mark.slow] * (check in RENDERS), id=f"{mutant.__name__}-{check}")
    for mutant, check in mutants.CAUGHT_BY.items()])
def test_a_mutant_is_rejected(mutant: type, check: str) -> None:
    verdict = outcome(mutant, check).verdict
    assert not verdict.passed
    assert (verdict.measure == "error") == (mutant in (mutants.FailsToRun, mutants.EndsTheProcess)), verdict.worst
