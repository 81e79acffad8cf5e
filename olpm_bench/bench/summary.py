"""From cells to numbers: one row a scene and method, the table, and the comparison at equal error.

Reads results, renders nothing: a new metric needs no new cell.
"""
from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import advice, bias, gains, metrics, statistics
from olpm_bench.bench.bias import APART
from olpm_bench.bench.clock import MAX_WAITED, UNRELIABLE
from olpm_bench.bench.files import SCHEMA_VERSION, ResultError, plain
from olpm_bench.bench.flip import exposures
from olpm_bench.bench.results import Cell, Results, warnings
from olpm_bench.bench.terminal import plain_console

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from olpm_bench.bench.config import Experiment
    from olpm_bench.bench.finished import Final, Finished, FinishedScene


def complete_cells(experiment: Experiment, results: Results, any_version: bool = False) -> dict[tuple[str, str], list[Cell]]:
    """Every cell of the experiment: (scene, method) -> one per seed, in the order of the TOML.

    Args:
        any_version: cells of these settings count also if other code, or another file of the scene, has made them.

    Raises:
        ResultError: a cell is missing or was made by another configuration; the message names it and the command that
            makes it.
    """
    cells: dict[tuple[str, str], list[Cell]] = {
        (scene.name, method.name): [] for scene in experiment.scene for method in experiment.method}
    for spec in experiment.cells():
        size = spec.scene.height, spec.scene.width
        cell = results.read_cell(spec.scene.name, spec.method.name, spec.seed, size)
        if cell is None or not (cell.info.get("key") == spec.key
                                or (any_version and _agrees(cell.config(), plain(spec.config())))):
            state = "missing" if cell is None else "of another configuration"
            raise ResultError(f"cell {spec} in {results.folder} is {state}; make it with: "
                              f"{experiment.command('run', results.folder.parent)}")
        cells[spec.scene.name, spec.method.name].append(cell)
    return cells


def _agrees(stored: Any, now: Any) -> bool:
    """Whether two configurations have the same values; keys that one version has and another has not do not count."""
    if isinstance(stored, dict) and isinstance(now, dict):
        return all(_agrees(stored[key], now[key]) for key in stored.keys() & now.keys())
    return bool(stored == now)


def summarise(finished: Finished) -> dict[str, Any]:
    """The summary of an experiment: ``{"schema_version", "rows", "flip_exposures"}``.

    There is one row a scene and method, in the TOML's order, and by scene the `flip.Exposures` of HDR-FLIP, None without a
    reference or with a black one.

    Over seeds, a figure is the median, also each of `metrics.METRICS`; but `l1_low` and `l1_high` are the 5 and 95 %
    quantiles, `mean` is the mean of `metrics.mean` with its standard error, `compile_seconds` and `wait_fraction` are the
    largest, and `overrun` is the largest share by which a cell exceeds a budget in seconds.  `noise_floor` is the reference's.
    `work_normalised_variance` [s] and `gain` are those of :mod:`olpm_bench.bench.gains` by the median, with `_trimmed` and
    `_mean` by the means over pixels, each with its 90 % interval; `variance_passes` are the passes of all cells that they
    stand on, and `undefined` says which of them, and which metrics, there are not and why.  `speed_up` is how many times as
    fast it is to equal L1 (at least, or at most, by `speed_up_bound` ">" or "<"), `worst_speed_up` by
    `statistics.worst_speed_up`.
    `apart`, `bias_seen` and `block_bias_seen` are the `bias.Difference` from the baseline, `memory` is by `Cell.memory`
    [bytes], and `guided` the share of the surfaces that the camera sees whose records have learnt enough to guide;
    `warnings` are those of training.  What has no value (a spread of one seed, the error of a scene without reference,
    what a guide has without one) is None.
    """
    budget = finished.experiment.budget.seconds
    rows = [_row(scene, method, budget) for scene in finished.scenes for method in scene.cells]
    found = {scene.scene.name: exposures(scene.reference.mean) if scene.reference is not None else None
             for scene in finished.scenes}
    return {"schema_version": SCHEMA_VERSION, "rows": rows,
            "flip_exposures": {name: asdict(e) if e is not None else None for name, e in found.items()}}


