"""Directional probability densities that learn from weighted directions: a library of its own.

    >>> import mitsuba as mi; mi.set_variant("llvm_ad_rgb")
    >>> import representations
    >>> gmm = representations.create("gaussian_mixture", components=8)
    >>> state = gmm.init(n_records=1000)

This file is the registry, and the only place that names all representations.  A new one is a class that
satisfies :class:`representations.interface.DirectionalPdf` and is found in one of three ways: a line in
``BUILT_IN`` below, an entry point of the group ``olpm_bench.representations``, or ``path/to/file.py:ClassName``.
"""
from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import inspect
import sys
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from representations import _llvm
from representations.suggest import closest

_llvm.select()          # before the first `import drjit` of the process

ENTRY_POINTS = "olpm_bench.representations"
BUILT_IN = {            # name -> module:Class, imported on first use
    "cosine": "representations.cosine:CosineLobe",
    "jensen": "representations.jensen:JensenHistogram",
    "hey": "representations.hey:HeyCones",
    "gaussian_mixture": "representations.gaussian_mixture:GaussianMixture",
}


class RepresentationError(ValueError):
    """An unknown representation or hyper-parameter; the message lists the known ones."""


def names() -> list[str]:
    """Every registered name: the built-in ones and those of installed entry points."""
    return sorted({*BUILT_IN, *(e.name for e in importlib.metadata.entry_points(group=ENTRY_POINTS))})


def file_of(name: str) -> tuple[Path, str] | None:
    """The file and the class of ``path/to/file.py:ClassName``, whose code is run; None: any other name."""
    file, _, attribute = name.rpartition(":")
    return (Path(file), attribute) if file.endswith(".py") else None


def find(name: str) -> Any:
    """The class behind a registered name or behind ``path/to/file.py:ClassName`` (which runs that file).

    Raises:
        RepresentationError: no such name, file or class, or one whose code cannot be loaded.
    """
    if name in BUILT_IN:
        module, _, attribute = BUILT_IN[name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS, name=name):
        try:
            return entry.load()
        except (Exception, SystemExit) as error:        # other people's code
            raise RepresentationError(f"representation '{name}', entry point {entry.value}, {_reason(error)}") from error
    if (found := file_of(name)) is not None:
        return _from_file(*found)
    raise RepresentationError(f"unknown representation '{name}'; known: {', '.join(names())}, or path/to/file.py:ClassName"
                              + closest(name, names()))


def create(type: str, **parameters: Any) -> Any:
    """A representation with its hyper-parameters, e.g. ``create("gaussian_mixture", components=16)``.

    The first argument is named as in a TOML, so that ``create(**{"type": "jensen"})`` works too.

    Raises:
        RepresentationError: unknown name; unknown, missing or invalid hyper-parameter; code of others that fails.
    """
    return instance(find(type), type, parameters)


def instance(cls: Any, type: str, parameters: dict[str, Any]) -> Any:
    """As :func:`create`, of a class that :func:`find` has found by the name `type`."""
    try:
        known = parameters_of(cls)
        for key, value in parameters.items():
            if key not in known:
                raise RepresentationError(f"representation '{type}' has no parameter '{key}'; "
                                          f"known: {', '.join(known) or 'none'}{closest(key, known)}")
            if (allowed := wrong_type(value, known[key].default)) is not None:
                raise RepresentationError(f"representation '{type}': {key} = {value!r}: must be {allowed}")
        return cls(**parameters)
    except RepresentationError:
        raise
    except (TypeError, ValueError) as error:
        raise RepresentationError(f"representation '{type}': {error}") from error
    except (Exception, SystemExit) as error:            # other people's code
        if type in BUILT_IN:
            raise
        raise RepresentationError(f"representation '{type}' {_reason(error)}") from error


@functools.cache
def parameters_of(cls: Any) -> Mapping[str, inspect.Parameter]:
    """The hyper-parameters of a class, by name."""
    return inspect.signature(cls).parameters


def wrong_type(value: Any, default: Any) -> str | None:
    """What a parameter with this default must be, if `value` is not; None also where the default doesn't tell."""
    if type(value) is type(default):
        return None
    if isinstance(default, bool):
        return None if isinstance(value, bool) else "true or false"
    if isinstance(default, int):
        return None if isinstance(value, Integral) and not isinstance(value, bool) else "a whole number"
    if isinstance(default, float):
        return None if isinstance(value, Real) and not isinstance(value, bool) else "a number"
    if isinstance(default, str):
        return None if isinstance(value, str) else "a string"
    return None


def _reason(error: BaseException) -> str:
    """In one line, why code cannot be loaded."""
    return " ".join(f"cannot be loaded: {error.__class__.__name__}: {error}".split())


def _from_file(file: Path, attribute: str) -> type:
    if not file.is_file():
        raise RepresentationError(f"representation file {file}: there is no such file")
    module_name = f"representation_{file.stem}"
    spec = importlib.util.spec_from_file_location(module_name, file)
    assert spec is not None and spec.loader is not None         # by the suffix, see `file_of`
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module           # dataclasses look their module up by name
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:    # other people's code, which may even say that all is well
        sys.modules.pop(module_name, None)
        raise RepresentationError(f"representation file {file} {_reason(error)}") from error
    if not inspect.isclass(getattr(module, attribute, None)):
        raise RepresentationError(f"representation file {file} has no class '{attribute}'")
    return getattr(module, attribute)
