"""Locks: one holder, who is followed when dead or silent for long, and notices when a lock is lost."""
from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import nullcontext

import pytest

from olpm_bench.bench import lock
from olpm_bench.bench.lock import LockedError


def owner(**changes) -> str:
    return json.dumps({**json.loads(lock._signed(lock._identity())), **changes})


def silent(seconds: float) -> str:
    return f"{time.monotonic() - seconds:020.3f}"


def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_lock_is_held_by_one(tmp_path):
    with lock.locked(tmp_path / "cell"):
        with pytest.raises(LockedError, match=f"held by process {os.getpid()}"), lock.locked(tmp_path / "cell"):
            pass
        assert (tmp_path / "cell" / "lock").exists()
    assert not (tmp_path / "cell" / "lock").exists()
    with pytest.raises(KeyError), lock.locked(tmp_path / "cell"):
        raise KeyError
    assert list((tmp_path / "cell").iterdir()) == []


@pytest.mark.parametrize("stale", [lambda: owner(pid=dead_pid()), lambda: owner(started=1.0), lambda: owner(boot="another")],
                         ids=["dead", "reused number", "before the machine was started again"])
def test_the_lock_of_the_dead_is_taken_over(tmp_path, stale):
    (tmp_path / "lock").write_text(stale())
    (tmp_path / ".image.exr.host-1.tmp.exr").write_text("half an ima")
    (tmp_path / ".cell.host-1.tmp").mkdir()
    (tmp_path / ".cell.host-1.tmp" / "image.exr").write_text("an image")
    with lock.locked(tmp_path):
        assert json.loads((tmp_path / "lock").read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text, age", [
    (lambda silence: owner(host="elsewhere", pid=1), lock.LEASE), (lambda silence: "not JSON", lock.LEASE),
    (lambda silence: owner(alive=silent(silence)), lock.LEASE),
    (lambda silence: owner(numbers="a container's", pid=1, alive=silent(silence)), lock.LEASE),
    (lambda silence: "", lock.SIGNING),
], ids=["another host", "unreadable", "hangs here", "hangs in a container", "killed before it had signed"])
def test_the_lock_of_the_silent_is_taken_over(tmp_path, text, age):
    path = tmp_path / "lock"
    path.write_text(text(age / 2))
    os.utime(path, (time.time() - age / 2,) * 2)
    with pytest.raises(LockedError, match=rf"last sign of life was {age / 2:.0f} s ago; after 30 minutes"), lock.locked(tmp_path):
        pass
    path.write_text(text(2 * age))
    os.utime(path, (time.time() - 2 * age,) * 2)
    with lock.locked(tmp_path):
        assert json.loads(path.read_text())["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error, seen", [(None, None), (FileNotFoundError("it went with the lock"), LockedError)])
def test_who_has_lost_a_lock_notices(tmp_path, monkeypatch, error, seen):
    path = tmp_path / "lock"
    with pytest.raises(seen) if seen else nullcontext(), lock.locked(tmp_path) as alive:
        before = json.loads(path.read_text())["alive"]
        alive()
        assert json.loads(path.read_text())["alive"] == before          # half a minute has not passed
        time.sleep(0.002)
        alive(at_once=True)
        assert json.loads(path.read_text())["alive"] > before
        path.write_text(owner(pid=1))                                   # of the thief
        for again in range(2):
            monkeypatch.setattr(lock, "BEAT", 0)
            with pytest.raises(LockedError, match="was lost to another process"):
                alive(at_once=not again)
        if error:
            raise error
    assert json.loads(path.read_text())["pid"] == 1


@pytest.mark.parametrize("text", [lambda: owner(host="elsewhere", pid=1), lambda: "not JSON"],
                         ids=["another host", "unreadable"])
def test_other_locks_are_respected(tmp_path, text):
    (tmp_path / "lock").write_text(written := text())
    with pytest.raises(LockedError), lock.locked(tmp_path):
        pass
    assert (tmp_path / "lock").read_text() == written