def _row(scene: FinishedScene, method: str, budget: float | None) -> dict[str, Any]:
    cells, final = scene.cells[method], scene.final[method]
    differs = bias.difference(final.means, scene.final[scene.baseline].means)
    if method == scene.baseline:        # from itself
        differs = bias.Difference(0.0, np.nan, np.nan)
    info = {key: np.array([cell.info[key] for cell in cells], np.float64) for key in (      # null becomes NaN
        "training_passes", "train_seconds", "render_seconds", "compile_seconds", "wait_fraction", "spp", "records",
        "bytes_per_record", "particles", "mean", "mean_stderr", "charged_seconds")}
    l1 = statistics.median_band(final.errors["l1"])
    faster = scene.speed_ups.get(method, statistics.Interval(np.nan, np.nan, np.nan))
    return plain({
        "scene": scene.scene.name, "method": method, "seeds": [cell.seed for cell in cells],
        "l1": l1.median, "l1_low": l1.low, "l1_high": l1.high,
        **{name: np.median(values) for name, values in final.errors.items()},
        **_by_kind("work_normalised_variance", final.variances), **_by_kind("gain", final.gains),
        "variance_passes": final.passes, "undefined": undefined(final),
        "speed_up": faster.value, "speed_up_low": faster.low, "speed_up_high": faster.high, "speed_up_bound": faster.bound,
        "mean": np.mean(info["mean"]),
        "mean_stderr": np.sqrt(np.sum(info["mean_stderr"] ** 2)) / len(cells),      # seeds are independent
        "charged_seconds": np.median(info["charged_seconds"]),
        "overrun": np.max(info["charged_seconds"]) / budget - 1 if budget is not None else None,
        "training_passes": _whole(np.median(info["training_passes"])),
        "train_seconds": np.median(info["train_seconds"]), "render_seconds": np.median(info["render_seconds"]),
        "compile_seconds": np.max(info["compile_seconds"]), "wait_fraction": np.max(info["wait_fraction"]),
        "spp": _whole(np.median(info["spp"])), "records": _whole(np.median(info["records"])),
        "bytes_per_record": _whole(np.median(info["bytes_per_record"])),
        "particles": _whole(np.median(info["particles"])),
        "memory": _median([cell.memory() for cell in cells]), "guided": _median([cell.info.get("trained") for cell in cells]),
        "worst_speed_up": scene.worst_speed_ups.get(method),
        **differs._asdict(),
        "noise_floor": scene.reference.noise_floor if scene.reference is not None else None,
        "warnings": warnings([cell.info for cell in cells]),
    })


def _by_kind(name: str, found: Mapping[str, statistics.Interval]) -> dict[str, float]:
    """Columns for each of `gains.KINDS`: the value and the ends of its interval; the median has the bare name."""
    columns: dict[str, float] = {}
    for kind, interval in found.items():
        column = name if kind == "median" else f"{name}_{kind}"
        columns |= {column: interval.value, f"{column}_low": interval.low, f"{column}_high": interval.high}
    return columns


def undefined(final: Final) -> list[str]:
    """Which of a method's variances, gains and metrics there are not, and why, a sentence for each reason."""
    reasons: dict[str, list[str]] = {}
    for noun, found in (("variance", final.variances), ("gain", final.gains)):
        for reason in dict.fromkeys(interval.why for interval in found.values() if interval.why):
            kinds = [kind for kind, interval in found.items() if interval.why == reason]
            reasons.setdefault(reason, []).append(noun if kinds == list(found) else f"{noun} by {' or '.join(kinds)}")
    return [f"there is no {' and no '.join(nouns)}, since {reason}" for reason, nouns in reasons.items()] + final.failures


def _whole(value: np.floating) -> int:
    return round(float(value))


