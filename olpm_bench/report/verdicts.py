"""The verdicts of `olpm-bench check`: a table, and a picture of each failure."""
from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench.summary import print_whole
from olpm_bench.bench.terminal import one_line, plain_console
from olpm_bench.report import figures

if TYPE_CHECKING:
    from rich.console import Console

    from olpm_bench.check.suite import Outcome
    from olpm_bench.check.verdict import Panel, Verdict

PANEL = 2.9                     # width of a panel [inch]
NONE = "#d9d9d9"                # outside the disk
DEEPEST = 1e-6                  # darkest colour of a logarithmic panel, of its brightest
FARTHEST = 6.0                  # standard deviations from which on colours are the strongest


def print_table(outcomes: Sequence[Outcome], pictures: dict[str, str], console: Console | None = None) -> None:
    """A row for each check, and the worst case in words of those that fail."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), collapse_padding=True, header_style="bold", pad_edge=False)
    for name in ("check", "verdict", "statistic", "s", "what it says"):
        table.add_column(name, justify="right" if name == "s" else "left", no_wrap=True)
    for o in outcomes:
        mark = Text("passed", style="green") if o.verdict.passed else Text("FAILED", style="bold red")
        table.add_row(o.check.name, mark, Text(statistic(o.verdict)), f"{o.seconds:.1f}", Text(o.check.sentence))
    console = console or plain_console()
    print_whole(table, console)
    failed: dict[str, list[str]] = {}           # one error may fail many checks
    for o in outcomes:
        if not o.verdict.passed:
            failed.setdefault(o.verdict.worst, []).append(o.check.name)
    for words, names in failed.items():
        line(console, f"{', '.join(names)} FAILED: {words}", "bold red")
        for name in names:
            if name in pictures:
                line(console, f"  picture: {pictures[name]}")
    for o in outcomes:
        if o.verdict.note not in ("", o.verdict.worst):
            line(console, f"{o.check.name}: {o.verdict.note}")


def line(console: Console, text: str, style: str = "") -> None:
    console.print(one_line(text), style=style or None, markup=False, emoji=False, highlight=False, soft_wrap=True)


def statistic(v: Verdict) -> str:
    """``smallest p of 46: 0.012 >= 2.7e-07``, ``0 invalid densities``."""
    if v.statistic is None:
        return v.measure
    if v.p is not None:
        return f"smallest p of {v.tests}: {v.statistic:.2g} {'>=' if v.passed else '<'} {v.threshold:.2g}"
    if v.threshold == 0:
        return f"{v.statistic:{'.0f' if float(v.statistic).is_integer() else '.3g'}} {v.measure}"
    return f"{v.measure}: {v.statistic:.3g}" + ("" if v.threshold is None else f" (bound {v.threshold:.3g})")


def picture(panels: Sequence[Panel], title: str, out: Path) -> None:
    """Write the panels side by side, PNG or PDF by the suffix."""
    import matplotlib.pyplot as plt

    with figures.style():
        figure, axes = plt.subplots(1, len(panels), figsize=(PANEL * len(panels), PANEL + 0.75), layout="constrained",
                                    squeeze=False)
        for a, panel in zip(axes[0], panels, strict=True):
            values, colours = _colours(panel, panels)
            shown = a.imshow(values, interpolation="nearest", **colours)
            if panel.mark is not None:
                a.plot(panel.mark[0] - 0.5, panel.mark[1] - 0.5, marker="o", markersize=9, markerfacecolor="none", color="white",
                       markeredgecolor="white", markeredgewidth=2.2)
                a.plot(panel.mark[0] - 0.5, panel.mark[1] - 0.5, marker="o", markersize=9, markerfacecolor="none",
                       markeredgecolor="black", markeredgewidth=0.9)
            a.set_title(panel.title)
            a.set_axis_off()
            figure.colorbar(shown, ax=a, location="bottom", fraction=0.05, pad=0.02, aspect=30, label=panel.unit)
        figure.suptitle("\n".join(textwrap.wrap(title, 40 * len(panels))), parse_math=False)
        figures.write(figure, out, dpi=160)
        plt.close(figure)


def _colours(panel: Panel, panels: Sequence[Panel]) -> tuple[np.ndarray, dict[str, Any]]:
    """What is drawn, its colour map and scale; panels of one kind share them, so that they can be compared."""
    import matplotlib
    from matplotlib.colors import LogNorm

    if panel.scale == "signed":
        return panel.values, {"cmap": matplotlib.colormaps["PuOr"].with_extremes(bad=NONE), "vmin": -FARTHEST, "vmax": FARTHEST}
    colours = {"cmap": matplotlib.colormaps["viridis"].with_extremes(bad=NONE)}
    drawn = np.concatenate([p.values[np.isfinite(p.values) & (p.values > 0)] for p in panels if p.scale == panel.scale])
    low, high = (float(drawn.min()), float(drawn.max())) if len(drawn) else (0.5, 1.0)
    if panel.scale == "linear":
        return panel.values, {**colours, "vmin": 0, "vmax": high}
    low = min(max(low, DEEPEST * high), high / 2)
    return np.maximum(panel.values, low), {**colours, "norm": LogNorm(low, high)}       # a NaN stays one
