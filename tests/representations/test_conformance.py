"""Every registered representation passes every conformance test in every state."""
from __future__ import annotations

from typing import Any

import conformance
import pytest

import representations
from representations.jensen import JensenHistogram

CASES, PARALLAX = conformance.cases(), conformance.cases_with_parallax()
TESTS = [conformance.density_is_valid, conformance.sample_reports_pdf, conformance.samples_follow_pdf,
         conformance.weight_scale_is_irrelevant, conformance.update_is_pure, conformance.records_are_independent,
         conformance.nothing_new_changes_nothing, conformance.records_can_be_appended, conformance.inactive_lanes_are_harmless]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "representation" in metafunc.fixturenames:
        given = metafunc.config.getoption("--representation")
        metafunc.parametrize("representation", [given] if given else representations.names(), indirect=True, scope="module")


@pytest.fixture(scope="module")
def representation(request: pytest.FixtureRequest) -> Any:
    return representations.create(request.param)


@pytest.mark.parametrize("case", PARALLAX, ids=[c.name.replace(" ", "_") for c in PARALLAX])
@pytest.mark.parametrize("test", TESTS[:3], ids=[t.__name__ for t in TESTS[:3]])
def test_conformance_with_parallax(representation: Any, test: Any, case: conformance.Case) -> None:
    test(representation, case)


@pytest.mark.parametrize("case", CASES, ids=[c.name.replace(" ", "_") for c in CASES])
@pytest.mark.parametrize("test", TESTS, ids=[t.__name__ for t in TESTS])
def test_conformance(representation: Any, test: Any, case: conformance.Case) -> None:
    test(representation, case)


class TooBright(JensenHistogram):
    """5 % too much density, in sample() and pdf() alike."""
    def _density(self, *args: Any) -> Any:
        return 1.05 * super()._density(*args)


class NextBin(JensenHistogram):
    """Looks into the neighbour's bin."""
    def _bin(self, wo: Any) -> Any:
        return super()._bin(wo) ^ 1


@pytest.mark.parametrize(("wrong", "case"), [(TooBright, "untrained"), (TooBright, "one particle"), (TooBright, "many modes"),
                                             (NextBin, "one particle"), (NextBin, "many modes"), (NextBin, "on-line")])
def test_a_wrong_density_is_caught(wrong: type, case: str) -> None:
    """The chi-square test has the power to see it."""
    with pytest.raises(AssertionError, match=r"samples don't follow the pdf|integral of pdf"):
        conformance.samples_follow_pdf(wrong(), next(c for c in CASES if c.name == case))
