"""Experiment files are read here: TOML -> :class:`olpm_bench.bench.config.Experiment`, or one line that says what is wrong.

Paths become absolute, sweeps and presets are replaced by what they stand for, and every name in the file is looked up.
Nothing is rendered, no scene is loaded, and no code is run but that of a representation FILE.py:Class, which is announced.
"""
from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

import representations
from olpm_bench import scenes as embedded
from olpm_bench import shipped
from olpm_bench.bench.config import (
    NO_REFERENCE,
    Budget,
    Claim,
    ConfigError,
    Experiment,
    Method,
    Scene,
    SweepFigure,
    looks_of,
)
from olpm_bench.bench.scale import scaled
from olpm_bench.bench.sweep import expanded
from olpm_bench.bench.terminal import one_line
from olpm_bench.suggest import closest
from olpm_bench.transport.settings import InputError, IntegratorSettings, TrainingSettings, preset_of

TABLES = {"budget": Budget, "scene": Scene, "method": Method, "claim": Claim, "sweep": SweepFigure,
          "integrator": IntegratorSettings, "training": TrainingSettings}
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
RESERVED = "references"         # the folder beside those of experiments
TOO_DEEP = "has tables or lists inside each other more deeply than can be read"


def load(path: Path | str, scenes: dict[str, Path] | None = None, scale: str | None = None) -> Experiment:
    """Read and check an experiment file.

    Args:
        path: the TOML; the paths in it are relative to its folder.
        scenes: name of a scene of the file -> XML to use in its place.
        scale: one of the file's scales; as the file stands by default.

    Raises:
        ConfigError: anything wrong with the file, with the files it names, or with `scenes`.
    """
    path = Path(path)
    if path.stem.strip(".").lower() in ("", RESERVED):
        raise ConfigError(f"experiment file {path}: its results would go to the folder {path.stem!r}; give it another name")
    try:
        if path.exists() and not path.is_file():
            raise OSError("no regular file")        # some never end
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"experiment file {path}: there is no such file{closest(path.stem, shipped.experiments())}") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"experiment file {path}: cannot be read: {error}") from None
    try:
        data = tomllib.loads(text)
    except ValueError as error:             # an integer of more than 4,300 digits is none of tomllib's own errors
        raise ConfigError(f"{path.name} is not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError(f"{path.name} {TOO_DEEP}") from None
    source, whole = path.name, data
    if scale is not None:
        try:
            data, source = scaled(data, scale, source), f"{source} --scale {scale}"
        except InputError as error:
            raise ConfigError(str(error)) from None
    experiment = parse(data, source, path.parent, scenes or {})
    if scale is not None:
        experiment = experiment.looking_as(_looks(whole))
    experiment._path, experiment._scale, experiment._scenes = path, scale, dict(scenes or {})
    return experiment


def _looks(whole: dict[str, Any]) -> dict[str, int]:
    """How the methods of a file look at its full scale, as far as that is right there."""
    try:
        methods = list(_tables(_without_sweeps(whole).get("method")))
    except InputError:
        return {}
    named = []
    for method in methods:
        series, look = method.get("series"), method.get("look")
        named.append((str(method.get("name")), str(series.get("name")) if isinstance(series, dict) else None,
                      look if isinstance(look, int) else None))
    return looks_of(named)


def parse(data: dict[str, Any], source: str, folder: Path, scenes: dict[str, Path] | None = None) -> Experiment:
    """Check what a TOML holds; `source` names it in messages, `folder` is what its paths are relative to.

    Args:
        scenes: as for :func:`load`; None where there is no option that replaces them.

    Raises:
        ConfigError: as :func:`load`.
    """
    try:
        data = _without_paths(data, folder, source)
        _replace_scenes(data, scenes or {}, source)
        data = _without_presets(_without_sweeps(data))
        # As JSON, because there strict means strict and still turns objects into dataclasses.
        experiment = Experiment.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        raise ConfigError(_explain(error, source)) from None
    except ConfigError:
        raise
    except InputError as error:
        raise ConfigError(f"{source}: {error}") from None
    except RecursionError:
        raise ConfigError(f"{source} {TOO_DEEP}") from None
    for scene in experiment.scene:
        _check_scene(scene, source, replaceable=scenes is not None)
    classes: dict[str, Any] = {}            # a sweep has one class: its file is run once
    for method in experiment.method:
        if (name := method.representation_name) is None:
            continue
        announce(name)
        try:
            if name not in classes:
                classes[name] = representations.find(name)
            representations.instance(classes[name], name, method.representation_parameters)
        except representations.RepresentationError as error:
            raise ConfigError(f"{source} [[method]] {method.name!r}: {error}") from None
    return experiment


@functools.cache
def announce(representation: str) -> None:
    """Say on the terminal, once, that code is run which is not ours: that of FILE.py:Class."""
    found = representations.file_of(representation)
    if found is not None and found[0].is_file():
        print(one_line(f"olpm-bench: runs the code of {found[0]}"), file=sys.stderr)


def _without_paths(data: dict[str, Any], folder: Path, source: str) -> dict[str, Any]:
    """A copy of `data` in which every path is absolute.

    Raises:
        ConfigError: a path that no file can have.
    """
    def absolute(path: str) -> str:
        try:
            found = (folder / path).resolve()
            found.exists()              # a name that is too long is noticed here
            return str(found)
        except (OSError, ValueError, RuntimeError) as error:        # a NUL; links in a circle
            raise ConfigError(f"{source}: {path!r} is no path: {getattr(error, 'strerror', None) or error}") from None

    data = json.loads(json.dumps(data, default=str))
    for scene in _tables(data.get("scene")):
        for key in ("file", "reference"):
            if isinstance(scene.get(key), str) and (key, scene[key]) != ("reference", str(NO_REFERENCE)):
                scene[key] = absolute(scene[key])
    for method in _tables(data.get("method")):
        representation = method.get("representation")
        kind = representation.get("type") if isinstance(representation, dict) else None
        if isinstance(representation, dict) and isinstance(kind, str) and (found := representations.file_of(kind)) is not None:
            representation["type"] = f"{absolute(str(found[0]))}:{found[1]}"
    return data


def _tables(value: Any) -> Iterator[dict[str, Any]]:
    return (table for table in (value if isinstance(value, list) else []) if isinstance(table, dict))


def _replace_scenes(data: dict[str, Any], scenes: dict[str, Path], source: str) -> None:
    known = {str(table.get("name")): table for table in _tables(data.get("scene"))}
    for name, file in scenes.items():
        if name not in known:
            raise ConfigError(f"--scene {name}={file}: no scene '{name}' in {source}; "
                              f"known: {', '.join(known)}{closest(name, known)}")
        known[name]["file"] = str(Path(file).resolve())


def _check_scene(scene: Scene, source: str, replaceable: bool) -> None:
    where = f"{source} [[scene]] {scene.name!r}"
    hint = f"; --scene {shlex.quote(scene.name)}=PATH points it elsewhere" if replaceable else ""
    if scene.file is not None:
        if not scene.file.is_file():
            raise ConfigError(f"{where}: file {scene.file}: there is no such file{hint}")
        if scene.parameters:
            raise ConfigError(f"{where}: parameters belong to embedded scenes; a file takes overrides")
    else:
        known = embedded.names()
        if scene.name not in known:
            raise ConfigError(f"{where}: unknown scene; known: {', '.join(known)}, or give file = \"scene.xml\""
                              + closest(scene.name, known))
        if scene.overrides:
            raise ConfigError(f"{where}: overrides belong to files; an embedded scene takes parameters")
        try:
            embedded.resolve(scene.name, scene.parameters)
        except embedded.SceneError as error:
            raise ConfigError(f"{where}: {error}") from None
    if scene.reference is not None and scene.has_reference and not scene.reference.exists():
        raise ConfigError(f"{where}: reference {scene.reference}: there is no such file or folder; \"none\" does without")


def _without_sweeps(data: dict[str, Any]) -> dict[str, Any]:
    """The experiment with every method that sweeps a setting replaced by the methods that it stands for.

    Raises:
        InputError: by `sweep.expanded`, or a name that is also that of another method.
    """
    methods = data.get("method")
    if not isinstance(methods, list):
        return data
    count = Counter(repr(method.get("name")) for method in _tables(methods))
    for method in _tables(methods):
        if "sweep" in method and count[repr(method.get("name"))] > 1:
            raise InputError(f"two methods of one name {method.get('name')!r}; names must differ")
    return data | {"method": [m for method in methods for m in (expanded(method) if isinstance(method, dict) else [method])]}


def _without_presets(data: dict[str, Any]) -> dict[str, Any]:
    """The experiment with every `preset` replaced by its values.

    A preset's training settings give way to those beside it, and its integrator settings to those of the table that it
    belongs to: `[training] preset` to `[integrator]`, a method's own to the method's `integrator`.  Methods without a
    representation have no preset.

    Raises:
        InputError: unknown preset.
    """
    def table(value: Any) -> dict[str, Any]:
        return value if isinstance(value, dict) else {}

    training = data.get("training", {})
    preset = _preset_of(table(training).get("preset", "best"), "[training]")
    common = {k: v for k, v in preset["integrator"].items() if k not in table(data.get("integrator"))}
    if isinstance(training, dict):
        training = preset["training"] | {k: v for k, v in training.items() if k != "preset"}
    methods = data.get("method")
    if isinstance(methods, list):
        methods = [_without_preset(method, common) if table(method).get("representation") is not None else method
                   for method in methods]
    return data | {"training": training} | ({"method": methods} if "method" in data else {})


def _without_preset(method: dict[str, Any], common: dict[str, Any]) -> dict[str, Any]:
    """A method with its own preset replaced by its values, or else with the integrator settings `common` to all."""
    training, integrator = method.get("training", {}), method.get("integrator", {})
    if isinstance(training, dict) and "preset" in training:
        preset = _preset_of(training["preset"], f"method {method.get('name')!r} training")
        start = dataclasses.asdict(TrainingSettings()) | preset["training"]
        training, common = start | {k: v for k, v in training.items() if k != "preset"}, preset["integrator"]
    return method | {"training": training, "integrator": common | integrator if isinstance(integrator, dict) else integrator}


def _preset_of(name: Any, where: str) -> dict[str, dict[str, Any]]:
    try:
        return preset_of(name)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _explain(error: ValidationError, source: str) -> str:
    """The first mistake that pydantic found, in one line."""
    first: Any = min(error.errors(), key=lambda e: e["type"] not in UNKNOWN)      # a misspelt key is missing, too
    parts = list(first["loc"])
    table = parts[0] if parts and parts[0] in TABLES else None
    cls: Any = TABLES.get(str(table), Experiment)
    where = source
    if table is not None and len(parts) > 1 and isinstance(parts[1], int):
        where, keys = f"{source} [[{table}]] {parts[1] + 1}", parts[2:]
    elif table is not None:
        where, keys = f"{source} [{table}]", parts[1:]
    else:
        keys = parts
    if first["type"] in UNKNOWN:
        known = list(cls.model_fields) if issubclass(cls, BaseModel) else [f.name for f in dataclasses.fields(cls)]
        if cls is TrainingSettings:
            known.insert(0, "preset")
        if cls is Method:
            known.append("sweep")
        return f"unknown key '{keys[-1]}' in {where}; known: {', '.join(known)}{closest(str(keys[-1]), known)}"
    if first["type"] in ("missing", "missing_argument"):
        return f"missing key '{keys[-1]}' in {where}" if keys else f"missing table '{table}' in {source}"
    if not keys and table is not None and not isinstance(first["input"], dict):     # the table itself is none
        where, keys = source, [where.removeprefix(source).strip()]
    if keys and keys[-1] == "float":             # the first of several types: pydantic tells them apart in the path
        literal = next((e for e in error.errors() if e["loc"][:-1] == first["loc"][:-1] and e["type"] == "literal_error"), None)
        keys = keys[:-1]
        first = {**first, "msg": first["msg"] + (f" or {literal['ctx']['expected']}" if literal else "")}
    name = ".".join(str(k) for k in keys)
    return f"{where}: {name + ' ' if name else ''}{_plain(first)}"


def _plain(error: Any) -> str:
    """A pydantic error without its vocabulary: the value and what is allowed."""
    if error["type"] == "value_error":
        text = str(error["ctx"]["error"])
        scalar = isinstance(error["input"], (int, float, str)) and text.startswith("must")
        return f"= {error['input']!r}: {text}" if scalar else text
    message = error["msg"].replace("Input should be", "must be").replace("an object", "a table")
    return f"= {error['input']!r}: {message}" if not isinstance(error["input"], dict) else message
