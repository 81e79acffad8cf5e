"""The truth at a vertex against closed forms, figures of known densities, and the vertices of paths."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from small_scenes import box, camera, furnace, grey, wall

from olpm_bench.bench import vertex
from olpm_bench.check.verdict import sidak
from olpm_bench.transport.settings import InputError, IntegratorSettings
from representations import square

BINS = 8
CENTRE = (8, 8)             # the pixel of 16 x 16 that looks at the back wall


def first(scene: mi.Scene, pixel: tuple[int, int] = CENTRE) -> vertex.Vertex:
    return next(vertex.trace(scene, scene.sensors()[0], pixel, 4))


def elevation(bins: int) -> np.ndarray:
    """cos(theta) at the fine cells of the square."""
    edge = bins * vertex.FINE
    s = (np.arange(edge) + 0.5) / edge
    x, y = np.meshgrid(s, s)
    return square.to_hemisphere(mi.Point2f(x.ravel(), y.ravel())).z.numpy().reshape(edge, edge).astype(float)


# ---------------------------------------------------------------- truth

def test_of_a_constant_environment_is_its_share_after_next_event_estimation():
    """Radiance 2 from everywhere on a diffuse floor: w = p^2 / (p^2 + q^2) with p = cos / pi and q = 1 / (4 pi)."""
    floor = wall((0, 0, 0), (0, 0, 1), 50, bsdf=grey(0.5))
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 2.0}}
    sensor = {**camera(), "to_world": mi.ScalarTransform4f().look_at((0, -3, 2), (0, 0, 0), (0, 0, 1))}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "floor": floor, "sky": sky})
    at = first(scene)
    np.testing.assert_allclose(at.frame[2], (0, 0, 1), atol=1e-6)
    np.testing.assert_allclose(at.frame[1], (0, 1, 0), atol=0.05)           # up in the image is away from the camera
    found = vertex.truth(scene, at, IntegratorSettings(max_depth=4), None, passes=2, bins=BINS)
    z = elevation(BINS)
    expected = vertex.over_bins(2 * z * z**2 / (z**2 + 1 / 16), BINS)
    np.testing.assert_allclose(found.incident.mean(0), expected, rtol=0.02, atol=0.005)     # of the bins' quadrature
    np.testing.assert_allclose(found.reflected, found.incident * 0.5 / np.pi, rtol=1e-3)


def test_of_a_furnace_is_the_geometric_series_and_the_share_of_emitters():
    """A closed box of radiance 1 and albedo a, paths of at most 5 segments: a + a^2 + a^3 + w beyond the first vertex."""
    a, scene = 0.5, furnace(0.5)
    at = first(scene)
    found = vertex.truth(scene, at, IntegratorSettings(max_depth=5), None, passes=8, bins=BINS)
    edge = BINS * vertex.FINE
    s = (np.arange(edge) + 0.5) / edge
    x, y = np.meshgrid(s, s)
    local = np.stack([c.numpy() for c in square.to_hemisphere(mi.Point2f(x.ravel(), y.ravel()))], 1).astype(float)
    d = local @ at.frame
    with np.errstate(divide="ignore"):
        reach = np.where(abs(d) > 1e-9, (np.sign(d) - at.p) / d, np.inf)         # to the wall of each axis
    reach[:, np.argmax(abs(at.frame[2]))] = np.where(local[:, 2] > 0, reach[:, np.argmax(abs(at.frame[2]))], np.inf)
    axis = np.argmin(reach, 1)
    distance, cosine = reach.min(1), abs(d[np.arange(len(d)), axis])
    p, q = local[:, 2] / np.pi, distance**2 / (cosine * 4 * 6)             # six walls of area 4, alike in choice
    w = p**2 / (p**2 + q**2)
    expected = vertex.over_bins((local[:, 2] * (a + a**2 + a**3 + w)).reshape(edge, edge), BINS)
    error = found.incident.std(0, ddof=1) / np.sqrt(len(found.incident)) + 0.01 * expected       # and of the quadrature
    z_values = (found.incident.mean(0) - expected) / error
    level = sidak(0.01, len(z_values))
    assert (2 * stats.t.sf(abs(z_values), 7)).min() > level
    assert 0 < found.noise < 0.2


# ---------------------------------------------------------------- figures

def test_a_density_that_is_the_truth_has_no_divergence_and_no_deviation():
    z = elevation(16)
    incident = np.tile(vertex.over_bins(z, 16), (2, 1))
    fit = vertex.fit(3 * incident, z / np.pi)
    assert fit.divergence == pytest.approx(0, abs=1e-6) and fit.deviation == pytest.approx(0, abs=2e-3) and fit.missed == 0


def test_the_figures_of_known_densities():
    """With z uniform in [0, 1] for even light: q = (z + 1/2) / 2 pi has KL = E[-log(z + 1/2)], and E[1 / (z + 1/2)] = log 3."""
    z, even = elevation(64), np.full((2, 64 * 64), 1.0)
    mixed = vertex.fit(even, (z + 0.5) / (2 * np.pi))
    assert mixed.divergence == pytest.approx(1 - 1.5 * np.log(1.5) + 0.5 * np.log(0.5), abs=1e-3)
    assert mixed.deviation == pytest.approx(np.sqrt(np.log(3) - 1), abs=3e-3)
    cosine = vertex.fit(np.tile(vertex.over_bins(z, 64), (2, 1)), np.full_like(z, 1 / (2 * np.pi)))
    assert cosine.divergence == pytest.approx(np.log(2) - 0.5, abs=3e-3)    # E[2 z log 2 z]
    assert cosine.deviation == pytest.approx(np.sqrt(1 / 3), abs=3e-3)      # E[(2 z)^2] - 1
    lossy = vertex.fit(even, np.full_like(z, 0.5 / (2 * np.pi)))            # half of the samples fail
    assert lossy.divergence == pytest.approx(np.log(2)) and lossy.deviation == pytest.approx(1)


def test_what_a_density_cannot_reach_is_told():
    half = np.ones((64, 64))
    half[:, :16] = 0
    fit = vertex.fit(np.ones((2, 256)), half)
    assert fit.missed == pytest.approx(0.25) and np.isinf(fit.deviation) and np.isinf(fit.divergence)
    rim = np.ones((2, 256))
    rim[:, :16] = 1e-6                                  # on the rim of the support: too little to count
    half[:, :16], half[:4] = 1, 0
    assert vertex.fit(rim, half).missed == pytest.approx(1e-6 * 16 / 240, rel=1e-3) and vertex.fit(rim, half).deviation < 1
    dark = vertex.fit(np.zeros((2, 256)), half)
    assert np.isnan(dark.divergence) and np.isnan(dark.missed)


def test_noise_of_the_truth_does_not_count_as_misfit():
    rng = np.random.default_rng(3)
    passes = rng.gamma(4, 0.25, (16, 1024))             # relative standard deviation 1/2, even on average
    even = np.full((64, 64), 1 / (2 * np.pi))
    fit, naive = vertex.fit(passes, even), passes.mean(0).std()
    assert naive > 0.11 and fit.deviation < 0.04 and fit.divergence < 1e-3


# ---------------------------------------------------------------- vertices

def test_a_path_goes_on_behind_a_mirror():
    scene = box(grey(0.5), mirror=wall((0, 0.9, 0), (0, -1, 0), 0.9, bsdf={"type": "conductor"}, id="mirror"))
    scene = mi.load_dict(scene)
    vertices = list(vertex.trace(scene, scene.sensors()[0], CENTRE, 5))
    assert [v.number for v in vertices][:2] == [1, 2] and len(vertices) <= 4
    assert not vertices[0].smooth and vertices[1].smooth
    np.testing.assert_allclose(vertices[1].o, vertices[0].p, atol=1e-3)
    np.testing.assert_allclose(vertices[1].d, vertices[0].d * (1, -1, 1), atol=1e-5)
    for v in vertices:
        np.testing.assert_allclose(v.frame @ v.frame.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(v.frame) == pytest.approx(1) and v.view[2] > 0
        np.testing.assert_allclose(v.mirror, v.view * (-1, -1, 1), atol=1e-5)


@pytest.mark.parametrize("pixel", [(-1, 0), (16, 0), (0, 16)])
def test_a_pixel_outside_the_image_is_refused(pixel):
    scene = mi.load_dict(box(grey(0.5)))
    with pytest.raises(InputError, match=r"outside the image, 16x16: x from 0 to 15"):
        list(vertex.trace(scene, scene.sensors()[0], pixel, 4))


def test_the_frame_turns_up_in_the_image():
    down = np.array([0, 0.6, -0.8])
    x, y, z = vertex.frame(np.array([0, 0, 1.0]), down, np.array([0, 0.8, 0.6]))
    np.testing.assert_allclose([x, y, z], np.eye(3), atol=1e-12)            # a floor: up is ahead, right is right
    x, y, _ = vertex.frame(np.array([0, -1.0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, 1.0]))
    np.testing.assert_allclose([x, y], [[1, 0, 0], [0, 0, 1]], atol=1e-12)          # a wall seen squarely
    straight = vertex.frame(np.array([0, 0, 1.0]), np.array([0, 0, -1.0]), np.array([0, 0, 1.0]))
    np.testing.assert_allclose(straight @ straight.T, np.eye(3), atol=1e-12)


# ---------------------------------------------------------------- densities

def test_without_a_guide_the_bsdf_is_sampled():
    scene = mi.load_dict(box(grey(0.5)))
    found = vertex.density(scene, first(scene), None, 0.5, BINS)
    np.testing.assert_allclose(found.mixture, elevation(BINS) / np.pi, atol=1e-5)
    assert found.guide is None and found.fraction == 1 and found.record is None
    dr.flush_malloc_cache()
