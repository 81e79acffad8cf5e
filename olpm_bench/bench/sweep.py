"""Methods that sweep a setting: one line of a TOML for a whole series of methods.

    [[method]]
    name = "GMM"
    representation = { type = "gaussian_mixture" }
    sweep = { "training.photons" = [10_000, 100_000, 1_000_000] }       # three methods: "GMM, photons 10k", ...
"""
from __future__ import annotations

import sys
from typing import Any

from olpm_bench.transport.settings import InputError

MOST = 1000                 # values of a sweep
TABLES = ("training", "integrator", "representation")


def expanded(method: dict[str, Any]) -> list[dict[str, Any]]:
    """The methods, as TOML holds them, that a method stands for: itself, or one for each value of its `sweep`.

    Raises:
        InputError: a sweep that is not one setting with its different positive numbers.
    """
    if "sweep" not in method:
        return [method]
    name, sweep = method.get("name"), method["sweep"]
    where = f"method {name!r} sweep"
    if not isinstance(sweep, dict) or len(sweep) != 1:
        raise InputError(f"{where} = {sweep!r}: must be one setting and its values, {{ \"training.passes\" = [1, 2, 5] }}")
    (setting, values), = sweep.items()
    table, dot, key = setting.partition(".")
    if table not in TABLES or not dot or not key:
        raise InputError(f"{where}: {setting!r}: must be TABLE.KEY with one of the tables {', '.join(TABLES)}")
    if not isinstance(values, list) or not values or not all(map(_is_positive, values)) or len(set(values)) < len(values):
        raise InputError(f"{where}: {setting} = {values!r}: must be different positive numbers")
    if len(values) > MOST:
        raise InputError(f"{where}: {setting} has {len(values)} values; must be at most {MOST}")
    if not isinstance(method.get(table, {}), dict):
        raise InputError(f"{where}: {table} = {method[table]!r}: must be a table")
    rest = {k: v for k, v in method.items() if k != "sweep"}
    return [rest | {"name": f"{name}, {key.replace('_', ' ')} {short(value)}", table: method.get(table, {}) | {key: value},
                    "series": {"name": name, "setting": setting, "value": value}} for value in values]


def short(value: float) -> str:
    """12000 as "12k", 3000000 as "3M"; other numbers as they are."""
    for unit, letter in ((1_000_000, "M"), (1000, "k")):
        if value >= unit and value % unit == 0:
            return f"{value // unit:.0f}{letter}"
    return f"{value:g}"


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= sys.float_info.max
