"""Lanes that take several paths: the same image in expectation, and only where samples need not be told apart."""
from __future__ import annotations

import mitsuba as mi
import pytest
from small_scenes import assert_same_expectation, box, grey, lamp, passes

import olpm_bench
from olpm_bench.transport import camera_rays
from olpm_bench.transport.camera_rays import paths_a_lane

SMALL = {"passes": 1, "photons": 10_000, "importons": 5_000, "record_radius": 0.08, "camera_passes": 2, "camera_paths": 2**14}
LENS = {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 1.5, "shutter_close": 0.1}


def _scene(**sensor) -> mi.Scene:
    content = box(grey(0.6), lamp=lamp())
    content["sensor"] |= sensor
    return mi.load_dict(content)


def _film(**film) -> dict:
    return {"film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"} | film}


@pytest.mark.parametrize("sensor", [{}, LENS, _film(crop_offset_x=3, crop_offset_y=5, crop_width=8, crop_height=6)],
                         ids=["pinhole", "thin lens", "crop window"])
def test_many_paths_a_lane_make_the_same_image(sensor, monkeypatch):
    monkeypatch.setattr(camera_rays, "FEWEST_LANES", 1)
    scene = _scene(**sensor)
    guided = olpm_bench.integrator(olpm_bench.train(scene, max_depth=6, **SMALL), max_depth=6)
    assert guided.paths_a_lane(scene.sensors()[0], 64) == camera_rays.MOST_PATHS
    expected = passes(scene, mi.load_dict({"type": "path", "max_depth": 6}), seed=3000)
    assert_same_expectation(passes(scene, guided), expected)


def test_one_path_a_lane_where_samples_must_be_told_apart(monkeypatch):
    monkeypatch.setattr(camera_rays, "FEWEST_LANES", 256)
    box_filter, alpha, gaussian = (_scene(**_film(**film)).sensors()[0]
                                   for film in ({}, {"pixel_format": "rgba"}, {"rfilter": {"type": "gaussian"}}))
    assert paths_a_lane(box_filter, 48) == camera_rays.MOST_PATHS           # 48 = 3 x 16
    assert paths_a_lane(box_filter, 12) == 4 and paths_a_lane(box_filter, 7) == 1 and paths_a_lane(box_filter, 1) == 1
    assert paths_a_lane(alpha, 64) == paths_a_lane(gaussian, 64) == 1
    monkeypatch.setattr(camera_rays, "FEWEST_LANES", 16 * 16 * 64)
    assert paths_a_lane(box_filter, 64) == 1 and paths_a_lane(box_filter, 128) == 2


@pytest.mark.parametrize("film", [{"pixel_format": "rgba"}, {"rfilter": {"type": "gaussian"}, "sample_border": True}],
                         ids=["alpha", "border"])
def test_films_that_tell_samples_apart(film):
    """A lid is off the box: alpha is 1 where a surface is seen; borders are sampled as Mitsuba samples them."""
    content = box(grey(0.6), light={"type": "constant"})
    content["sensor"] |= _film(**film)
    del content["wall2"]
    scene = mi.load_dict(content, optimize=False)
    ours, theirs = (passes(scene, integrator, seed=seed) for seed, integrator in (
        (0, olpm_bench.integrator(max_depth=4)), (1000, mi.load_dict({"type": "path", "max_depth": 4}))))
    assert ours.shape == theirs.shape
    assert_same_expectation(ours, theirs)
