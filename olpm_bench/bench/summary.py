"""From cells to numbers: one row a scene and method, the table, and the comparison at equal error.

Reads results, renders nothing: a new metric needs no new cell.
"""
from __future__ import annotations

import csv
import io
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import metrics, statistics
from olpm_bench.bench.clock import WAITED
from olpm_bench.bench.results import SCHEMA_VERSION, Cell, Reference, ResultError, Results, plain

if TYPE_CHECKING:
    from rich.console import Console

    from olpm_bench.bench.config import Experiment, Scene

COLUMNS = ("scene", "method", "seeds", "l1", "l1_low", "l1_high", "relmse", "relmse_trimmed",
           "work_normalised_variance", "gain", "gain_low", "gain_high", "mean", "mean_stderr", "training_passes",
           "train_seconds", "render_seconds", "compile_seconds", "wait_fraction", "spp", "records", "bytes_per_record",
           "particles", "invalid_pixels")


def complete_cells(experiment: Experiment, results: Results) -> dict[tuple[str, str], list[Cell]]:
    """Every cell of the experiment: (scene, method) -> one per seed, in the order of the TOML.

    Raises:
        ResultError: a cell is missing or was made by another configuration; the message names it and the command that
            makes it.
    """
    keys = {(spec.scene.name, spec.method.name, spec.seed): spec.key for spec in experiment.cells()}
    cells: dict[tuple[str, str], list[Cell]] = {
        (scene.name, method.name): [] for scene in experiment.scene for method in experiment.method}
    for (scene, method, seed), key in keys.items():
        cell = results.read_cell(scene, method, seed)
        if cell is None or cell.info.get("key") != key:
            state = "missing" if cell is None else "of another configuration"
            raise ResultError(f"cell {scene} / {method} / seed {seed} in {results.folder} is {state}; "
                              f"make it with: {_command('run', experiment, results)}")
        cells[scene, method].append(cell)
    return cells


def scene_reference(references: Mapping[str, Reference], scene: Scene, results: Results,
                    experiment: Experiment) -> Reference | None:
    """The reference of a scene; None if the experiment does without.

    Raises:
        ResultError: there is none; the message names the command that makes it.
    """
    if not scene.has_reference:
        return None
    if scene.name not in references:
        raise ResultError(f"scene {scene.name} has no reference; make it with: {_command('reference', experiment, results)}")
    return references[scene.name]


def _command(name: str, experiment: Experiment, results: Results) -> str:
    return shlex.join([*experiment.command(name), "--results", str(results.folder.parent)])


def error_curve(cells: Sequence[Cell], reference: Reference,
                metric: Callable[[np.ndarray, np.ndarray], float] = metrics.l1,
                over: str = "seconds") -> statistics.Curve:
    """Error at the checkpoints of the cells (one per seed) over a column of their traces: charged seconds, or "spp"."""
    times = [np.array([line[over] for line in cell.trace], np.float64) for cell in cells]
    errors = [np.array([metric(image, reference.mean) for image in cell.checkpoints()]) for cell in cells]
    return statistics.common_curve(times, errors)


def summarise(experiment: Experiment, results: Results, references: Mapping[str, Reference]) -> dict[str, Any]:
    """The summary of an experiment: ``{"schema_version", "rows"}``, one row a scene and method, in the TOML's order.

    Over seeds, a figure is the median; but `l1_low` and `l1_high` are the 5 and 95 % quantiles, `mean` is the mean
    with its standard error, `compile_seconds` and `wait_fraction` are the largest, `invalid_pixels` is the sum.  `gain` is the
    baseline's work-normalised variance over the method's, with its 90 % bootstrap interval.  What has no value (a spread
    of one seed, the error of an image with NaN or of a scene without reference) is None.

    Args:
        references: by the name of the scene.

    Raises:
        ResultError: a cell or reference is missing.
    """
    cells, rows = complete_cells(experiment, results), []
    for scene in experiment.scene:
        reference = scene_reference(references, scene, results, experiment)
        images = {method.name: [cell.image()["mean"] for cell in cells[scene.name, method.name]] for method in experiment.method}
        works = {name: _work(cells[scene.name, name], means) for name, means in images.items()}
        for name, means in images.items():
            gain = statistics.gain(works[experiment.baseline_name], works[name])
            rows.append(_row(scene.name, name, cells[scene.name, name], means, reference, gain))
    return {"schema_version": SCHEMA_VERSION, "rows": rows}


