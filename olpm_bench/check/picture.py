"""What a picture of a failure shows: the density of a record over the equal-area disk beside its samples."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from olpm_bench.check.particles import uniform_directions
from olpm_bench.check.trained import Trained
from olpm_bench.check.verdict import Panel, Picture

CELLS = 64                  # along the disk's diameter
DIRECTIONS = 1 << 19


def to_disk(wo: np.ndarray) -> np.ndarray:
    """Direction -> cell coordinates (column, row) on the equal-area disk of radius sqrt(1 - z); y points up [..., 2]."""
    xy = wo[..., :2] / np.sqrt(1 + np.maximum(wo[..., 2:3], 0))
    return (xy * (1, -1) + 1) * (CELLS / 2)


def over_disk(wo: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Sums of `mass` at directions in each cell, per solid angle [CELLS, CELLS]; NaN outside the disk."""
    column, row = np.clip(to_disk(wo).astype(int), 0, CELLS - 1).T
    values = np.bincount(row * CELLS + column, mass, CELLS**2).reshape(CELLS, CELLS)
    centre = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
    inside = centre**2 + centre[:, None] ** 2 < 1
    return np.where(inside, values / CELL, np.nan)


CELL = 2 * (2 / CELLS) ** 2         # solid angle of a cell [sr]: the disk's area pi is 2 pi sr


def of_record(trained: Trained, record: int, worst: np.ndarray | None = None) -> Picture:
    """Cell means of pdf(), the histogram of samples, and their difference in standard deviations; `worst` is marked."""
    def panels() -> list[Panel]:
        rng, records = trained.records.rng(6), trained.records
        index = np.full(DIRECTIONS, record)
        y = records.proposals.at(index, rng.random((DIRECTIONS, 3)))
        y = y[y[:, 2] > 0]
        share = trained.density(index[:len(y)], y) / records.proposals.pdf(index[:len(y)], y) / DIRECTIONS
        x = trained.draw(index, rng)
        x, one = x.wo[x.alive], np.full(x.alive.sum(), 1 / DIRECTIONS)
        expected, sampled = over_disk(y, np.nan_to_num(share)), over_disk(x, one)
        error = np.sqrt((over_disk(y, np.nan_to_num(share) ** 2) + over_disk(x, one**2)) / CELL)
        z = np.divide(sampled - expected, error, out=np.where(np.isnan(error), np.nan, 0.0), where=error > 0)
        mark = None if worst is None else (float(to_disk(worst)[0]), float(to_disk(worst)[1]))
        return [Panel(f"pdf of {records.name(record)}", expected, mark=mark),
                Panel(f"histogram of {DIRECTIONS} samples", sampled, mark=mark),
                Panel("samples - pdf", z, "signed", "standard deviations", mark)]
    return panels


def of_density(title: str, pdf: Callable[[np.ndarray], np.ndarray]) -> Panel:
    """Cell means of a function of directions [n, 3]."""
    wo = uniform_directions(DIRECTIONS, np.random.default_rng(0))
    return Panel(title, over_disk(wo, pdf(wo) * 2 * np.pi / DIRECTIONS))
