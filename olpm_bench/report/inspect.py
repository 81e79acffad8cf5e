"""The picture of `olpm-bench inspect`: what guides have learnt at a point of a path, beside the truth and their particles.

Hemispheres are shown as equal-area disks (Lambert), seen from outside along the normal: the rim is the horizon, and up is
up in the image.  Reads what :mod:`olpm_bench.bench.vertex` found, renders nothing.
"""
from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench.vertex import Density, Fit, Truth, Vertex
from olpm_bench.report import figures, records, tonemap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

DISK = 1.36                     # diameter [inch]
GAP = 0.16                      # between columns
UNDER = 0.34                    # for the figures under a disk
WHERE = 1.9                     # width of the image
LABEL = 0.24                    # for the names of the rows
COLOUR_MAP = "inferno"          # on white, which is a density of 0
PIXELS = 440                    # of a disk
KINDS = {"photons": ("#D55E00", "o"), "camera paths": ("#0072B2", "D")}
LARGEST = 12.0                  # heavier particles are drawn as if they weighed as many times the mean
GREY = "#555555"


@dataclass(frozen=True)
class Column:
    """One method.

    look: number of its colour, as `Experiment.looks`.
    learnt: its record against the incident light; None without a record.
    sampled: the mixture of BSDF and record against the reflected light.
    particles: kind -> directions [n, 3] in the vertex's frame and weights [n].
    """
    name: str
    look: int
    density: Density
    learnt: Fit | None
    sampled: Fit
    particles: Mapping[str, tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Page:
    """One vertex.

    image: linear RGB (h, w, 3); shown: record of each pixel (h, w), or None without guides.
    guide: the method whose guide decides which share of direct light the truth has; None without guides.
    """
    title: str
    image: np.ndarray
    shown: np.ndarray | None
    pixel: tuple[int, int]
    vertex: Vertex
    truth: Truth
    columns: Sequence[Column]
    guide: str | None = None


def draw(page: Page) -> Figure:
    """The picture, in the style that is active."""
    from matplotlib.figure import Figure

    truths = [over_sphere(passes.mean(0)) for passes in (page.truth.incident, page.truth.reflected)]
    norm = _scale(truths)
    note = _caption(page)
    left = [LABEL + WHERE + GAP + i * (DISK + GAP) for i in range(len(page.columns) + 1)]
    width = left[-1] + DISK + 0.1
    lines = textwrap.wrap(note, width=int((width - 0.2) * 26))
    head, row, foot = 0.52, DISK + UNDER, 0.1 + 0.115 * len(lines)
    height = head + 3 * row + foot
    figure = Figure(figsize=(width, height))

    def place(x: float, line: int, w: float = DISK, h: float = DISK) -> Axes:
        axes = figure.add_axes((x / width, 1 - (head + line * row + h) / height, w / width, h / height))
        axes.set_axis_off()
        return axes

    def under(x: float, line: int, text: str, second: str = "", bold: bool = False) -> None:
        y = head + line * row + DISK + 0.04
        for i, (content, colour) in enumerate(((text, "#222222"), (second, GREY))):
            figure.text((x + DISK / 2) / width, 1 - (y + 0.125 * i) / height, content, ha="center", va="top", fontsize=7.5 - i,
                        color=colour, weight="bold" if bold and i == 0 else "normal")

    figure.text(0.1 / width, 1 - 0.07 / height, page.title, ha="left", va="top", fontsize=10.5)
    for line, text in enumerate((r"incident $L_i\cos\theta$", r"reflected $f L_i\cos\theta$", "particles")):
        figure.text((LABEL - 0.1) / width, 1 - (head + line * row + DISK / 2) / height, text, rotation=90, ha="center",
                    va="center", fontsize=8.5)
    _where(page, place)
    names = [("truth", "#000000"), *((c.name, figures.colour(c.look)) for c in page.columns)]
    for x, (name, colour) in zip(left, names, strict=False):
        figure.text((x + DISK / 2) / width, 1 - (head - 0.06) / height, textwrap.fill(name, 22), ha="center", va="bottom",
                    fontsize=9, color=colour)
    for line, shown in enumerate(truths):
        _disk(place(left[0], line), shown, page.vertex, norm)
    under(left[0], 0, "no light" if math.isnan(page.truth.noise) else f"noise of a bin {page.truth.noise:.0%}")
    _legend(figure, place(LABEL, 2, WHERE), norm)

    best = min(c.sampled.deviation for c in page.columns)
    for x, column in zip(left[1:], page.columns, strict=True):
        density = column.density
        if density.guide is not None:
            _disk(place(x, 0), density.guide, page.vertex, norm)
            under(x, 0, *_figures(column.learnt))
            _particles(place(x, 2), column.particles, page.vertex)
            under(x, 2, ", ".join(f"{len(w)} {kind}" for kind, (_, w) in column.particles.items()),
                  f"{density.particles:,} seen; radius {density.radius:.3g}".replace(",", "\N{THIN SPACE}"))
        _disk(place(x, 1), density.mixture, page.vertex, norm)
        text, second = _figures(column.sampled)
        alone = density.fraction == 1
        under(x, 1, text, second or ("BSDF alone" if alone else f"BSDF fraction {density.fraction:.2f}"),
              bold=column.sampled.deviation == best < math.inf and len(page.columns) > 1)
    figure.text(0.1 / width, 0.05 / height, "\n".join(lines), ha="left", va="bottom", fontsize=6.5, color=GREY, linespacing=1.2)
    return figure


def _figures(fit: Fit | None) -> tuple[str, str]:
    """What stands under a disk: two figures, and where they are infinite why."""
    if fit is None or math.isnan(fit.divergence):
        return "-", ""
    if math.isinf(fit.deviation):
        return r"KL $\infty$   $\sigma/\mu$ $\infty$", f"0 where {100 * fit.missed:.2g} % of the light is"
    return rf"KL {fit.divergence:.3f}   $\sigma/\mu$ {fit.deviation:.2f}", ""


def _caption(page: Page) -> str:
    t = page.truth
    direct = "" if page.guide is None else (
        f" Of direct light it has the share that the guide of \u201c{page.guide}\u201d is to learn; photons teach none of it, "
        "which raises the KL of guides that learn from them alone.")
    return (
        "The hemisphere as an equal-area disk, seen along the normal; its rim is the horizon, and up is up in the image. "
        f"Truth: {t.paths} paths for each of {t.bins} x {t.bins} bins, without the light that next-event estimation brings."
        f"{direct} Top: what the record has learnt. Middle: what the path tracer samples, a mixture of BSDF and record. Bottom: "
        "what one more pass would teach the record; the area of a dot is its weight. KL: divergence "
        "KL(truth\u00a0||\u00a0pdf)\u00a0[nat]. \u03c3/\u03bc: relative standard deviation of truth / pdf, the noise of one "
        "sample.")


def over_sphere(values: np.ndarray) -> np.ndarray:
    """Values of equal-area bins [n * n] as a density [n, n] 1/sr; zero if there are none."""
    n = math.isqrt(len(values))
    total = values.sum() * 2 * math.pi / len(values)
    return (values / total if total > 0 else np.zeros_like(values)).reshape(n, n)


def _scale(densities: Sequence[np.ndarray]) -> Normalize:
    """The one logarithmic scale of all densities: from the dimmer parts of the truth to its brightest."""
    from matplotlib.colors import LogNorm

    top = max(max(float(d.max()) for d in densities), 0.1)
    lit = np.concatenate([d[d > 0] for d in densities])
    bottom = float(np.quantile(lit, 0.02)) if len(lit) else top
    return LogNorm(min(max(bottom, 1e-4 * top), 1e-2 * top), top)


# ---------------------------------------------------------------- disks

def project(d: np.ndarray) -> np.ndarray:
    """Directions [..., 3] on the equal-area disk [..., 2]."""
    return d[..., :2] / np.sqrt(1 + d[..., 2:])


def disk(fine: np.ndarray, pixels: int = PIXELS) -> np.ndarray:
    """A map over the concentric square [n, n] as an image of the disk [pixels, pixels], y upwards; NaN outside.

    Both are equal-area maps of the hemisphere, of the same radius for the same elevation: the inverse of Shirley & Chiu (1997).
    """
    x, y = np.meshgrid(*2 * [(np.arange(pixels) + 0.5) / pixels * 2 - 1])
    r, wide = np.hypot(x, y), abs(x) > abs(y)
    side = np.where(wide, np.where(x < 0, -r, r), np.where(y < 0, -r, r))
    with np.errstate(invalid="ignore", divide="ignore"):
        angle = np.where(wide, np.arctan(y / x), np.arctan(x / y)) * 4 / np.pi
    u, v = np.where(wide, side, side * angle), np.where(wide, side * angle, side)
    n = len(fine)
    column, row = (np.clip(np.nan_to_num((w + 1) / 2 * n), 0, n - 1).astype(int) for w in (u, v))
    return np.where(r <= 1, fine[row, column], np.nan)


def _circle(axes: Axes) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((0, 0), 1, fill=False, edgecolor="#333333", linewidth=0.7))
    axes.set(xlim=(-1.02, 1.02), ylim=(-1.02, 1.02), aspect="equal")


