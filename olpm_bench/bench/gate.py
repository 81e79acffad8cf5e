"""Claims of an experiment, put to the test: is one method better than another by the factor that the file states?

Seeds are paired.  The ratio of two errors is the geometric mean over seeds of the paired ratios, bounded from above by a
bootstrap over seeds; that of two variances is of all seeds together, bounded by a jackknife.  A claim holds if that bound does
not exceed what it states, and so never for a lack of data; nor where the mean images of the two differ: who is biased is not
better.  All claims must hold, which needs no correction for their number.
"""
from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import metrics, statistics
from olpm_bench.bench.bias import APART
from olpm_bench.bench.config import Claim, ConfigError, Experiment
from olpm_bench.bench.files import SCHEMA_VERSION
from olpm_bench.bench.reference_file import Reference
from olpm_bench.bench.results import Cell, Results
from olpm_bench.bench.summary import apart, complete_cells, number, print_whole, work
from olpm_bench.bench.terminal import plain_console

if TYPE_CHECKING:
    from rich.console import Console

LEAST_SEEDS = 8


@dataclass(frozen=True)
class Verdict:
    """A claim in one scene: the measured ratio, the bounds that it keeps with the claim's confidence each, and by how many
    standard errors the two mean images differ."""
    scene: str
    claim: Claim
    ratio: float
    low: float
    high: float
    apart: float

    @property
    def holds(self) -> bool:
        return self.high <= self.claim.ratio and self.apart <= APART        # not for NaN

    def __str__(self) -> str:
        biased = f": the means are {self.apart:.0f} standard errors apart" if self.apart > APART else ""
        return "holds" if self.holds else f"FAILS{biased}"

    def as_dict(self) -> dict[str, Any]:
        return {**self.claim.model_dump(exclude={"ratio"}), "claimed": self.claim.ratio, "holds": self.holds,
                **{k: v for k, v in asdict(self).items() if k != "claim"}}


def check(experiment: Experiment) -> None:
    """
    Raises:
        ConfigError: no claims, fewer seeds than 8, or an error of a scene that does without a reference.
    """
    name = experiment.path.name
    if not experiment.claim:
        raise ConfigError(f'{name} claims nothing: a [[claim]] has keys {", ".join(Claim.model_fields)}')
    if len(experiment.seeds) < LEAST_SEEDS:
        raise ConfigError(f"{name}: seeds = {len(experiment.seeds)}: a claim needs at least {LEAST_SEEDS}")
    for claim in experiment.claim:
        for scene in experiment.scene:
            if claim.metric in metrics.METRICS and not scene.has_reference:
                raise ConfigError(f"{name}: metric = {claim.metric!r} needs a reference, and scene {scene.name!r} does without; "
                                  f"known without: {', '.join(metrics.OVER_SEEDS)}")


def judge(experiment: Experiment, results: Results, references: dict[str, Reference]) -> list[Verdict]:
    """The verdicts, claim by claim and scene by scene.

    Raises:
        ConfigError: as `check`; ResultError: a cell or a reference is missing.
    """
    check(experiment)
    cells = complete_cells(experiment, results)
    verdicts = []
    for claim in experiment.claim:
        for scene in experiment.scene:
            better, worse = cells[scene.name, claim.better], cells[scene.name, claim.worse]
            ratio = _ratio(claim, better, worse, references.get(scene.name))
            verdicts.append(Verdict(scene.name, claim, ratio.value, ratio.low, ratio.high, apart(better, worse)))
    return verdicts


def _ratio(claim: Claim, better: list[Cell], worse: list[Cell], reference: Reference | None) -> statistics.Interval:
    n = len(better)
    images = [[cell.image()["mean"] for cell in cells] for cells in (better, worse)]
    if claim.metric in metrics.OVER_SEEDS:
        variance = metrics.OVER_SEEDS[claim.metric]
        works = work(better, images[0]), work(worse, images[1])

        def of_variances(index: np.ndarray) -> float:
            a, b = (variance(w.luminance[index], w.seconds[index]) for w in works)
            return a / b if b > 0 else float("nan")
        return statistics.jackknife(of_variances, n, confidence=claim.confidence)
    assert reference is not None
    metric = metrics.METRICS[claim.metric]
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (np.log([metric(image, reference.mean) for image in method]) for method in images)
        return statistics.bootstrap(lambda index: float(np.exp(np.mean(a[index] - b[index]))), n,
                                    band=statistics.expanded_band(claim.confidence, n))


def write(verdicts: list[Verdict], results: Results) -> None:
    """Write gate.json."""
    results.write_json("gate.json", {"schema_version": SCHEMA_VERSION, "holds": all(v.holds for v in verdicts),
                                     "claims": [v.as_dict() for v in verdicts]})


def print_verdicts(verdicts: list[Verdict], console: Console | None = None) -> None:
    """Print a line for each claim and scene."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), header_style="bold", pad_edge=False)
    for name in ("scene", "claim", "ratio", "bounds", ""):
        table.add_column(name, justify="right" if name in ("ratio", "bounds") else "left", no_wrap=True)
    for v in verdicts:
        claim = f"{v.claim.metric} of {v.claim.better} <= {v.claim.ratio:g} x that of {v.claim.worse}"
        bounds = f"{number(v.low)}-{number(v.high)} ({v.claim.confidence:.3g} each)"
        table.add_row(Text(v.scene), Text(claim), number(v.ratio), bounds,
                      Text(str(v), style="green" if v.holds else "bold red"))
    print_whole(table, console or plain_console())
