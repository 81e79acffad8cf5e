"""Scales of an experiment: its file's ``[scale.NAME]`` tables, laid over the rest of it.

    [scale.small]                                   # olpm-bench run X.toml --scale small
    seeds = 2
    budget = { seconds = 5 }
    scene = { width = 64, height = 36 }             # of every scene
    method = [{ name = "GMM", training = { passes = 1 } }]      # only this one, with a change
"""
from __future__ import annotations

from typing import Any

from olpm_bench.suggest import closest
from olpm_bench.transport.settings import InputError

LEAST_CROP = 4          # pixels along a side of a crop that gets smaller with its image


def scaled(data: dict[str, Any], name: str, source: str) -> dict[str, Any]:
    """An experiment, as TOML holds it, at one of its scales.

    Tables are merged key by key.  Of scenes and methods, a table changes all; an array of tables names those that stay, each
    with its changes.  The title says the scale, unless it is changed, too; crops change with the size of the image, if that does
    by a whole factor, and else are left out.

    Raises:
        InputError: no such scale, scene or method; the message lists those that there are.
    """
    scales = data.get("scale")
    known = scales if isinstance(scales, dict) else {}
    if not isinstance(known.get(name), dict):
        raise InputError(f"--scale {name}: {source} has no [scale.{name}]; known: {', '.join(known) or 'none'}"
                         + closest(name, known))
    base = {**data, "title": f"{data['title']} ({name})"} if "title" in data else data
    return _laid_over(base, known[name], f"{source} [scale.{name}]")


def _laid_over(base: Any, change: Any, where: str) -> Any:
    if isinstance(base, dict) and isinstance(change, dict):
        if "crops" in base and {"width", "height"} & change.keys():
            base = base | {"crops": _crops(base, base | change)}
        return base | {key: _laid_over(base.get(key), value, f"{where} {key}") for key, value in change.items()}
    if _are_tables(base) and isinstance(change, dict):
        return [_laid_over(table, change, where) for table in base]
    if _are_tables(base) and _are_tables(change):
        known, named = {str(table.get("name")): table for table in base}, [str(table.get("name")) for table in change]
        for name in named:
            if name not in known:
                raise InputError(f"{where}: none is named {name!r}; known: {', '.join(known)}{closest(name, known)}")
        return [_laid_over(known[name], table, where) for name, table in zip(named, change, strict=True)]
    return change


def _crops(old: dict[str, Any], new: dict[str, Any]) -> list[list[int]]:
    """The crops of a scene's image when its size changes: the same parts of it, in whole pixels and not too few; none where the
    factor is not whole, or where they would no longer be of one shape."""
    sizes: list[Any] = [table.get(key) for table in (old, new) for key in ("width", "height")]
    boxes = old["crops"]
    if not _are_counts(sizes) or not isinstance(boxes, list) or not all(_are_counts(box) and len(box) == 4 for box in boxes):
        return []
    W, H, w, h = sizes
    if W * h != H * w or min(sizes) == 0 or (W % w and w % W):
        return []
    corners = [[round(x * w / W) for x in box[:2]] for box in boxes]
    edges = [[max(round(x * w / W), min(x, LEAST_CROP)) for x in box[2:]] for box in boxes]
    found = [[max(min(x, w - a), 0), max(min(y, h - b), 0), a, b] for (x, y), (a, b) in zip(corners, edges, strict=True)]
    return found if all(a * edges[0][1] == b * edges[0][0] and a <= w and b <= h for a, b in edges) else []


def _are_counts(value: Any) -> bool:
    return isinstance(value, list) and all(type(x) is int and 0 <= x < 2**31 for x in value)


def _are_tables(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(table, dict) for table in value)