def _disk(axes: Axes, density: np.ndarray, vertex: Vertex, norm: Normalize) -> None:
    shown = disk(density)
    axes.imshow(np.ma.masked_where(~(shown > 0), shown), cmap=COLOUR_MAP, norm=norm, extent=(-1, 1, -1, 1), origin="lower",
                interpolation="nearest")
    _circle(axes)
    _marks(axes, vertex, "white", "black")


def _marks(axes: Axes, vertex: Vertex, colour: str, edge: str) -> None:
    """Normal, direction of the view, and its mirror image."""
    for d, marker, size in ((np.array([0, 0, 1]), "+", 4.5), (vertex.view, "o", 4.5), (vertex.mirror, "x", 4.0)):
        for c, width in ((edge, 1.7), (colour, 0.8)) if d[2] >= 0 else ():          # a shading normal may mirror it below
            axes.plot(*project(d), marker=marker, markersize=size, markerfacecolor="none", markeredgecolor=c,
                      markeredgewidth=width, clip_on=False)


def _particles(axes: Axes, particles: Mapping[str, tuple[np.ndarray, np.ndarray]], vertex: Vertex) -> None:
    """Dots whose area is their weight."""
    _circle(axes)
    for kind, (d, weight) in particles.items():
        colour, marker = KINDS[kind]
        x, y = project(d).T
        axes.scatter(x, y, s=3.2 * np.minimum(weight, LARGEST), color=colour, marker=marker, alpha=0.45, linewidths=0)
    _marks(axes, vertex, "#333333", "white")


