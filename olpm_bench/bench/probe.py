"""Scene files are loaded by another process first: where that makes Mitsuba crash or hang, it is one line and not our end.

Mitsuba 3.9.1 is killed by a PLY whose faces name vertices that it has not, for one.
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

from olpm_bench.bench import other_process
from olpm_bench.scenes import SceneError, read_xml

COMMAND = other_process.command("olpm_bench.bench.probe")


def check(path: Path, overrides: dict[str, Any]) -> None:
    """
    Raises:
        SceneError: the file can't be loaded, or Mitsuba crashes or hangs when it loads it.
    """
    read_xml(path)                  # what is no XML at all needs no other process
    with other_process.Process(COMMAND) as process:
        answer = process.ask(str(path), overrides)
    if "refused" in answer:
        raise SceneError(answer["refused"])
    if "hung" in answer:
        raise SceneError(f"scene file {path}: Mitsuba has not loaded it after {answer['hung']:.0f} s")
    if "died" in answer:
        raise SceneError(f"scene file {path}: Mitsuba crashes when it loads it ({other_process.end(answer)}): "
                         "one of its meshes or images may be broken")
    # a traceback is a bug, which the load that follows shows in full


def load(path: str, overrides: dict[str, Any]) -> None:
    """Load a scene file with a small film."""
    from olpm_bench.scenes import load as scene_load

    scene_load.load(Path(path), overrides, 8, 6)


if __name__ == "__main__":
    other_process.serve(load)
