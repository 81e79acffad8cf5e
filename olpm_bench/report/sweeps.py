"""The figure of methods that sweep a setting: error, memory or training time over it, a curve a series, log-log.

Reads results, renders nothing.  Methods without a sweep are level lines.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from olpm_bench.bench import metrics, statistics, summary
from olpm_bench.bench.config import Experiment, Method
from olpm_bench.bench.files import read_json
from olpm_bench.bench.reference_file import Reference
from olpm_bench.bench.results import Cell, Results
from olpm_bench.bench.sweep import short
from olpm_bench.report import figures

PARTICLE_BYTES = 48         # position, direction, normal, weight and distance as `transport.particles` stores them

LABELS = {"l1": "L1 error", "relmse": "relMSE", "bytes": "memory of learning [MB]", "train_seconds": "training [s]"}
ERRORS: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {"l1": metrics.l1, "relmse": metrics.relmse}


def sweeps(results: Results, experiment: Experiment, references: Mapping[str, Reference], out: Path | None = None) -> bool:
    """Write sweep.png and sweep.pdf into `out` (the results folder by default), if some method sweeps a setting.

    Errors are left out of scenes without reference.

    Returns:
        Whether there was something to draw.

    Raises:
        ResultError: a cell or reference is missing; the message names the command that makes it.
    """
    if not any(method.series for method in experiment.method):
        return False
    cells = summary.complete_cells(experiment, results)
    names = tuple(dict.fromkeys(_series(method) for method in experiment.method))
    panels = []
    for scene in experiment.scene:
        reference = summary.scene_reference(references, scene, results, experiment)
        for quantity in experiment.sweep.y:
            if reference is None and quantity in ERRORS:
                continue
            curves = _curves(experiment, {m.name: cells[scene.name, m.name] for m in experiment.method}, quantity, reference)
            if curves:
                floor = reference.noise_floor if reference is not None and quantity == "l1" else None
                panels.append(figures.Panel(
                    title=scene.name if len(experiment.scene) > 1 else "", curves=curves, training={},
                    budget=max(float(curve.times[-1]) for curve in curves.values()), floor=floor or 0.0,
                    abscissa=_abscissa(experiment), ordinate=LABELS[quantity], numbers=short, slope=False, looks=names))
    if not panels:
        return False
    with figures.style():
        figure = figures.draw(panels, experiment.title, _caption(experiment, results))
        figures.save(figure, out or results.folder, "sweep")
    return True


def _curves(experiment: Experiment, cells: Mapping[str, Sequence[Cell]], quantity: str,
            reference: Reference | None) -> dict[str, statistics.Curve]:
    """Series -> the quantity of every seed over the abscissa; what is zero has no place on a logarithmic axis."""
    points: dict[str, list[tuple[float, list[float]]]] = {}
    for method in experiment.method:
        group = cells[method.name]
        points.setdefault(_series(method), []).append((_position(experiment, method, group),
                                                       [_value(cell, quantity, reference) for cell in group]))
    swept = [x for series in points.values() for x, _ in series if x > 0]
    curves = {}
    for name, series in points.items():
        ordered = sorted(series)
        if ordered[0][0] == 0:          # no sweep: level
            ordered = [(x, ordered[0][1]) for x in sorted({min(swept), max(swept)})]
        x, y = np.array([x for x, _ in ordered]), np.array([y for _, y in ordered]).T
        if (y > 0).all():
            curves[name] = statistics.Curve(x, y)
    return curves


def _series(method: Method) -> str:
    return method.series.name if method.series else method.name


def _position(experiment: Experiment, method: Method, cells: Sequence[Cell]) -> float:
    """Where a method is on the abscissa; 0 if it belongs to no series."""
    if method.series is None:
        return 0.0
    if experiment.sweep.x == "photons":
        return float(np.median([sum(done["photons"] for done in cell.info["passes"]) for cell in cells]))
    return method.series.value


def _value(cell: Cell, quantity: str, reference: Reference | None) -> float:
    if quantity in ERRORS:
        assert reference is not None
        return ERRORS[quantity](cell.image()["mean"], reference.mean)
    if quantity == "bytes":
        stored = max((done["stored"] for done in cell.info["passes"]), default=0)
        return (cell.info["records"] * cell.info["bytes_per_record"] + PARTICLE_BYTES * stored) / 1e6
    return float(cell.info[quantity])


def _abscissa(experiment: Experiment) -> str:
    if experiment.sweep.x == "photons":
        return "photons traced"
    settings = dict.fromkeys(method.series.setting for method in experiment.method if method.series)
    return " or ".join(setting.partition(".")[2].replace("_", " ") for setting in settings)


def _caption(experiment: Experiment, results: Results) -> str:
    n, budget = len(experiment.seeds), experiment.budget
    seeds = f"Median and 5\N{EN DASH}95 % band of {n} seeds" if n > 1 else "One seed"
    spent = f"{budget.seconds:g} s a method, training included" if budget.seconds else f"{budget.spp} samples per pixel"
    memory = " Memory: the guide, and the most particles stored at once." if "bytes" in experiment.sweep.y else ""
    return f"{seeds}; {spent}.{memory} {figures.machine(read_json(results.folder / 'env.json'))}"