# ---------------------------------------------------------------- the first columns

def _where(page: Page, place: Any) -> None:
    """The image, and the records over it."""
    h, w, _ = page.image.shape
    size = {"w": WHERE, "h": WHERE * h / w} if WHERE * h / w <= DISK else {"w": DISK * w / h, "h": DISK}
    images = [tonemap.srgb(page.image, tonemap.auto_exposure(page.image))]
    if page.shown is not None:
        images.append(records.cells(page.shown, page.image))
    for line, image in enumerate(images):
        axes = place(LABEL, line, **size)
        axes.imshow(image, interpolation="nearest")
        records.mark(axes, page.pixel)


def _legend(figure: Figure, axes: Axes, norm: Normalize) -> None:
    """The colour bar, and what the marks mean."""
    from matplotlib.cm import ScalarMappable

    axes.set(xlim=(0, 1), ylim=(0, 1))
    bar = figure.colorbar(ScalarMappable(norm, COLOUR_MAP), cax=axes.inset_axes((0.02, 0.76, 0.96, 0.07)), extend="both",
                          orientation="horizontal")
    bar.ax.tick_params(labelsize=6.5, pad=1.5)
    axes.text(0.5, 0.87, "density [1/sr]; white: 0", ha="center", va="bottom", fontsize=7.5)
    entries = [*((marker, colour, kind) for kind, (colour, marker) in KINDS.items()),
               *((marker, "none", text) for marker, text in (("+", "normal"), ("o", "where the path comes from"),
                                                             ("x", "its mirror direction")))]
    for i, (marker, colour, text) in enumerate(entries):
        y = 0.5 - 0.115 * i
        axes.plot(0.06, y, marker=marker, markersize=4.5, markerfacecolor=colour, linestyle="none", alpha=0.8,
                  markeredgecolor="#333333" if colour == "none" else colour, markeredgewidth=0.8)
        axes.text(0.12, y, text, va="center_baseline", fontsize=7.5)
