"""Unbiased whatever scatters and whatever shines: every BSDF under every emitter, unguided and guided by each representation.

Each BSDF has a block of pixels, which Welch's t-test compares with Mitsuba's `path`: the block's mean, and those of its quarters.
A scene has one environment: by default `sunsky` and all local emitters shine at once, alike in brightness, and `constant` and
`envmap` alone, on a few BSDFs.  `pytest -m slow tests/transport/test_grid.py --grid` lets each emitter shine alone on all BSDFs,
with four times the samples; `-rP` prints which bias would have been seen (README, "What is checked").

Camera paths do not see a `directionalarea`, neither in Mitsuba's `path` nor in ours: its photons teach, and it must add nothing.
"""
from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_grid import BSDFS, CELL, COLUMNS, EMITTERS, scene
from scipy import stats
from small_scenes import blocks, passes

import olpm_bench
import representations
from olpm_bench.check.verdict import sidak
from olpm_bench.transport.guide import GuidedPoint
from olpm_bench.transport.guided_bsdf import GuidedBSDF

TRAINING = {"passes": 2, "photons": 50_000, "importons": 20_000, "record_radius": 0.03, "camera_passes": 2, "camera_paths": 2**16}
DEPTH = 6
PASSES, SPP = 32, 64
LEVEL = 0.01                # probability that all tests together fail although nothing is wrong
SEEN = 0.25                 # largest bias that may go unseen on a BSDF; found: 0.16, with --grid 0.19
METHODS = ("unguided", *representations.names())


MEASURED = ("measured",)    # in a room of its own: the others fill four rows
OTHERS = tuple(name for name in BSDFS if name not in MEASURED)


class Room(NamedTuple):
    """What shines, on which BSDFs, and what is compared there with `path`."""
    emitters: tuple[str, ...]
    bsdfs: tuple[str, ...] = OTHERS
    methods: tuple[str, ...] = METHODS


FEW = ("diffuse", "conductor", "roughconductor", "dielectric", "plastic", "mask")
TOGETHER = Room(tuple(name for name in EMITTERS if name not in ("constant", "envmap")))
ROOMS = {"constant": Room(("constant",), FEW, tuple(method for method in METHODS if method != "hey")),
         "envmap": Room(("envmap",), FEW, tuple(method for method in METHODS if method != "cosine")),
         "the others, measured": Room(TOGETHER.emitters, MEASURED), "the others": TOGETHER}
ALONE = {f"{name}{', measured' * (bsdfs == MEASURED)}": Room((name,), bsdfs)
         for name in EMITTERS if name != "directionalarea" for bsdfs in (OTHERS, MEASURED)}


def number_of_tests(rooms: Iterable[Room]) -> int:
    """A block and its quarters for each BSDF and method."""
    return 5 * sum(len(room.bsdfs) * len(room.methods) for room in rooms)


