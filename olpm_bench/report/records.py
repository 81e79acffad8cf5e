"""A picture of the records over the image: which serves a pixel, its radius, and the particles that it has seen.

Reads what :func:`olpm_bench.transport.view.records_seen` found, renders nothing.
"""
from __future__ import annotations

import colorsys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.report import figures, tonemap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from olpm_bench.transport.view import RecordView

PANEL = 4.2                     # width of an image [inch]
NONE = (0.55, 0.55, 0.55)       # where there is no record
SHADE = 0.35                    # how far the image's brightness, between this and 1, darkens the cells
COLOUR_MAP = "viridis"
BAR: dict[str, Any] = {"location": "bottom", "fraction": 0.04, "pad": 0.02, "aspect": 40}


def records_map(view: RecordView, image: np.ndarray, trained: int, out: Path, marks: Sequence[tuple[int, int]] = ()) -> None:
    """Write the picture, PNG or PDF by its suffix.

    Args:
        image: the same view, linear RGB (h, w, 3).
        trained: particles from which a record guides paths.
        marks: pixels (x, y) to mark.
    """
    with figures.style():
        figure = draw(view, image, trained)
        for axes in figure.axes[:3]:
            for pixel in marks:
                mark(axes, pixel)
        figures.write(figure, out)


def cells(record: np.ndarray, image: np.ndarray) -> np.ndarray:
    """A colour for each record, by its index alone, in the image's light and shade (h, w, 3); grey without a record."""
    golden = (5 ** 0.5 - 1) / 2             # hues that neighbours in number don't share
    palette = np.array([colorsys.hsv_to_rgb(i * golden % 1, 0.45 + 0.3 * (i * 0.7548 % 1), 1) for i in range(record.max() + 1)]
                       + [NONE])            # index -1
    light = tonemap.encode(image, tonemap.auto_exposure(image)).mean(-1, keepdims=True)
    return palette[record] * (SHADE + (1 - SHADE) * np.nan_to_num(light))


def mark(axes: Axes, pixel: tuple[int, int]) -> None:
    """A cross-hair around a pixel, seen on dark and on bright images."""
    for colour, width in (("black", 2.4), ("white", 1.1)):
        axes.plot(*pixel, marker="o", markersize=7, markerfacecolor="none", markeredgecolor=colour, markeredgewidth=width)


def draw(view: RecordView, image: np.ndarray, trained: int) -> Figure:
    """Three panels: cells of the records, radius, particles."""
    import matplotlib.pyplot as plt
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    height, width = view.record.shape
    figure, axes = plt.subplots(1, 3, figsize=(3 * PANEL, PANEL * height / width + 0.75), layout="constrained")
    some = view.record >= 0
    shown = len(np.unique(view.record[some]))
    axes[0].imshow(cells(view.record, image), interpolation="nearest")
    figure.colorbar(ScalarMappable(), ax=axes[0], **BAR).ax.set_visible(False)          # so that the panels line up
    axes[0].set_title(f"records: {shown} seen, serving {some.mean():.1%} of the pixels")
    _values(axes[1], figure, np.where(some, view.radius, np.nan), "validity radius / largest", vmin=0, vmax=1)
    norm = LogNorm(1, max(float(view.count.max()), 10.0))
    _values(axes[2], figure, np.where(view.count > 0, view.count, np.nan),
            f"particles seen; {np.mean(view.count >= trained):.1%} of the pixels have {trained} or more", norm=norm)
    for a in axes:
        a.set_axis_off()
    plt.close(figure)
    return figure


def _values(axes: Axes, figure: Figure, values: np.ndarray, title: str, **scale: Any) -> None:
    import matplotlib

    shown = axes.imshow(values, cmap=matplotlib.colormaps[COLOUR_MAP].with_extremes(bad=NONE), interpolation="nearest", **scale)
    figure.colorbar(shown, ax=axes, **BAR)
    axes.set_title(title)
