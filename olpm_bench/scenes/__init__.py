"""The embedded scenes, and what identifies a scene.

    >>> from olpm_bench import scenes
    >>> scenes.parameters("door_ajar")
    {'gap': 0.07, 'rotation': 23.7, 'floor_roughness': 0.12}

Each embedded scene is a module of this package whose ``build(**parameters)`` returns a dictionary for
``mi.load_dict``, and whose ``check`` of the same parameters refuses values out of their range.  Its first docstring
line is its description, and its ``VERSION`` grows when the image changes.  One of several rooms names them in ``ROOMS``, and
its ``room`` tells in which a point is.
A new one is a file and a word in ``EMBEDDED``.  Nothing here loads Mitsuba: :mod:`olpm_bench.scenes.load` does.
"""
from __future__ import annotations

import hashlib
import importlib
import inspect
import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np

from olpm_bench.suggest import closest
from olpm_bench.transport.settings import InputError

LARGEST = 1e6           # parameter of an embedded scene
MOST_INCLUDES = 14      # inside each other, as in Mitsuba
# What a file says of its image beside its size and path depth, which older versions passed over.
HONOURED = {"hide_emitters", "hideEmitters", "crop_width", "crop_height", "crop_offset_x", "crop_offset_y"}
LONGEST = 4096          # characters of a scene file's parameter, which can be made of others that are made of others
EMBEDDED = ("door_ajar", "living_room", "classroom", "cornell_box")


class SceneError(InputError):
    """A scene that cannot be used; the message is one line: which thing, which value, what is allowed."""


def names() -> dict[str, str]:
    """Every embedded scene with its one-line description."""
    return {name: (_module(name).__doc__ or "").partition("\n")[0] for name in EMBEDDED}


def parameters(name: str) -> dict[str, Any]:
    """The parameters of an embedded scene with their defaults; ``build`` documents them.

    Raises:
        SceneError: no such scene.
    """
    return {p.name: p.default for p in inspect.signature(_module(name).build).parameters.values()}


def resolve(name: str, changes: dict[str, Any] | None = None) -> dict[str, Any]:
    """The parameters of an embedded scene with some changed, every default written out.

    Raises:
        SceneError: no such scene, a parameter it has not, or a value that is no number or out of its range.
    """
    known = parameters(name)
    for key, value in (changes or {}).items():
        if key not in known:
            raise SceneError(f"scene '{name}' has no parameter '{key}'; known: {', '.join(known) or 'none'}"
                             + closest(key, known))
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < LARGEST:
            raise SceneError(f"scene '{name}', parameter {key} = {value!r}: must be a number, below {LARGEST:g}")
    values = {key: float((changes or {}).get(key, default)) for key, default in known.items()}
    _module(name).check(**values)
    return values


def build(name: str, changes: dict[str, Any] | None = None) -> dict[str, Any]:
    """The dictionary of an embedded scene, for ``mi.load_dict``.  Needs a variant.

    Raises:
        SceneError: no such scene, a parameter it has not, or a value out of its range.
    """
    return _module(name).build(**resolve(name, changes))


def rooms(name: str, changes: dict[str, Any] | None = None) -> tuple[tuple[str, ...], Callable[[np.ndarray], np.ndarray]] | None:
    """The rooms of an embedded scene, and what gives the index of that in which each of some points [n, 3] is; None: it has one.

    Raises:
        SceneError: as `resolve`.
    """
    module, rotation = _module(name), resolve(name, changes).get("rotation")
    return (module.ROOMS, lambda p: module.room(p, rotation)) if hasattr(module, "ROOMS") else None


def check_range(what: str, value: float, low: float, high: float, unit: str = "") -> None:
    """
    Raises:
        SceneError: a value out of its range, or NaN.
    """
    if not low <= value <= high:
        raise SceneError(f"{what} = {value!r}: must be in [{low}, {high}]{unit and f', in {unit}'}")


def is_file(name_or_path: str | Path) -> bool:
    """Whether this names a file rather than an embedded scene: it is a path, ends in .xml or holds a separator."""
    return isinstance(name_or_path, Path) or re.search(r"[/\\]|\.xml$", name_or_path, re.IGNORECASE) is not None


def digest(name_or_path: str | Path, changes: dict[str, Any] | None = None) -> str:
    """SHA-256 [hex] of all that determines a scene, but for the sensor's size and path depth.

    Embedded: name, version and every parameter.  File: the overrides, and name and contents of the XML, of those it
    includes and of the other files it refers to; where the file lies does not matter.

    Raises:
        SceneError: no such scene or file, a parameter that the embedded scene has not, or a file that is not XML.
    """
    if is_file(name_or_path):
        path = Path(name_or_path)
        overrides = {key: str(value) for key, value in (changes or {}).items()}
        files, _ = read(path, overrides)
        content: dict[str, Any] = {"overrides": overrides, "files": _file_content(path, files)}
        if any(element.get("name") in HONOURED for file in files.values() for element in file.root.iter()):
            content["honoured"] = 1         # references and cells of versions that passed over it do not count
    else:
        name = str(name_or_path)
        content = {"scene": name, "version": _module(name).VERSION, "parameters": resolve(name, changes)}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


class _AsMitsuba(ElementTree.TreeBuilder):
    """Refuses what Mitsuba's own parser passes over: then both have read the same."""

    def doctype(self, *_: str | None) -> None:
        raise SceneError("has a DOCTYPE, whose entities and values of attributes Mitsuba would leave out; write the file without")


