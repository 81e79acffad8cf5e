"""Locks: one holder, who is followed when dead or silent for long, and notices when a lock is lost."""
from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import pytest

from olpm_bench.bench import lock
from olpm_bench.bench.lock import LockedError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def machine(tmp_path_factory, monkeypatch):
    """Containers have no machine-id."""
    (path := tmp_path_factory.mktemp("etc") / "machine-id").write_text("0123\n")
    monkeypatch.setattr(lock, "MACHINE_ID", path)


def owner(**changes) -> str:
    return json.dumps({**json.loads(lock._signed(lock._identity())), **changes})


def silent(seconds: float) -> str:
    return f"{time.monotonic() - seconds:020.3f}"


def dead_pid() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def without_links(*names):
    raise PermissionError(1, "Operation not permitted", *names)


@pytest.mark.parametrize("links", [True, False])
def test_a_lock_is_held_by_one(tmp_path, monkeypatch, links):
    if not links:
        monkeypatch.setattr(os, "link", without_links)
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


@pytest.mark.parametrize("text", [
    lambda silence: owner(host="elsewhere", machine="4567", boot="another", pid=1), lambda silence: "not JSON",
    lambda silence: owner(alive=silent(silence)), lambda silence: owner(numbers="a container's", pid=1, alive=silent(silence)),
    lambda silence: owner(machine="4567", boot="another", pid=1),
    lambda silence: owner(numbers="a container's", boot="another", pid=1), lambda silence: "",
], ids=["another host", "unreadable", "hangs here", "hangs in a container", "another host of our name",
        "a container elsewhere, or of before a restart", "killed where there are no hard links"])
def test_the_lock_of_the_silent_is_taken_over(tmp_path, text):
    path, age = tmp_path / "lock", lock.LEASE
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


@pytest.mark.parametrize("text", [lambda: owner(host="elsewhere", boot="another", pid=1), lambda: "not JSON",
                                  lambda: owner(machine="", boot="another", pid=1)],
                         ids=["another host", "unreadable", "a host of our name that cannot be told apart"])
def test_other_locks_are_respected(tmp_path, text):
    lock.MACHINE_ID.write_text("")
    (tmp_path / "lock").write_text(written := text())
    with pytest.raises(LockedError), lock.locked(tmp_path):
        pass
    assert (tmp_path / "lock").read_text() == written


# ---------------------------------------------------------------- at the same time, and killed

def of(pid: int) -> str:
    """`files.writer()` of another process of this machine."""
    return lock.writer().replace(f"-{os.getpid()}", f"-{pid}")


def test_who_asks_for_a_lock_is_left_alone_while_it_lives(tmp_path):
    """What it has moved aside may be the new holder's lock, which it puts back."""
    living, dead = (tmp_path / f".lock.{of(pid)}.tmp" for pid in (os.getppid(), dead_pid()))
    living.touch()
    dead.touch()
    with lock.locked(tmp_path):
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted([living.name, "lock"])
    os.utime(living, (time.time() - 2 * lock.LEASE,) * 2)
    lock.tidy(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("gone", [False, True], ids=["put back", "and it is gone"])
@pytest.mark.parametrize("links", [True, False])
def test_two_take_over_a_lock_at_once(tmp_path, monkeypatch, links, gone):
    """Another process has taken it over, between our look at it and our renaming."""
    path, rename, fresh = tmp_path / "lock", os.rename, owner(pid=os.getppid(), started=lock._started(os.getppid()))
    path.write_text(owner(pid=dead_pid()))

    def late(source, target):
        path.write_text(fresh)
        rename(source, target)
        if gone:
            os.unlink(target)
    monkeypatch.setattr(os, "rename", late)
    if not links:
        monkeypatch.setattr(os, "link", without_links)
    if gone:
        with lock.locked(tmp_path):
            assert json.loads(path.read_text())["pid"] == os.getpid()
    else:
        with pytest.raises(LockedError, match=f"held by process {os.getppid()} "), lock.locked(tmp_path):
            pass
        assert path.read_text() == fresh
    assert [file.name for file in tmp_path.iterdir()] == ["lock"] * (not gone)


KILLED = """
import os, sys
from pathlib import Path
import killed
from olpm_bench.bench import lock

folder = Path(sys.argv[1]) / "cell"
sys.addaudithook(killed.event)
for n in range(1, 100):
    if (child := os.fork()) == 0:
        killed.seen, killed.at = 0, n
        with lock.locked(folder) as alive:
            alive(at_once=True)
        os._exit(0)
    status = os.waitpid(child, 0)[1]
    with lock.locked(folder):
        pass
    assert os.listdir(folder) == [], os.listdir(folder)
    if status == 0:
        break
print(n)
"""


def test_who_is_killed_between_two_writes_of_a_lock_is_followed_at_once(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), "0", "-"], text=True, capture_output=True, timeout=300,
                          env={**os.environ, "PYTHONPATH": f"{ROOT}:{Path(__file__).parent}"})
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 6
