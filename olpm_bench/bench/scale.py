"""Scales of an experiment: its file's ``[scale.NAME]`` tables, laid over the rest of it.

    [scale.small]                                   # olpm-bench run X.toml --scale small
    seeds = 2
    budget = { seconds = 5 }
    scene = { width = 64, height = 36 }             # of every scene
    method = [{ name = "GMM", training = { passes = 1 } }]      # only this one, with a change
"""
from __future__ import annotations

from typing import Any

from olpm_bench.transport.settings import InputError


def scaled(data: dict[str, Any], name: str, source: str) -> dict[str, Any]:
    """An experiment, as TOML holds it, at one of its scales.

    Tables are merged key by key.  Of scenes and methods, a table changes all; an array of tables names those that stay, each
    with its changes.  The title says the scale, unless it is changed, too; and crops belong to one size of the image.

    Raises:
        InputError: no such scale, scene or method; the message lists those that there are.
    """
    scales = data.get("scale")
    known = scales if isinstance(scales, dict) else {}
    if not isinstance(known.get(name), dict):
        raise InputError(f"--scale {name}: {source} has no [scale.{name}]; known: {', '.join(known) or 'none'}")
    base = {**data, "title": f"{data['title']} ({name})"} if "title" in data else data
    return _laid_over(base, known[name], f"{source} [scale.{name}]")


def _laid_over(base: Any, change: Any, where: str) -> Any:
    if isinstance(base, dict) and isinstance(change, dict):
        if {"width", "height"} & change.keys():
            base = {key: value for key, value in base.items() if key != "crops"}
        return base | {key: _laid_over(base.get(key), value, f"{where} {key}") for key, value in change.items()}
    if _are_tables(base) and isinstance(change, dict):
        return [_laid_over(table, change, where) for table in base]
    if _are_tables(base) and _are_tables(change):
        known, named = {str(table.get("name")): table for table in base}, [str(table.get("name")) for table in change]
        for name in named:
            if name not in known:
                raise InputError(f"{where}: none is named {name!r}; known: {', '.join(known)}")
        return [_laid_over(known[name], table, where) for name, table in zip(named, change, strict=True)]
    return change


def _are_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(table, dict) for table in value)
