"""Lanes that take several paths: the same image in expectation, and only where samples need not be told apart."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
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


@pytest.mark.parametrize("guided", [False, True])
def test_images_do_not_depend_on_the_number_of_threads(guided, monkeypatch):
    """Of 135 pixels of 768 samples, some are where one thread's share of the lanes ends and another's begins."""
    monkeypatch.setattr(camera_rays, "FEWEST_LANES", 2**14)
    scene = _scene(**_film(width=15, height=9))
    integrator = olpm_bench.integrator(olpm_bench.train(scene, max_depth=6, **SMALL) if guided else None, max_depth=6)
    assert integrator.paths_a_lane(scene.sensors()[0], 768) == (4 if guided else 1)
    threads, images = dr.thread_count(), []
    try:
        for count in (1, 2, 5):
            dr.set_thread_count(count)
            images.append(mi.render(scene, integrator=integrator, spp=768, seed=3).numpy())
    finally:
        dr.set_thread_count(threads)
    assert images[0].min() > 0 and (images[0] == images[1]).all() and (images[0] == images[2]).all()


@pytest.mark.parametrize("lanes", [1, 3, 7, 2**15, 2**17, 3 * 2**15])
def test_sums_of_pixels(lanes):
    scene = _scene(**_film(width=3, height=2))
    camera = camera_rays.CameraRays(scene.sensors()[0], lanes, 1)
    sums, position = camera.sum_pixels(mi.Spectrum(mi.Float(dr.arange(mi.UInt32, 6 * lanes) // lanes)))
    assert (sums.numpy() == np.arange(6) * lanes).all()
    assert (position.numpy() == [[0, 1, 2] * 2, [0, 0, 0, 1, 1, 1]]).all()


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
