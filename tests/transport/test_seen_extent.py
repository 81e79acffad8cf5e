"""The extent and scale of what the camera and its paths see: geometry that is far away must not make records coarse."""
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import assert_same_expectation, box, grey, lamp, passes

import olpm_bench
from olpm_bench.transport import settings
from olpm_bench.transport.cache import CHILDREN, Grid, RecordCache
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.seen_extent import (
    MARGIN,
    MAX_UNCOVERED,
    MODERATE_CELLS,
    SEGMENTS,
    SeenExtent,
    weighted_quantiles,
)
from olpm_bench.transport.settings import IntegratorSettings
from olpm_bench.transport.training import Training, surface_bounds

DEPTH = 8
RADIUS = 0.02
FEW: dict[str, Any] = {"passes": 2, "photons": 30_000, "importons": 10_000, "camera_passes": 2, "camera_paths": 2 ** 14}
PLANE = 20_000.0            # half the edge of a plane below the box [units]; the box is 2 wide


def plane() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().translate((0, 0, -1.05)).scale(PLANE)
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "twosided", "bsdf": grey(0.5)}}


def scene(**more: Any) -> mi.Scene:
    """A closed box of edge 2 with a camera and a lamp in it, and more."""
    return mi.load_dict(box(grey(0.7), lamp=lamp(10), **more), optimize=False)


def extent(of: mi.Scene, record_radius: float = RADIUS) -> SeenExtent:
    return SeenExtent.of(of, of.sensors()[0], DEPTH, surface_bounds(of), record_radius)


def corners(bbox: mi.ScalarBoundingBox3f) -> np.ndarray:
    return np.array([bbox.min, bbox.max]).reshape(2, 3)


@pytest.fixture(scope="module")
def alone() -> SeenExtent:
    return extent(scene())


def test_quantiles_count_weights():
    values, weights = np.array([3.0, 1.0, 2.0]), np.array([0.2, 0.5, 0.3])
    np.testing.assert_array_equal(weighted_quantiles(values, weights, [0.4, 0.6, 0.9, 1.0]), [1, 2, 3, 3])


def test_a_closed_box_is_seen_whole(alone):
    """All of its walls are met: the seen box is that of all surfaces, and so is the scale."""
    bounds = corners(surface_bounds(scene()))
    np.testing.assert_allclose(corners(alone.box), bounds, atol=1e-3)
    np.testing.assert_allclose(corners(alone.covered), bounds, atol=1e-3)
    assert alone.scale == pytest.approx(np.linalg.norm(bounds[1] - bounds[0]), rel=1e-3)
    assert not alone.warnings(RADIUS * alone.scale)


def test_weights_are_throughputs():
    """In a closed box of reflectance 0.7 the k-th vertex of each path weighs 0.7^k."""
    closed = extent(mi.load_dict(box(grey(0.7)), optimize=False))
    weight, count = np.unique(np.round(closed.vertices.weight, 4), return_counts=True)
    np.testing.assert_allclose(weight[::-1], 0.7 ** np.arange(DEPTH), atol=1e-4)
    assert (count > 0.9 * count.max()).all()


@pytest.mark.parametrize("far", [
    {"plane": plane},
    {"far": lambda: {"type": "sphere", "center": (0, 0, 1e4)}},
], ids=["a plane of 40,000 units", "one far object"])
def test_what_is_not_seen_does_not_count(alone, far):
    """The scale stays that of the box, but for the margin around it; tables stay small, and cover what is seen."""
    found = extent(scene(**{name: make() for name, make in far.items()}))
    assert alone.scale * 0.999 < found.scale < alone.scale * (1 + 2 * MARGIN)
    np.testing.assert_allclose(corners(found.box), corners(alone.box), atol=2 * MARGIN * 1.001)
    low, high = corners(found.covered)
    assert (low <= corners(alone.box)[0]).all() and (high >= corners(alone.box)[1]).all()
    assert Grid.over(found.covered, 0.5 * RADIUS * found.scale).n_cells <= 1.01 * MODERATE_CELLS


def test_the_extent_is_repeatable(alone):
    again = extent(scene())
    assert again.scale == alone.scale
    np.testing.assert_array_equal(again.vertices.position, alone.vertices.position)


def test_a_view_of_the_distance_does_not_make_a_room_coarse():
    """Through the open ceiling one sees dark walls at a distance of 4,000 units, more than the quantiles leave out: and yet
    records are as small as the paths in the room are long."""
    parts = box(grey(0.7), far={"type": "sphere", "radius": 4000.0, "flip_normals": True, "bsdf": grey(0.02)})
    del parts["wall4"]
    found = extent(mi.load_dict(parts, optimize=False))
    position, weight = found.vertices.position, found.vertices.weight
    share = weight[(np.abs(position) > 100).any(1)].sum() / weight.sum()
    assert MAX_UNCOVERED < share < 0.5
    assert np.linalg.norm(np.diff(corners(found.box), axis=0)) > 1000
    assert found.scale == SEGMENTS * weighted_quantiles(found.vertices.segment, weight, [0.5])[0] < 25
    assert Grid.over(found.covered, 0.5 * RADIUS * found.scale).n_cells <= 1.01 * MODERATE_CELLS
    low, high = corners(found.covered)
    assert (low < -0.95).all() and (high > 0.95).all()
    (said,) = found.warnings(RADIUS * found.scale)
    assert f"{share:.0%} of what the camera's paths meet lies too far" in said


