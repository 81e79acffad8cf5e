"""A finished experiment: its cells and references, read once, and what tables, figures and page show of them, computed once.

Reads results, renders nothing: a new metric needs no new cell.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from olpm_bench.bench import bias, gains, metrics, pixel_variance, statistics
from olpm_bench.bench.clock import UNRELIABLE
from olpm_bench.bench.files import read_json
from olpm_bench.bench.reference_file import NEAR_FLOOR, Reference
from olpm_bench.bench.results import Cell, Results
from olpm_bench.bench.summary import complete_cells

if TYPE_CHECKING:
    from olpm_bench.bench.config import Experiment, Scene


class Final(NamedTuple):
    """What the final images of a method show.

    errors: by metric, one per seed; NaN without reference.
    failures: a sentence on each metric that failed.
    variances: by `gains.KINDS`, the work-normalised variance [s].
    gains: by `gains.KINDS`, the baseline's work-normalised variance over the method's.
    passes: of all cells, which variances stand on.
    means: of the images, for the bias guard.
    """
    errors: dict[str, np.ndarray]
    failures: list[str]
    variances: dict[str, statistics.Interval]
    gains: dict[str, statistics.Interval]
    passes: int
    means: bias.Means


@dataclass(frozen=True)
class FinishedScene:
    """The cells of a scene, and what follows from their images; that is computed when it is first asked for.

    cells: method -> one per seed, in the order of the TOML.
    reference: None if the experiment does without.
    """
    scene: Scene
    cells: dict[str, list[Cell]]
    reference: Reference | None
    baseline: str

    @cached_property
    def final(self) -> dict[str, Final]:
        """Method -> what its final images show."""
        errors, failures, variances, guards, radiances = {}, {}, {}, {}, []
        for method, cells in self.cells.items():        # one at a time: images take memory
            images = pixel_variance.read(cells)
            errors[method], failures[method] = self._errors(images.mean)
            variances[method] = gains.work_variance(method, images)
            guards[method] = bias.means(cells, images)
            radiances.append(images.mean.mean(axis=0))
        radiance = self.reference.mean if self.reference is not None else np.mean(radiances, axis=0)
        normalised = {method: gains.normalised(variance, radiance) for method, variance in variances.items()}
        baseline = normalised[self.baseline]
        return {method: Final(errors[method], failures[method],
                              {kind: gains.estimate(variance, kind) for kind in gains.KINDS},
                              {kind: gains.gain(baseline, variance, kind) for kind in gains.KINDS}, variance.passes,
                              guards[method])
                for method, variance in normalised.items()}

    def _errors(self, images: np.ndarray) -> tuple[dict[str, np.ndarray], list[str]]:
        if self.reference is None:
            return {name: np.full(len(images), np.nan) for name in metrics.METRICS}, []
        return metrics.errors(images, self.reference.mean)

    def curves(self, over: str = "seconds") -> dict[str, statistics.Curve]:
        """Method -> its L1 error over a column of the traces: charged seconds, or "spp".  There must be a reference.

        Without methods that have no error at all, as of a black scene: logarithmic axes have no place for them.
        """
        return {method: statistics.common_curve([np.array([line[over] for line in cell.trace], np.float64) for cell in cells],
                                                self._l1[method])
                for method, cells in self.cells.items() if all((errors > 0).all() for errors in self._l1[method])}

    @cached_property
    def _l1(self) -> dict[str, list[np.ndarray]]:
        """Method -> for each seed the L1 error at each checkpoint."""
        assert self.reference is not None
        truth = self.reference.mean
        return {method: [np.array([metrics.l1(image, truth) for image in cell.checkpoints()]) for cell in cells]
                for method, cells in self.cells.items()}

    @property
    def least_error(self) -> float:
        """The L1 error below which it is the reference's own; 0 if its noise is unknown."""
        return NEAR_FLOOR * ((self.reference and self.reference.noise_floor) or 0.0)

    @cached_property
    def speed_ups(self) -> dict[str, statistics.Interval]:
        """Method -> its speed-up over the baseline at equal L1, a ratio of charged seconds; empty without reference."""
        if self.reference is None:
            return {}
        curves, unknown = self.curves(), statistics.Interval(np.nan, np.nan, np.nan)
        return {method: statistics.speed_up(curves[self.baseline], curves[method], least=self.least_error)
                if {self.baseline, method} <= curves.keys() else unknown for method in self.cells if method != self.baseline}

    @cached_property
    def worst_speed_ups(self) -> dict[str, float]:
        """Method -> its least speed-up over the baseline, of all L1 errors that both reach; empty without reference."""
        curves = self.curves() if self.reference is not None else {}
        return {method: statistics.worst_speed_up(curves[self.baseline], curve, self.least_error)
                for method, curve in curves.items() if self.baseline in curves}


@dataclass(frozen=True)
class Finished:
    """All that a report is made of."""
    experiment: Experiment
    results: Results
    scenes: list[FinishedScene]

    @property
    def compared(self) -> list[FinishedScene]:
        """The scenes with a reference."""
        return [scene for scene in self.scenes if scene.reference is not None]

    @property
    def speed_ups(self) -> dict[str, dict[str, statistics.Interval]]:
        """Method -> scene -> its speed-up over the baseline at equal L1; scenes without reference are left out."""
        baseline = self.experiment.baseline_name
        return {method.name: {scene.scene.name: scene.speed_ups[method.name] for scene in self.compared}
                for method in self.experiment.method if method.name != baseline}

    @property
    def unreliable(self) -> list[str]:
        """The methods of which a cell waited for busy cores for so long that its timings can't be relied on."""
        return [method.name for method in self.experiment.method
                if any(cell.info["wait_fraction"] > UNRELIABLE
                       for scene in self.scenes for cell in scene.cells[method.name])]

    @cached_property
    def machines(self) -> list[str]:
        """The machines that the cells were made on; where no cell says so, that of the last run."""
        cells = [cell for scene in self.scenes for group in scene.cells.values() for cell in group]
        said = [cell.info["machine"] for cell in cells if "machine" in cell.info] or [read_json(self.results.folder / "env.json")]
        return sorted({_label(machine) for machine in said})


def _label(machine: Mapping[str, Any]) -> str:
    """"CPU, n threads", and the variant if that is none for a CPU; older cells say less."""
    label = machine["cpu"]
    if "threads" in machine:
        label += f", {machine['threads']} threads"
    if not machine.get("variant", "llvm").startswith("llvm"):
        label += f", {machine['variant']}"
    return str(label)


def read(experiment: Experiment, results: Results, references: Mapping[str, Reference], any_version: bool = False) -> Finished:
    """The experiment with all its cells.

    Args:
        references: by the name of the scene, of every scene that does not do without; any_version: as for `complete_cells`.

    Raises:
        ResultError: a cell is missing.
    """
    cells, baseline = complete_cells(experiment, results, any_version), experiment.baseline_name
    return Finished(experiment, results, [
        FinishedScene(scene, {method.name: cells[scene.name, method.name] for method in experiment.method},
                      references[scene.name] if scene.has_reference else None, baseline) for scene in experiment.scene])
