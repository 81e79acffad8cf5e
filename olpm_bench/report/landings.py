"""The figure of where particles land: the share of stored photons and importons by region, over the passes of training."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from olpm_bench.transport.training import PassStatistics

KINDS = ("photons", "importons")


def draw(passes: Sequence[PassStatistics], names: Sequence[str]) -> Figure:
    """One panel for photons and one for importons, in the style that is active (`figures.style`).

    Lines: share of the hits in each region.  Shade below: the effective sample size (sum w)^2 / sum w^2 of those hits, as
    a share of all hits.

    Args:
        passes: statistics of a training that was given `regions`.
        names: of the regions.
    """
    from matplotlib import rcParams
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.ticker import MaxNLocator, PercentFormatter

    figure = Figure(figsize=(6.6, 2.4), layout="constrained")
    for axes, kind in zip(figure.subplots(1, len(KINDS), sharey=True), KINDS, strict=True):
        index = [s.index + 1 for s in passes if kind in s.regions]
        hits = np.array([s.regions[kind] for s in passes if kind in s.regions])         # [passes, regions, 2]
        total = np.maximum(hits[:, :, 0].sum(1, keepdims=True), 1)
        for r, (name, style) in enumerate(zip(names, rcParams["axes.prop_cycle"](), strict=False)):
            axes.plot(index, hits[:, r, 0] / total[:, 0], **style, label=name)
            axes.fill_between(index, hits[:, r, 1] / total[:, 0], color=style["color"], alpha=0.17, linewidth=0)
        axes.set_title(kind)
        axes.set_xlabel("training pass")
        axes.set_ylim(bottom=0)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_major_formatter(PercentFormatter(1))
    figure.axes[0].set_ylabel("share of the hits")
    lines = figure.axes[0].get_lines()
    shade = Patch(color="black", alpha=0.17, linewidth=0, label="shaded: their effective number")
    figure.legend(handles=[*lines, shade], loc="outside lower center", ncols=len(lines) + 1)
    return figure
