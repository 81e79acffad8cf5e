"""What a check has found: a verdict with its statistic, its threshold and its worst case."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from olpm_bench.bench.progress import is_interrupt


@dataclass(frozen=True)
class Panel:
    """A function over the hemisphere's equal-area disk, or an image.

    values: [h, w], row 0 on top; NaN where there is nothing.
    scale: "log"; "linear"; or "signed", which is symmetric about 0.
    mark: where the worst case is, as (column, row) in cells.
    """
    title: str
    values: np.ndarray
    scale: str = "log"
    unit: str = "1/sr"
    mark: tuple[float, float] | None = None


Picture = Callable[[], list[Panel]]


@dataclass
class Verdict:
    """The outcome of one check.

    statistic, threshold: what `measure` names, passed while on the right side of the threshold; None if it came to none.
    p: of a statistical check, corrected for its number of `tests`; None where nothing is left to chance.
    worst: the worst case in words.
    note: what else is worth knowing, also after success.
    picture: of a failure; drawn once, if at all.
    """
    passed: bool
    measure: str
    statistic: float | None
    threshold: float | None
    worst: str = ""
    p: float | None = None
    tests: int = 1
    note: str = ""
    picture: Picture | None = field(default=None, repr=False)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: all but the picture."""
        return {k: v for k, v in vars(self).items() if k != "picture"}

    def panels(self) -> list[Panel]:
        """Those of a failure's picture; none if the representation, which has failed before, can't even be asked for it."""
        if self.passed or self.picture is None:
            return []
        try:
            return self.picture()
        except Exception as error:
            if is_interrupt(error):
                raise
            return []


def sidak(level: float, tests: int) -> float:
    """Level of each of so many independent tests that together raise a false alarm with probability `level`."""
    return float(-np.expm1(np.log1p(-level) / tests))


def combined(p: float, tests: int) -> float:
    """p-value of the smallest of so many independent p-values (Sidak)."""
    return float(-np.expm1(tests * np.log1p(-min(p, 1 - 1e-16))))


@dataclass(frozen=True)
class Failure:
    """That no chance excuses: how often, or how much, and the first case of it."""
    size: float
    words: str
    picture: Picture | None = None


def exact(failures: list[Failure], measure: str, note: str = "") -> Verdict:
    """Passed if there are none; else the largest speaks."""
    if not failures:
        return Verdict(True, measure, 0.0, 0.0, note=note)
    worst = max(failures, key=lambda f: f.size)
    return Verdict(False, measure, float(worst.size), 0.0, worst.words, note=note, picture=worst.picture)


def worst_of(verdicts: dict[str, Verdict]) -> Verdict:
    """That of the same check under several circumstances, as one; '' needs no words."""
    where, worst = min(verdicts.items(), key=lambda v: (v[1].passed, 1.0 if v[1].p is None else v[1].p))
    words = f"{where}, " * bool(where)
    notes = [f"{name}: {v.note}" if name else v.note for name, v in verdicts.items()
             if v.note and (not name or v.note not in [other.note for other in verdicts.values() if other is not v])]
    n = len(verdicts)
    return replace(worst, worst=worst.worst and words + worst.worst, tests=n * worst.tests,
                   p=None if worst.p is None else combined(worst.p, n), note="; ".join(notes))


class PValues:
    """p-values of one check's tests, each with the words and the picture of its failure."""

    def __init__(self) -> None:
        self.found: list[tuple[float, str, Picture | None]] = []

    def add(self, p: float, words: str, picture: Picture | None = None) -> None:
        """A NaN is no p-value, and fails."""
        self.found.append((0.0 if np.isnan(p) else float(p), words, picture))

    def verdict(self, level: float, note: str = "") -> Verdict:
        """Rejected if the smallest p-value is below what Sidak leaves of `level`."""
        p, words, picture = min(self.found, key=lambda t: t[0])
        threshold = sidak(level, len(self.found))
        return Verdict(p >= threshold, "smallest p", p, threshold, words, combined(p, len(self.found)), len(self.found), note,
                       picture)
