"""`olpm-bench check`: its statistics, what it prints, and its exit codes."""
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from typer.testing import CliRunner

from olpm_bench.check import examination, suite
from olpm_bench.check.particles import BATCHES, CONDITIONS, IDENTICAL, LONG, many, nothing, uniform_directions
from olpm_bench.check.picture import CELL, over_disk
from olpm_bench.check.population import ASKED, population, population_with_parallax
from olpm_bench.check.proposal import Proposals
from olpm_bench.check.verdict import PValues, Verdict, combined, sidak
from olpm_bench.cli import app

MUTANTS = Path(__file__).parents[1] / "representations/mutants.py"


def call(*arguments: object):
    return CliRunner().invoke(app, ["check", *map(str, arguments)])


# ---------------------------------------------------------------- statistics

def test_sidak_and_its_inverse() -> None:
    assert sidak(0.05, 1) == pytest.approx(0.05) and sidak(1e-4, 1000) == pytest.approx(1e-7, rel=1e-3)
    assert combined(sidak(0.01, 37), 37) == pytest.approx(0.01)


def test_false_alarms_are_as_frequent_as_stated() -> None:
    """Of verdicts over 50 uniform p-values each."""
    rng, alarms, runs, level = np.random.default_rng(0), 0, 2000, 0.05
    p = []
    for _ in range(runs):
        p_values = PValues()
        for value in rng.random(50):
            p_values.add(value, "")
        verdict = p_values.verdict(level)
        alarms += not verdict.passed
        p.append(verdict.p)
    assert stats.binomtest(alarms, runs, level).pvalue > 1e-3
    assert stats.kstest(p, "uniform").pvalue > 1e-3


def test_a_nan_is_no_p_value() -> None:
    p_values = PValues()
    p_values.add(np.nan, "nothing to compare")
    assert not p_values.verdict(0.01).passed


# ---------------------------------------------------------------- proposals and populations

def test_proposals_have_their_density() -> None:
    """E_q[1 / q] over what lies above the horizon is the hemisphere's solid angle, q at all scales around a particle."""
    rng = np.random.default_rng(1)
    proposals, n = Proposals([nothing(), many(5, rng), many(1000, rng)], rng), 1 << 15
    assert len(proposals.pdf(np.zeros(0, int), np.zeros((0, 3)))) == 0
    for record in range(3):
        index = np.full(n, record)
        wo = proposals.at(index, rng.random((n, 3)))
        above = wo[:, 2] > 0
        ratio = np.where(above, 1 / proposals.pdf(index, wo), 0)
        z = (ratio.mean() - 2 * np.pi) / (ratio.std() / np.sqrt(n) + 1e-4)
        assert abs(z) < stats.norm.isf(1e-3 / 6)


def test_every_condition_is_in_both_populations() -> None:
    records = population(0)
    assert set(records.conditions) == {*CONDITIONS, *LONG} and len(records.batches) == BATCHES
    assert max(len(records.of(r)[1]) for r in range(len(records))) > 1_000_000
    empty = [r for r in range(len(records)) if len(records.of(r)[1]) == 0]
    assert empty and all(records.conditions[r] in ("untrained", "few at a time") for r in empty)
    assert all(records.conditions[r] != records.conditions[r + 1] for r in range(len(records) - 1))
    aimed = population_with_parallax(0)
    everywhere = {f"{name}, {asked}" for name in CONDITIONS for asked in ASKED}
    assert set(aimed.conditions) == everywhere | {f"{name}, {next(iter(ASKED))}" for name in LONG}
    thousands = records.conditions.index("thousands identical")
    assert len(records.of(thousands)[1]) == IDENTICAL and records.proposals.count[thousands] == 1
    assert all(batch.at is not None for batch in aimed.arrays() if len(batch))
    finite = [np.isfinite(batch.distance).mean() for batch in records.arrays()]
    assert all(batch.at is None for batch in records.arrays()) and min(finite) > 0.5        # as in training
    identical = aimed.conditions.index("ten identical, beside")
    assert len(aimed.of(identical)[1]) == 10 and aimed.proposals.count[identical] == 1 and aimed.complete[identical]


