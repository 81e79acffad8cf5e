"""The image sheet: reference and methods side by side, with error maps and crops.

Reads results, renders nothing.  Pixels are shown as they are: magnified by whole numbers, or averaged in whole blocks
where an image is too wide for its column.
"""
from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import metrics, summary
from olpm_bench.report import figures, tonemap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from olpm_bench.bench.config import Experiment
    from olpm_bench.bench.finished import Finished

COLUMN = 480                            # wanted width of a column [pixel]
GAP = 10
DPI = 100
BOXES = ("#ff5a1f", "#29c5ff", "#ffe14d", "#c77dff")       # of the crops, seen on dark and on bright images
COLOUR_MAP = "magma"

Crop = Sequence[int]                    # x, y, width, height [pixel]


@dataclass(frozen=True)
class Block:
    """What the figures show of one scene; images are (h, w, 3), linear RGB."""
    scene: str
    reference: np.ndarray
    floor: float | None
    images: dict[str, np.ndarray]       # by method
    given: Sequence[Crop] = ()          # crops that the experiment's file asks for

    @cached_property
    def errors(self) -> dict[str, tuple[float, float]]:
        """Method -> L1 and relMSE of its image."""
        return {name: (metrics.l1(image, self.reference), metrics.relmse(image, self.reference))
                for name, image in self.images.items()}

    @cached_property
    def error_maps(self) -> dict[str, np.ndarray]:
        """Method -> `relative_error` of its image."""
        return {name: relative_error(image, self.reference) for name, image in self.images.items()}

    @cached_property
    def exposure(self) -> float:
        """Of the reference, for all images."""
        return tonemap.auto_exposure(self.reference)

    @cached_property
    def crops(self) -> list[Crop]:
        """Those given, or two where the methods differ most."""
        if self.given:
            return list(self.given)
        width, height = _crop_size(self.reference)
        encoded = [tonemap.encode(np.nan_to_num(image), self.exposure) for image in self.images.values()]
        found = choose_crops(encoded, tonemap.encode(self.reference, self.exposure), width, height)
        return [(x, y, width, height) for x, y in found]


def sheet(found: Finished, blocks: Sequence[Block]) -> list[str]:
    """Write sheet.png into the results folder, if there is something to show; return its name."""
    if not blocks:
        return []
    with figures.style():
        figure = draw(blocks, caption(found))
        figures.write(figure, found.results.folder / "sheet.png", dpi=DPI)
    return ["sheet.png"]


def blocks(found: Finished) -> list[Block]:
    """What the figures show of each scene with a reference: of each method the seed with the median L1."""
    shown = []
    for scene in found.compared:
        assert scene.reference is not None
        images = {method.name: scene.cells[method.name][median_seed(scene.final[method.name].errors["l1"])].image()["mean"]
                  for method in found.experiment.shown}
        shown.append(Block(scene.scene.name, scene.reference.mean, scene.reference.noise_floor, images, scene.scene.crops))
    return shown


