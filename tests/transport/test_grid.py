"""Unbiased whatever scatters and whatever shines: every BSDF under every emitter, unguided and guided by each representation.

Each BSDF has a block of pixels, which Welch's t-test compares with Mitsuba's `path`: the block's mean, and those of its quarters.
By default all emitters shine at once.  `pytest -m slow tests/transport/test_grid.py --grid` lets them shine one after the other,
with four times the samples; `-rP` prints which bias would have been seen (README, "What is checked").
"""
from __future__ import annotations

from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_grid import BSDFS, CELL, COLUMNS, EMITTERS, scene
from scipy import stats
from small_scenes import blocks, passes

import olpm_bench
import representations
from olpm_bench.transport.guide import GuidedPoint
from olpm_bench.transport.guided_bsdf import GuidedBSDF

TRAINING = {"passes": 2, "photons": 50_000, "importons": 20_000, "record_radius": 0.03, "camera_passes": 2, "camera_paths": 2**16}
DEPTH = 6
PASSES, SPP = 32, 64
LEVEL = 0.01                # probability that all tests together fail although nothing is wrong
ENVIRONMENTS = ("constant", "envmap", "sunsky")        # of which a scene can have one
TOGETHER = tuple(name for name in EMITTERS if name not in ENVIRONMENTS[:2])
METHODS = ("unguided", *representations.names())
TESTS = 5 * len(BSDFS) * len(METHODS)                   # the block and its quarters

pytestmark = pytest.mark.slow


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Emitter by emitter, so that what is rendered for one serves all methods."""
    if "emitters" in metafunc.fixturenames:
        alone = metafunc.config.getoption("--grid")
        lights = {name: (name,) for name in EMITTERS} if alone else {"all emitters": TOGETHER}
        cases = {f"{name}-{method}": (emitters, method) for name, emitters in lights.items() for method in METHODS}
        metafunc.parametrize(("emitters", "method"), cases.values(), ids=cases)


class Blocks:
    """Means over the blocks of pixels in n passes: [n, BSDF] and of their quarters [n, 4 * BSDF]."""

    def __init__(self, images: np.ndarray) -> None:
        assert np.isfinite(images).all() and (images >= 0).all()
        self.whole = blocks(images, CELL)[:, :len(BSDFS)]
        quarters = blocks(images, CELL // 2).reshape(len(images), -1, 2, COLUMNS, 2).swapaxes(2, 3)
        self.quarters = quarters.reshape(len(images), -1)[:, :4 * len(BSDFS)]


class Comparison:
    """A method's blocks beside Mitsuba's, for each BSDF.

    Attributes:
        level: of each test, where all of so many `tests` have `LEVEL` together (Sidak).
        p: the least p-value of the block and its quarters.
        bias: of the block, relative.
        seen: the relative bias of the block that would be found with a probability of 0.9.
    """

    def __init__(self, ours: Blocks, theirs: Blocks, tests: int) -> None:
        self.level = 1 - (1 - LEVEL) ** (1 / tests)
        whole = stats.ttest_ind(ours.whole, theirs.whole, equal_var=False)
        quarters = stats.ttest_ind(ours.quarters, theirs.quarters, equal_var=False)
        self.p = np.minimum(whole.pvalue, quarters.pvalue.reshape(-1, 4).min(1))
        mean = theirs.whole.mean(0)
        self.bias = ours.whole.mean(0) / mean - 1
        error = np.sqrt(ours.whole.var(0, ddof=1) / len(ours.whole) + theirs.whole.var(0, ddof=1) / len(theirs.whole)) / mean
        # Nine times of ten: the threshold, and 1.28 standard errors more
        self.seen = error * (stats.t.isf(self.level / 2, whole.df) + 1.28)

    @property
    def rejected(self) -> dict[str, str]:
        """The BSDFs where the two differ, and by how much."""
        return {name: line for name, line, p in zip(BSDFS, self.lines(), self.p, strict=True) if p < self.level}

    def lines(self) -> list[str]:
        return [f"{name:28} off by {bias:+7.2%}, p = {p:8.2g}; a bias of {seen:6.2%} would be seen"
                for name, bias, p, seen in zip(BSDFS, self.bias, self.p, self.seen, strict=True)]


@lru_cache(maxsize=1)
def lit_by(emitters: tuple[str, ...]) -> mi.Scene:
    return scene(*emitters)


@lru_cache(maxsize=1)
def by_mitsuba(emitters: tuple[str, ...], spp: int) -> Blocks:
    return Blocks(passes(lit_by(emitters), mi.load_dict({"type": "path", "max_depth": DEPTH}), PASSES, spp, seed=1000))


@lru_cache(maxsize=len(METHODS))
def trained(emitters: tuple[str, ...], representation: str):
    guide = olpm_bench.train(lit_by(emitters), representation, max_depth=DEPTH, **TRAINING)
    assert guide.trained > 0.3
    return guide


def compare(emitters: tuple[str, ...], method: str, tests: int, spp: int) -> Comparison:
    guide = trained(emitters, method) if method != "unguided" else None
    integrator = olpm_bench.integrator(guide, max_depth=DEPTH)
    return Comparison(Blocks(passes(lit_by(emitters), integrator, PASSES, spp)), by_mitsuba(emitters, spp), tests)


def test_every_bsdf_under_every_emitter(emitters, method, request):
    alone = request.config.getoption("--grid")
    found = compare(emitters, method, *((TESTS * len(EMITTERS), 4 * SPP) if alone else (TESTS, SPP)))
    print(f"{', '.join(emitters)}; {method}:", *found.lines(), sep="\n")
    assert not found.rejected, "\n".join(found.rejected.values())
    assert np.median(found.seen) < 0.1


def _density_too_large(patch: pytest.MonkeyPatch) -> None:
    """The guide reports 1.5 times the density that it samples."""
    pdf = GuidedPoint.pdf
    patch.setattr(GuidedPoint, "pdf", lambda self, d: 1.5 * pdf(self, d))


def _specular_weight(patch: pytest.MonkeyPatch) -> None:
    """Specular samples are not divided by the probability of asking the BSDF."""
    one_sample = GuidedBSDF._one_sample

    def wrong(self, *args):
        bs, weight = one_sample(self, *args)
        return bs, dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), weight * self.fraction, weight)
    patch.setattr(GuidedBSDF, "_one_sample", wrong)


@pytest.mark.parametrize(("mutation", "caught"), [
    (_density_too_large, {"diffuse", "plastic", "pplastic", "mask", "twosided", "bumpmap", "normalmap"}),
    (_specular_weight, {"mask", "mask, textured", "blendbsdf"}),
], ids=["density", "specular"])
def test_wrong_integrators_are_caught(mutation, caught, monkeypatch):
    trained(TOGETHER, "gaussian_mixture")
    mutation(monkeypatch)
    found = compare(TOGETHER, "gaussian_mixture", TESTS, SPP)
    print(mutation.__doc__, *found.lines(), sep="\n")
    assert caught <= found.rejected.keys(), "\n".join(found.lines())
