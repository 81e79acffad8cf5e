"""What a run would do, without doing it: its cells, its time and memory, and whatever it would refuse."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from olpm_bench.bench import reference, run
from olpm_bench.bench.config import CellSpec, Experiment
from olpm_bench.bench.results import Results
from olpm_bench.bench.shard import WHOLE, Shard
from olpm_bench.transport.settings import InputError


@dataclass(frozen=True)
class Plan:
    """What a run would do.

    complete: for each of `cells`, whether it need not be run.
    gigabytes: memory that the largest cell takes.
    to_make: charged seconds that references take which are missing or were interrupted, by the name of the scene.
    refusals: why a run would stop before its first cell, a line each.
    """
    cells: list[CellSpec]
    complete: list[bool]
    gigabytes: float
    to_make: dict[str, float]
    refusals: list[str]

    @property
    def todo(self) -> list[CellSpec]:
        """The cells that are to be run."""
        return [spec for spec, complete in zip(self.cells, self.complete, strict=True) if not complete]

    @property
    def hours(self) -> float | None:
        """Charged hours of the cells; None for a budget of samples, whose time nobody knows before."""
        seconds = [spec.budget.seconds for spec in self.todo]
        return sum(s for s in seconds if s) / 3600 if None not in seconds else None


def plan(experiment: Experiment, root: Path, shard: Shard = WHOLE, makes_references: bool = False) -> Plan:
    """What a run of a shard of the cells would do.

    Args:
        root: the `--results` folder.
        makes_references: it makes the references that there are not.

    Raises:
        NewerSchemaError: a result is of a later version.
    """
    results, cells = Results(root / experiment.stem), shard.of(experiment.cells())
    complete = [run.is_complete(results, spec)[0] for spec in cells]
    to_make = reference.to_make(experiment, root)
    todo = [spec for spec, done in zip(cells, complete, strict=True) if not done]
    checks: list[Callable[[], object]] = [
        lambda: run.references(experiment, root, to_make if makes_references else ()),
        lambda: run.require_folders(results, cells, root), lambda: run.require_memory(todo)]
    return Plan(cells, complete, max(map(run.memory, cells), default=0.0), to_make,
                [refusal for check in checks if (refusal := _refusal(check)) is not None])


def _refusal(check: Callable[[], object]) -> str | None:
    try:
        check()
    except InputError as error:
        return str(error)
    return None


def lines(found: Plan) -> list[str]:
    """The plan in words, but for what it refuses."""
    said = [f"{spec}{'  (complete)' if complete else ''}" for spec, complete in zip(found.cells, found.complete, strict=True)]
    said += [f"{name}: its reference still takes about {duration(seconds)} (an estimate: {seconds:.0f} charged seconds, and "
             "compilation); run --with-reference makes it" for name, seconds in found.to_make.items()]
    hours = "unknown" if found.hours is None else f"{found.hours:.2f}, and compilation"
    said.append(f"{sum(not complete for complete in found.complete)} of {len(found.cells)} cells to run; hours: {hours}; "
                f"memory: about {found.gigabytes:.1f} GB")
    return said


def duration(seconds: float) -> str:
    """A time in the unit that suits it, in few digits: "45 seconds", "5 minutes", "2.1 hours"."""
    for unit, name in ((3600, "hours"), (60, "minutes")):
        if seconds >= 1.5 * unit:
            return f"{seconds / unit:.2g} {name}"
    return f"{seconds:.0f} seconds"
