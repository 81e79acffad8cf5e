"""What there is, as `olpm-bench list` shows it: scenes, representations with their parameters, and experiments."""
from __future__ import annotations

import inspect
import tomllib
from collections.abc import Iterator
from pathlib import Path

import representations
from olpm_bench import scenes, shipped
from olpm_bench.bench.terminal import one_line


def lines() -> Iterator[str]:
    """All of it, a line each."""
    yield "Scenes"
    for name, description in scenes.names().items():
        given = ", ".join(f"{k} = {v}" for k, v in scenes.parameters(name).items())
        yield f"  {name}: {description}{f'  ({given})' if given else ''}"
    yield "  or any Mitsuba XML"
    yield "Representations"
    for name in representations.names():
        yield from _representation(name)
    yield "  or path/to/file.py:ClassName"
    yield "Experiments"
    own = sorted(Path(shipped.EXPERIMENTS).glob("*.toml"))
    for file in own:
        yield one_line(f"  {file}: {_title(file)}")
    for name, file in shipped.experiments().items():
        if name not in {file.stem for file in own}:
            yield one_line(f"  {name}: {_title(file)}")


def _representation(name: str) -> Iterator[str]:
    """Its name with the first line of what it says of itself, and each parameter with type and default."""
    try:
        cls = representations.find(name)
        parameters = representations.parameters_of(cls)
    except (representations.RepresentationError, TypeError, ValueError) as error:
        yield one_line(f"  {name}: cannot be used: {error}")
        return
    description = (inspect.getdoc(cls) or "").partition("\n")[0]
    yield one_line(f"  {name}: {description}")
    for name, parameter in parameters.items():
        kind = parameter.annotation if isinstance(parameter.annotation, str) else type(parameter.default).__name__
        yield one_line(f"    {name}: {kind}{'' if parameter.default is parameter.empty else f' = {parameter.default!r}'}")


def _title(file: Path) -> str:
    try:
        return str(tomllib.loads(file.read_text(encoding="utf-8")).get("title", ""))
    except (OSError, ValueError, RecursionError) as error:
        return f"cannot be read: {error}"
