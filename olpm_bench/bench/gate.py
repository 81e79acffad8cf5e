"""Claims of an experiment, put to the test: is one method better than another by the factor that the file states?

What a claim is about is a ratio of expectations.  For an error that is the ratio of the expected errors of the image of one
seed.  For a variance it is the ratio of the variances of a pixel in the image of one cell, relative to the squared radiance
around it as gains have it, averaged over all pixels; work-normalised, each is multiplied by the charged seconds of its cell.
Both come as one number a seed and method, whose expectation is what the claim is about, and seeds are paired.

A claim holds if the upper bound of :mod:`olpm_bench.bench.ratio_bound` does not exceed what it states, and so never for a lack
of data.  A variance that is a mean over pixels has few pixels that matter, so its bound allows for three more outliers as large
as the largest that was seen (rule of three).  A claim does not hold where the mean images of the two differ: who is biased is
not better.  All claims must hold, which needs no correction for their number.
"""
from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import bias, gains, metrics, pixel_variance
from olpm_bench.bench.config import Claim, ConfigError, Experiment
from olpm_bench.bench.files import SCHEMA_VERSION
from olpm_bench.bench.pixel_variance import CellImages
from olpm_bench.bench.ratio_bound import MIN_SEEDS, ratio_bound
from olpm_bench.bench.reference_file import Reference
from olpm_bench.bench.results import Results
from olpm_bench.bench.statistics import Interval
from olpm_bench.bench.summary import complete_cells, number, print_whole
from olpm_bench.bench.terminal import plain_console

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Verdict:
    """A claim in one scene: the measured ratio, the bounds that it keeps with the claim's confidence each, and how far the
    two mean images differ."""
    scene: str
    claim: Claim
    ratio: float
    low: float
    high: float
    difference: bias.Difference

    @property
    def holds(self) -> bool:
        return self.high <= self.claim.ratio and self.difference.apart <= bias.APART        # not for NaN

    def __str__(self) -> str:
        said = f": {self.difference}" if str(self.difference) else ""
        return f"{'holds' if self.holds else 'FAILS'}{said}"

    def as_dict(self) -> dict[str, Any]:
        return {**self.claim.model_dump(exclude={"ratio"}), "claimed": self.claim.ratio, "holds": self.holds,
                **{k: v for k, v in asdict(self).items() if k not in ("claim", "difference")},
                **self.difference._asdict()}


def check(experiment: Experiment) -> None:
    """
    Raises:
        ConfigError: no claims, fewer seeds than `MIN_SEEDS`, or an error of a scene that does without a reference.
    """
    name = experiment.path.name
    if not experiment.claim:
        raise ConfigError(f'{name} claims nothing: a [[claim]] has keys {", ".join(Claim.model_fields)}')
    if len(experiment.seeds) < MIN_SEEDS:
        raise ConfigError(f"{name}: seeds = {len(experiment.seeds)}: a claim needs at least {MIN_SEEDS}, "
                          "since rare events leave no trace in fewer")
    for claim in experiment.claim:
        for scene in experiment.scene:
            if claim.metric in metrics.METRICS and not scene.has_reference:
                raise ConfigError(f"{name}: metric = {claim.metric!r} needs a reference, and scene {scene.name!r} does without; "
                                  f"known without: {', '.join(metrics.VARIANCES)}")


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
            both = [cells[scene.name, method] for method in (claim.better, claim.worse)]
            better, worse = (pixel_variance.read(group) for group in both)
            found = ratio(claim, better, worse, references.get(scene.name))
            means = [bias.means(group, images) for group, images in zip(both, (better, worse), strict=True)]
            verdicts.append(Verdict(scene.name, claim, found.value, found.low, found.high, bias.difference(*means)))
    return verdicts


def ratio(claim: Claim, better: CellImages, worse: CellImages, reference: Reference | None) -> Interval:
    """What a claim is about, with bounds that hold with its confidence each.

    Args:
        better, worse: images of as many seeds.
        reference: of the scene; only variances do without.
    """
    if claim.metric in metrics.VARIANCES:
        return _ratio_of_variances(claim, better, worse, reference)
    assert reference is not None
    of_better, of_worse = (metrics.error(claim.metric, images.mean, reference.mean)[0] for images in (better, worse))
    return ratio_bound(of_better, of_worse, claim.confidence)


def _ratio_of_variances(claim: Claim, better: CellImages, worse: CellImages, reference: Reference | None) -> Interval:
    """The ratio of the mean variances of a pixel."""
    both = [better, worse]
    if claim.metric == "relative_variance":
        both = [replace(images, seconds=np.ones(len(images))) for images in both]
    radiance = reference.mean if reference is not None else np.mean([images.mean.mean(axis=0) for images in both], axis=0)
    of_better, of_worse = (gains.normalised(gains.work_variance(name, images), radiance).by_cell
                           for name, images in zip((claim.better, claim.worse), both, strict=True))
    seeds_of_better, seeds_of_worse = (v.mean(axis=(1, 2), dtype=np.float64) for v in (of_better, of_worse))
    return ratio_bound(seeds_of_better, seeds_of_worse, claim.confidence, (_unseen(of_better), _unseen(of_worse)))


def _unseen(variances: np.ndarray) -> float:
    """What the mean of (seeds, h, w) would grow by with three more outliers as large as the largest."""
    return gains.UNSEEN * float(variances.max()) / variances.size


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
        ends = f"{number(v.low)}-{number(v.high)}" if math.isfinite(v.high) else f"{number(v.low)} or more"
        bounds = f"{ends} ({v.claim.confidence:.3g} each)"
        table.add_row(Text(v.scene), Text(claim), number(v.ratio), bounds,
                      Text(str(v), style="green" if v.holds else "bold red"))
    print_whole(table, console or plain_console())
