"""Every addition to the talk's method keeps the expectation of the image, on and off: Z-tests against Mitsuba's `path`."""
from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from small_scenes import RESOLUTION, assert_same_expectation, box, furnace, grey, lamp, passes

import olpm_bench
from olpm_bench.check.small_scenes import blocks
from olpm_bench.check.verdict import sidak
from olpm_bench.transport import settings

DEPTH = 8
N, SPP = 32, 64
FEW = {"passes": 3, "photons": 20_000, "importons": 10_000, "camera_paths": SPP * RESOLUTION**2,
       "record_radius": 0.08}
ON = {**FEW, "camera_passes": 3}
SWITCHED = {                                # preset, training, integrator
    "all on": ("best", {}, {}),
    "the talk's": ("paper2014", {}, {}),
    "the talk's, without roulette": ("paper2014_norr", {}, {}),
    "roulette by throughput": ("best", {}, {"roulette": "throughput"}),
    "a narrow window": ("best", {}, {"window": 20.0}),
    "no camera paths": ("best", {"camera_passes": 0}, {}),
    "one fraction": ("best", {"learn_fraction": False}, {}),
    "no radiance of camera paths": ("best", {"learn_radiance": False}, {}),
    "direct light not learnt": ("best", {"learn_direct": False}, {}),
    "new records untrained": ("best", {"inherit": False}, {}),
    "no parallax": ("best", {"parallax": False}, {}),
    "emitters' own photons": ("best", {"emission": "emitter"}, {}),
    "window by flux": ("best", {"weight_window": "flux"}, {}),
    "nearest particles": ("best", {"gather": "nearest"}, {}),
    "shrinking records": ("best", {"shrink": True}, {}),
}


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    """A box without ceiling under a sky of bright spots, with a lamp, a glossy and a glass sphere."""
    sky = mi.Bitmap(np.random.default_rng(5).random((8, 16, 3)).astype(np.float32) ** 4)
    content = box(grey(0.7), lamp=lamp(), sky={"type": "envmap", "bitmap": sky},
                  glossy={"type": "sphere", "center": [-0.35, 0.3, -0.5], "radius": 0.4,
                          "bsdf": {"type": "roughconductor", "alpha": 0.15}},
                  glass={"type": "sphere", "center": [0.5, 0.2, -0.7], "radius": 0.25, "bsdf": {"type": "dielectric"}})
    del content["wall5"]
    return mi.load_dict(content, optimize=False)


@pytest.fixture(scope="module")
def expected(scene) -> np.ndarray:
    return passes(scene, mi.load_dict({"type": "path", "max_depth": DEPTH}), 2 * N, SPP, seed=1000)


@pytest.mark.slow
@pytest.mark.parametrize("name", SWITCHED)
def test_images_have_the_expectation_of_path(scene, expected, name):
    preset, changes, integrator = SWITCHED[name]
    amounts = FEW if preset.startswith("paper") else ON
    guide = olpm_bench.train(scene, preset=preset, max_depth=DEPTH, integrator=integrator, **amounts | changes)
    assert guide.trained > 0.3
    guided = olpm_bench.integrator(guide, preset, max_depth=DEPTH, **integrator)
    assert_same_expectation(passes(scene, guided, N, SPP), expected, 0.01 / len(SWITCHED))


@pytest.mark.slow
@pytest.mark.parametrize("name", SWITCHED)
def test_the_furnace_is_even(name):
    """Everywhere 1 / (1 - albedo), but for the 2^-40 of longer paths."""
    (preset, changes, integrator), scene = SWITCHED[name], furnace(0.5)
    amounts = FEW if preset.startswith("paper") else ON
    guide = olpm_bench.train(scene, preset=preset, max_depth=40, integrator=integrator, **amounts | changes)
    assert guide.trained > 0.3
    images = passes(scene, olpm_bench.integrator(guide, preset, max_depth=40, **integrator), N, 16)
    p = stats.ttest_1samp(blocks(images, 8), 2.0).pvalue          # of many samples: a narrow window leaves skewed ones
    p = np.append(p, stats.ttest_1samp(images.mean((1, 2, 3)), 2.0).pvalue)
    assert np.min(p) >= sidak(0.01 / len(SWITCHED), len(p)), f"mean {images.mean():.6f}"


@pytest.mark.slow
def test_images_that_the_guide_learns_from_have_it_too(scene, expected):
    """Those of training passes, which are blended in, and those of learning while rendering: each guided by what came before."""
    olpm_bench.register()
    from olpm_bench.transport.training import Training

    training = Training(scene, "gaussian_mixture", settings.training(**ON | {"camera_passes": N}),
                        settings.integrator(max_depth=DEPTH))
    images = [np.array(statistics.image) for statistics in training.run() if statistics.image is not None]
    images += [np.array(training.camera_pass().image) for _ in range(N)]
    assert training.camera_spp == SPP and len(images) == 2 * N
    assert_same_expectation(np.array(images, np.float64), expected)
