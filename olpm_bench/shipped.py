"""The experiments and references that come with olpm-bench: in a clone in its top folders, installed in its package."""
from __future__ import annotations

from pathlib import Path

PACKAGE = Path(__file__).parent
IN_A_CLONE = {"experiments": PACKAGE.parent / "experiments", "references": PACKAGE.parent / "results" / "references"}
EXPERIMENTS = "experiments"         # the folder of experiments, of a clone and of whoever writes their own


def folder(name: str) -> Path:
    """The folder "experiments" or "references" that comes with this copy of olpm-bench."""
    packaged = PACKAGE / name
    return packaged if packaged.is_dir() else IN_A_CLONE[name]


def experiments() -> dict[str, Path]:
    """Name -> file of every experiment that comes with olpm-bench."""
    return {file.stem: file for file in sorted(folder("experiments").glob("*.toml"))}


def experiment_file(path: Path) -> Path:
    """The experiment file that a command line means by `path`: that file, or what is there of that name.

    ``quickstart``, ``quickstart.toml`` and ``experiments/quickstart.toml`` all name an experiment, which is looked for in the
    folder ``experiments`` and then among those that come with olpm-bench.  What names none is returned as it is.
    """
    if path.exists() or path.suffix not in ("", ".toml") or path.parent not in (Path(), Path(EXPERIMENTS)):
        return path
    own = Path(EXPERIMENTS) / f"{path.stem}.toml"
    return own if own.is_file() else experiments().get(path.stem, path)


def named(path: Path) -> str:
    """How a command line names an experiment file: by its name alone if it comes with olpm-bench and lies elsewhere."""
    return path.stem if path.is_absolute() and path == experiments().get(path.stem) else str(path)
