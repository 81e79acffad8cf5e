"""HDR-FLIP [Andersson et al. 2021] of an image, at exposures that its scene's reference fixes.

The evaluator ends its process on input that it dislikes, so it has one of its own, which answers one request after another.
"""
from __future__ import annotations

import atexit
import functools
import json
import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from olpm_bench.bench import other_process

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])     # of linear RGB, Rec. 709
# The tone curve of ACES, as the evaluator has it: (A x^2 + B x) / (C x^2 + D x + E).
ACES_NUMERATOR = np.array([0.6**2 * 2.51, 0.6 * 0.03, 0.0])
ACES_DENOMINATOR = np.array([0.6**2 * 2.43, 0.6 * 0.59, 0.14])
ACES_BRIGHT = 0.85          # what the tone curve shows at the exposures' anchors
STOPS = 20                  # pixels darker by more than that than the brightest one count as black
WHITE = 1e6                 # times the reference's maximum: white at every exposure


class FlipError(RuntimeError):
    """The evaluator gave no answer."""


@dataclass(frozen=True)
class Exposures:
    """The range of exposures over which HDR-FLIP takes the largest error, in stops on the radiance of the reference.

    start: shows the brightest luminance of the reference at 85 % of white.
    stop: shows the median luminance of its pixels that are not black so.
    count: of the exposures, evenly spaced from start to stop.
    """
    start: float
    stop: float
    count: int


def exposures(reference: np.ndarray) -> Exposures | None:
    """The exposures that a reference (h, w, 3) fixes for all images of its scene; None if it is black or not finite.

    They are those of the publication but for the median, which leaves black pixels out: the median of all pixels falls by
    20 stops where more than half of a reference becomes black.
    """
    if not np.isfinite(reference).all():
        return None
    luminance = np.maximum(reference, 0).astype(np.float64) @ LUMINANCE
    brightest = float(luminance.max())
    if brightest == 0:
        return None
    median = float(np.median(luminance[luminance >= brightest * 2.0**-STOPS]))
    start, stop = (float(np.log2(_aces_anchor() / value)) for value in (brightest, median))
    return Exposures(start, stop, max(2, int(np.ceil(stop - start))))


def _aces_anchor() -> float:
    """The value that the tone curve shows at 85 % of white."""
    return float(np.roots(ACES_NUMERATOR - ACES_BRIGHT * ACES_DENOMINATOR).max())


def flip(x: np.ndarray, r: np.ndarray) -> float:
    """Mean HDR-FLIP of an image against its reference, both (h, w, 3) linear RGB, in [0, 1].

    Both are divided by the reference's maximum first, so that the unit of radiance does not matter.

    Returns:
        NaN where an image is not finite, or the reference is black.

    Raises:
        FlipError: the evaluator ended, or hung.
    """
    found = exposures(r)
    if found is None or not np.isfinite(x).all():
        return float("nan")
    maximum = float(r.max())
    test, reference = (np.clip(image.astype(np.float64) / maximum, 0, WHITE).astype(np.float32) for image in (x, r))
    shift = float(np.log2(maximum))
    parameters = {"startExposure": found.start + shift, "stopExposure": found.stop + shift, "numExposures": found.count}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "images.npz"
        np.savez(path, reference=reference, test=test)
        answer = _evaluator().ask(str(path), parameters)
    if "mean" not in answer:
        hung = f"gave no answer for {answer['hung']:.0f} s" if "hung" in answer else None
        raise FlipError(f"the evaluator of HDR-FLIP {hung or f'ended its process: {other_process.end(answer)}'}")
    return float(answer["mean"])


@functools.cache
def _evaluator() -> other_process.Process:
    """The process that evaluates, started with the first request; it ends with the one that asks."""
    process = other_process.Process(other_process.command("olpm_bench.bench.flip"))
    atexit.register(process.__exit__)
    return process


def _serve() -> None:
    """Answer requests, lines of JSON [path of two images, parameters], by {"mean": HDR-FLIP}."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")     # read by `import`; threads that spin for work take it from others
    import flip_evaluator

    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)                   # what the evaluator prints is no answer
    for line in sys.stdin:
        path, parameters = json.loads(line)
        with np.load(path) as images:
            result = flip_evaluator.evaluate(images["reference"], images["test"], "HDR", applyMagma=False, parameters=parameters)
        print(json.dumps({"mean": float(result[1])}), file=answers)


if __name__ == "__main__":
    _serve()
