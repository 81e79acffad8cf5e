"""`olpm-bench check`: one run of all checks with its table and pictures, or many runs to count the false alarms."""
from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
from rich.console import Console
from scipy import stats

import representations
from olpm_bench.bench.config import own_code
from olpm_bench.bench.files import ResultError, digest, plain, slug
from olpm_bench.bench.progress import Bar
from olpm_bench.check import isolated, suite
from olpm_bench.check.suite import LEVEL, Check, Outcome, Subject
from olpm_bench.report import verdicts

COARSE = (0.1, 0.01)        # levels at which a campaign of some runs can see whether p-values are honest
CHANCE = 1e-3               # that honest ones are taken for dishonest, in a campaign

Run = Callable[[Subject, Sequence[Check]], Iterator[Outcome]]


def examine(subject: Subject, checks: Sequence[Check], folder: Path, quiet: bool = False) -> dict[str, Any]:
    """Run the checks once and draw the failures into `folder`; print the table unless `quiet`.

    Returns:
        What `--json` prints.
    """
    start = time.perf_counter()
    with _examiner(subject) as run:
        outcomes = _run(run, subject, checks)
    pictures = {o.check.name: str(path) for o in outcomes if (path := _draw(o, subject, folder)) is not None}
    seconds, passed = time.perf_counter() - start, all(o.verdict.passed for o in outcomes)
    if not quiet:
        console = Console()
        verdicts.print_table(outcomes, pictures, console)
        failed = sum(not o.verdict.passed for o in outcomes)
        result = f"{failed} of {len(outcomes)} checks FAILED" if failed else f"{len(outcomes)} checks passed"
        verdicts.line(console, f"{subject.name}: {result} in {seconds:.0f} s (seed {subject.seed}; designed for one "
                      f"false alarm in {1 / LEVEL:.0f} such runs)", "bold red" if failed else "bold green")
    found = [{"name": o.check.name, "sentence": o.check.sentence, **o.verdict.as_dict(), "seconds": o.seconds,
              "picture": pictures.get(o.check.name)} for o in outcomes]
    return {"representation": subject.specification, "seed": subject.seed, "declared": list(subject.declared), "passed": passed,
            "level": LEVEL, "p": suite.p_value(outcomes), "seconds": seconds, "checks": found}


def campaign(subject: Subject, checks: Sequence[Check], runs: int, folder: Path, quiet: bool = False,
             log: Path | None = None) -> dict[str, Any]:
    """Run the checks with `runs` seeds from the subject's on, count the alarms, and see whether p-values are honest.

    Other arguments are those of `examine`.

    log: a file of a JSON line a run.  Seeds that are in it are not run again; all its runs of these checks by this code count.
    """
    console, about = Console(), _about(subject, checks)
    found = _logged(log, about)
    with _examiner(subject) as run:
        for seed in range(subject.seed, subject.seed + runs):
            if seed in found:
                continue
            one = Subject(subject.specification, seed, subject.declared)
            start = time.perf_counter()
            outcomes = _run(run, one, checks)
            failed = [o for o in outcomes if not o.verdict.passed]
            p = suite.p_value(outcomes)
            found[seed] = plain({
                **about, "seed": seed, "passed": not failed, "p": p, "failed": {o.check.name: o.verdict.worst for o in failed},
                "smallest": {o.check.name: o.verdict.p for o in outcomes if o.verdict.p is not None},
                "seconds": time.perf_counter() - start, "pictures": [
                    str(path) for o in failed if (path := _draw(o, one, folder / f"seed{seed}")) is not None]})
            if log is not None:
                _append(log, json.dumps(found[seed], allow_nan=False))
            if not quiet:
                words = "; ".join(f"{o.check.name}: {o.verdict.worst}" for o in failed)
                verdicts.line(console, f"seed {seed}: {f'FAILED {words}' if failed else f'passed, p = {p:.3g}'}")
    found = _logged(log, about) or found            # other processes write to it, too
    lines, n = [found[seed] for seed in sorted(found)], len(found)
    alarms = sum(not line["passed"] for line in lines)
    shares = calibration(lines)
    if not quiet:
        verdicts.line(console, f"{subject.name}: {alarms} of {n} runs raised an alarm; at most {n * LEVEL:.2g} expected")
        for name, share in shares.items():
            below = " and ".join(f"p < {level} in {count / share['runs']:.1%}" for level, count in share["below"].items())
            wrong = "" if share["passed"] else f": FAILED, too small too often (binomial p = {share['binomial_p']:.1g})"
            verdicts.line(console, f"  {name}: {below} of {share['runs']} runs{wrong}", "bold red" if wrong else "")
    passed = alarms == 0 and all(share["passed"] for share in shares.values())
    return {"representation": subject.specification, "declared": list(subject.declared), "passed": passed, "level": LEVEL,
            "alarms": alarms, "calibration": shares, "runs": lines}


