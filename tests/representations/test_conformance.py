"""Every registered representation passes every check of `olpm-bench check`."""
from __future__ import annotations

import pytest

import representations
from olpm_bench.check import suite

DECLARED = {"cosine": ("constant",)}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    given = metafunc.config.getoption("--representation")
    metafunc.parametrize("subject", [given] if given else representations.names(), indirect=True, scope="module")


@pytest.fixture(scope="module")
def subject(request: pytest.FixtureRequest) -> suite.Subject:
    return suite.Subject({"type": request.param}, declared=DECLARED.get(request.param, ()))


RENDERS = ("furnace", "image")          # slow ones


@pytest.mark.parametrize("check", [pytest.param(c, marks=[pytest.mark.slow] * (c.name in RENDERS)) for c in suite.CHECKS],
                         ids=lambda c: c.name)
def test_conformance(subject: suite.Subject, check: suite.Check) -> None:
    outcome, = suite.run(subject, [check])
    assert outcome.verdict.passed, outcome.verdict.worst