def read_xml(path: Path) -> ElementTree.Element:
    """The root element of an XML file.

    Raises:
        SceneError: a missing or unreadable file, one that is not XML, or one with a DOCTYPE.
    """
    if not (exists(path) and path.is_file()):
        raise SceneError(f"scene file {path}: there is no such file")
    try:
        return ElementTree.parse(path, ElementTree.XMLParser(target=_AsMitsuba())).getroot()
    except OSError as error:
        raise SceneError(f"scene file {path}: {error.strerror}") from error
    except SceneError as error:
        raise SceneError(f"scene file {path} {error}") from None
    except (ElementTree.ParseError, ValueError) as error:
        raise SceneError(f"scene file {path} is not well-formed XML: {error}") from error


@dataclass(frozen=True)
class SceneFile:
    """An XML file as Mitsuba reads it.

    root: its root element; the attributes of all elements have values in place of `$name`.
    folders: where Mitsuba looks for files once it has read this one, one folder after the other.
    spectra: the files that its elements name by the attribute `filename`, and where Mitsuba finds each.
    """
    root: ElementTree.Element
    folders: tuple[Path, ...]
    spectra: tuple[tuple[str, Path | None], ...]


def read(path: Path, overrides: dict[str, str]) -> tuple[dict[Path, SceneFile], list[str]]:
    """A scene file and all files that it includes, and the names of their parameters.

    As Mitsuba 3.9.1: a ``<default>`` holds from there on, unless there is one already.  An ``<include>`` is looked for beside
    the file that it is in, then where that one was looked for, and last in the current folder.  A ``<path>`` is searched first
    from there on, by its own file and those that this includes.

    Raises:
        SceneError: one is missing or not XML, too many include each other, a parameter is too long, or a ``<path>`` is no folder.
    """
    found: dict[Path, SceneFile] = {}
    names: dict[str, None] = {}
    values = dict(overrides)

    def add(file: Path, folders: tuple[Path, ...], depth: int) -> None:
        if file in found:
            return
        if depth > MOST_INCLUDES:
            raise SceneError(f"scene file {path}: files include each other more than {MOST_INCLUDES} deep")
        root, spectra = read_xml(file), []
        found[file] = SceneFile(root, folders, ())          # it may include itself
        for element in root.iter():
            for key, text in element.items():
                if "$" in text:
                    names.update(dict.fromkeys(re.findall(r"\$(\w+)", text)))
                    element.set(key, substitute(text, values))
            if element.tag == "default":
                name, value = element.get("name", ""), element.get("value", "")
                if len(value) > LONGEST:
                    raise SceneError(f"scene file {file}: parameter '{name}' has {len(value)} characters, at most {LONGEST}")
                names[name] = None
                values.setdefault(name, value)
            elif element.tag == "path":
                folders = (_folder(file, element.get("value", ""), folders), *folders)
            elif element.tag == "include":
                name, inner = element.get("filename", ""), (file.parent, *folders)
                add(located(name, inner) or file.parent / name, inner, depth + 1)
            elif "filename" in element.attrib:
                name = element.get("filename", "")
                spectra.append((name, located(name, folders)))
        found[file] = SceneFile(root, folders, tuple(spectra))

    add(path, (path.parent, Path()), 0)
    return found, list(names)


def _folder(file: Path, name: str, folders: Sequence[Path]) -> Path:
    """The folder that a ``<path>`` in a file names.

    Raises:
        SceneError: there is none.
    """
    folder = located(name, (file.parent, *folders))
    if folder is None or not folder.is_dir():
        raise SceneError(f"scene file {file}: <path>: there is no folder '{name}'")
    return folder


def substitute(text: str, values: dict[str, str]) -> str:
    """`text` with each `$name` replaced; where one name begins with another, the longer counts.  A `\\$` is a dollar sign."""
    if "$" not in text:
        return text
    longest_first = "|".join(re.escape(name) for name in sorted(values, key=len, reverse=True)) or "(?!)"
    return re.sub(rf"(?<!\\)\$({longest_first})", lambda m: values[m[1]], text).replace("\\$", "$")


def located(name: str, folders: Sequence[Path]) -> Path | None:
    """The first of the folders' files, or folders, of that name."""
    return next((folder / name for folder in folders if exists(folder / name)), None)


def named_files(path: Path, files: dict[Path, SceneFile]) -> Iterator[tuple[str, Path | None, bool]]:
    """What scene files name, but for includes: the name, what Mitsuba finds by it, and whether it must be a file's.

    Any string may be a file's name.  Mitsuba looks for spectra when it reads the XML, for all else when that is done.
    """
    for file in files.values():
        for element in file.root.iter("string"):
            name = element.get("value", "")
            yield name, located(name, files[path].folders), element.get("name") == "filename"
        for name, found in file.spectra:
            yield name, found, True


def _file_content(path: Path, files: dict[Path, SceneFile]) -> list[list[Any]]:
    """[name, SHA-256 of the contents (None: missing)] of a scene file, as it was read, and of all files it refers to."""
    content: list[list[Any]] = [[f.name, _sha256(f)] for f in files]
    for name, file, must_be in named_files(path, files):
        sha256 = _sha256(file) if file is not None and file.is_file() else None
        if must_be or ("." in name and sha256 is not None):
            content.append([name, sha256])
    return content


def exists(file: Path) -> bool:
    """Whether there is such a file; not if there can't be one of that name."""
    try:
        return file.exists()
    except (OSError, ValueError):
        return False


def _sha256(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _module(name: str) -> ModuleType:
    if name not in EMBEDDED:
        raise SceneError(f"unknown scene '{name}'; known: {', '.join(EMBEDDED)}, or the path of a Mitsuba XML file"
                         + closest(name, EMBEDDED))
    return importlib.import_module(f"{__name__}.{name}")
