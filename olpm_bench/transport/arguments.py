"""Settings that come flat, as keyword arguments or as the parameters of a plugin: each goes where it belongs."""
from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from numbers import Number
from typing import Any

import representations
from olpm_bench.suggest import closest
from olpm_bench.transport.settings import InputError, IntegratorSettings


def distributed(given: Mapping[str, Any], *tables: type, representation: str | None = None) -> list[dict[str, Any]]:
    """The settings of each table, and last those of the representation, if there is one.

    A name that several have belongs to the first.

    Args:
        tables: dataclasses of settings.
        representation: whose hyper-parameters may be among them.

    Raises:
        InputError: a name that is known to none, or a value that is no number, string or list of these.
        RepresentationError: there is no such representation.
    """
    for key, value in given.items():
        if not isinstance(value, str | list | tuple | Number):
            raise InputError(f"{key}: must be a number, a string or a list, not {_kind(value)}")
    own = [[f.name for f in dataclasses.fields(table)] for table in tables]
    if representation is not None:
        own.append(list(inspect.signature(representations.find(representation)).parameters))
    found: list[dict[str, Any]] = [{} for _ in own]
    for key, value in given.items():
        place = next((i for i, names in enumerate(own) if key in names), None)
        if place is None:
            raise InputError(_unknown(key, [name for names in own for name in names], IntegratorSettings in tables))
        found[place][key] = value
    return found


def _unknown(key: str, known: list[str], with_integrator: bool) -> str:
    if not with_integrator and key in [f.name for f in dataclasses.fields(IntegratorSettings)]:
        return f"'{key}' is a setting of the integrator: give integrator={{'{key}': ...}}"
    return f"unknown setting '{key}'; known: {', '.join(dict.fromkeys(known))}{closest(key, known)}"


def require_type(name: str, value: Any, allowed: type | tuple[type, ...], words: str) -> None:
    """
    Raises:
        InputError: `value` is of another type than `allowed`, which `words` describe.  Its text is not in the message: that of a
            scene is pages long.
    """
    if not isinstance(value, allowed):
        raise InputError(f"{name}: must be {words}, not {_kind(value)}")


def _kind(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"