def _median(values: Sequence[float | None]) -> float | None:
    """None where a cell says nothing, as older ones do."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if len(known) == len(values) else None


def write(summary: dict[str, Any], results: Results) -> None:
    """Write summary.json and table.csv (seeds separated by spaces, sentences by semicolons, empty for no value) into the results
    folder."""
    results.write_json("summary.json", summary)
    text = io.StringIO()
    table = csv.DictWriter(text, list(summary["rows"][0]), lineterminator="\n")
    table.writeheader()
    table.writerows({**row, "seeds": " ".join(map(str, row["seeds"])),
                     **{key: "; ".join(row[key]) for key in ("undefined", "warnings")}}
                    for row in summary["rows"])
    results.write_text("table.csv", text.getvalue())


def print_table(summary: dict[str, Any], console: Console | None = None) -> None:
    """Print the rows: errors with their spread over seeds, seconds, counts; flags cells that waited or went wrong."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), collapse_padding=True, header_style="bold", pad_edge=False)
    scenes = list(dict.fromkeys(row["scene"] for row in summary["rows"]))
    for name in ("method", "L1", "5-95 %", "relMSE", "trimmed", "gain", "trimmed gain", "passes", "train s", "render s", "spp",
                 "records"):
        table.add_column(name, justify="left" if name == "method" else "right", no_wrap=True)
    for scene in scenes:
        rows = [row for row in summary["rows"] if row["scene"] == scene]
        table.add_row(Text(scene, style="bold"), *[""] * 11)
        best = min((row["l1"] for row in rows if row["l1"] is not None), default=None)
        for row in rows:
            spread = "-" if len(row["seeds"]) == 1 or row["l1"] is None else f"{number(row['l1_low'])}-{number(row['l1_high'])}"
            table.add_row(
                Text("  " + row["method"]),
                Text(number(row["l1"]), style="bold green" if row["l1"] is not None and row["l1"] == best else ""), spread,
                number(row["relmse"]), number(row["relmse_trimmed"]),
                with_ends(row, "gain"), with_ends(row, "gain_trimmed"), f"{row['training_passes']}",
                f"{row['train_seconds']:.1f}", f"{row['render_seconds']:.1f}", f"{row['spp']}", f"{row['records']}")
    console = console or plain_console()
    print_whole(table, console)
    print_variances(summary, console)
    _print_notes(summary, console)


def print_variances(summary: dict[str, Any], console: Console) -> None:
    """Print what is known of the variances and gains of each row, and on how many seeds and passes it stands."""
    from rich.table import Table
    from rich.text import Text

    title = "Relative variance of a pixel x seconds, and gain over the baseline, with 90 % intervals"
    table = Table(box=None, padding=(0, 1), collapse_padding=True, header_style="bold", pad_edge=False)
    for name in ("method", "seeds", "passes", *(f"{what}, {kind}" for kind in gains.KINDS for what in ("var x s", "gain"))):
        table.add_column(name, justify="left" if name == "method" else "right", no_wrap=True)
    scene = None
    for row in summary["rows"]:
        if row["scene"] != scene:
            scene = row["scene"]
            table.add_row(Text(scene, style="bold"), *[""] * 8)
        columns = [f"{name}{suffix}" for suffix in ("", "_trimmed", "_mean") for name in ("work_normalised_variance", "gain")]
        table.add_row(Text("  " + row["method"]), f"{len(row['seeds'])}", f"{row['variance_passes']}",
                      *(with_ends(row, column) for column in columns))
    console.print()
    console.print(title, style="bold", markup=False, highlight=False, soft_wrap=True)
    print_whole(table, console)


def print_metrics(summary: dict[str, Any], console: Console | None = None) -> None:
    """Print every metric of every row, and what is to be known of the cells."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), header_style="bold", pad_edge=False)
    for name in ("scene", "method", *metrics.METRICS):
        table.add_column(name, justify="left" if name in ("scene", "method") else "right", no_wrap=True)
    for row in summary["rows"]:
        table.add_row(Text(row["scene"]), Text(row["method"]), *(number(row[name]) for name in metrics.METRICS))
    console = console or plain_console()
    print_whole(table, console)
    _print_notes(summary, console)


def notes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is to be known of the cells of a table's rows: that they waited, took long, had to warn, were overtaken, or
    differ in the mean."""
    shared = set.intersection(*(set(row["undefined"]) for row in rows)) if len(rows) > 1 else set()
    found = [sentence for sentence in rows[0]["undefined"] if sentence in shared]       # of all rows: told once
    for row in rows:
        said = [sentence for sentence in row["undefined"] if sentence not in shared] + list(row["warnings"])
        if row["wait_fraction"] > UNRELIABLE:
            said.append(f"timings unreliable: other programs kept it from the processor for {row['wait_fraction']:.0%} of "
                        "the time, so delete its cells and run it again on an idle machine")
        elif row["wait_fraction"] > MAX_WAITED:
            said.append(f"waited {row['wait_fraction']:.0%} of its time for a busy core")
        said += advice.sentences(row)
        if row["apart"] > APART:
            said.append(f"its mean image is {row['apart']:.0f} standard errors from the baseline's, in the whole or in a "
                        "block: one of the two is biased, or has too few samples to know its error")
        found += [f"{row['scene']} / {row['method']}: {words}" for words in said]
    return found


