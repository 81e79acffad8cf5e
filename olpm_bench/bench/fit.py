"""How well a representation fits directional data: what `olpm-bench fit` prints.

Densities are divided by their integral over the hemisphere, so that one that loses samples below the horizon is not
praised or blamed for it twice; the integral is reported.  "Mixed" is q = (cos / pi + p_fit) / 2, what a path tracer
samples at a diffuse vertex that is guided half of the time.
"""
from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport import npz
from olpm_bench.transport.settings import InputError
from representations import square
from representations import state as states
from representations.interface import DirectionalPdf, ParticleBatch

RESOLUTION = 2048           # quadrature points along the square; the sun's disk is 7 across
LANES = 1 << 20             # directions evaluated at once


def fit(representation: DirectionalPdf[Any], samples: Path, heldout: Path, batches: int = 1,
        seed: int = 0) -> dict[str, float | int | None]:
    """Train one record on weighted directions, fed in `batches` equal parts, and grade it on others.

    Args:
        samples: .npz with `wo` [n, 3], unit vectors with z > 0, and `weight` [n].
        heldout: the same for the true distribution, with its density `pdf` [n] at `wo` [1/sr].

    Returns:
        mean_log_pdf: mean of ln p_fit over the held-out directions [nats]; None where one of them has density 0.
        zero_density_fraction: how many have.
        mean_log_pdf_mixed: mean of ln q.
        second_moment: E_p[p / q], the relative second moment of one-sample MIS at a white diffuse vertex; 1 is ideal.
        integral: of p_fit over the hemisphere, before the division by it.
        seconds_per_particle: wall time of the updates; kernels are compiled before.
        bytes: of the record's state.

    Means are weighted by the held-out weights.

    Raises:
        InputError: a file or array that is missing, or is not what it has to be.
    """
    wo, weight = _load(samples, "wo", "weight")
    heldout_wo, heldout_weight, truth = _load(heldout, "wo", "weight", "pdf")
    if not 1 <= batches <= len(wo):
        raise InputError(f"batches = {batches}: must be in 1 .. {len(wo)}, the number of directions in {samples}")
    parts = []
    for part in np.array_split(np.arange(len(wo)), batches):
        direction = mi.Vector3f(np.ascontiguousarray(wo[part].T, np.float32))
        parts.append(ParticleBatch.from_arrays(direction, mi.Float(weight[part].astype(np.float32)),
                                               dr.zeros(mi.UInt32, len(part)), 1))
    _train(representation, parts, seed)             # compiles
    state, seconds = _train(representation, parts, seed)

    integral = _integral(representation, state)
    if not integral > 0:
        raise InputError(f"the fitted density integrates to {integral}, so it can't be normalised")
    p_fit = _pdf(representation, state, heldout_wo) / integral
    q = 0.5 * heldout_wo[:, 2] / np.pi + 0.5 * p_fit
    share = heldout_weight / heldout_weight.sum()
    zeros = p_fit == 0
    return {
        "mean_log_pdf": None if zeros.any() else float(share @ np.log(p_fit)),
        "zero_density_fraction": float(zeros.mean()),
        "mean_log_pdf_mixed": float(share @ np.log(q)),
        "second_moment": float(share @ (truth / q)),
        "integral": integral,
        "seconds_per_particle": seconds / len(wo),
        "bytes": states.bytes_of(state),
    }


def _train(representation: DirectionalPdf[Any], parts: list[ParticleBatch], seed: int) -> tuple[Any, float]:
    """State after all parts, and the wall time of the updates [s]."""
    state = representation.init(1, seed)
    dr.eval(state)
    dr.sync_thread()
    start = time.perf_counter()
    for index, part in enumerate(parts):
        state = representation.update(state, part, seed + index)
        dr.eval(state)
    dr.sync_thread()
    return state, time.perf_counter() - start


def _pdf(representation: DirectionalPdf[Any], state: Any, wo: np.ndarray) -> np.ndarray:
    """Density at directions [n, 3], as float64 [n]."""
    found = [representation.pdf(state, dr.zeros(mi.UInt32, len(part)), mi.Vector3f(np.ascontiguousarray(part.T, np.float32)))
             for part in np.array_split(wo, -(-len(wo) // LANES))]
    return np.concatenate([np.asarray(p.numpy(), np.float64) for p in found])


def _integral(representation: DirectionalPdf[Any], state: Any) -> float:
    """Integral over the hemisphere: the midpoint rule on the equal-area square, `RESOLUTION`^2 points."""
    total = 0.0
    for begin in range(0, RESOLUTION**2, LANES):
        i = dr.arange(mi.UInt32, LANES) + dr.opaque(mi.UInt32, begin)
        s = mi.Point2f(mi.Float(i % RESOLUTION) + 0.5, mi.Float(i // RESOLUTION) + 0.5) / RESOLUTION
        pdf = representation.pdf(state, dr.zeros(mi.UInt32, LANES), square.to_hemisphere(s))
        total += float(pdf.numpy().sum(dtype=np.float64))
    return total / RESOLUTION**2 / square.TO_SOLID_ANGLE


def _load(file: Path, *names: str) -> list[np.ndarray]:
    """Arrays of an .npz file, checked and as float64; weights over the largest."""
    if not Path(file).is_file():
        raise InputError(f"{file}: there is no such file")
    archive = npz.read(file)
    for name in names:
        if name not in archive:
            raise InputError(f"{file}: not an .npz file of directions: no array '{name}'; it has {', '.join(archive) or 'none'}, "
                             f"but {', '.join(names)} are needed")
        if archive[name].dtype.kind not in "fiu":
            raise InputError(f"{file}: not an .npz file of directions: array '{name}' is of type {archive[name].dtype}")
    arrays = [np.asarray(archive[name], np.float64) for name in names]
    n = len(arrays[0]) if arrays[0].ndim else 0
    for name, array in zip(names, arrays, strict=True):
        shape = (n, 3) if name == "wo" else (n,)
        if array.shape != shape or n == 0:
            raise InputError(f"{file}: array '{name}' has shape {array.shape}; must be {'(n, 3)' if name == 'wo' else '(n,)'} "
                             f"with n = {n or '1 or more'}")
        if not np.isfinite(array).all():
            raise InputError(f"{file}: array '{name}' has {np.count_nonzero(~np.isfinite(array))} NaN or infinite entries")
        if name != "wo" and array.min() < 0:
            raise InputError(f"{file}: array '{name}' has {np.count_nonzero(array < 0)} negative entries")
    by_name = dict(zip(names, arrays, strict=True))
    if not by_name["weight"].any():
        raise InputError(f"{file}: array 'weight' is zero everywhere")
    wo = by_name["wo"]
    stray = np.abs(np.linalg.norm(wo, axis=1) - 1) > 1e-3
    if stray.any():
        raise InputError(f"{file}: array 'wo' has {np.count_nonzero(stray)} vectors that are not of unit length")
    if wo[:, 2].min() <= 0:
        below = np.count_nonzero(wo[:, 2] <= 0)
        raise InputError(f"{file}: array 'wo' has {below} directions below the horizon; must have z > 0")
    largest = by_name["weight"].max()           # only ratios matter, and sums of large ones overflow
    return [array / largest if name == "weight" else array for name, array in by_name.items()]
