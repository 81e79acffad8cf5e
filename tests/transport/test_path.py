"""The unguided loop is Mitsuba's `path`; the guided one has the same expectation whatever the guide has learnt."""
from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from small_scenes import assert_same_expectation, box, grey, lamp, passes, wall

import olpm_bench

TRAINING = {"passes": 2, "photons": 20_000, "importons": 10_000, "record_radius": 0.08, "camera_passes": 2, "camera_paths": 2**14}
DEPTH = 8


# The grid (test_grid.py) has all of them, and is slow.
BSDFS = {
    "glossy": {"type": "roughconductor", "alpha": 0.15},
    "rough glass": {"type": "roughdielectric", "alpha": 0.3},
    "masked": {"type": "mask", "opacity": 0.6, "bsdf": {"type": "twosided", "bsdf": grey(0.7)}},
    "principled": {"type": "principled", "roughness": 0.4, "spec_trans": 0.4, "eta": 1.4},
}


def _scene(bsdf) -> mi.Scene:
    """A box with a lamp that shines upwards, a sphere and a tilted panel of the BSDF under test."""
    panel_bsdf = {"type": "twosided", "bsdf": bsdf} if bsdf["type"] == "roughconductor" else bsdf
    return mi.load_dict(box(grey(0.6), lamp=lamp(),
                            sphere={"type": "sphere", "center": [-0.35, 0.3, -0.5], "radius": 0.4, "bsdf": bsdf},
                            panel=wall((0.5, 0.5, -0.4), (-0.5, -0.7, 0.5), 0.35, bsdf=panel_bsdf)))


@pytest.fixture(scope="module")
def mitsuba_path():
    return mi.load_dict({"type": "path", "max_depth": DEPTH})


@pytest.mark.parametrize("name", BSDFS)
def test_guided_and_unguided_agree_with_mitsuba(name, mitsuba_path):
    scene = _scene(BSDFS[name])
    expected = passes(scene, mitsuba_path, seed=1000)
    assert_same_expectation(passes(scene, olpm_bench.integrator(max_depth=DEPTH, roulette="throughput")), expected)
    guide = olpm_bench.train(scene, "gaussian_mixture", max_depth=DEPTH, **TRAINING)
    for roulette in ("contribution", "none"):
        guided = olpm_bench.integrator(guide, max_depth=DEPTH, roulette=roulette)
        assert_same_expectation(passes(scene, guided, seed=2000), expected)


EMITTERS = {
    "area": lambda: wall((0.3, 0.4, 0.7), (0, 0, -1), 0.2,
                         emitter={"type": "area", "radiance": {"type": "rgb", "value": 5.0}}),
    "point": lambda: {"type": "point", "position": [0.3, 0.4, 0.6], "intensity": 1.0},
    "spot": lambda: {"type": "spot", "intensity": 5.0, "cutoff_angle": 40.0,
                     "to_world": mi.ScalarTransform4f().look_at((0.3, 0.4, 0.6), (0, 0.5, -1), (0, 1, 0))},
    "directional": lambda: {"type": "directional", "direction": [0.2, 0.4, -1.0], "irradiance": 2.0},
    "constant": lambda: {"type": "constant", "radiance": 1.0},
    "envmap": lambda: {"type": "envmap",
                       "bitmap": mi.Bitmap(np.random.default_rng(5).random((8, 16, 3)).astype(np.float32) ** 4)},
    "sunsky": lambda: {"type": "sunsky", "sun_direction": [0.2, -0.3, 0.9]},
}


@pytest.mark.parametrize("name", EMITTERS)
def test_every_emitter_trains_and_agrees(name, mitsuba_path):
    """An open box: the walls but without the ceiling, so that light from outside comes in."""
    content = box(grey(0.7), emitter=EMITTERS[name]())
    del content["wall5"]                        # the ceiling
    scene = mi.load_dict(content, optimize=False)      # merged rectangles lose the bounds that distant emitters need
    guide = olpm_bench.train(scene, "gaussian_mixture", max_depth=DEPTH, **TRAINING)
    assert guide.particles > 1000
    assert_same_expectation(passes(scene, olpm_bench.integrator(guide, max_depth=DEPTH)), passes(scene, mitsuba_path, seed=1000))


@pytest.mark.parametrize("sampler", ["independent", "stratified"])
def test_samples_a_pixel_are_those_of_the_scene_if_not_given(sampler):
    scene = mi.load_dict(box(grey(0.7), lamp=lamp()))
    film = {"type": "hdrfilm", "width": 6, "height": 5, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "film": film, "sampler": {"type": sampler, "sample_count": 16}})
    integrator = olpm_bench.integrator(max_depth=3)
    given, asked, odd = (mi.render(scene, sensor=sensor, integrator=integrator, spp=spp).numpy() for spp in (16, 0, 7))
    np.testing.assert_array_equal(given, asked)
    assert given.shape == odd.shape == (5, 6, 3)


def test_max_depth(mitsuba_path):
    """Depth counts as in Mitsuba: 1 shows emitters, 2 adds direct light."""
    scene = mi.load_dict(box(grey(0.7), lamp=lamp()))
    for depth in (1, 2, 3):
        ours, theirs = (mi.render(scene, integrator=i, spp=256, seed=s).numpy().mean() for s, i in enumerate(
            (olpm_bench.integrator(max_depth=depth), mi.load_dict({"type": "path", "max_depth": depth}))))
        assert ours == pytest.approx(theirs, rel=0.02)