def bias_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """How large a bias would have been seen between the mean images of each method and the baseline, in words."""
    lines = []
    for row in rows:
        shares = [np.nan if row[key] is None else row[key] for key in ("bias_seen", "block_bias_seen")]
        seen = str(bias.Difference(row["apart"], *shares))
        if seen and row["apart"] <= APART:          # that others are apart, `notes` says
            lines.append(f"{row['scene']} / {row['method']}: its mean image agrees with the baseline's; {seen}")
    return lines


def _print_notes(summary: dict[str, Any], console: Console) -> None:
    for line in bias_lines(summary["rows"]):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    for note in notes(summary["rows"]):
        console.print(note, style="yellow", markup=False, highlight=False, soft_wrap=True)


def print_whole(table: Table, console: Console) -> None:
    """Print a table as wide as it is: a narrow terminal wraps the lines, and no number is cut off."""
    terminal, needed = console.width, console.measure(table, options=console.options.update(width=1000)).maximum
    console.width = max(terminal, needed)
    console.print(table)
    console.width = terminal


def with_ends(row: Mapping[str, Any], column: str, dash: str = "-") -> str:
    """A number of a row and its interval; a dash where there is none, as no number stands without its interval."""
    ends = [row[column + end] for end in ("_low", "_high")]
    if None in ends:
        return "-"
    return f"{number(row[column])} ({number(ends[0])}{dash}{number(ends[1])})"


def print_speed_ups(found: Mapping[str, Mapping[str, statistics.Interval]], baseline: str,
                    console: Console | None = None) -> None:
    """Print `speed_up_lines`."""

    console = console or plain_console()
    for line in speed_up_lines(found, baseline):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


def speed_up_lines(found: Mapping[str, Mapping[str, statistics.Interval]], baseline: str) -> list[str]:
    """The speed-ups over `baseline` at equal L1 with 90 % intervals, and their geometric mean over scenes, in words."""
    lines = []
    for method, scenes in found.items():
        lines += [f"{scene} / {method}: {_ratio(interval, baseline)}" for scene, interval in scenes.items()]
        values = [interval.value for interval in scenes.values()]
        if len(values) > 1 and np.isfinite(values).all() and not any(interval.bound for interval in scenes.values()):
            lines.append(f"{method}: {statistics.geometric_mean(values):.2g}x, geometric mean of {len(values)} scenes")
    return lines


def _ratio(interval: statistics.Interval, baseline: str) -> str:
    if not math.isfinite(interval.value):
        return f"shares no L1 error with {baseline}"
    if not interval.bound and not interval.ends():
        return f"its speed-up over {baseline} has no interval, which takes 3 seeds that all reach the L1 error"
    bound = {">": "more than ", "<": "less than ", "": ""}[interval.bound]
    return f"{bound}{interval.value:.2g}x{interval.ends()} as fast as {baseline} at equal L1"


def number(value: float | None) -> str:
    """Three significant digits, without an exponent where it stays short; a dash for no value."""
    if value is None or not math.isfinite(value):
        return "-"
    if value == 0:
        return "0"
    decimals = 2 - math.floor(math.log10(abs(value)))
    if decimals > 6 or decimals < -4:
        return f"{value:.2e}"
    return f"{round(value, decimals):.{max(decimals, 0)}f}"
