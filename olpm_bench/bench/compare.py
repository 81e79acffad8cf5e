"""Images against a reference by every metric: `olpm-bench compare`."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import metrics
from olpm_bench.bench.exr import read_exr
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.reference_file import read_reference
from olpm_bench.bench.summary import number, print_whole
from olpm_bench.bench.terminal import plain_console

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Comparison:
    """Metric -> error of each image, in the order of `images`; with how many pixels are NaN, infinite or negative."""
    reference: Path
    images: list[Path]
    errors: dict[str, list[float]]
    invalid_pixels: list[int]

    def as_dict(self) -> dict[str, Any]:
        return {"reference": str(self.reference), "images": [
            {"image": str(path), **{name: values[i] for name, values in self.errors.items()},
             "invalid_pixels": self.invalid_pixels[i]} for i, path in enumerate(self.images)]}


def compare(a: Path, b: Path, reference: Path | None = None) -> Comparison:
    """The errors of two images, or without a reference that of `a` with `b` as the reference.

    Args:
        a, b: EXR files of one size: ours (the part "mean") or of any other renderer (the first part).
        reference: an EXR, or a folder that `olpm-bench reference` has made; it may be larger by a whole factor.

    Raises:
        ResultError: a file that is missing or no RGB EXR; sizes that differ.
    """
    images = [_read(path) for path in (a, b)]
    if images[0].shape != images[1].shape:
        sizes = (f"{path} is {image.shape[1]}x{image.shape[0]}" for path, image in zip((a, b), images, strict=True))
        raise ResultError(f"{', '.join(sizes)}: must be of one size")
    if reference is None:
        paths, truth = [a], images[1]
    else:
        paths, truth = [a, b], read_reference(reference, images[0].shape[1], images[0].shape[0]).mean
    images = images[:len(paths)]
    errors = {name: [metric(image, truth) for image in images] for name, metric in metrics.METRICS.items()}
    invalid = [int((~(np.isfinite(image) & (image >= 0)).all(axis=-1)).sum()) for image in images]
    return Comparison(reference or b, paths, errors, invalid)


def _read(path: Path) -> np.ndarray:
    """The image (h, w, 3) of an EXR."""
    parts, _ = read_exr(path)
    image = parts.get("mean", next(iter(parts.values())))
    if image.shape[2] != 3:
        raise ResultError(f"{path} has no RGB image")
    return image


def print_comparison(found: Comparison, console: Console | None = None) -> None:
    """Print a line for each metric; the smaller of two errors is marked."""
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), header_style="bold", pad_edge=False)
    table.add_column("metric", no_wrap=True)
    for path in found.images:
        table.add_column(Text(str(path)), justify="right", no_wrap=True)
    for name, errors in found.errors.items():
        best = min(errors) if len(errors) > 1 else None
        table.add_row(name, *(Text(number(e), style="bold green" if e == best else "") for e in errors))
    console = console or plain_console()
    print_whole(table, console)
    console.print(f"against {found.reference}", markup=False, highlight=False, soft_wrap=True)
    for path, invalid in zip(found.images, found.invalid_pixels, strict=True):
        if invalid:
            console.print(f"{path}: {invalid} pixels are NaN, infinite or negative", style="yellow", markup=False, soft_wrap=True)
