"""Another process tries files: its death, its silence and its refusal are answers."""
from __future__ import annotations

import sys

import pytest

from olpm_bench.bench import other_process, probe
from olpm_bench.scenes import SceneError

CHILD = """
import json, os, sys, time
for line in sys.stdin:
    what, = json.loads(line)
    if what == "die": os.abort()
    if what == "hang": time.sleep(600)
    print(json.dumps({"refused": what}), flush=True)
"""


def test_a_process_that_dies_or_hangs_is_started_again():
    with other_process.Process([sys.executable, "-c", CHILD], seconds=5.0) as process:
        assert process.ask("no") == {"refused": "no"} and process.ask("still no") == {"refused": "still no"}
        assert process.starts == 1
        assert process.ask("die") == {"died": -6}
        assert process.ask("no") == {"refused": "no"} and process.starts == 2
        assert process.ask("hang") == {"hung": 5.0}
        assert process.process is None


def test_nothing_is_imported_from_the_folder_that_one_works_in(tmp_path, monkeypatch):
    """A downloaded scene may have a json.py beside it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)         # what it names is wanted, "." too
    (tmp_path / "json.py").write_text("open('was_run', 'w')")
    (tmp_path / "room.xml").write_text("<scene")
    with other_process.Process(probe.COMMAND) as process:
        assert "refused" in process.ask("room.xml", {})
    assert not (tmp_path / "was_run").exists()


@pytest.mark.parametrize("answer, message", [
    ({"died": -11}, r"room\.xml: Mitsuba crashes when it loads it \(SIGSEGV\)"), ({"died": 1}, r"room\.xml: .* \(exit code 1\)"),
    ({"hung": 900.0}, r"room\.xml: Mitsuba has not loaded it after 900 s"), ({"refused": "no such scene"}, "^no such scene$")])
def test_what_is_said_of_it(tmp_path, monkeypatch, answer, message):
    monkeypatch.setattr(other_process.Process, "ask", lambda *_: answer)
    (tmp_path / "room.xml").write_text("<scene/>")
    with pytest.raises(SceneError, match=message):
        probe.check(tmp_path / "room.xml", {})
