"""Files that are whole or not there: written beside their place and renamed.  JSON without NaN, versions, digests."""
from __future__ import annotations

import functools
import hashlib
import json
import math
import os
import re
import shutil
import tempfile
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from olpm_bench.transport.settings import InputError

SCHEMA_VERSION = 1
LONGEST_NAME = 80       # of a folder
DEVICE = r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?"


class ResultError(InputError):
    """A result that is missing, broken, or of a newer schema; the message names the file and what to do."""


class NewerSchemaError(ResultError):
    """A file of a later version of olpm-bench: read by nobody here, and overwritten by nobody here."""


def slug(name: str) -> str:
    """A name as a folder: letters, digits, dot, dash and underscore, not too many, and none that Windows keeps for devices."""
    folder = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "unnamed"
    if re.fullmatch(DEVICE, folder, re.IGNORECASE):
        folder = f"_{folder}"
    if len(folder) > LONGEST_NAME:
        folder = f"{folder[:LONGEST_NAME - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return folder


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a path beside `path` to write to; it takes the place of `path` if the body succeeds, else it goes.

    Raises:
        OSError: cannot be written; it names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{writer()}.tmp{path.suffix}")
    try:
        yield beside
        os.replace(beside, path)
    except OSError as error:
        if error.filename in (None, str(beside), beside):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        clean_up(lambda: beside.unlink(missing_ok=True))


def clean_up(remove: Callable[[], None]) -> None:
    """Remove something, also if Ctrl-C comes in the middle."""
    try:
        remove()
    except KeyboardInterrupt:
        remove()
        raise


def check_writable(folder: Path) -> None:
    """
    Raises:
        OSError: no file can be made in the folder, e.g. as it is read-only; it names the folder.
    """
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None


@functools.cache
def here() -> dict[str, str]:
    """Whose process numbers are this process's: `boot`, one run of one machine; `numbers`, its own ones, as a container has."""
    try:
        return {"boot": Path("/proc/sys/kernel/random/boot_id").read_text().strip(), "numbers": os.readlink("/proc/self/ns/pid")}
    except OSError:             # not on Linux
        return {"boot": f"{uuid.getnode():x}", "numbers": ""}


def require_inside(folder: Path, root: Path) -> None:
    """
    Raises:
        ResultError: a link on the way from `root` to `folder` leads out of it; nothing is written there.
    """
    if not Path(found := os.path.realpath(folder)).is_relative_to(os.path.realpath(root)):
        raise ResultError(f"{folder} is {found}, by a link that leads out of {root}: nothing is written there")


def writer() -> str:
    """Who writes, in the names of unfinished files."""
    return f"{digest(*(part.encode() for part in here().values()))}-{os.getpid()}"


def remove_path(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def digest(*content: bytes) -> str:
    found = hashlib.sha256()
    for part in content:
        found.update(part)
    return found.hexdigest()[:16]


def write_text(path: Path, text: str) -> None:
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: NumPy scalars become Python's, NaN and infinity become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)


def write_json(path: Path, value: Any) -> None:
    write_text(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object of ours.

    Raises:
        ResultError: missing or broken.
        NewerSchemaError: written by a later version.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultError(f"{path}: there is no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ResultError(f"{path} is broken: {error}") from None
    if not isinstance(value, dict):
        raise ResultError(f"{path} is broken: not a JSON object")
    check_schema(path, value.get("schema_version"))
    return value


def check_schema(path: Path, version: Any) -> None:
    """
    Raises:
        ResultError: no version; NewerSchemaError: a newer one than ours.
    """
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise ResultError(f"{path}: schema_version = {version!r}; known: 1 to {SCHEMA_VERSION}")
    if version > SCHEMA_VERSION:
        raise NewerSchemaError(f"{path}: schema_version = {version} is newer than this olpm-bench, which reads up to "
                               f"{SCHEMA_VERSION}; update it, or use another --results folder")
