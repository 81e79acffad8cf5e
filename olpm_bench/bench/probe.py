"""Scene files are loaded by another process first: where that makes Mitsuba crash or hang, it is one line and not our end.

Mitsuba 3.9.1 is killed by a PLY whose faces name vertices that it has not, for one.  Nothing short of loading them tells such
files from others, so that a file is loaded twice, but only once in its life: a file that could be loaded is remembered by the
digest of all that it consists of, in `cache_folder`.
"""
from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from olpm_bench import scenes
from olpm_bench.bench import environment, other_process
from olpm_bench.bench.files import replacing
from olpm_bench.bench.progress import activity
from olpm_bench.scenes import SceneError, read_xml

if TYPE_CHECKING:
    from olpm_bench.scenes.stated import Stated

COMMAND = other_process.command("olpm_bench.bench.probe")
SMALL = 8, 6                # pixels of the image when a file is tried

_tried: dict[tuple[Any, ...], Stated] = {}          # by this process


def check(path: Path, overrides: dict[str, Any]) -> Stated:
    """What a scene file says of its image, when it has turned out that it can be loaded.

    Raises:
        SceneError: the file can't be loaded, or Mitsuba crashes or hangs when it loads it.
    """
    read_xml(path)                  # what is no XML at all needs no other process
    stat = path.stat()
    tried = str(path.resolve()), json.dumps(overrides, sort_keys=True, default=str), stat.st_mtime_ns, stat.st_size
    if tried not in _tried:
        _tried[tried] = _check(path, overrides)
    return _tried[tried]


def _check(path: Path, overrides: dict[str, Any]) -> Stated:
    remembered = _file_of(path, overrides)
    if remembered is not None and (said := _read(remembered)) is not None:
        return said
    with activity(f"loading {path.name} in another process, once for each version of the file"), \
            other_process.Process(COMMAND) as process:
        answer = process.ask(str(path), overrides)
    if "refused" in answer:
        raise SceneError(answer["refused"])
    if "hung" in answer:
        raise SceneError(f"scene file {path}: Mitsuba has not loaded it after {answer['hung']:.0f} s")
    if "died" in answer:
        raise SceneError(f"scene file {path}: Mitsuba crashes when it loads it ({other_process.end(answer)}): "
                         "one of its meshes or images may be broken")
    if "traceback" in answer:       # a bug, which loading it here shows in full
        load(str(path), overrides)
    if remembered is not None:
        with contextlib.suppress(OSError), replacing(remembered) as beside:       # then it is loaded twice the next time, too
            beside.write_text(json.dumps(answer["ok"]), encoding="utf-8")
    return _from_json(answer["ok"])


def load(path: str, overrides: dict[str, Any]) -> dict[str, Any]:
    """Load a scene file with a small film; what it says of its image, for JSON."""
    from olpm_bench.scenes.load import Parsed

    parsed = Parsed(Path(path), overrides)
    stated = parsed.stated
    parsed.build(min(stated.width, SMALL[0]), min(stated.height, SMALL[1]))
    return dataclasses.asdict(stated)


def cache_folder() -> Path | None:
    """Where is remembered which files could be loaded: OLPM_BENCH_CACHE, or a folder of the user's; None without a home."""
    if folder := os.environ.get("OLPM_BENCH_CACHE"):
        return Path(folder)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "olpm-bench"
    except RuntimeError:
        return None


def _file_of(path: Path, overrides: dict[str, Any]) -> Path | None:
    """The file that remembers that this scene file, as it is, can be loaded by this version of Mitsuba."""
    from olpm_bench.scenes.stated import Stated

    if (folder := cache_folder()) is None:
        return None
    fields = [f.name for f in dataclasses.fields(Stated)]
    key = [scenes.digest(path, overrides), importlib.metadata.version("mitsuba"), environment.wanted_variant(), fields]
    return folder / "scenes" / f"{hashlib.sha256(json.dumps(key).encode()).hexdigest()}.json"


def _read(file: Path) -> Stated | None:
    """What a file remembers; None: nothing, or it is broken."""
    try:
        return _from_json(json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _from_json(said: dict[str, Any]) -> Stated:
    from olpm_bench.scenes.stated import Stated

    pairs = {"film": tuple(said["film"]), "offset": tuple(said["offset"]), "replaced": [tuple(pair) for pair in said["replaced"]]}
    return Stated(**(said | pairs))


if __name__ == "__main__":
    other_process.serve(load)
