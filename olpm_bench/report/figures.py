"""The convergence figure, L1 error over charged seconds, one panel a scene; and the gains in variance with their intervals.

Reads results, renders nothing.  Colour, marker and dash belong to a method in all figures: `Experiment.looks`.
"""
from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import statistics
from olpm_bench.bench.files import replacing
from olpm_bench.bench.reference_file import NEAR_FLOOR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from olpm_bench.bench.config import Experiment
    from olpm_bench.bench.finished import Finished, FinishedScene

STYLE = Path(__file__).with_name("olpm_bench.mplstyle")
GREY = "#8a8a8a"
TIMES = "\N{MULTIPLICATION SIGN}"
PLAIN: dict[str, Any] = {"marker": "none", "linestyle": "-"}
NEAR_LABEL = 0.8                # curves that end further left, in axes units, are not tied to their labels
PANEL = (2.75, 2.05)            # width, height of a panel's axes [inch]
COLUMNS = 2                     # panels side by side
ROW = 0.17                      # height of a row of gains [inch]
GAINS = ("gain", "gain_trimmed")        # columns of the summary that are drawn, filled and hollow
MARK = 6.0                      # height of a row of marks of training [pt]


@dataclass(frozen=True)
class Panel:
    """What one panel shows.

    curves: method -> error of every seed over the abscissa.
    looks: method -> number of its colour, marker and dash, as `Experiment.looks`.
    training: method -> where its training ends on the abscissa; left out where there is none, or older cells do not say.
    budget: where the cells were to stop, None if that is elsewhere for each.
    floor: noise floor of the reference, mean |A - B| / 2; 0 if unknown.
    speed_ups: method -> how much faster than the baseline it is at equal error.
    abscissa, ordinate: labels of the axes; numbers: of the ticks of the abscissa.
    slope: show the rate of Monte Carlo.
    """
    title: str
    curves: dict[str, statistics.Curve]
    looks: Mapping[str, int]
    training: dict[str, float]
    budget: float | None
    floor: float
    speed_ups: dict[str, statistics.Interval] = field(default_factory=dict)
    abscissa: str = "time [s], training included"
    ordinate: str = "L1 error"
    numbers: Callable[[float], str] | None = None       # `tick_label`
    slope: bool = True


def curves(found: Finished) -> list[str]:
    """Write figure.png, figure.pdf and figure.svg into the results folder, if some scene has a reference; return their names.

    A panel a scene over charged seconds, and for a budget in samples another over samples per pixel.
    """
    experiment = found.experiment
    axes = ["seconds"] if experiment.budget.spp is None else ["spp", "seconds"]
    several = len(experiment.scene) * len(axes) > 1
    panels = [_panel(scene.scene.name if several else experiment.title, scene, over, experiment)
              for scene in found.compared for over in axes]
    panels = [panel for panel in panels if panel.curves]
    if not panels:
        return []
    faint = any((curve.median < NEAR_FLOOR * panel.floor).any() for panel in panels for curve in panel.curves.values())
    with style():
        figure = draw(panels, experiment.title if len(panels) > 1 else "",
                      caption(found, any(panel.training for panel in panels), faint))
        return save(figure, found.results.folder, "figure")


def _panel(title: str, scene: FinishedScene, over: str, experiment: Experiment) -> Panel:
    assert scene.reference is not None
    shown, curves, floor = [method.name for method in experiment.shown], scene.curves(over), scene.reference.noise_floor or 0.0
    curves = {name: curves[name] for name in shown if name in curves}
    if over == "spp":
        return Panel(title, curves, experiment.looks, {}, float(experiment.budget.spp or 0), floor, abscissa="samples per pixel")
    ended: dict[str, list[Any]] = {name: [cell.info.get("training_ended") for cell in scene.cells[name]] for name in curves}
    return Panel(title, curves, experiment.looks,
                 {name: float(np.median(times)) for name, times in ended.items() if None not in times},
                 experiment.budget.seconds, floor, {name: scene.speed_ups[name] for name in shown if name in scene.speed_ups})