def _work(cells: Sequence[Cell], images: Sequence[np.ndarray]) -> statistics.Work:
    seconds = np.array([cell.info["charged_seconds"] for cell in cells], np.float64)
    return statistics.Work(np.stack([metrics.luminance(image) for image in images]), seconds)


def _row(scene: str, method: str, cells: Sequence[Cell], images: Sequence[np.ndarray], reference: Reference | None,
         gain: statistics.Interval) -> dict[str, Any]:
    def errors(metric: Callable[[np.ndarray, np.ndarray], float]) -> list[float]:
        return [metric(image, reference.mean) if reference is not None else float("nan") for image in images]

    info = {key: np.array([cell.info[key] for cell in cells], np.float64) for key in (      # null becomes NaN
        "training_passes", "train_seconds", "render_seconds", "compile_seconds", "charged_seconds", "wait_fraction", "spp",
        "records", "bytes_per_record", "particles", "invalid_pixels", "mean", "mean_stderr")}
    l1 = statistics.median_band(errors(metrics.l1))
    row = {
        "scene": scene, "method": method, "seeds": [cell.seed for cell in cells],
        "l1": l1.median, "l1_low": l1.low, "l1_high": l1.high,
        "relmse": np.median(errors(metrics.relmse)), "relmse_trimmed": np.median(errors(metrics.relmse_trimmed)),
        "work_normalised_variance": metrics.work_normalised_variance(images, float(np.mean(info["charged_seconds"]))),
        "gain": gain.value, "gain_low": gain.low, "gain_high": gain.high, "mean": np.mean(info["mean"]),
        "mean_stderr": np.sqrt(np.sum(info["mean_stderr"] ** 2)) / len(cells),      # seeds are independent
        "training_passes": _whole(np.median(info["training_passes"])),
        "train_seconds": np.median(info["train_seconds"]), "render_seconds": np.median(info["render_seconds"]),
        "compile_seconds": np.max(info["compile_seconds"]), "wait_fraction": np.max(info["wait_fraction"]),
        "spp": _whole(np.median(info["spp"])), "records": _whole(np.median(info["records"])),
        "bytes_per_record": _whole(np.median(info["bytes_per_record"])),
        "particles": _whole(np.median(info["particles"])), "invalid_pixels": _whole(np.sum(info["invalid_pixels"])),
    }
    return {key: plain(row[key]) for key in COLUMNS}


def _whole(value: np.floating) -> int:
    return round(float(value))


def write(summary: dict[str, Any], results: Results) -> None:
    """Write summary.json and table.csv (seeds separated by spaces, empty for no value) into the results folder."""
    results.write_json("summary.json", summary)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for row in summary["rows"]:
        table.writerow([" ".join(map(str, row[key])) if key == "seeds" else row[key] for key in COLUMNS])
    results.write_text("table.csv", text.getvalue())


def speed_ups(experiment: Experiment, results: Results,
              references: Mapping[str, Reference]) -> dict[str, dict[str, statistics.Interval]]:
    """Speed-up of each method over the baseline at equal L1: method -> scene -> ratio of charged seconds.

    Scenes without reference are left out.
    """
    cells = complete_cells(experiment, results)
    baseline = experiment.baseline_name
    others = [method.name for method in experiment.method if method.name != baseline]
    found: dict[str, dict[str, statistics.Interval]] = {method: {} for method in others}
    for scene in experiment.scene:
        reference = scene_reference(references, scene, results, experiment)
        if reference is None:
            continue
        first = error_curve(cells[scene.name, baseline], reference)
        for method in others:
            found[method][scene.name] = statistics.speed_up(first, error_curve(cells[scene.name, method], reference))
    return found


