"""`olpm-bench check`: one run of all checks with its table and pictures, or many runs to count the false alarms."""
from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from scipy import stats

from olpm_bench.bench.files import slug
from olpm_bench.bench.progress import Bar, is_interrupt
from olpm_bench.check import suite
from olpm_bench.check.suite import LEVEL, Check, Outcome, Subject
from olpm_bench.report import verdicts

COARSE = (0.1, 0.01)        # levels at which a campaign of some runs can see whether p-values are honest


def examine(subject: Subject, checks: Sequence[Check], folder: Path, quiet: bool = False) -> dict[str, Any]:
    """Run the checks once and draw the failures into `folder`; print the table unless `quiet`.

    Returns:
        What `--json` prints.
    """
    start = time.perf_counter()
    outcomes = _run(subject, checks)
    pictures = {o.check.name: str(path) for o in outcomes if (path := _draw(o, subject, folder)) is not None}
    seconds, passed = time.perf_counter() - start, all(o.verdict.passed for o in outcomes)
    if not quiet:
        console = Console()
        verdicts.print_table(outcomes, pictures, console)
        failed = sum(not o.verdict.passed for o in outcomes)
        result = f"{failed} of {len(outcomes)} checks FAILED" if failed else f"{len(outcomes)} checks passed"
        verdicts.line(console, f"{subject.name}: {result} in {seconds:.0f} s (seed {subject.seed}; by chance, one such run in "
                      f"{1 / LEVEL:.0f} fails)", "bold red" if failed else "bold green")
    found = [{"name": o.check.name, "sentence": o.check.sentence, **o.verdict.as_dict(), "seconds": o.seconds,
              "picture": pictures.get(o.check.name)} for o in outcomes]
    return {"representation": subject.specification, "seed": subject.seed, "declared": list(subject.declared), "passed": passed,
            "level": LEVEL, "p": suite.p_value(outcomes), "seconds": seconds, "checks": found}


def campaign(subject: Subject, checks: Sequence[Check], runs: int, folder: Path, quiet: bool = False) -> dict[str, Any]:
    """Run the checks with `runs` seeds from the subject's on, and count the alarms; the arguments are those of `examine`."""
    console, found = Console(), []
    alarms, beyond = 0, dict.fromkeys(COARSE, 0)
    for seed in range(subject.seed, subject.seed + runs):
        one = Subject(subject.specification, seed, subject.declared)
        start = time.perf_counter()
        outcomes = _run(one, checks)
        failed = [o for o in outcomes if not o.verdict.passed]
        p = suite.p_value(outcomes)
        alarms += bool(failed)
        for level in COARSE:
            beyond[level] += p < level
        found.append({"seed": seed, "passed": not failed, "p": p, "failed": {o.check.name: o.verdict.worst for o in failed},
                      "smallest": {o.check.name: o.verdict.p for o in outcomes if o.verdict.p is not None},
                      "seconds": time.perf_counter() - start, "pictures": [
                          str(path) for o in failed if (path := _draw(o, one, folder / f"seed{seed}")) is not None]})
        if not quiet:
            words = "; ".join(f"{o.check.name}: {o.verdict.worst}" for o in failed)
            verdicts.line(console, f"seed {seed}: {f'FAILED {words}' if failed else f'passed, p = {p:.3g}'}")
    if not quiet:
        verdicts.line(console, f"{subject.name}: {alarms} of {runs} runs raised an alarm; at most {runs * LEVEL:.2g} expected")
        for level, count in beyond.items():
            verdicts.line(console, f"  p < {level}: {count} of {runs}, at most {runs * level:.3g} expected (binomial p = "
                          f"{stats.binomtest(count, runs, level, 'greater').pvalue:.2g})")
    return {"representation": subject.specification, "declared": list(subject.declared), "passed": alarms == 0, "level": LEVEL,
            "alarms": alarms, "below": {str(level): count for level, count in beyond.items()}, "runs": found}


def _run(subject: Subject, checks: Sequence[Check]) -> list[Outcome]:
    outcomes: list[Outcome] = []
    with Bar(len(checks)) as bar:
        for outcome in suite.run(subject, checks):
            outcomes.append(outcome)
            bar.at(len(outcomes), outcome.check.name)
    return outcomes


def _draw(outcome: Outcome, subject: Subject, folder: Path) -> Path | None:
    """The picture of a failure; None if it passed, has none, or the representation can't even be asked for it."""
    verdict = outcome.verdict
    if verdict.passed or verdict.picture is None:
        return None
    try:
        panels = verdict.picture()
    except Exception as error:          # other people's code, which has failed before
        if is_interrupt(error):
            raise
        return None
    path = folder / slug(Path(subject.name.replace(":", "-")).name) / f"{outcome.check.name}.png"
    verdicts.picture(panels, f"{subject.name}, {outcome.check.name}: {verdict.worst}", path)
    return path