def test_no_surface_to_guide_from():
    """Mirrors alone: the scale is that of all surfaces."""
    ball = mi.load_dict({"type": "scene", "sensor": box(grey(0.5))["sensor"], "light": {"type": "constant"},
                         "ball": {"type": "sphere", "bsdf": {"type": "conductor"}}})
    found = extent(ball)
    assert found.scale == pytest.approx(12 ** 0.5, rel=1e-5) and not found.warnings(1)


def test_records_that_are_too_coarse_are_told_of(alone):
    """Also where the user has asked for them: a quarter of the diagonal in a box of paths of about its edge."""
    radius = 0.5 * alone.scale
    closer = alone.vertices.weight[alone.vertices.segment < radius].sum() / alone.vertices.weight.sum()
    (said,) = alone.warnings(radius)
    assert f"{closer:.0%} of what" in said and "make record_radius smaller than" in said
    wide = settings.training(passes=1, photons=1000, importons=1000, record_radius=0.25)
    training = Training(scene(), "cosine", wide, IntegratorSettings(max_depth=2))
    closer = np.mean(training.seen.vertices.segment < 0.25 * training.seen.scale)
    (said,) = [line for line in next(training.run()).warnings if "too coarse" in line]
    assert closer > 1 / 3 and f"{closer:.0%} of what" in said


def test_records_resolve_a_room_on_a_plane():
    """With 6 records of 20,000 units there is nothing to guide by.  Photons on the plane add none where nobody looks."""
    outdoors = scene(plane=plane(), sky={"type": "constant", "radiance": 1.0})
    few = settings.training(passes=1, photons=20_000, importons=5_000, camera_passes=1, camera_paths=2 ** 12)
    training = Training(outdoors, "jensen", few, IntegratorSettings(max_depth=DEPTH))
    for statistics in training.run():
        assert not [line for line in statistics.warnings if "coarse" in line or "off surfaces" in line]
    cache = training.radiance.cache
    assert 0.99 < cache.radius / (RADIUS * 12 ** 0.5) < 1 + 2 * MARGIN
    in_room = (np.abs(cache.points[:, :3]) < 1.01).all(1)
    assert in_room.sum() > 1000 and (~in_room).sum() < 0.1 * len(cache)
    assert len(cache.table) - CHILDREN * len(cache) <= 2 * MODERATE_CELLS


def test_no_record_is_added_outside_of_the_box():
    cache = RecordCache(mi.ScalarBoundingBox3f((-1, -1, -1), (1, 1, 1)), 0.01, scale=10.0)
    assert cache.radius == pytest.approx(0.1)
    rng = np.random.default_rng(0)
    p = mi.Point3f(rng.uniform(-3, 3, (3, 20_000)).astype(np.float32))
    n = dr.normalize(mi.Normal3f(rng.normal(size=(3, 20_000)).astype(np.float32)))
    cache.grow(p, n, mi.Bool(True))
    assert len(cache) > 100 and np.abs(cache.points[:, :3]).max() < 1.1
    far = mi.Point3f(p) + mi.Point3f(10, 0, 0)
    assert not dr.any(cache.lookup(far, n, mi.Bool(True))[2])
    again = RecordCache.from_numpy(cache.to_numpy())
    assert again.radius == cache.radius
    for a, b in zip(cache.lookup(p, n, mi.Bool(True)), again.lookup(p, n, mi.Bool(True)), strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())


def test_caches_without_a_scale_can_be_read():
    """Files of the format before it: the radius was a share of the box's diagonal."""
    cache = RecordCache(mi.ScalarBoundingBox3f(-1, 1), 0.1)
    arrays = cache.to_numpy()
    del arrays["scale"]
    assert RecordCache.from_numpy(arrays).radius == pytest.approx(cache.radius)


@pytest.mark.slow
def test_a_plane_far_below_does_not_take_the_gain():
    """In a box whose lamp is behind a screen, guiding saves variance [at equal samples], as much with the plane as without."""
    screen = {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": grey(0.5)},
              "to_world": mi.ScalarTransform4f().translate((0, 0, 0.8)).scale(0.75)}
    images = {}
    for name, more in (("box", {}), ("plane", {"plane": plane()})):
        parts = box(grey(0.7), 0.01, lamp=lamp(10), screen=screen, **more)
        here = mi.load_dict(parts, optimize=False)
        guide: Guide = olpm_bench.train(here, "gaussian_mixture", **{**FEW, "camera_passes": 6}, max_depth=DEPTH)
        images[name] = passes(here, olpm_bench.integrator(guide, max_depth=DEPTH), 32, 32, seed=1)
    images["unguided"] = passes(here, olpm_bench.integrator(max_depth=DEPTH), 32, 32, seed=2)
    variance = {name: np.mean(image.var(0, ddof=1)) for name, image in images.items()}
    assert variance["plane"] < 1.25 * variance["box"]
    assert variance["plane"] < 0.5 * variance["unguided"]
    assert_same_expectation(images["plane"], images["box"])