def print_table(summary: dict[str, Any], console: Console | None = None) -> None:
    """Print the rows: errors with their spread over seeds, seconds, counts; flags cells that waited or went wrong."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), collapse_padding=True, header_style="bold", pad_edge=False)
    scenes = list(dict.fromkeys(row["scene"] for row in summary["rows"]))
    for name in ("method", "L1", "5-95 %", "relMSE", "trimmed", "var x s", "gain", "passes", "train s", "render s", "spp",
                 "records"):
        table.add_column(name, justify="left" if name == "method" else "right", no_wrap=True)
    notes = []
    for scene in scenes:
        rows = [row for row in summary["rows"] if row["scene"] == scene]
        table.add_row(Text(scene, style="bold"), *[""] * 11)
        best = min((row["l1"] for row in rows if row["l1"] is not None), default=None)
        for row in rows:
            spread = "-" if len(row["seeds"]) == 1 or row["l1"] is None else f"{number(row['l1_low'])}-{number(row['l1_high'])}"
            table.add_row(
                Text("  " + row["method"]),
                Text(number(row["l1"]), style="bold green" if row["l1"] is not None and row["l1"] == best else ""), spread,
                number(row["relmse"]), number(row["relmse_trimmed"]), number(row["work_normalised_variance"]),
                _gain(row), f"{row['training_passes']}",
                f"{row['train_seconds']:.1f}", f"{row['render_seconds']:.1f}", f"{row['spp']}", f"{row['records']}")
            label = f"{scene} / {row['method']}"
            if row["wait_fraction"] > WAITED:
                notes.append(f"{label}: waited {row['wait_fraction']:.0%} of its time for a busy core")
            if row["invalid_pixels"]:
                notes.append(f"{label}: {row['invalid_pixels']} pixels are NaN, infinite or negative")
    console = console or Console()
    terminal, needed = console.width, console.measure(table, options=console.options.update(width=1000)).maximum
    console.width = max(terminal, needed)       # a narrow terminal wraps the lines; no number is cut off
    console.print(table)
    console.width = terminal
    for note in notes:
        console.print(note, style="yellow", markup=False, highlight=False, soft_wrap=True)


def _gain(row: Mapping[str, Any]) -> str:
    spread = f" ({number(row['gain_low'])}-{number(row['gain_high'])})" if row["gain_low"] is not None else ""
    return number(row["gain"]) + spread


def print_speed_ups(found: Mapping[str, Mapping[str, statistics.Interval]], baseline: str,
                    console: Console | None = None) -> None:
    """Print the speed-ups over `baseline` at equal L1 with 90 % intervals, and their geometric mean over scenes."""
    from rich.console import Console

    console = console or Console()
    for method, scenes in found.items():
        lines = [f"{scene} / {method}: {_ratio(interval, baseline)}" for scene, interval in scenes.items()]
        values = [interval.value for interval in scenes.values()]
        if len(values) > 1 and np.isfinite(values).all() and not any(interval.bound for interval in scenes.values()):
            lines.append(f"{method}: {statistics.geometric_mean(values):.2g}x, geometric mean of {len(values)} scenes")
        for line in lines:
            console.print(line, markup=False, highlight=False, soft_wrap=True)


def _ratio(interval: statistics.Interval, baseline: str) -> str:
    if not math.isfinite(interval.value):
        return f"shares no L1 error with {baseline}"
    spread = f" ({interval.low:.2g}-{interval.high:.2g})" if math.isfinite(interval.low) and not interval.bound else ""
    bound = {">": "more than ", "<": "less than ", "": ""}[interval.bound]
    return f"{bound}{interval.value:.2g}x{spread} as fast as {baseline} at equal L1"


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
