"""Checks of other people's code, in a process of its own: what ends or stops that process is a failure like any other."""
from __future__ import annotations

import functools
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from olpm_bench.bench import other_process
from olpm_bench.check import suite
from olpm_bench.check.suite import Check, Outcome, Subject
from olpm_bench.check.verdict import Panel, Verdict
from representations import RepresentationError

COMMAND = other_process.command("olpm_bench.check.isolated")


class Examiner(other_process.Process):
    """`suite.run` in another process, which outlives the check."""

    def __init__(self) -> None:
        super().__init__(COMMAND, quiet=False)

    def __enter__(self) -> Examiner:
        return self

    def run(self, subject: Subject, checks: Sequence[Check]) -> Iterator[Outcome]:
        """
        Raises:
            RepresentationError: it can't be made.
        """
        for check in checks:
            start = time.perf_counter()
            answer = self.ask(subject.specification, subject.seed, subject.declared, check.name)
            if "refused" in answer:
                raise RepresentationError(answer["refused"])
            if "traceback" in answer:
                raise AssertionError(answer["traceback"])
            yield Outcome(check, _verdict(answer), time.perf_counter() - start)


def _verdict(answer: dict[str, Any]) -> Verdict:
    if "hung" in answer:
        return Verdict(False, "hangs", None, None, f"does not come back within {answer['hung']:.0f} s")
    if "died" in answer:
        return Verdict(False, "dies", None, None, f"ends the process: {other_process.end(answer)}")
    fields, panels = answer["ok"]
    drawn = [Panel(**{**panel, "values": np.array(panel["values"], float)}) for panel in panels]
    return Verdict(**fields, picture=lambda: drawn)


@functools.lru_cache(maxsize=1)         # its states serve all checks
def _subject(specification: str, seed: int, declared: tuple[str, ...]) -> Subject:
    return Subject(json.loads(specification), seed, declared)


def _examine(specification: dict[str, Any], seed: int, declared: Sequence[str], name: str) -> tuple[dict[str, Any], Any]:
    """The fields of a verdict, and of the panels of its picture."""
    subject = _subject(json.dumps(specification), seed, tuple(declared))
    verdict = next(suite.run(subject, suite.named([name]))).verdict
    return verdict.as_dict(), [asdict(panel) for panel in verdict.panels()]


if __name__ == "__main__":
    other_process.serve(_examine)
