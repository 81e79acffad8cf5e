"""Who is at work on a cell or a reference: a file `lock` in its folder, that no crash and no step of a clock leaves behind."""
from __future__ import annotations

import json
import math
import os
import re
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from olpm_bench.bench.files import ResultError, clean_up, here, remove_path, writer

LEASE = 1800.0          # [s] without a sign of life after which a lock or an unfinished file counts as left behind
BEAT = 30.0             # [s] between signs of life, at least
MACHINE_ID = Path("/etc/machine-id")
UNFINISHED = re.compile(r"\..+\.([0-9a-f]+)-(\d+)\.tmp(?:\.\w+)?")     # by `writer`


class LockedError(ResultError):
    """Another process is at work on the cell or reference."""


class Alive(Protocol):
    """A sign of life of who holds a lock, to be given now and then; `at_once` also if the last was a moment ago.

    Raises:
        LockedError: the lock is lost.
    """
    def __call__(self, at_once: bool = False) -> None: ...


@contextmanager
def locked(folder: Path) -> Iterator[Alive]:
    """Hold a folder (of a cell or a reference) while the body runs, by a file `lock` in it.

    Yields what gives signs of life: before the body writes a result it does so at once, as the folder may be another's by then.

    The lock of a process of this host that no longer lives is taken over, and any after half an hour without a sign of life;
    unfinished files are removed.

    Raises:
        LockedError: another process holds it, or has taken it over.
    """
    path = folder / "lock"
    folder.mkdir(parents=True, exist_ok=True)
    me, last = _acquire(path), time.monotonic()

    def is_mine() -> bool:
        try:
            return _read_lock(path) == me
        except FileNotFoundError:
            return False

    def check() -> None:
        if not is_mine():
            raise LockedError(f"{path} was lost to another process, after {time.monotonic() - last:.0f} s without a sign of life")

    def alive(at_once: bool = False) -> None:
        nonlocal last
        if not at_once and time.monotonic() - last < BEAT:
            return
        check()
        with path.open("r+b") as file:          # in place, and of the same length: needs no room on the disk
            file.write(_signed(me))
        last = time.monotonic()

    try:
        for left in folder.glob(".*.tmp*"):
            if not left.name.startswith(".lock."):      # others may be asking for the lock right now
                remove_path(left)
        remove_unfinished(folder)
        yield alive
    except OSError:
        check()                     # an unfinished file may have gone with the lock
        raise
    finally:
        clean_up(lambda: path.unlink(missing_ok=True) if is_mine() else None)


def tidy(folder: Path) -> None:
    """Remove lock and unfinished files of a process that was killed when its work was done."""
    if (folder / "lock").exists() or any(folder.glob(".*.tmp*")):
        with suppress(LockedError), locked(folder):
            pass


def _identity() -> dict[str, Any]:
    """This process.  `machine` tells apart those of one name; it is empty where there is no telling."""
    try:
        machine = MACHINE_ID.read_text().strip()
    except OSError:             # not on Linux, or in a container
        machine = ""
    return {"pid": os.getpid(), "started": _started(os.getpid()), "host": socket.gethostname(), "machine": machine, **here()}


def _started(pid: int) -> float | None:
    """When a process was started [s], by a clock that nobody sets where there is one; None if it has ended."""
    try:
        state, *fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if state in "ZX" else int(fields[18]) / os.sysconf("SC_CLK_TCK")
    except (FileNotFoundError, ProcessLookupError):
        import psutil
        try:
            return None if Path("/proc/self/stat").exists() else psutil.Process(pid).create_time()
        except psutil.Error:
            return None


def _signed(owner: dict[str, Any]) -> bytes:
    """What a lock says: its owner, and the last sign of life [s] by the clock of all processes since the machine started."""
    return json.dumps({**owner, "alive": f"{time.monotonic():020.3f}"}).encode()


def _read_lock(path: Path, alive: bool = False) -> dict[str, Any]:
    """The owner of a lock, with or without the last sign of life; {} if it says nothing.

    Raises:
        FileNotFoundError: nobody's.
    """
    content = path.read_bytes()
    try:
        owner = json.loads(content or b"{}")
        return {key: value for key, value in owner.items() if alive or key != "alive"}
    except (ValueError, AttributeError):
        return {"unreadable": content}


