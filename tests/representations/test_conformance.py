"""Every registered representation passes every check of `olpm-bench check`."""
from __future__ import annotations

import pytest
from asking import RENDERS

import representations
from olpm_bench.check import suite

DECLARED = {"cosine": ("constant",)}


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "subject" in metafunc.fixturenames:
        given = metafunc.config.getoption("--representation")
        metafunc.parametrize("subject", [given] if given else representations.names(), indirect=True, scope="module")


@pytest.fixture(scope="module")
def subject(request: pytest.FixtureRequest) -> suite.Subject:
    return suite.Subject({"type": request.param}, declared=DECLARED.get(request.param, ()))


@pytest.mark.parametrize("check", [pytest.param(c, marks=[pytest.mark.slow] * (c.name in RENDERS)) for c in suite.CHECKS],
                         ids=lambda c: c.name)
def test_conformance(subject: suite.Subject, check: suite.Check) -> None:
    outcome, = suite.run(subject, [check])
    assert outcome.verdict.passed, outcome.verdict.worst


@pytest.mark.parametrize("name", ["jensen", "hey"])
def test_order_of_records(name: str) -> None:
    """Permuted records give permuted states, bit for bit: no random number goes by the index of a record."""
    outcome, = suite.run(suite.Subject({"type": name}), suite.named(["independence"]))
    assert outcome.verdict.note.endswith("the same bits")