def median_seed(errors: np.ndarray) -> int:
    """Which of the errors is the median (the lower one of two)."""
    return int(np.argsort(errors)[(len(errors) - 1) // 2])


def caption(found: Finished) -> str:
    """What every picture of images must say: budget, seeds, and the machines."""
    return f"{found.experiment.title}: {shown(found.experiment)}. {figures.machines(found)}"


def shown(experiment: Experiment, has_reference: bool = True) -> str:
    """Budget and seed of the images in words."""
    n = len(experiment.seeds)
    seed = "one seed" if n == 1 else f"of {n} seeds the one with the median L1" if has_reference else f"the first of {n} seeds"
    return f"{budget(experiment)}; {seed}"


def budget(experiment: Experiment) -> str:
    """The budget of a cell in words."""
    seconds, spp = experiment.budget.seconds, experiment.budget.spp
    return f"{seconds:g} s a method, training included" if seconds else f"{spp} samples per pixel"


def relative_error(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """|x - r| / (r + 0.01), mean over channels: (h, w)."""
    return np.asarray(np.mean(np.abs(image - reference) / (reference + metrics.EPSILON), axis=-1, dtype=np.float64))


def error_scale(errors: Sequence[np.ndarray]) -> float:
    """Upper end of the colour scale that all maps share: their 95 % quantile, rounded up to 1, 2 or 5 times 10^n."""
    values = np.concatenate([error[np.isfinite(error)] for error in errors])
    wanted = float(np.quantile(values, 0.95)) if values.size else 1.0
    if wanted <= 0:
        return 1.0
    decade = 10.0 ** np.floor(np.log10(wanted))
    return float(next((m * decade for m in (1, 2, 5) if m * decade >= wanted), 10 * decade))


def choose_crops(shown: Sequence[np.ndarray], reference: np.ndarray, width: int, height: int) -> list[tuple[int, int]]:
    """Upper left corners (x, y) of the two windows, apart if the image has room, in which the methods differ most.

    Args:
        shown, reference: tone-mapped images (h, w, 3): what counts is what is seen, and one firefly cannot win.
    """
    seen = np.where(reference.mean(axis=-1) < 0.9, 1, 0.1)      # little is seen where the reference is white
    means = np.stack([_window_means(seen * np.abs(image - reference).mean(axis=-1), width, height) for image in shown])
    score = np.ptp(means, axis=0) if len(shown) > 1 else means[0]
    y, x = np.unravel_index(np.argmax(score), score.shape)
    for share in (2, 1, 0):             # further apart than touching, if there is room
        apart, down, across = score.copy(), share * height, share * width
        apart[max(0, y - down + 1):y + down, max(0, x - across + 1):x + across] = -np.inf
        if np.isfinite(apart).any():
            break
    y2, x2 = np.unravel_index(np.argmax(apart), score.shape)
    return [(int(x), int(y)), (int(x2), int(y2))]


def _window_means(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Mean of every window that fits, at its upper left corner, by a summed-area table."""
    table = np.pad(values, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    total = table[height:, width:] - table[:-height, width:] - table[height:, :-width] + table[:-height, :-width]
    means: np.ndarray = total / (width * height)
    return means


def resize(image: np.ndarray, width: int = COLUMN) -> np.ndarray:
    """(h, w, ...) to about `width`: pixels repeated, or whole blocks averaged (a remainder at far edges is dropped)."""
    w = image.shape[1]
    return _magnified(image, max(1, round(width / w))) if w <= width * 1.5 else _averaged(image, round(w / width))


def _magnified(image: np.ndarray, k: int) -> np.ndarray:
    return image.repeat(k, axis=0).repeat(k, axis=1)


def _averaged(image: np.ndarray, k: int) -> np.ndarray:
    h, w = image.shape[0] // k, image.shape[1] // k
    blocks: np.ndarray = image[:h * k, :w * k].reshape(h, k, w, k, *image.shape[2:]).mean(axis=(1, 3), dtype=np.float64)
    return blocks


def _fitted(image: np.ndarray, width: int) -> np.ndarray:
    """As `resize`, but never wider than `width`."""
    w = image.shape[1]
    return _magnified(image, width // w) if w <= width else _averaged(image, math.ceil(w / width))


def draw(blocks: Sequence[Block], note: str = "") -> Figure:
    """The sheet, in the style that is active."""
    from matplotlib.figure import Figure

    sizes = [resize(block.reference).shape for block in blocks]
    column = max(width for _, width, _ in sizes)
    text = round(0.058 * column)                    # size of the text [pixel]
    crop_heights = [max(len(inset) for inset in _insets(block.reference, block.crops, width))
                    for block, (_, width, _) in zip(blocks, sizes, strict=True)]
    left = GAP + (round(1.5 * text) if len(blocks) > 1 else 0)
    head = round(1.9 * text)
    caption_row = round(1.65 * text)
    block_heights = [2 * h + crop + caption_row + 2 * GAP for (h, _, _), crop in zip(sizes, crop_heights, strict=True)]
    width = left + (1 + len(blocks[0].images)) * (column + GAP)
    lines = _wrapped(note, 0.95 * (width - left - GAP), 0.75 * text)
    foot = round((0.85 + 0.75 * len(lines)) * text) if lines else GAP
    height = head + sum(block_heights) + 2 * GAP * (len(blocks) - 1) + foot
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))
    axes.set_axis_off()
    columns = [left + i * (column + GAP) for i in range(1 + len(blocks[0].images))]
    for x, name in zip(columns, ("Reference", *blocks[0].images), strict=True):
        _text(axes, x + column / 2, head / 2, name, 1.15 * text)
    y = head
    for block, block_height, (_, shown_width, _) in zip(blocks, block_heights, sizes, strict=True):
        if len(blocks) > 1:
            _text(axes, GAP + 0.6 * text, y + block_height / 2, block.scene, 1.15 * text, rotation=90)
        _draw_block(axes, block, [x + (column - shown_width) // 2 for x in columns], y, text, caption_row)
        y += block_height + 2 * GAP
    _text(axes, columns[0], height - foot / 2, "\n".join(lines), 0.75 * text, ha="left", color="#555555", linespacing=1.0)
    return figure


def _wrapped(note: str, width: float, size: float) -> list[str]:
    """The lines of a note of this width and size of letters [pixel]."""
    if not note:
        return []
    return textwrap.wrap(note, int(len(note) * width / (DPI * figures.text_width(note, size * 72 / DPI))))


def _crop_size(reference: np.ndarray) -> tuple[int, int]:
    """Width and height of a crop [pixel]: about a fifth of the image, and two fill the width of an image on the sheet."""
    h, w, _ = reference.shape
    half = (resize(reference).shape[1] - GAP) // 2
    k = max(1, round(half / (0.2 * w)))
    width = min(w, max(1, half // k))
    return width, min(h, max(1, round(0.7 * width)))


def _insets(image: np.ndarray, crops: Sequence[Crop], shown_width: int) -> list[np.ndarray]:
    """The crops of an image as they stand on the sheet, side by side under an image."""
    cell = (shown_width - GAP * (len(crops) - 1)) // len(crops)
    return [_fitted(image[y:y + height, x:x + width], cell) for x, y, width, height in crops]


def _draw_block(axes: Axes, block: Block, columns: Sequence[int], top: int, text: int, caption_row: int) -> None:
    import matplotlib
    from matplotlib.patches import Rectangle

    height, width, _ = resize(block.reference).shape
    magnified = width / block.reference.shape[1]
    scale = error_scale(list(block.error_maps.values()))
    colours = matplotlib.colormaps[COLOUR_MAP].with_extremes(bad="#" + bytes(tonemap.INVALID).hex())
    best = np.nanmin(list(block.errors.values()), axis=0)
    error_top = top + height + caption_row
    crop_top = error_top + height + GAP
    for x, (name, image) in zip(columns, {"": block.reference, **block.images}.items(), strict=True):
        _image(axes, x, top, tonemap.srgb(resize(image), block.exposure))
        insets = _insets(image, block.crops, width)
        room = width - sum(inset.shape[1] for inset in insets)          # shared between them
        at = x
        for (cx, cy, crop_width, crop_height), inset, box in zip(block.crops, insets, BOXES, strict=False):
            axes.add_patch(Rectangle((x + cx * magnified, top + cy * magnified), crop_width * magnified,
                                     crop_height * magnified, fill=False, edgecolor=box, linewidth=1.8))
            _image(axes, at, crop_top, tonemap.srgb(inset, block.exposure))
            axes.add_patch(Rectangle((at + 2, crop_top + 2), inset.shape[1] - 4, inset.shape[0] - 4, fill=False,
                                     edgecolor=box, linewidth=3.2))
            at += inset.shape[1] + room // max(1, len(insets) - 1)
        middle = top + height + caption_row / 2
        if name:
            _image(axes, x, error_top, colours(resize(block.error_maps[name]) / scale)[..., :3])
            for label, value, lowest, share in zip(("L1", "relMSE"), block.errors[name], best, (0.25, 0.72), strict=True):
                _text(axes, x + share * width, middle, f"{label} {summary.number(value)}", text,
                      weight="bold" if value == lowest and len(block.errors) > 1 else "normal")
        else:
            if block.floor is not None:
                _text(axes, x + width / 2, middle, f"noise floor {summary.number(block.floor)}", text, color="#555555")
            _draw_scale(axes, x, error_top, width, height, scale, text)


def _draw_scale(axes: Axes, x: float, y: float, width: int, height: int, scale: float, text: int) -> None:
    """The colour bar of the error maps, in the place of the reference's own."""
    import matplotlib

    bar_height = round(0.7 * text)
    bar = np.broadcast_to(np.linspace(0, 1, round(0.8 * width)), (bar_height, round(0.8 * width)))
    left, top = x + round(0.1 * width), y + round(0.5 * height) - bar_height // 2
    _text(axes, x + width / 2, top - 0.95 * text, "error |x \N{MINUS SIGN} r| / (r + 0.01)", text)
    _image(axes, left, top, matplotlib.colormaps[COLOUR_MAP](bar)[..., :3])
    for share in (0, 0.5, 1):
        label = f"{share * scale:g}"
        _text(axes, left + share * bar.shape[1], top + bar_height + 0.75 * text,
              "\N{GREATER-THAN OR EQUAL TO} " + label if share == 1 else label, 0.9 * text)


def _image(axes: Axes, x: float, y: float, image: np.ndarray) -> None:
    height, width = image.shape[:2]
    axes.imshow(image, extent=(x, x + width, y + height, y), interpolation="nearest", aspect="auto")
    axes.set(xlim=axes.get_xlim(), ylim=axes.get_ylim())


def _text(axes: Axes, x: float, y: float, text: str, size: float, **style: Any) -> None:
    axes.text(x, y, text, fontsize=size * 72 / DPI, va="center", **{"ha": "center", "color": "#222222", **style})