def gains(found: Finished, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Write gains.png, gains.pdf and gains.svg into the results folder, unless there is no gain; return their names.

    Args:
        rows: of the summary.
    """
    experiment = found.experiment
    rows = [row for row in rows if row["method"] != experiment.baseline_name]
    if not any(row[column] is not None for row in rows for column in GAINS):
        return []
    passes = [row["variance_passes"] for row in rows]
    counted = f"{min(passes):,}" if min(passes) == max(passes) else f"{min(passes):,} to {max(passes):,}"
    note = (f"Relative variance of a pixel times charged seconds, from {counted} passes of {len(experiment.seeds)} seeds of a "
            "method: above the median over blocks of pixels, below the mean without the worst 0.1 % of pixels. "
            f"90 % intervals over paired seeds, widened for light that was not met. {machines(found)}")
    with style():
        figure = draw_gains(rows, experiment.looks, experiment.baseline_name, experiment.title, note)
        return save(figure, found.results.folder, "gains")


def draw_gains(rows: Sequence[Mapping[str, Any]], looks: Mapping[str, int], baseline: str, title: str = "",
               note: str = "") -> Figure:
    """The gains by the median and, in a second row, by the trimmed mean, in the style that is active.

    Args:
        rows: of the summary, without the baseline's, scene by scene; looks: as of a `Panel`.
    """
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    lines: list[tuple[Mapping[str, Any], str] | str] = []       # from the top: a scene's name above its rows
    for scene in scenes:
        lines += [scene, *((row, column) for row in rows if row["scene"] == scene for column in GAINS)]
    numbers = {i: _gain_label(*line) for i, line in enumerate(lines) if not isinstance(line, str)}
    left = 0.2 + max(*(0.12 + text_width(row["method"], 8) for row in rows), *(text_width(scene, 8.5) for scene in scenes))
    right, bottom, head = 0.2 + max(text_width(text, 7.5) for text in numbers.values()), 0.42, 0.34 if title else 0.1
    width, inner = left + PANEL[0] + right, ROW * (len(lines) + 0.6)
    caption_ = textwrap.wrap(note, width=int((width - 0.2) * 21))
    foot = 0.06 + 0.115 * len(caption_)
    height = head + inner + bottom + foot
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((left / width, (foot + bottom) / height, PANEL[0] / width, inner / height))
    axes.set_xscale("log")
    ends = [1, *(row[key] for row in rows for key in ("gain", "gain_low", "gain_high") if row[key])]
    low, high = _padded(min(ends), max(ends), 0.06)
    axes.set(xlim=(low, high), ylim=(len(lines) - 0.2, -0.8))
    axes.set_xlabel(f"gain over {baseline}: ratio of var \N{MULTIPLICATION SIGN} s")
    positions = ticks(low, high)
    axes.xaxis.set_ticks(positions, [tick_label(position) for position in positions])
    axes.xaxis.set_ticks([], minor=True)
    axes.yaxis.set_ticks([])
    axes.axvline(1, color="#555555", linewidth=0.9, zorder=1)
    for y, line in enumerate(lines):
        if isinstance(line, str):
            axes.text(-(left - 0.1) / PANEL[0], y, line, transform=axes.get_yaxis_transform(), va="center_baseline",
                      fontsize=8.5)
            continue
        row, column = line
        look = _look(looks[row["method"]])
        name, colour = (row["method"], look["color"]) if column == GAINS[0] else ("trimmed", GREY)
        axes.text(-0.1 / PANEL[0], y, name, color=colour, ha="right", transform=axes.get_yaxis_transform(),
                  va="center_baseline")
        axes.text(1 + 0.1 / PANEL[0], y, numbers[y], transform=axes.get_yaxis_transform(), va="center_baseline",
                  fontsize=7.5)
        ends = [row[f"{column}_low"], row[f"{column}_high"]]
        if None in ends:
            continue
        axes.plot(ends, [y, y], color=look["color"], linewidth=1.1, marker="|", markersize=5,
                  markeredgecolor=look["color"], markeredgewidth=0.9, linestyle="-")
        face = look["color"] if column == GAINS[0] else "white"
        axes.plot(row[column], y, **{**look, "linestyle": "none"}, markersize=5, zorder=3, markerfacecolor=face)
    if title:
        figure.text(0.5, 1 - 0.08 / height, title, ha="center", va="top", fontsize=10.5)
    figure.text(0.1 / width, 0.04 / height, "\n".join(caption_), ha="left", va="bottom", fontsize=6.5, color="#555555",
                linespacing=1.2)
    return figure


def _gain_label(row: Mapping[str, Any], column: str) -> str:
    """A gain with its interval; a dash where there is none."""
    def short(value: float) -> str:
        return f"{value:#.3g}".rstrip(".")

    low, high = row[f"{column}_low"], row[f"{column}_high"]
    if low is None or high is None:
        return "-"
    return f"{short(row[column])} ({short(low)}\N{EN DASH}{short(high)})"


def style() -> AbstractContextManager[None]:
    """The style of our figures; holds for drawing and for saving."""
    import matplotlib.style

    return matplotlib.style.context(STYLE)


def _look(number: int) -> dict[str, Any]:
    """Colour, marker and dash, in the style that is active."""
    from matplotlib import rcParams

    cycle = list(rcParams["axes.prop_cycle"])
    return dict(cycle[number % len(cycle)])


def save(figure: Figure, folder: Path, name: str) -> list[str]:
    """Write name.png, name.pdf and name.svg; return these names."""
    metadata: dict[str, Any] = {"png": None, "pdf": {"CreationDate": None}, "svg": {"Date": None}}
    for suffix, data in metadata.items():
        write(figure, folder / f"{name}.{suffix}", metadata=data)
    return [f"{name}.{suffix}" for suffix in metadata]


def write(figure: Figure, path: Path, **options: Any) -> None:
    """Write one file, its format by its suffix; options as `savefig` has them.

    Raises:
        OSError: cannot be written.
    """
    drawn = io.BytesIO()        # written to a disk that fills up, Matplotlib's PDF raises an AttributeError instead
    figure.savefig(drawn, format=path.suffix[1:].lower(), **options)
    with replacing(path) as beside:
        beside.write_bytes(drawn.getvalue())


def caption(found: Finished, trained: bool = False, faint: bool = False) -> str:
    """What every figure must say: seeds, spread, whether training counts, and the machines.

    Args:
        trained: the end of some method's training is marked; faint: some curve comes near the noise floor.
    """
    experiment = found.experiment
    n = len(experiment.seeds)
    seeds = f"Median and 5\N{EN DASH}95 % band of {n} seeds." if n > 1 else "One seed."
    training = " Hollow markers below the axis: the end of training." if trained else ""
    interval = ", 90 % jackknife interval" if n > 2 else ""
    faster = f" {TIMES}: times as fast as {experiment.baseline_name} to an equal error{interval}."
    near = f" Faint: below {NEAR_FLOOR:g} times the noise of the reference." if faint else ""
    return f"{seeds}{training}{faster if len(experiment.shown) > 1 else ''}{near} {machines(found)}"


def machines(found: Finished) -> str:
    """The machines that made the cells, as a sentence."""
    return f"{'; '.join(found.machines)}."


def draw(panels: Sequence[Panel], title: str = "", note: str = "") -> Figure:
    """The figure, in the style that is active.

    Args:
        title: above all panels; note: caption below them.
    """
    from matplotlib import rcParams
    from matplotlib.figure import Figure

    figure = Figure()
    subplots = [figure.add_axes((0, 0, 1, 1), label=str(i)) for i in range(len(panels))]
    strip = max(_draw_panel(axes, panel) for axes, panel in zip(subplots, panels, strict=True))
    for axes, panel in zip(subplots, panels, strict=True):
        axes.set_xlabel(panel.abscissa)
        axes.tick_params(axis="x", pad=rcParams["xtick.major.pad"] + strip)
    columns = min(COLUMNS, len(panels))
    rows = math.ceil(len(panels) / columns)
    numbers = [label.get_text() for axes in subplots for label in axes.get_yticklabels()]
    left = 0.32 + max(text_width(text, 7.5) for text in numbers)
    right = 0.28 + 1.03 * max(text_width(text, size) for panel in panels for text, size in (
        *((method, 8) for method in panel.curves), *((speed_up_label(interval), 6.5) for interval in panel.speed_ups.values())))
    bottom, top = 0.42 + strip / 72, 0.28 if any(panel.title for panel in panels) else 0.1
    width = columns * (left + PANEL[0] + right)
    lines = textwrap.wrap(note, width=int((width - left) * 21))
    head, foot = 0.28 if title else 0.0, 0.06 + 0.115 * len(lines)
    height = head + rows * (top + PANEL[1] + bottom) + foot
    figure.set_size_inches(width, height)
    for i, axes in enumerate(subplots):
        row, column = divmod(i, columns)
        x = left + column * (left + PANEL[0] + right)
        y = height - head - row * (top + PANEL[1] + bottom) - top - PANEL[1]
        axes.set_position((x / width, y / height, PANEL[0] / width, PANEL[1] / height))
        if column == 0 or panels[i].ordinate != panels[i - 1].ordinate:
            axes.set_ylabel(panels[i].ordinate)
            axes.yaxis.set_label_coords(-(left - 0.18) / PANEL[0], 0.5)
    if title:
        figure.text(0.5, 1 - 0.08 / height, title, ha="center", va="top", fontsize=10.5)
    figure.text(left / width, 0.04 / height, "\n".join(lines), ha="left", va="bottom", fontsize=6.5, color="#555555",
                linespacing=1.2)
    return figure


def speed_up_label(interval: statistics.Interval) -> str:
    """A speed-up with its interval, or a bound of it; empty where there is neither."""
    if not math.isfinite(interval.value) or not (interval.bound or interval.ends()):
        return ""
    return f"{interval.bound}{interval.value:.2g}{TIMES}" + interval.ends("\N{EN DASH}")


def text_width(text: str, size: float) -> float:
    """Width [inch] of a text of `size` points."""
    if not text:
        return 0.0
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    return float(TextPath((0, 0), text, size=size, prop=FontProperties(family="STIXGeneral")).get_extents().width) / 72


def _draw_panel(axes: Axes, panel: Panel) -> float:
    """Returns how far below the ticks of the time axis something is drawn [pt]."""
    styles = {method: _look(panel.looks[method]) for method in panel.curves}
    axes.set_title(panel.title)
    axes.set_xscale("log")
    axes.set_yscale("log")
    _limits(axes, panel)
    for method, curve in panel.curves.items():
        _draw_curve(axes, curve, styles[method], panel.floor)
    _draw_floor(axes, panel)
    if panel.slope:
        _draw_slope(axes, panel)
    _draw_labels(axes, panel, styles)
    return _draw_training(axes, panel.training, styles)


def _limits(axes: Axes, panel: Panel) -> None:
    """Axes that hold curves, training and, where it isn't far below, the noise floor; with ticks at round numbers."""
    bands = [statistics.median_band(curve.errors) for curve in panel.curves.values()]
    starts = [curve.times[0] for curve in panel.curves.values()] + list(panel.training.values())
    x_low, x_high = min(starts), max(panel.budget or 0, *(curve.times[-1] for curve in panel.curves.values()))
    y_low, y_high = min(band.low.min() for band in bands), max(band.high.max() for band in bands)
    if panel.floor > y_low / 4:
        y_low = min(y_low, panel.floor)
    x_low, x_high = _padded(x_low, x_high, 0.035)
    y_low, y_high = _padded(y_low, y_high, 0.1)
    axes.set_xlim(x_low, x_high)
    axes.set_ylim(y_low, y_high)
    for axis, positions, label in ((axes.xaxis, ticks(x_low, x_high, panel.budget), panel.numbers or tick_label),
                                   (axes.yaxis, ticks(y_low, y_high), tick_label)):
        axis.set_ticks(positions, [label(position) for position in positions])
        axis.set_ticks([], minor=True)


def _padded(low: float, high: float, share: float) -> tuple[float, float]:
    """A range widened by a share of its logarithmic length, which is at least that of a factor of 2."""
    pad = share * max(math.log(high / low), math.log(2))
    if high / low < 2:
        pad = max(pad, (math.log(2) - math.log(high / low)) / 2)
    return low * math.exp(-pad), high * math.exp(pad)


def ticks(low: float, high: float, end: float | None = None) -> list[float]:
    """Round numbers from `low` to `high` for a logarithmic axis, at least three; and `end`, in place of near ones."""
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for ladder in ((1,), (1, 2, 5), (1, 1.5, 2, 3, 5, 7), range(1, 10), np.arange(1, 10, 0.5), np.arange(1, 10, 0.2)):
        found = [float(f"{m:g}e{d}") for d in decades for m in ladder if low <= float(f"{m:g}e{d}") <= high]
        if len(found) >= 3:
            break
    if end is not None:
        room = (high / low) ** 0.08
        found = [tick for tick in found if not end / room < tick < end * room] + [end]
    return found


def tick_label(value: float) -> str:
    """Plain decimals where they are short, else a power of ten."""
    if 1e-4 <= value < 1e5:
        return f"{value:.10g}"
    mantissa, exponent = f"{value:.2e}".split("e")
    factor = "" if float(mantissa) == 1 else rf"{float(mantissa):g}\cdot "
    return rf"${factor}10^{{{int(exponent)}}}$"


def _draw_curve(axes: Axes, curve: statistics.Curve, style: Mapping[str, Any], floor: float) -> None:
    band = statistics.median_band(curve.errors)
    near = band.median < NEAR_FLOOR * floor         # drawn faintly
    axes.fill_between(curve.times, band.low, band.high, color=style["color"], alpha=0.17, linewidth=0)
    if near.any():
        axes.plot(curve.times, band.median, **{**style, **PLAIN}, linewidth=0.6, alpha=0.5)
    if len(curve.times) == 1:
        axes.vlines(curve.times, band.low, band.high, color=style["color"], linewidth=0.8)
    clear = np.where(near, np.nan, band.median)
    step = max(1, (len(curve.times) - 1) // 8)
    axes.plot(curve.times, clear, **{**style, "marker": "none"})
    axes.plot(curve.times[::step], clear[::step], **{**style, "linestyle": "none"}, zorder=3)


def _draw_floor(axes: Axes, panel: Panel) -> None:
    low = axes.get_ylim()[0]
    lowest = min(curve.errors.min() for curve in panel.curves.values())
    if panel.floor >= low:
        axes.axhline(panel.floor, color=GREY, linestyle=(0, (1, 1.6)), linewidth=0.9, zorder=1)
    if lowest < panel.floor:            # a poor reference: the curves are below its line
        _note(axes, "noise of the reference", (0, panel.floor), (4, 2), ha="left", va="bottom")
    elif panel.floor >= low:
        _note(axes, "noise of the reference", (1, panel.floor), (-2, -2), ha="right", va="top")
    elif panel.floor > 0:
        text = f"noise of the reference: {tick_label(float(f'{panel.floor:.2g}'))} \N{DOWNWARDS ARROW}"
        _note(axes, text, (0, low), (4, 2), ha="left", va="bottom")


def _note(axes: Axes, text: str, at: tuple[float, float], offset: tuple[float, float], **alignment: Any) -> None:
    axes.annotate(text, at, xycoords=("axes fraction", "data"), xytext=offset, textcoords="offset points", fontsize=6.5,
                  color=GREY, **alignment)


def _draw_training(axes: Axes, training: Mapping[str, float], styles: Mapping[str, Mapping[str, Any]]) -> float:
    """A hollow marker of each method below the time axis, where its training ends; near ones are stacked.

    Returns:
        How far below the ticks the last row ends [pt].
    """
    from matplotlib import rcParams
    from matplotlib.transforms import ScaledTranslation

    low, high = np.log(axes.get_xlim())
    placed: list[tuple[float, int]] = []
    for method, seconds in sorted(training.items(), key=lambda item: item[1]):
        x = (math.log(seconds) - low) / (high - low)
        row = 0
        while any(abs(x - other) < 0.03 and row == taken for other, taken in placed):
            row += 1
        placed.append((x, row))
        below = ScaledTranslation(0, -(row + 0.7) * MARK / 72, axes.figure.dpi_scale_trans)
        axes.plot(x, 0, marker=styles[method]["marker"], linestyle="none", markersize=4.2, markerfacecolor="white",
                  markeredgecolor=styles[method]["color"], markeredgewidth=0.9, transform=axes.transAxes + below,
                  clip_on=False, zorder=5)
    return max((MARK * (row + 1) - rcParams["xtick.major.size"] for _, row in placed), default=0)


def _draw_labels(axes: Axes, panel: Panel, styles: Mapping[str, Mapping[str, Any]]) -> None:
    """Method names, with their speed-ups below, at the ends of their curves, moved apart where they would overlap."""
    points = [axes.transAxes.inverted().transform(axes.transData.transform((curve.times[-1], curve.median[-1])))
              for curve in panel.curves.values()]
    heights = spread([float(y) for _, y in points], gap=(17 if panel.speed_ups else 10) / 72 / PANEL[1])
    for (method, style), (x, y), label_y in zip(styles.items(), points, heights, strict=False):
        if x > NEAR_LABEL:
            axes.plot([x, 1.02, 1.035], [y, label_y, label_y], **{**style, **PLAIN}, linewidth=0.6, alpha=0.7,
                      transform=axes.transAxes, clip_on=False, zorder=1)
        axes.plot(1.05, label_y, **style, transform=axes.transAxes, clip_on=False)
        axes.text(1.07, label_y, method, color=style["color"], transform=axes.transAxes, va="center_baseline")
        if method in panel.speed_ups:
            axes.text(1.07, label_y - 7.5 / 72 / PANEL[1], speed_up_label(panel.speed_ups[method]), fontsize=6.5, color=GREY,
                      transform=axes.transAxes, va="center_baseline")


def spread(positions: Sequence[float], gap: float) -> list[float]:
    """Positions moved apart to at least `gap`, in their order, as little as least squares allows."""
    order = sorted(range(len(positions)), key=lambda i: positions[i])
    blocks: list[list[float]] = []      # [sum of wanted starts, count]: pool adjacent violators
    for rank, i in enumerate(order):
        blocks.append([positions[i] - rank * gap, 1])
        while len(blocks) > 1 and blocks[-2][0] / blocks[-2][1] > blocks[-1][0] / blocks[-1][1]:
            total, count = blocks.pop()
            blocks[-1][0] += total
            blocks[-1][1] += count
    starts = [total / count for total, count in blocks for _ in range(int(count))]
    moved = [0.0] * len(positions)
    for rank, (i, start) in enumerate(zip(order, starts, strict=True)):
        moved[i] = start + rank * gap
    return moved


def _draw_slope(axes: Axes, panel: Panel) -> None:
    """A short line of slope -1/2, the rate of Monte Carlo, where the panel is emptiest."""
    (x_low, x_high), (y_low, y_high) = np.log(axes.get_xlim()), np.log(axes.get_ylim())
    fall = 0.5 * (x_high - x_low) / (y_high - y_low)        # of the slope, in axes units
    length = min(0.3, 0.4 / fall)
    occupied = []
    for curve in panel.curves.values():
        band = statistics.median_band(curve.errors)
        x = (np.log(curve.times) - x_low) / (x_high - x_low)
        occupied += [np.column_stack([x, (np.log(y) - y_low) / (y_high - y_low)]) for y in band]
    if panel.floor > 0:
        y = max((math.log(panel.floor) - y_low) / (y_high - y_low), 0.06)
        occupied.append(np.column_stack([np.linspace(0, 1, 40), np.full(40, y)]))
    points = np.concatenate(occupied)
    along = np.linspace(0, length, 12)
    best, where = -1.0, (0.0, 0.0)
    for x in np.linspace(0.04, 0.96 - length, 24):
        for y in np.linspace(0.96, 0.06 + fall * length, 24):
            line = np.column_stack([x + along, y - fall * along + 0.02])       # and its label above it
            distance = float(np.min(np.hypot((points[:, None, 0] - line[:, 0]) * PANEL[0],
                                             (points[:, None, 1] - line[:, 1]) * PANEL[1])))
            distance = min(distance, 0.3)       # [inch]; further away is no better: the first found is high and left
            if distance > best:
                best, where = distance, (float(x), float(y))
    x, y = where
    axes.plot([x, x + length], [y, y - fall * length], color=GREY, **PLAIN, linewidth=0.8,
              transform=axes.transAxes, zorder=1)
    angle = -math.degrees(math.atan2(fall * length * PANEL[1], length * PANEL[0]))
    axes.text(x + length / 2, y - fall * length / 2, "slope \N{MINUS SIGN}1/2", rotation=angle, rotation_mode="anchor",
              ha="center", va="bottom", fontsize=6.5, color=GREY, transform=axes.transAxes)
