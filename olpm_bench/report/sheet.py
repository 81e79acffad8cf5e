"""The image sheet: reference and methods side by side, with error maps and crops.

Reads results, renders nothing.  Pixels are shown as they are: magnified by whole numbers, or averaged in whole blocks
where an image is too wide for its column.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import metrics, summary
from olpm_bench.bench.results import Reference, Results, read_json, replacing
from olpm_bench.report import figures, tonemap

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from olpm_bench.bench.config import Experiment

COLUMN = 480                            # wanted width of a column [pixel]
GAP = 10
DPI = 100
BOXES = ("#ff5a1f", "#29c5ff")          # of the crops, seen on dark and on bright images
COLOUR_MAP = "magma"


@dataclass(frozen=True)
class Block:
    """What the sheet shows of one scene; images are (h, w, 3), linear RGB."""
    scene: str
    reference: np.ndarray
    floor: float | None
    images: dict[str, np.ndarray]       # by method


def sheet(results: Results, experiment: Experiment, references: Mapping[str, Reference],
          out: Path | None = None) -> None:
    """Write sheet.png into `out` (the results folder by default); of each method the seed with the median L1.

    Scenes without reference are left out; there must be another.

    Raises:
        ResultError: a cell or reference is missing; the message names the command that makes it.
    """
    cells = summary.complete_cells(experiment, results)
    blocks = []
    for scene in experiment.scene:
        reference = summary.scene_reference(references, scene, results, experiment)
        if reference is None:
            continue
        images = {}
        for method in (method.name for method in experiment.shown):
            images[method] = _median_image([cell.image()["mean"] for cell in cells[scene.name, method]], reference.mean)
        blocks.append(Block(scene.name, reference.mean, reference.noise_floor, images))
    note = _caption(experiment, read_json(results.folder / "env.json"))
    with figures.style():
        figure = draw(blocks, note)
        with replacing((out or results.folder) / "sheet.png") as beside:
            figure.savefig(beside, dpi=DPI)


def _median_image(images: Sequence[np.ndarray], reference: np.ndarray) -> np.ndarray:
    """The image with the median L1 (the lower one of two)."""
    order = np.argsort([metrics.l1(image, reference) for image in images])
    return images[order[(len(images) - 1) // 2]]


def _caption(experiment: Experiment, environment: Mapping[str, Any]) -> str:
    budget = experiment.budget
    spent = f"{budget.seconds:g} s a method, training included" if budget.seconds else f"{budget.spp} samples per pixel"
    n = len(experiment.seeds)
    seeds = f"of {n} seeds the one with the median L1" if n > 1 else "one seed"
    return f"{experiment.title}: {spent}; {seeds}. {figures.machine(environment)}"


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
    h, w = image.shape[:2]
    if w <= width * 1.5:
        k = max(1, round(width / w))
        return image.repeat(k, axis=0).repeat(k, axis=1)
    k = round(w / width)
    h, w = h // k, w // k
    blocks: np.ndarray = image[:h * k, :w * k].reshape(h, k, w, k, *image.shape[2:]).mean(axis=(1, 3), dtype=np.float64)
    return blocks


def draw(blocks: Sequence[Block], note: str = "") -> Figure:
    """The sheet, in the style that is active."""
    from matplotlib.figure import Figure

    sizes = [resize(block.reference).shape for block in blocks]
    column = max(width for _, width, _ in sizes)
    text = round(0.058 * column)                    # size of the text [pixel]
    crop_heights = [_crop_geometry(block.reference, width)[2]
                    for block, (_, width, _) in zip(blocks, sizes, strict=True)]
    left = GAP + (round(1.5 * text) if len(blocks) > 1 else 0)
    head, foot = round(1.9 * text), round(1.6 * text) if note else GAP
    caption_row = round(1.65 * text)
    block_heights = [2 * h + crop + caption_row + 2 * GAP for (h, _, _), crop in zip(sizes, crop_heights, strict=True)]
    width = left + (1 + len(blocks[0].images)) * (column + GAP)
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
    if note:
        _text(axes, columns[0], height - foot / 2, note, 0.75 * text, ha="left", color="#555555")
    return figure


def _crop_geometry(reference: np.ndarray, shown_width: int) -> tuple[int, int, int]:
    """Width and height of a crop in the image [pixel], and its height on the sheet: two fill the width of an image."""
    h, w, _ = reference.shape
    half = (shown_width - GAP) // 2
    k = max(1, round(half / (0.2 * w)))
    crop_width = min(w, max(1, half // k))
    crop_height = min(h, max(1, round(0.7 * crop_width)))
    return crop_width, crop_height, k * crop_height


def _draw_block(axes: Axes, block: Block, columns: Sequence[int], top: int, text: int, caption_row: int) -> None:
    import matplotlib
    from matplotlib.patches import Rectangle

    exposure = tonemap.auto_exposure(block.reference)
    height, width, _ = resize(block.reference).shape
    magnified = width / block.reference.shape[1]
    crop_width, crop_height, crop_shown = _crop_geometry(block.reference, width)
    encoded = [tonemap.encode(np.nan_to_num(image), exposure) for image in block.images.values()]
    crops = choose_crops(encoded, tonemap.encode(block.reference, exposure), crop_width, crop_height)
    errors = {name: relative_error(image, block.reference) for name, image in block.images.items()}
    scale = error_scale(list(errors.values()))
    colours = matplotlib.colormaps[COLOUR_MAP].with_extremes(bad="#" + bytes(tonemap.INVALID).hex())
    under = {name: (metrics.l1(image, block.reference), metrics.relmse(image, block.reference))
             for name, image in block.images.items()}
    best = np.nanmin([[*pair] for pair in under.values()], axis=0)
    error_top = top + height + caption_row
    crop_top = error_top + height + GAP
    for x, (name, image) in zip(columns, {"": block.reference, **block.images}.items(), strict=True):
        _image(axes, x, top, tonemap.srgb(resize(image), exposure))
        for i, ((cx, cy), box) in enumerate(zip(crops, BOXES, strict=True)):
            axes.add_patch(Rectangle((x + cx * magnified, top + cy * magnified), crop_width * magnified,
                                     crop_height * magnified, fill=False, edgecolor=box, linewidth=1.8))
            k = crop_shown // crop_height
            crop = image[cy:cy + crop_height, cx:cx + crop_width].repeat(k, axis=0).repeat(k, axis=1)
            at = x if i == 0 else x + width - crop.shape[1]
            _image(axes, at, crop_top, tonemap.srgb(crop, exposure))
            axes.add_patch(Rectangle((at + 2, crop_top + 2), crop.shape[1] - 4, crop.shape[0] - 4, fill=False,
                                     edgecolor=box, linewidth=3.2))
        middle = top + height + caption_row / 2
        if name:
            _image(axes, x, error_top, colours(resize(errors[name]) / scale)[..., :3])
            for label, value, lowest, share in zip(("L1", "relMSE"), under[name], best, (0.25, 0.72), strict=True):
                _text(axes, x + share * width, middle, f"{label} {summary.number(value)}", text,
                      weight="bold" if value == lowest and len(under) > 1 else "normal")
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
