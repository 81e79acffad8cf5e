"""What is learnt from camera paths: a transcript in NumPy, the rendering equation at diffuse surfaces, and memory."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import box, camera, grey, lamp, wall

import olpm_bench
from olpm_bench.transport import camera_paths, headroom, settings
from olpm_bench.transport.camera_paths import CameraPaths
from olpm_bench.transport.settings import InputError
from olpm_bench.transport.training import Training

ALBEDO, DEPTH, SPP = 0.6, 6, 16
POINT = {"type": "point", "position": [0.3, 0.4, 0.3], "intensity": 1.0}        # which no path can hit


def _render(content, paths_a_lane=1, **settings) -> tuple[mi.TensorXf, CameraPaths]:
    scene = mi.load_dict(content, optimize=False)
    sensor = scene.sensors()[0]
    integrator = olpm_bench.integrator(max_depth=DEPTH, **settings)
    integrator.paths_a_lane = lambda sensor, spp: paths_a_lane
    paths = CameraPaths(int(np.prod(sensor.film().crop_size())), SPP, DEPTH, paths_a_lane)
    image = integrator.render_paths(scene, sensor, 3, SPP, paths)
    dr.eval(image)
    paths.propagate()
    return image, paths


def _vertices(paths: CameraPaths) -> dict[str, np.ndarray]:
    """[rows, n_paths, 4] of each array; NaN in rows that a path has not reached."""
    unused = np.arange(paths.rows)[:, None] >= paths.count.numpy()
    found = {}
    for name in ("position", "direction", "normal", "weight", "reflected", "emitted"):
        found[name] = getattr(paths, name).numpy()[:4 * unused.size].reshape(paths.rows, paths.n_paths, 4).astype(float)
        found[name][unused] = np.nan
    return found


@pytest.mark.parametrize(("roulette", "paths_a_lane"), [("none", 1), ("throughput", 1), ("throughput", 4)])
def test_radiance_is_propagated_from_the_end_of_each_path(roulette, paths_a_lane):
    """The recursion in NumPy; and what arrives at the camera is the image."""
    image, paths = _render(box(grey(ALBEDO), light=POINT), paths_a_lane, roulette=roulette, rr_depth=2)
    v = {name: np.nan_to_num(array) for name, array in _vertices(paths).items()}
    radiance = np.zeros((paths.n_paths, 3))
    luminance = np.array(mi.luminance(mi.Color3f(np.eye(3, dtype=np.float32))))
    for row in reversed(range(paths.rows)):
        emitted, nee = v["emitted"][row, :, :3], v["emitted"][row, :, 3:]
        incident = emitted / (1 + nee ** 2) + radiance
        returned = v["weight"][row, :, :3] * incident
        np.testing.assert_allclose(v["position"][row, :, 3], incident @ luminance * v["weight"][row, :, 3], rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(v["reflected"][row, :, 3], returned @ luminance, rtol=1e-4, atol=1e-7)
        radiance = v["reflected"][row, :, :3] + returned
    assert radiance.mean() == pytest.approx(image.numpy()[..., :3].mean(), rel=1e-4)
    assert (paths.count.numpy() < paths.rows).any() == (roulette == "throughput")


def test_diffuse_surfaces_return_what_arrives():
    """L_o = (a / pi) E: what a vertex returns is a / pi times the weight of its estimate of incident flux."""
    _, paths = _render(box(grey(ALBEDO), light=POINT), roulette="none")
    particles = paths.particles()
    _, weight, direction, distance, normal = particles.read(particles.place)
    returned, chosen_by_bsdf, reflected = paths.returned(particles.place)
    assert (reflected.numpy() >= returned.numpy()).all() and reflected.numpy().sum() > 2 * returned.numpy().sum()
    np.testing.assert_allclose(returned.numpy(), ALBEDO / np.pi * weight.numpy(), rtol=1e-3, atol=1e-6)
    assert len(particles) > 5_000 and weight.numpy().max() > 0
    assert (chosen_by_bsdf.numpy() == -1).all()                 # nobody guided
    seen = weight.numpy() > 0
    assert (dr.dot(direction, normal).numpy()[seen] > 0).all() and (distance.numpy()[seen] > 0).all()


def test_direct_light_that_the_guide_learns():
    """A floor under a white sky, which next-event estimation samples with density 1 / 4 pi: cos - 1 / 4 is left to learn."""
    content = {"type": "scene", "sensor": camera(), "floor": wall((0, 0, -1), (0, 0, 1), 50, bsdf=grey(ALBEDO)),
               "sky": {"type": "constant"}}
    scene = mi.load_dict(content, optimize=False)
    learnt = {}
    for direct in (True, False):
        few_records = settings.training(passes=0, camera_paths=2**15, learn_direct=direct, record_radius=0.1)
        training = Training(scene, "gaussian_mixture", few_records, settings.integrator(max_depth=DEPTH))
        for _ in range(3):
            training.camera_pass()
        paths = CameraPaths(training.pixels, 64, DEPTH)
        dr.eval(training.integrator.render_paths(scene, training.sensor, 7, 64, paths))
        paths.propagate()
        vertices = paths.particles()
        lessons = paths.lessons(vertices.place)
        learnt[direct] = lessons.read(lessons.place)[1].numpy().sum() / len(vertices)
        assert (len(lessons) > len(vertices)) == direct
    assert learnt[True] == pytest.approx(2 * np.pi * ((1 - 1 / 16) / 2 - 3 / 16), rel=0.02)
    assert learnt[False] > 0


@pytest.mark.parametrize("paths_a_lane", [1, 8])
def test_vertices_are_bounded_and_evenly_spaced(monkeypatch, paths_a_lane):
    """Of more paths than are kept, whole pixels are left out in even spacing."""
    monkeypatch.setattr(camera_paths, "MOST_PATHS", 1000)
    _, paths = _render(box(grey(ALBEDO), lamp=lamp()), paths_a_lane, roulette="none")
    pixels = paths.n_paths // SPP
    assert paths.n_paths <= 1000 + SPP and pixels > 30
    assert len(paths.position) == 8 * paths.rows * paths.n_paths           # vertices, and what is learnt of their direct light
    assert (paths.count.numpy() == paths.rows).mean() > 0.9
    first = _vertices(paths)["position"][0, :pixels, :3]
    assert np.isfinite(first).all() and len(np.unique(first, axis=0)) == pixels


def test_the_sky_is_infinitely_far_whoever_finds_it():
    """As a sample of the emitter and as a ray that leaves the scene: parallax must not turn its light."""
    content = box(grey(ALBEDO), sky={"type": "constant"}, light=POINT)
    del content["wall5"]
    scene = mi.load_dict(content, optimize=False)
    sensor = scene.sensors()[0]
    few = {"passes": 1, "photons": 20_000, "importons": 10_000, "camera_passes": 3, "camera_paths": 2**13}
    guide = olpm_bench.train(scene, max_depth=DEPTH, **few)
    paths = CameraPaths(int(np.prod(sensor.film().crop_size())), SPP, DEPTH)
    dr.eval(olpm_bench.integrator(guide, max_depth=DEPTH).render_paths(scene, sensor, 3, SPP, paths))
    taught = paths.position.numpy().reshape(2, paths.rows, paths.n_paths, 4)[1, ..., 3] > 0
    assert taught.sum() > 100
    assert np.isinf(paths.direction.numpy().reshape(2, paths.rows, paths.n_paths, 4)[1, ..., 3][taught]).all()


def test_mirrors_get_no_records():
    scene = mi.load_dict(box({"type": "conductor"}, lamp=lamp()), optimize=False)
    training = Training(scene, "jensen", settings.training(passes=0, camera_passes=2, camera_paths=2**13),
                        settings.integrator(max_depth=DEPTH))
    for statistics in training.run():
        assert statistics.stored > 1000
    points = training.radiance.cache.points[:, :3]
    assert len(points) > 0 and np.linalg.norm(points - (0.3, 0.4, 0.7), axis=1).max() < 0.3         # all on the lamp


def test_more_vertices_than_there_is_room_for_are_refused(monkeypatch):
    with pytest.raises(InputError, match="a smaller max_depth"):
        CameraPaths(2**17, 1, 10_000)
    monkeypatch.setattr(headroom, "free", lambda: 1e6)
    with pytest.raises(InputError, match=r"the vertices of 1024 camera paths of up to 12 each take about 0\.0018 GB"):
        CameraPaths(1024, 1, 13)
