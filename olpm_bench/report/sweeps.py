"""The figure of methods that sweep a setting: error, memory or training time over it, a curve a series, log-log.

Reads results, renders nothing.  Methods without a sweep are level lines.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from olpm_bench.bench import statistics
from olpm_bench.bench.config import Experiment, Method, Series
from olpm_bench.bench.finished import Finished, FinishedScene
from olpm_bench.bench.sweep import short
from olpm_bench.report import figures, sheet

LABELS = {"l1": "L1 error", "relmse": "relMSE", "bytes": "memory of learning [MB]", "train_seconds": "training [s]"}
ERRORS = ("l1", "relmse")


def sweeps(found: Finished) -> list[str]:
    """Write sweep.png, sweep.pdf and sweep.svg into the results folder, if some method sweeps a setting; return their names.

    Errors are left out of scenes without reference.
    """
    experiment = found.experiment
    if not any(method.series for method in experiment.method):
        return []
    panels = []
    for scene in found.scenes:
        for quantity in experiment.sweep.y:
            if scene.reference is None and quantity in ERRORS:
                continue
            if curves := _curves(experiment, scene, quantity):
                floor = scene.reference.noise_floor if scene.reference is not None and quantity == "l1" else None
                panels.append(figures.Panel(
                    title=scene.scene.name if len(experiment.scene) > 1 else "", curves=curves, looks=experiment.looks,
                    training={}, budget=max(float(curve.times[-1]) for curve in curves.values()), floor=floor or 0.0,
                    abscissa=_abscissa(experiment), ordinate=LABELS[quantity], numbers=short, slope=False))
    if not panels:
        return []
    with figures.style():
        return figures.save(figures.draw(panels, experiment.title, _caption(found)), found.results.folder, "sweep")


def _curves(experiment: Experiment, scene: FinishedScene, quantity: str) -> dict[str, statistics.Curve]:
    """Method or sweep -> the quantity of every seed over the abscissa; what is zero has no place on a logarithmic axis."""
    points: dict[str, list[tuple[float, list[float]]]] = {}
    for method in experiment.method:
        if method.series is not None and (x := _position(experiment, method, method.series, scene)) > 0:
            points.setdefault(method.series.name, []).append((x, _values(scene, method.name, quantity)))
    swept = {x for series in points.values() for x, _ in series}
    level = {method.name: [(x, _values(scene, method.name, quantity)) for x in {min(swept), max(swept)}]
             for method in experiment.method if method.series is None and swept}
    curves = {}
    for name, series in (level | points).items():
        series = sorted(series)
        values = np.array([values for _, values in series]).T
        if (values > 0).all():
            curves[name] = statistics.Curve(np.array([x for x, _ in series]), values)
    return curves


def _position(experiment: Experiment, method: Method, series: Series, scene: FinishedScene) -> float:
    """Where a method of a sweep is on the abscissa; counts are those done, of which a budget in seconds may cut some off."""
    if experiment.sweep.x == "photons":
        return _median(scene, method, lambda passes: sum(p["photons"] for p in passes))
    if series.setting == "training.passes" and (training := experiment.training_of(method)) is not None:
        # By photons, for the passes of a single batch are one, and those of importons that go first are none.
        return _median(scene, method, lambda passes: sum(p["photons"] for p in passes) / training.photons)
    if series.setting == "training.camera_passes":          # later ones belong to rendering
        return _median(scene, method, lambda passes: sum(p["spp"] > 0 and p["index"] < p["passes"] for p in passes))
    return series.value


def _median(scene: FinishedScene, method: Method, count: Callable[[list[dict[str, Any]]], float]) -> float:
    """Median over seeds of what is counted in the training passes of a cell."""
    return float(np.median([count(cell.info["passes"]) for cell in scene.cells[method.name]]))


def _cut_short(found: Finished) -> list[str]:
    """The methods of sweeps that did less than their setting asked for, and how much that is."""
    experiment = found.experiment
    if experiment.sweep.x == "photons":
        return []
    where = {scene.scene.name: f" in {scene.scene.name}" if len(found.scenes) > 1 else "" for scene in found.scenes}
    return [f"{method.name} at {x:g}{where[scene.scene.name]}" for scene in found.scenes for method in experiment.method
            if method.series is not None and (x := _position(experiment, method, method.series, scene)) < method.series.value]


def _values(scene: FinishedScene, method: str, quantity: str) -> list[float]:
    """The quantity of every seed."""
    if quantity in ERRORS:
        return [float(error) for error in scene.final[method].errors[quantity]]
    if quantity == "bytes":
        return [(cell.memory() or 0) / 1e6 for cell in scene.cells[method]]
    return [float(cell.info[quantity]) for cell in scene.cells[method]]


def _abscissa(experiment: Experiment) -> str:
    if experiment.sweep.x == "photons":
        return "photons traced"
    settings = dict.fromkeys(method.series.setting for method in experiment.method if method.series)
    return " or ".join(setting.partition(".")[2].replace("_", " ") for setting in settings)


def _caption(found: Finished) -> str:
    experiment = found.experiment
    n = len(experiment.seeds)
    seeds = f"Median and 5\N{EN DASH}95 % band of {n} seeds" if n > 1 else "One seed"
    cut = f" Drawn at what the budget had time for: {'; '.join(short_of)}." if (short_of := _cut_short(found)) else ""
    memory = " Memory: the guide, and the most particles stored at once." if "bytes" in experiment.sweep.y else ""
    return f"{seeds}; {sheet.budget(experiment)}.{cut}{memory} {figures.machines(found)}"
