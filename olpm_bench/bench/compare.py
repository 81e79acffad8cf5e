"""Images against a reference by every metric: `olpm-bench compare`."""
from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from olpm_bench.bench import metrics
from olpm_bench.bench.exr import read_exr
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.flip import Exposures, exposures
from olpm_bench.bench.reference_file import read_reference
from olpm_bench.bench.summary import number, print_whole
from olpm_bench.bench.terminal import plain_console

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Comparison:
    """The errors of images.

    errors: metric -> error of each image, in the order of `images`; NaN where it has none.
    failures: a sentence on each metric that failed.
    invalid_pixels: of each image, how many pixels are NaN, infinite or negative.
    exposures: those of HDR-FLIP; None for a black reference.
    """
    reference: Path
    images: list[Path]
    errors: dict[str, list[float]]
    failures: list[str]
    invalid_pixels: list[int]
    exposures: Exposures | None

    def as_dict(self) -> dict[str, Any]:
        images = [{"image": str(path), **{name: values[i] for name, values in self.errors.items()},
                   "invalid_pixels": self.invalid_pixels[i]} for i, path in enumerate(self.images)]
        return {"reference": str(self.reference), "images": images, "failures": self.failures,
                "flip_exposures": asdict(self.exposures) if self.exposures is not None else None}


def compare(a: Path, b: Path, reference: Path | None = None) -> Comparison:
    """The errors of two images, or without a reference that of `a` with `b` as the reference.

    Args:
        a, b: EXR files of one size: ours (the layer "mean") or of any other renderer (what it shows).
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
    errors, failures = metrics.errors(images, truth)
    invalid = [int((~(np.isfinite(image) & (image >= 0)).all(axis=-1)).sum()) for image in images]
    return Comparison(reference or b, paths, {name: values.tolist() for name, values in errors.items()}, failures, invalid,
                      exposures(truth))


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
        best = min((e for e in errors if math.isfinite(e)), default=None) if len(errors) > 1 else None
        table.add_row(name, *(Text(number(e), style="bold green" if e == best else "") for e in errors))
    console = console or plain_console()
    print_whole(table, console)
    console.print(f"against {found.reference}", markup=False, highlight=False, soft_wrap=True)
    for failure in found.failures:
        console.print(failure, style="yellow", markup=False, highlight=False, soft_wrap=True)
    for path, invalid in zip(found.images, found.invalid_pixels, strict=True):
        if invalid:
            console.print(f"{path}: {invalid} pixels are NaN, infinite or negative", style="yellow", markup=False, soft_wrap=True)
