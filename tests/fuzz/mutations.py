"""Broken versions of valid files, for hypothesis: by their structure, and byte by byte.

A campaign of any size: ``OLPM_BENCH_FUZZ=10000 pytest tests/fuzz``; by default 300 files in all, the same ones each time.
"""
from __future__ import annotations

import copy
import os
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

EXAMPLES = int(os.environ.get("OLPM_BENCH_FUZZ", "300"))
PATIENCE, EACH = 600.0, 10.0        # [s] that a test and each of its examples may take on a busy machine

NUMBERS = [0, -1, 1, 2, 7, 2**31, 2**32, 2**63, -2**63, 10**30, 0.0, -0.0, 0.5, 1e-38, 1e-45, 1e38, 1e308, -1e308,
           float("nan"), float("inf"), float("-inf")]
NAMES = ["", " ", ".", "..", "...", "-", "a/b", "../up", "../../../../etc/passwd", "/etc/passwd", "/dev/zero", "~", "~root",
         "CON", "nul.txt", "C:\\x", "a\nb", "a\tb", "\x00", "a\x1b[31mb", "'", '"', "$HOME", "`id`", "%s%n", "{0}", "é" * 200,
         "\u202e", "\U0001f600", "x" * 300, "x" * 5000, "e\u0301", "none", "None", "auto", "[red]", "nan", "1e999",
         "${resx}", "$x", "<&>"]
names = st.sampled_from(NAMES) | st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
scalars = st.sampled_from(NUMBERS) | names | st.booleans() | st.integers() | st.floats()
values = st.recursive(scalars, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(names, inner, max_size=3),
                      max_leaves=6)


def examples(share: float) -> Callable[..., Any]:
    """A test that takes its share of all examples, and its time for them; the same ones each time unless it is a campaign."""
    n = max(1, round(share * EXAMPLES))
    same = settings(max_examples=n, deadline=None, database=None, derandomize="OLPM_BENCH_FUZZ" not in os.environ,
                    print_blob=True, suppress_health_check=list(HealthCheck))
    return lambda test: pytest.mark.timeout(PATIENCE + EACH * n)(same(test))


def _places(value: Any) -> list[tuple[Any, Any]]:
    """(container, key) of everything inside nested tables and lists."""
    found: list[tuple[Any, Any]] = []
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        found += [(value, key), *_places(inner)]
    return found


@st.composite
def tables(draw: st.DrawFn, valid: dict[str, Any]) -> dict[str, Any]:
    """A nested table with one to three things deleted, doubled, moved, renamed or of another value or type."""
    data = copy.deepcopy(valid)
    for _ in range(draw(st.integers(1, 3))):
        places = _places(data)
        if not places:
            break
        container, key = draw(st.sampled_from(places))
        how = draw(st.sampled_from(["delete", "value", "value", "value", "rename", "double", "wrap", "move"]))
        if how == "delete":
            del container[key]
        elif how == "value":
            container[key] = draw(values)
        elif how == "wrap":
            container[key] = draw(st.sampled_from([[container[key]], {"a": container[key]}]))
        elif isinstance(container, list):
            container.insert(key, copy.deepcopy(container[key]))
        elif how == "rename":
            container[draw(names)] = container.pop(key)
        else:
            other, place = draw(st.sampled_from(places))
            moved = copy.deepcopy(container[key])
            other[place] = moved
    return data


@st.composite
def mutated_bytes(draw: st.DrawFn, valid: bytes, most: int = 4, dictionary: tuple[bytes, ...] = ()) -> bytes:
    """A file with a few bytes flipped, overwritten, inserted, removed or doubled, or cut short."""
    data = bytearray(valid)
    for _ in range(draw(st.integers(1, most))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        how = draw(st.sampled_from(["flip", "set", "insert", "remove", "double", "cut", "swap"]))
        n = draw(st.sampled_from([1, 2, 4, 16, 100]))
        if how == "flip" and data:
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif how == "set":
            data[at:at + n] = draw(st.sampled_from([0, 255, 127, 128, 32, 34, 60, 91])).to_bytes(1, "big") * n
        elif how == "insert":
            known = st.sampled_from([*dictionary, b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"9" * 30])
            data[at:at] = draw(st.binary(max_size=8) | known)
        elif how == "remove":
            del data[at:at + n]
        elif how == "double":
            data[at:at] = data[at:at + n]
        elif how == "cut" and draw(st.integers(0, 3)) == 0:
            del data[at:]
        else:
            to = draw(st.integers(0, max(len(data) - 1, 0)))
            data[at:at + n], data[to:to + n] = data[to:to + n], data[at:at + n]
    return bytes(data)
