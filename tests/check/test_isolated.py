"""Other people's code is examined by another process: what ends that one is a failure of the check that it was in."""
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from olpm_bench.bench import other_process
from olpm_bench.check import isolated, suite
from olpm_bench.cli import app

MUTANTS = Path(__file__).parents[1] / "representations/mutants.py"
ENDS = """
import os
import drjit as dr
import mitsuba as mi
from representations.jensen import JensenHistogram

class Leaves(JensenHistogram):
    def pdf(self, *args):
        os._exit(0)

class OutOfBounds(JensenHistogram):
    def pdf(self, state, record, *args):
        return super().pdf(state, record, *args) + dr.gather(mi.Float, mi.Float(0, 0), record + (1 << 31))
"""


@pytest.mark.parametrize(("name", "end"), [("Leaves", "exit code 0"), ("OutOfBounds", "SIGSEGV")])
def test_what_ends_the_process_fails_and_the_other_checks_go_on(tmp_path: Path, name: str, end: str) -> None:
    (tmp_path / "ends.py").write_text(ENDS)
    only = [word for check in ("memory", "density", "samples") for word in ("--only", check)]
    result = CliRunner().invoke(app, ["check", f"{tmp_path / 'ends.py'}:{name}", *only, "--pictures", str(tmp_path)])
    assert result.exit_code == 1 and "2 of 3 checks FAILED" in result.stdout
    assert f"density, samples FAILED: ends the process: {end}" in result.stdout and f"ends.py:{name}: 2 of 3" in result.stdout
    passed = [line.split()[0] for line in result.stdout.splitlines() if "passed" in line.split()]
    assert passed == ["memory"]


def test_it_finds_what_the_same_checks_find_in_this_process() -> None:
    subject, checks = suite.Subject({"type": f"{MUTANTS}:ScaleMatters"}), suite.named(["samples", "scale"])
    here = list(suite.run(subject, checks))
    with isolated.Examiner() as examiner:
        there = list(examiner.run(subject, checks))
        assert examiner.starts == 1
    assert [o.verdict.as_dict() for o in there] == [o.verdict.as_dict() for o in here]
    assert [o.verdict.passed for o in here] == [True, False] and there[0].verdict.panels() == []
    assert here[1].verdict.panels()
    for a, b in zip(here[1].verdict.panels(), there[1].verdict.panels(), strict=True):
        assert np.array_equal(a.values, b.values, equal_nan=True)
        assert (a.title, a.scale, a.unit) == (b.title, b.scale, b.unit) and np.array_equal(a.mark, b.mark)


def test_a_check_that_hangs_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(other_process.Process, "ask", lambda *_: {"hung": 900.0})
    outcome, = isolated.Examiner().run(suite.Subject({"type": "file.py:Mine"}), suite.named(["samples"]))
    assert not outcome.verdict.passed and outcome.verdict.worst == "does not come back within 900 s"


def test_an_interrupt_ends_the_process() -> None:
    with pytest.raises(KeyboardInterrupt), isolated.Examiner() as examiner:
        list(examiner.run(suite.Subject({"type": "jensen"}), suite.named(["memory"])))
        process = examiner.process
        assert process is not None and process.poll() is None
        raise KeyboardInterrupt
    assert process.poll() is not None
