"""Files to begin with: an experiment, or a representation, made from `olpm_bench.templates`."""
from __future__ import annotations

import re
from pathlib import Path

from olpm_bench.bench.config import ConfigError
from olpm_bench.suggest import closest

TEMPLATES = Path(__file__).parents[1] / "templates"
KINDS = {"experiment": "experiment.toml", "representation": "representation.py"}


def new(kind: str, name: str) -> Path:
    """Write NAME.toml or NAME.py into the current folder.

    Args:
        kind: one of `KINDS`.
        name: letters, digits and underscores; of an experiment also dashes.

    Raises:
        ConfigError: another kind or name.
        FileExistsError, OSError: there is such a file; it cannot be written.
    """
    if kind not in KINDS:
        raise ConfigError(f"new {kind}: must be one of {', '.join(KINDS)}{closest(kind, KINDS)}")
    template = TEMPLATES / KINDS[kind]
    stem = name.removesuffix(template.suffix)
    allowed, words = (r"\w[\w-]*", "letters, digits, - and _") if kind == "experiment" else (r"[a-z]\w*", "a-z, digits and _")
    if not re.fullmatch(allowed, stem, re.ASCII) or stem == "references":
        raise ConfigError(f"new {kind} {name}: its name must be of {words}, and not 'references'")
    path = Path(f"{stem}{template.suffix}")
    with path.open("x", encoding="utf-8") as file:
        file.write(template.read_text(encoding="utf-8").replace("NAME", stem).replace("Example", class_name(stem)))
    return path


def class_name(stem: str) -> str:
    """my_lobes -> MyLobes."""
    return "".join(word.capitalize() for word in stem.split("_"))


def next_step(kind: str, path: Path) -> str:
    """The command that the file is for."""
    return f"olpm-bench run {path}" if kind == "experiment" else f"olpm-bench check {path}:{class_name(path.stem)}"