def test_the_disk_keeps_areas() -> None:
    """A uniform density is 1 / 2 pi in every cell within the disk."""
    n = 1 << 18
    values = over_disk(uniform_directions(n, np.random.default_rng(2)), np.full(n, 1 / n))
    inner = values[20:44, 20:44]
    assert np.nansum(values) * CELL == pytest.approx(1, abs=0.02)
    assert inner.mean() == pytest.approx(1 / (2 * np.pi), rel=5 / np.sqrt(n * CELL * inner.size / (2 * np.pi)))


# ---------------------------------------------------------------- the command

def test_json(tmp_path: Path) -> None:
    result = call("jensen", "--only", "memory", "--only", "scale", "--json", "--pictures", tmp_path)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout, parse_constant=lambda text: pytest.fail(f"{text} in JSON"))
    assert found["passed"] and [c["name"] for c in found["checks"]] == ["memory", "scale"] and not list(tmp_path.iterdir())


def test_json_stays_json_if_the_representation_prints(tmp_path: Path, capfd) -> None:
    (tmp_path / "prints.py").write_text("from representations.jensen import JensenHistogram\nclass Prints(JensenHistogram):\n"
                                        "    def pdf(self, *args):\n        print('asked')\n        return super().pdf(*args)\n")
    result = call(f"{tmp_path / 'prints.py'}:Prints", "--only", "scale", "--json")
    assert json.loads(result.stdout)["passed"] and "asked" in capfd.readouterr().err        # of another process


def test_a_failure_has_words_a_picture_and_an_exit_code(tmp_path: Path) -> None:
    result = call(f"{MUTANTS}:ScaleMatters", "--only", "scale", "--only", "purity", "--pictures", tmp_path)
    assert result.exit_code == 1
    assert "scale FAILED: record" in result.stdout and "1 of 2 checks FAILED" in result.stdout
    picture, = tmp_path.rglob("*.png")
    assert picture.name == "scale.png" and str(picture) in result.stdout.replace("\n", "")


@pytest.mark.parametrize(("mutant", "check", "words"), [
    ("UntrainedTwoPercent", "many-records", "samples and pdf differ by -2"), ("OneNaN", "many-records", "record "),
    ("Unseeded", "purity", "gives other bits")])
def test_what_fails_has_a_picture(tmp_path: Path, mutant: str, check: str, words: str) -> None:
    result = call(f"{MUTANTS}:{mutant}", "--only", check, "--pictures", tmp_path)
    picture, = tmp_path.rglob("*.png")
    assert result.exit_code == 1 and words in result.stdout and picture.name == f"{check}.png"


def test_the_picture_of_a_cone_on_its_disk_shows_too_many_samples_in_the_middle() -> None:
    outcome, = suite.run(suite.Subject({"type": f"{MUTANTS}:DiskForCone"}), suite.named(["one-particle"]))
    assert outcome.verdict.picture is not None
    pdf, samples, z = (panel.values for panel in outcome.verdict.picture())
    middle, radius = slice(14, 18), np.hypot(*np.mgrid[-15.5:16, -15.5:16])
    rim = (pdf > 0.99 * pdf.max()) & (radius > radius[pdf > 0.99 * pdf.max()].max() - 1)
    assert z[middle, middle].mean() > 3 and z[rim].mean() < -1
    assert samples.sum() == pytest.approx(pdf.sum(), rel=0.01)


def test_a_declaration_is_believed_only_if_it_is_true() -> None:
    assert call("cosine", "--only", "learning").exit_code == 1
    assert call("cosine", "--only", "learning", "--declare", "constant").exit_code == 0
    assert call("jensen", "--only", "learning", "--declare", "constant").exit_code == 1
    assert call(f"{MUTANTS}:MemoryGrows", "--only", "memory", "--declare", "grows").exit_code == 0


@pytest.mark.parametrize(("name", "setting"), [("hey", "cones=1"), ("hey", "cones=4"), ("jensen", "resolution=2"),
                                              ("gaussian_mixture", "components=1")])
def test_what_keeps_little_is_valid_if_it_says_so(name: str, setting: str) -> None:
    """One cone is a density; it learns one particle of a thousand, and aims at it, and is too wide for more."""
    command = [name, "--set", f"representation.{setting}", "--only", "learning", "--only", "aiming"]
    result = call(*command)
    assert result.exit_code == 1 and "1 of 2 checks FAILED" in result.stdout and "is declared coarse" in result.stdout
    assert call(*command, "--declare", "coarse").exit_code == 0


