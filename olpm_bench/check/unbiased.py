"""Guided by the representation, the path tracer keeps its expectation: trained on the scene, and on garbage."""
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
from scipy import stats

import olpm_bench
from olpm_bench.check.small_scenes import blocks, box, furnace, grey, lamp, passes
from olpm_bench.check.verdict import Panel, Picture, PValues, Verdict
from olpm_bench.transport import settings
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.roulette import PixelEstimate
from representations.interface import ParticleBatch

TRAINING: dict[str, Any] = {"passes": 2, "photons": 20_000, "importons": 10_000, "record_radius": 0.08,
                            "camera_passes": 2, "camera_paths": 2**14}
DEPTH = 8
ALBEDO = 0.5
OVERLAP = 0.01              # of the furnace's walls
ROUNDING = 5e-4             # relative error that the furnace is forgiven: Mitsuba's `path` finds 2.00038 +- 0.00005 in place of 2
PASSES, SPP = 32, 64
BLOCK = 8                   # pixels along each side of the blocks that are compared
GARBAGE = 100               # particles of a record
BELIEVED = 0.5              # BSDF fraction of records taught garbage, at least: at 0.1 paths weigh up to ten times as much with
                            # each bounce, blocks are as skewed as 5, and t-tests find p < 0.001 six times too often


def keep_the_furnace(specification: dict[str, Any], seed: int, level: float) -> Verdict:
    """A closed box of albedo a that emits 1: radiance 1 / (1 - a) everywhere, whatever the guide believes."""
    scene, expected, p_values, skewness = furnace(ALBEDO, OVERLAP), 1 / (1 - ALBEDO), PValues(), 0.0
    # Paths long enough that what is cut off, a^40, doesn't show
    for how, guide in _guides(scene, specification, seed, parallax=False):
        images = passes(scene, olpm_bench.integrator(guide, max_depth=40, rr_depth=8), PASSES, SPP, _seed(seed))
        skewness = max(skewness, _test(p_values, images, np.full_like(images[0], expected), None, f"the furnace, {how}"))
    return p_values.verdict(level, f"{2 * PASSES} images of {SPP} samples a pixel, blocks of a skewness up to {skewness:.1f}")


def keep_the_image(specification: dict[str, Any], seed: int, level: float) -> Verdict:
    """A box lit indirectly, with a glossy sphere in it: the image is that of Mitsuba's `path`."""
    glossy = {"type": "roughconductor", "alpha": 0.15}
    sphere = {"type": "sphere", "center": [-0.35, 0.3, -0.5], "radius": 0.4, "bsdf": glossy}
    content = box(grey(0.6), lamp=lamp(), sphere=sphere)
    scene = mi.load_dict(content, parallel=False, optimize=False)       # in one order, which has the same kernels each time
    reference = passes(scene, mi.load_dict({"type": "path", "max_depth": DEPTH}), PASSES, SPP, _seed(seed) + PASSES)
    p_values, skewness = PValues(), 0.0
    for how, guide in _guides(scene, specification, seed, parallax=True):
        images = passes(scene, olpm_bench.integrator(guide, max_depth=DEPTH), PASSES, SPP, _seed(seed))
        skewness = max(skewness, _test(p_values, images, reference.mean(0), reference, f"the box, {how}"))
    return p_values.verdict(level, f"{3 * PASSES} images of {SPP} samples a pixel, blocks of a skewness up to {skewness:.1f}")


def _seed(seed: int) -> int:
    """Of the first image; those of another run of the checks are others."""
    return 1000 + 4 * PASSES * seed


def _guides(scene: mi.Scene, specification: dict[str, Any], seed: int, parallax: bool) -> Iterator[tuple[str, Guide]]:
    """Trained on the scene, with or without `parallax`, then on garbage, the other way: each scene is rendered with both."""
    olpm_bench.register()
    from olpm_bench.transport.training import Training

    words = {True: "with parallax", False: "without parallax"}
    training = Training(scene, specification, settings.training(**TRAINING, parallax=parallax),
                        settings.integrator(max_depth=DEPTH), seed)
    for _ in training.run():
        pass
    guide = training.radiance
    share = f"({guide.trained:.0%} of {guide.records} records guide)"
    yield f"trained on the scene {words[parallax]} {share}", guide
    guide.parallax = not parallax
    teach_garbage(guide, seed)
    yield f"trained on garbage {words[not parallax]} {share}", guide


def teach_garbage(guide: Guide, seed: int) -> None:
    """Particles that have nothing to do with the light, one random direction a record, of wild weights; wild estimates, too."""
    rng = np.random.default_rng([13, seed])
    n = guide.records
    lobe = rng.normal(size=(n, 1, 3)) + 0.1 * rng.normal(size=(n, GARBAGE, 3))
    lobe[..., 2] = np.abs(lobe[..., 2])
    wo = (lobe / np.linalg.norm(lobe, axis=-1, keepdims=True)).reshape(-1, 3)
    guide.state = guide.representation.init(n, seed, guide.parallax)
    guide.learn_particles(ParticleBatch.from_arrays(mi.Vector3f(wo.T), mi.Float(rng.lognormal(0, 2, n * GARBAGE)),
                                                    mi.UInt32(np.repeat(np.arange(n), GARBAGE)), n), seed)
    fraction, outgoing = rng.uniform(BELIEVED, 0.9, n), rng.lognormal(0, 2, n)
    guide.rows = mi.Float(np.stack([np.ones(n), fraction, outgoing, np.zeros(n)], axis=1).ravel())
    assert guide.pixels is not None
    guide.pixels = PixelEstimate(rng.lognormal(0, 1, guide.pixels.luminance.shape))


def _test(p_values: PValues, images: np.ndarray, expected: np.ndarray, reference: np.ndarray | None, name: str) -> float:
    """t-tests of the image's mean and of its blocks, against what is known or (Welch) against other images.

    Returns:
        The largest skewness of a block: p-values of skewed images are approximate, most of all small ones.
    """
    broken = ~np.isfinite(images) | (images < 0)
    picture = _picture(images, expected, reference)
    if broken.any():
        p_values.add(0, f"{name}: {broken.sum()} values of {broken.size} are not finite or negative", picture)
        return 0.0
    for size, what in ((images.shape[1], "the image"), (BLOCK, f"a block of {BLOCK} x {BLOCK} pixels")):
        a, b = blocks(images, size), blocks(expected[None], size)[0]
        if reference is None:
            p = stats.ttest_1samp(a, np.clip(a.mean(0), b * (1 - ROUNDING), b * (1 + ROUNDING))).pvalue
        else:
            p = stats.ttest_ind(a, blocks(reference, size), equal_var=False).pvalue
        for i, value in enumerate(np.atleast_1d(p)):
            error = a[:, i].std(ddof=1) / np.sqrt(len(a))
            p_values.add(value, f"{name}: {what} is {a[:, i].mean():.4f} +- {error:.4f} instead of {b[i]:.4f}", picture)
    return float(np.abs(stats.skew(a)).max())


def _picture(images: np.ndarray, expected: np.ndarray, reference: np.ndarray | None) -> Picture:
    def panels() -> list[Panel]:
        mean, variance = images.mean((0, -1)), images.mean(-1).var(0, ddof=1) / len(images)
        if reference is not None:
            variance = variance + reference.mean(-1).var(0, ddof=1) / len(reference)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (mean - expected.mean(-1)) / np.sqrt(variance)
        return [Panel("guided", mean, "linear", "radiance"), Panel("expected", expected.mean(-1), "linear", "radiance"),
                Panel("guided - expected", z, "signed", "standard deviations")]
    return panels