pytestmark = pytest.mark.slow


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Emitter by emitter, so that what is rendered for one serves all methods."""
    if "room" in metafunc.fixturenames:
        rooms = ALONE if metafunc.config.getoption("--grid") else ROOMS
        cases = {f"{name}-{method}": (room, method) for name, room in rooms.items() for method in room.methods}
        metafunc.parametrize(("room", "method"), cases.values(), ids=cases)


class Blocks:
    """Means over the blocks of pixels in n passes: [n, BSDF] and of their quarters [n, 4 * BSDF]."""

    def __init__(self, images: np.ndarray, bsdfs: tuple[str, ...]) -> None:
        assert np.isfinite(images).all() and (images >= 0).all()
        self.bsdfs, self.whole = bsdfs, blocks(images, CELL)[:, :len(bsdfs)]
        quarters = blocks(images, CELL // 2).reshape(len(images), -1, 2, COLUMNS, 2).swapaxes(2, 3)
        self.quarters = quarters.reshape(len(images), -1)[:, :4 * len(bsdfs)]


class Comparison:
    """A method's blocks beside Mitsuba's, for each BSDF.

    Attributes:
        level: of each test, where all of so many `tests` have `LEVEL` together (Sidak).
        p: the least p-value of the block and its quarters.
        bias: of the block, relative.
        seen: the relative bias of the block that would be found with a probability of 0.9.
    """

    def __init__(self, ours: Blocks, theirs: Blocks, tests: int) -> None:
        self.level = sidak(LEVEL, tests)
        self.bsdfs = ours.bsdfs
        whole = stats.ttest_ind(ours.whole, theirs.whole, equal_var=False)
        quarters = stats.ttest_ind(ours.quarters, theirs.quarters, equal_var=False)
        self.p = np.minimum(whole.pvalue, quarters.pvalue.reshape(-1, 4).min(1))
        mean = theirs.whole.mean(0)
        self.bias = ours.whole.mean(0) / mean - 1
        error = np.sqrt(ours.whole.var(0, ddof=1) / len(ours.whole) + theirs.whole.var(0, ddof=1) / len(theirs.whole)) / mean
        # Nine times of ten: the threshold, and 1.28 standard errors more
        self.seen = error * (stats.t.isf(self.level / 2, whole.df) + 1.28)
        assert np.isfinite([self.p, self.seen]).all(), "\n".join(self.lines())      # where all is black there is no test

    @property
    def rejected(self) -> dict[str, str]:
        """The BSDFs where the two differ, and by how much."""
        return {name: line for name, line, p in zip(self.bsdfs, self.lines(), self.p, strict=True) if p < self.level}

    def lines(self) -> list[str]:
        return [f"{name:28} off by {bias:+7.2%}, p = {p:8.2g}; a bias of {seen:6.2%} would be seen"
                for name, bias, p, seen in zip(self.bsdfs, self.bias, self.p, self.seen, strict=True)]


@lru_cache(maxsize=1)
def lit(room: Room) -> mi.Scene:
    return scene(room.emitters, room.bsdfs)


@lru_cache(maxsize=1)
def by_mitsuba(room: Room, spp: int) -> Blocks:
    images = passes(lit(room), mi.load_dict({"type": "path", "max_depth": DEPTH}), PASSES, spp, seed=1000)
    return Blocks(images, room.bsdfs)


@lru_cache(maxsize=len(METHODS))
def trained(room: Room, representation: str):
    guide = olpm_bench.train(lit(room), representation, max_depth=DEPTH, **TRAINING)
    assert guide.trained > 0.3
    return guide


def compare(room: Room, method: str, tests: int, spp: int) -> Comparison:
    guide = trained(room, method) if method != "unguided" else None
    integrator = olpm_bench.integrator(guide, max_depth=DEPTH)
    return Comparison(Blocks(passes(lit(room), integrator, PASSES, spp), room.bsdfs), by_mitsuba(room, spp), tests)


def test_emitters_that_shine_together_have_comparable_shares():
    """Of the light on diffuse spheres: from half to twice an equal share in the image, and a fifth of it at least on each."""
    by_path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    light = {name: Blocks(passes(scene((name,), ("diffuse",) * len(OTHERS)), by_path, 1, SPP), OTHERS).whole[0]
             for name in TOGETHER.emitters}
    assert not light.pop("directionalarea").any()
    mean = sum(light.values()) / len(light)
    for name, found in light.items():
        assert 0.5 < found.mean() / mean.mean() < 2, name
        assert (found / mean).min() > 0.2, name


def test_every_bsdf_under_every_emitter(room, method, request):
    grid = request.config.getoption("--grid")
    rooms, spp = (ALONE, 4 * SPP) if grid else (ROOMS, SPP)
    found = compare(room, method, number_of_tests(rooms.values()), spp)
    print(f"{', '.join(room.emitters)}; {method}:", *found.lines(), sep="\n")
    assert not found.rejected, "\n".join(found.rejected.values())
    assert np.median(found.seen) < 0.1 and found.seen.max() < SEEN, "\n".join(found.lines())


def _density_too_large(patch: pytest.MonkeyPatch) -> None:
    """The guide reports 1.5 times the density that it samples."""
    pdf = GuidedPoint.pdf
    patch.setattr(GuidedPoint, "pdf", lambda self, d: 1.5 * pdf(self, d))


def _specular_weight(patch: pytest.MonkeyPatch) -> None:
    """Specular samples of mixed BSDFs weigh a quarter too little."""
    one_sample = GuidedBSDF._one_sample

    def wrong(self, *args):
        bs, weight = one_sample(self, *args)
        mixed = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) & (self.fraction < 1)
        return bs, weight * dr.select(mixed, 0.75, 1)
    patch.setattr(GuidedBSDF, "_one_sample", wrong)


@pytest.mark.parametrize(("mutation", "caught"), [
    (_density_too_large, {"diffuse", "plastic", "pplastic", "mask", "twosided", "bumpmap", "normalmap"}),
    (_specular_weight, {"mask", "mask, textured", "blendbsdf"}),
], ids=["density", "specular"])
def test_wrong_integrators_are_caught(mutation, caught, monkeypatch):
    trained(TOGETHER, "gaussian_mixture")
    mutation(monkeypatch)
    found = compare(TOGETHER, "gaussian_mixture", number_of_tests(ROOMS.values()), SPP)
    print(mutation.__doc__, *found.lines(), sep="\n")
    assert caught <= found.rejected.keys(), "\n".join(found.lines())