def test_who_learns_nothing_is_not_coarse() -> None:
    assert call("jensen", "--set", "representation.resolution=1", "--only", "learning", "--declare", "coarse").exit_code == 1
    assert call("cosine", "--only", "learning", "--declare", "coarse").exit_code == 1


def test_a_campaign_counts_alarms(tmp_path: Path) -> None:
    result = call("jensen", "--only", "learning", "--repeat", 3, "--seed", 5)
    assert result.exit_code == 0 and "0 of 3 runs raised an alarm" in result.stdout and "seed 7: passed" in result.stdout
    result = call(f"{MUTANTS}:InPlace", "--only", "purity", "--repeat", 2, "--json", "--pictures", tmp_path)
    assert result.exit_code == 1 and json.loads(result.stdout)["alarms"] == 2


def test_an_interrupt_while_a_failure_is_drawn_is_none_of_other_peoples_errors(tmp_path: Path, monkeypatch) -> None:
    def interrupted(*_: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise RuntimeError("dr.while_loop(): encountered an exception") from error

    failure = Verdict(False, "wrong", None, None, "wrong", picture=interrupted)
    monkeypatch.setattr(suite, "run", lambda subject, checks: iter([suite.Outcome(checks[0], failure, 0.0)]))
    result = call("jensen", "--only", "memory", "--pictures", tmp_path)
    assert result.exit_code == 130 and "interrupted" in result.stderr


def test_a_campaign_goes_on_from_its_log(tmp_path: Path) -> None:
    log, mine = tmp_path / "logs/jensen.jsonl", tmp_path / "mine.py"
    mine.write_text("from representations.jensen import JensenHistogram\n\nclass Mine(JensenHistogram): pass\n")

    def campaign(*arguments: object) -> list[str]:
        result = call(f"{mine}:Mine", "--only", "scale", "--log", log, *arguments)
        assert result.exit_code == 0, result.output
        return result.stdout.splitlines()

    assert [line[:6] for line in campaign("--repeat", 2)[:2]] == ["seed 0", "seed 1"]
    seed, total, *_ = campaign("--repeat", 2, "--seed", 1)
    assert seed.startswith("seed 2: passed") and "0 of 3 runs raised an alarm" in total
    assert json.loads(call(f"{mine}:Mine", "--only", "scale", "--log", log, "--json").stdout)["runs"] == [
        json.loads(line) for line in log.read_text().splitlines()]
    assert campaign("--only", "memory")[0].startswith("seed 0")            # other checks, or other code, are other runs
    mine.write_text(mine.read_text() + "# changed\n")
    seed, total, *_ = campaign("--seed", 9)
    assert seed.startswith("seed 9") and "0 of 1 runs" in total and len(log.read_text().splitlines()) == 5
    good = log.read_bytes()
    for bad in (b'{"seed": 1}', b"PK\x03\x04\xff\xfe", b"[" * 100_000):
        log.write_bytes(good + bad)
        result = call(f"{mine}:Mine", "--log", log)
        assert result.exit_code == 2 and "line 6 is broken" in result.stderr and len(result.stderr.splitlines()) == 1


def test_a_campaign_goes_on_after_a_line_that_a_kill_cut_short(tmp_path: Path) -> None:
    log, command = tmp_path / "log.jsonl", ["jensen", "--only", "scale", "--log", tmp_path / "log.jsonl"]
    assert call(*command, "--repeat", 2).exit_code == 0
    first, second, end = log.read_text().split("\n")
    log.write_text(first + "\n" + second[:len(second) // 2])
    result = call(*command, "--repeat", 2)
    assert result.exit_code == 0 and "0 of 2 runs" in result.stdout and result.stdout.startswith("seed 1: passed")
    assert log.read_text().startswith(first + "\n" + second[:len(second) // 2] + "\n{") and end == ""
    assert "0 of 3 runs" in call(*command, "--repeat", 3).stdout


def test_a_failure_is_told_where_no_picture_can_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    arguments = [f"{MUTANTS}:PdfTimesTen", "--only", "integral", "--pictures", tmp_path / "file"]
    result = call(*arguments)
    assert result.exit_code == 1 and "1 of 1 checks FAILED" in result.stdout and "no picture of integral: " in result.stderr
    log = tmp_path / "log.jsonl"
    result = call(*arguments, "--repeat", 1, "--log", log)
    assert result.exit_code == 1 and json.loads(log.read_text())["passed"] is False


@pytest.mark.parametrize(("power", "exit_code", "share"), [(1, 0, 0.1), (2, 1, 0.1**0.5), (0.5, 0, 0.01)],
                         ids=["calibrated", "too small", "too large"])
def test_a_campaign_judges_the_p_values_of_each_check(tmp_path: Path, power: float, exit_code: int, share: float) -> None:
    """No alarm among 300 logged runs, and those of one check are u^power for uniform u."""
    about = examination._about(suite.Subject({"type": "jensen"}), suite.named(["integral", "samples"]))
    rng, log, n = np.random.default_rng(0), tmp_path / "log.jsonl", 300
    runs = [{**about, "seed": seed, "passed": True, "p": rng.random(), "smallest": {"integral": rng.random(),
             "samples": rng.random()**power}} for seed in range(n)]
    log.write_text("".join(json.dumps(run) + "\n" for run in runs))
    command = ["jensen", "--only", "integral", "--only", "samples", "--repeat", n, "--log", log]
    result = call(*command)
    assert result.exit_code == exit_code and f"0 of {n} runs raised an alarm" in result.stdout
    lines = {line.split(":")[0].strip(): line for line in result.stdout.splitlines()[1:]}
    assert {name for name, line in lines.items() if "FAILED" in line} == ({"samples"} if exit_code else set())
    found = json.loads(call(*command, "--json").stdout)
    assert found["passed"] == (exit_code == 0) and list(found["calibration"]) == ["all checks", "integral", "samples"]
    count = found["calibration"]["samples"]["below"]["0.1"]
    assert stats.binomtest(count, n, share).pvalue > 1e-3 and f"p < 0.1 in {count / n:.1%} and p < 0.01 in" in lines["samples"]


def test_a_logged_run_without_its_p_values_is_refused(tmp_path: Path) -> None:
    about = examination._about(suite.Subject({"type": "jensen"}), suite.named(["scale"]))
    log = tmp_path / "log.jsonl"
    for smallest in ({}, {"smallest": None}, {"smallest": {"scale": None}}):
        log.write_text(json.dumps({**about, "seed": 0, "passed": True, "p": 1.0, **smallest}))
        result = call("jensen", "--only", "scale", "--log", log)
        assert result.exit_code == 2 and "line 1 is broken" in result.stderr


@pytest.mark.parametrize(("arguments", "words"), [
    (["nosuch"], "unknown representation 'nosuch'"), (["jensen", "--only", "nosuch"], "unknown check 'nosuch'; known: density"),
    (["jensen", "--declare", "nosuch"], "--declare nosuch: must be one of constant, grows, coarse"),
    (["missing.py:Mine"], "there is no such file"), (["jensen", "--set", "representation.bins=3"], "no parameter 'bins'")])
def test_bad_input(arguments: list[str], words: str) -> None:
    result = call(*arguments)
    assert result.exit_code == 2 and words in result.stderr and len(result.stderr.splitlines()) == 1


def test_an_error_that_fails_several_checks_is_told_once() -> None:
    result = call(f"{MUTANTS}:FailsToRun", "--only", "density", "--only", "integral")
    assert result.exit_code == 1 and result.stdout.count("AttributeError") == 1
    assert "density, integral FAILED: AttributeError" in result.stdout


def test_errors_of_other_peoples_code_are_failures() -> None:
    outcome, = suite.run(suite.Subject({"type": f"{MUTANTS}:FailsToRun"}), suite.named(["purity"]))
    assert not outcome.verdict.passed and outcome.verdict.worst.startswith("AttributeError: ")
    assert "mutants.py:" in outcome.verdict.worst


def test_who_asks_for_too_much_memory_fails(tmp_path: Path) -> None:
    (tmp_path / "greedy.py").write_text("import numpy as np\nfrom representations.jensen import JensenHistogram\n\n"
                                        "class Greedy(JensenHistogram):\n    def update(self, state, batch, seed=0):\n"
                                        "        return super().update(state, batch, seed + len(np.zeros(1 << 50)))\n")
    result = call(f"{tmp_path}/greedy.py:Greedy", "--only", "scale", "--only", "purity", "--pictures", tmp_path)
    assert result.exit_code == 1 and "2 of 2 checks FAILED" in result.stdout
    assert "scale, purity FAILED: " in result.stdout and "MemoryError: Unable to allocate 8.00 PiB" in result.stdout