def calibration(lines: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """How often the p-values of whole runs, and of each check, lie below `COARSE`; passed unless that is more often than stated.

    They may do so less often: corrections for the number of tests are bounds.  A run in which a check leaves nothing to chance
    does not count for it.
    """
    values = {"all checks": [line["p"] for line in lines]}
    for line in lines:
        for name, p in line["smallest"].items():
            values.setdefault(name, []).append(p)
    found: dict[str, dict[str, Any]] = {}
    for name, p_values in values.items():
        below = {level: sum(p < level for p in p_values) for level in COARSE}
        p = min(float(stats.binomtest(count, len(p_values), level, "greater").pvalue) for level, count in below.items())
        found[name] = {"runs": len(p_values), "below": {str(level): count for level, count in below.items()}, "binomial_p": p,
                       "passed": p >= CHANCE / len(values) / len(COARSE)}
    return found


def _about(subject: Subject, checks: Sequence[Check]) -> dict[str, Any]:
    """What runs have in common that count together: what is examined, by which checks, a hash of all code that does so,
    and versions."""
    from olpm_bench.bench import environment

    files, own = sorted(Path(__file__).parent.glob("*.py")), subject.name.rpartition(":")[0]
    code = digest(own_code().encode(), *(file.read_bytes() for file in [*files, *([Path(own)] if own else [])]))
    return plain({"representation": subject.specification, "declared": sorted(subject.declared),
                  "checks": [check.name for check in checks], "code": code, "variant": mi.variant(),
                  "versions": environment.versions()})


def _append(log: Path, line: str) -> None:
    """Add a line, after what a process that was killed may have left of one."""
    log.parent.mkdir(parents=True, exist_ok=True)
    cut = log.exists() and log.read_bytes()[-1:] not in (b"", b"\n")
    with log.open("a", encoding="utf-8") as file:
        file.write("\n" * cut + line + "\n")


def _logged(log: Path | None, about: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """The runs in the file that are `about` the same, by their seeds.

    Raises:
        ResultError: a line that is none of ours, nor the beginning of one.
    """
    found, text = {}, log.read_text(encoding="utf-8", errors="replace") if log and log.exists() else ""
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith('{"') and not line.endswith("}"):        # a process was killed while it wrote
            continue
        try:
            run = json.loads(line)
            if all(run[key] == value for key, value in about.items()):
                found[int(run["seed"])] = {**run, "passed": bool(run["passed"]), "p": float(run["p"]),
                                           "smallest": {name: float(p) for name, p in run["smallest"].items()}}
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            raise ResultError(f"{log}: line {number} is broken; remove it") from None
    return found


@contextlib.contextmanager
def _examiner(subject: Subject) -> Iterator[Run]:
    """`suite.run`, for other people's code in another process."""
    if subject.name in representations.BUILT_IN:
        yield suite.run
        return
    with isolated.Examiner() as examiner:
        yield examiner.run


def _run(run: Run, subject: Subject, checks: Sequence[Check]) -> list[Outcome]:
    outcomes: list[Outcome] = []
    with Bar(len(checks)) as bar:
        for outcome in run(subject, checks):
            outcomes.append(outcome)
            bar.at(len(outcomes), outcome.check.name)
    return outcomes


def _draw(outcome: Outcome, subject: Subject, folder: Path) -> Path | None:
    """The picture of a failure; None if there is none, or it can't be written: verdicts do not depend on pictures."""
    panels = outcome.verdict.panels()
    if not panels:
        return None
    path = folder / slug(Path(subject.name.replace(":", "-")).name) / f"{outcome.check.name}.png"
    try:
        verdicts.picture(panels, f"{subject.name}, {outcome.check.name}: {outcome.verdict.worst}", path)
    except OSError as error:
        print(f"olpm-bench: no picture of {outcome.check.name}: {error}", file=sys.stderr)
        return None
    return path
