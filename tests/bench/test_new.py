"""What `olpm-bench new` writes runs as it is; and the examples of the help are commands that there are."""
from __future__ import annotations

import re
import shlex

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import representations
from olpm_bench.bench import new
from olpm_bench.check import suite
from olpm_bench.check.particles import batch, equal, lobes, nothing
from olpm_bench.cli import app
from olpm_bench.examples import EXAMPLES, FIRST


def call(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_a_new_experiment_passes_a_dry_run_at_both_of_its_scales(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written = call("new", "experiment", "first-try")
    assert written.exit_code == 0 and "next: olpm-bench run first-try.toml" in written.stdout
    for scale in ([], ["--scale", "small"]):
        dry = call("run", "first-try.toml", *scale, "--dry-run")
        assert dry.exit_code == 0 and "4 of 4 cells to run" in dry.stdout, dry.output
    text = (tmp_path / "first-try.toml").read_text()
    assert "NAME" not in text
    # What is commented out is right, too, but for another's reference and the file of one's own representation.
    call("new", "representation", "mine")
    text = text.replace('# reference = "none"', 'reference = "none"')
    text = re.sub(r"^# (\[\[method|name = |representation = |sweep = )", r"\1", text, flags=re.MULTILINE)
    (tmp_path / "all.toml").write_text(text)
    dry = call("run", "all.toml", "--dry-run")
    assert dry.exit_code == 0 and "Mine / seed 1" in dry.stdout and "Hey, photons 200k / seed 0" in dry.stdout, dry.output


def test_a_new_representation_loads_learns_and_samples(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written = call("new", "representation", "my_lobes.py")
    assert written.exit_code == 0 and "next: olpm-bench check my_lobes.py:MyLobes" in written.stdout
    assert not re.search("NAME|Example", (tmp_path / "my_lobes.py").read_text())
    mine = representations.create("my_lobes.py:MyLobes", resolution=4)
    n = 5000
    state = mine.update(mine.init(2), batch([equal(lobes(n, np.random.default_rng(1))), nothing()]))
    rng = mi.PCG32(n)
    wo, pdf = mine.sample(state, dr.zeros(mi.UInt32, n), rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()))
    assert dr.all(pdf > 0) and dr.allclose(pdf, mine.pdf(state, dr.zeros(mi.UInt32, n), wo))
    fresh = mine.pdf(state, dr.full(mi.UInt32, 1, n), wo)                   # it has learnt, the other record has not
    assert dr.allclose(fresh, wo.z / dr.pi) and dr.mean(dr.log(pdf))[0] > dr.mean(dr.log(fresh))[0] + 0.1


@pytest.mark.slow
def test_a_new_representation_passes_every_check(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = new.new("representation", "mine")
    subject = suite.Subject({"type": f"{path}:Mine"}, 0)
    assert [outcome for outcome in suite.run(subject) if not outcome.verdict.passed] == []


@pytest.mark.parametrize("kind, name, words", [
    ("experimet", "a", "must be one of experiment, representation; did you mean 'experiment'?"),
    ("experiment", "../a", "its name must be of letters, digits, - and _"),
    ("experiment", "references", "not 'references'"),
    ("representation", "my-lobes", "its name must be of a-z, digits and _"),
    ("representation", "1", "its name must be of a-z, digits and _")])
def test_names_that_cannot_be(tmp_path, monkeypatch, kind, name, words):
    monkeypatch.chdir(tmp_path)
    result = call("new", kind, name)
    assert result.exit_code == 2 and words in result.stderr and not list(tmp_path.iterdir())


def test_nothing_is_written_over(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("precious")
    result = call("new", "representation", "mine")
    assert result.exit_code == 2 and result.stderr == "olpm-bench: mine.py: File exists\n"
    assert (tmp_path / "mine.py").read_text() == "precious"


COMMANDS = typer.main.get_command(app).commands


def test_every_command_has_examples():
    assert set(EXAMPLES) == set(COMMANDS)


@pytest.mark.parametrize("example", [*(e for examples in EXAMPLES.values() for e in examples), *FIRST[:-1]])
def test_examples_are_commands_that_there_are(example):
    name, *arguments = shlex.split(example)
    COMMANDS[name].make_context(name, arguments).close()            # parsed, not run
    assert f"  olpm-bench {example}\n" in call(*([name] if example in EXAMPLES[name] else []), "--help").stdout