def _silence(owner: dict[str, Any], path: Path) -> float:
    """Seconds since a lock's last sign of life; infinite if its owner has ended.

    On one machine nobody's clock counts but the one that cannot be set; between machines, that of the file system.
    """
    me = _identity()
    with suppress(KeyError, TypeError, ValueError):     # of another version
        if owner["boot"] == me["boot"]:
            if owner["numbers"] == me["numbers"] and _started(owner["pid"]) != owner["started"]:
                return math.inf                         # also if another process has its number now
            return time.monotonic() - float(owner["alive"])
        if me["machine"] and all(owner[name] == me[name] for name in ("machine", "host", "numbers")):
            return math.inf                             # the machine was started again
    return _age(path)


def _age(path: Path) -> float:
    """Seconds since a file was written, by the clock of its file system."""
    with tempfile.TemporaryFile(dir=path.parent, prefix=".now.", suffix=".tmp") as now:
        return abs(os.fstat(now.fileno()).st_mtime - path.stat().st_mtime)      # set back, it may be in the future


def silence(folder: Path) -> float | None:
    """Seconds since the last sign of life of who holds a folder, infinite if that process has ended; None if nobody does."""
    try:
        return _silence(_read_lock(folder / "lock", alive=True), folder / "lock")
    except FileNotFoundError:
        return None


def _acquire(path: Path) -> dict[str, Any]:
    """Create the lock; return its owner, this process."""
    me = _identity()
    for _ in range(3):
        if _create(path, _signed(me)):
            return me
        with suppress(FileNotFoundError):               # released meanwhile, or another was faster
            owner = _read_lock(path, alive=True)
            silent = _silence(owner, path)
            if silent <= LEASE:
                who = f"process {owner['pid']} on {owner['host']}" if {"pid", "host"} <= owner.keys() else "somebody unknown"
                raise LockedError(f"{path} is held by {who}, whose last sign of life was {silent:.0f} s ago; "
                                  f"after {LEASE / 60:.0f} minutes without one it is taken over")
            aside = _beside(path)
            os.rename(path, aside)                      # one of those who try this succeeds
            if _read_lock(aside, alive=True) != owner:  # it lives, or another was faster: put back what was moved
                with suppress(OSError):
                    _link(aside, path)
            aside.unlink(missing_ok=True)
    raise LockedError(f"{path} is contended")


def _beside(path: Path) -> Path:
    return path.with_name(f".lock.{writer()}.tmp")


def _create(path: Path, content: bytes) -> bool:
    """Create a lock that is signed from the first moment on; False if there is one."""
    beside, made = _beside(path), False
    try:
        beside.unlink(missing_ok=True)      # of who had our number: another name of its lock
        beside.write_bytes(content)
        _link(beside, path)
        made = True
        beside.unlink()
    except BaseException as error:          # a full disk, Ctrl-C
        for left in (beside, path) if made else (beside,):
            with suppress(OSError):
                clean_up(partial(remove_path, left))
        if isinstance(error, FileExistsError):
            return False
        if isinstance(error, OSError):
            error.filename, error.filename2 = str(path), None
        raise
    return True


def _link(source: Path, path: Path) -> None:
    """Give a file another name; where a file system has no hard links, a copy, which for a moment is empty.

    Raises:
        FileExistsError: the name is taken.
    """
    try:
        os.link(source, path)
    except FileExistsError:
        raise
    except OSError:
        with path.open("xb") as file:
            try:
                file.write(source.read_bytes())
                file.flush()
            except BaseException:           # a full disk, Ctrl-C
                path.unlink(missing_ok=True)
                raise


def remove_unfinished(folder: Path) -> None:
    """Remove the unfinished files in a folder whose writers are gone."""
    for left in folder.glob(".*.tmp*"):
        with suppress(FileNotFoundError):
            if _is_left(left):
                remove_path(left)


def _is_left(path: Path) -> bool:
    """Whether an unfinished file's writer has ended, or is silent for half an hour.

    Raises:
        FileNotFoundError: it is gone.
    """
    if (found := UNFINISHED.fullmatch(path.name)) is None:
        return False                # not one of ours
    who, pid = found.groups()
    return (writer() == f"{who}-{os.getpid()}" and _started(int(pid)) is None) or _age(path) > LEASE
