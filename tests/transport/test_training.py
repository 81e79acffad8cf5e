"""The schedule: what is learnt, in constant memory, without recompiling, and the same each time."""
from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from small_scenes import assert_no_kernel_a_pass, box, grey, lamp

import olpm_bench
import representations
from olpm_bench.scenes.load import load
from olpm_bench.transport import settings
from olpm_bench.transport.estimates import FLOOR
from olpm_bench.transport.gather import LENDERS
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.training import Training, train
from representations import state as states

SMALL = settings.training(passes=3, photons=20_000, importons=10_000, record_radius=0.08, camera_passes=2, camera_paths=2 ** 14)
PARTICLES = dataclasses.replace(SMALL, camera_passes=0)
SHRINKING = {"shrink": True, "neighbours": 80}
PARALLAX = {"parallax": True}
DEPTH = 6
PATHS = settings.integrator(max_depth=DEPTH)


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    return mi.load_dict(box(grey(0.6), lamp=lamp()))


def _arrays(guide: Guide) -> dict[str, np.ndarray]:
    return states.to_numpy(guide.state) | {"points": guide.cache.points, "radii": guide.cache.radii, "count": guide.count.numpy()}


@pytest.mark.parametrize("name", representations.names())
def test_guides_learn_on_line(scene, name):
    seen = []
    guide = train(scene, name, SMALL, PATHS, on_pass=seen.append)
    assert [s.index for s in seen] == [0, 1, 2, 3, 4]
    assert [s.image is None for s in seen] == [True, True, True, False, False]
    assert all(s.stored > 10_000 and s.kept > 0 for s in seen)
    assert all(s.kept <= (s.stored if s.image is None else LENDERS * s.stored) for s in seen)
    assert guide.particles == sum(s.kept for s in seen)
    assert guide.records == seen[-1].records > 100
    enough, fraction, outgoing, _ = guide.rows.numpy().reshape(-1, 4).T
    assert set(enough) <= {0, 1} and enough.mean() == pytest.approx(guide.trained) and (outgoing != 0).all()
    assert guide.estimates.by_either.numpy()[fraction == 0].max(initial=0) == 0          # nothing learnt: as the settings say
    fraction = fraction[fraction > 0]
    assert fraction.min() >= FLOOR - 1e-6 and fraction.max() <= 1 - FLOOR + 1e-6 and (fraction.std() > 0.01 or name == "cosine")
    assert np.mean(guide.count.numpy() >= 40) > 0.8


@pytest.mark.parametrize(("name", "changes"), [("jensen", {}), ("gaussian_mixture", {}), ("gaussian_mixture", SHRINKING),
                                               ("gaussian_mixture", {**SHRINKING, "gather": "nearest"}),
                                               ("gaussian_mixture", PARALLAX), ("hey", PARALLAX)])
def test_training_repeats_bit_for_bit_whatever_the_threads(scene, name, changes):
    threads = dr.thread_count()
    try:
        results = []
        for count in (1, 2):
            dr.set_thread_count(count)
            results.append(_arrays(train(scene, name, settings.with_changes(SMALL, changes), PATHS, seed=4)))
    finally:
        dr.set_thread_count(threads)
    for key, value in results[0].items():
        np.testing.assert_array_equal(value, results[1][key], err_msg=key)


def test_seeds_differ(scene):
    a, b = (train(scene, "jensen", SMALL, PATHS, seed=s) for s in (0, 1))
    assert a.records != b.records or not np.array_equal(a.cache.points, b.cache.points)


@pytest.mark.parametrize(("name", "changes"), [("jensen", {}), ("hey", {}), ("gaussian_mixture", {}),
                                               ("gaussian_mixture", PARALLAX), ("hey", PARALLAX)])
def test_no_kernel_is_compiled_after_warm_up(scene, name, changes):
    """Not promised of shrinking records: late first fits and splits of cells compile some fifteen kernels."""
    many = settings.with_changes(SMALL, {"passes": 6, "camera_passes": 5, **changes})
    for seed in (0, 2):         # one may miss what only some passes do
        train(scene, name, many, PATHS, seed=seed)
    assert_no_kernel_a_pass(Training(scene, name, many, PATHS, seed=1).run())


@pytest.mark.slow
@pytest.mark.parametrize("gather", ["binned", "nearest"])
def test_shrinking_records_saturate(scene, gather):
    """Fewer and fewer records are added, none smaller than what fills it, and all surfaces stay guided."""
    shrinking = settings.with_changes(PARTICLES, {"passes": 12, "gather": gather, **SHRINKING})
    training = Training(scene, "jensen", shrinking, PATHS)
    records, radii = [], np.zeros(0)
    for _ in training.run():
        cache = training.radiance.cache
        assert (cache.radii[:len(radii)] <= radii).all()
        records.append(len(cache))
        radii = cache.radii.copy()
    added = np.diff(records)
    assert added[-4:].mean() < 0.25 * added[:3].mean() and records[-1] > 1.3 * records[0]
    assert radii.min() < 0.8 * cache.radius and training.radiance.trained > 0.9


def test_memory_is_constant(scene):
    """The state is no larger after many passes than after a few: nothing of the particles stays, and surfaces fill up."""
    training = Training(scene, "gaussian_mixture", settings.with_changes(SMALL, {"passes": 8, "camera_passes": 8}), PATHS)
    guide, held = training.radiance, []
    for _ in training.run():
        cache = sum(value.nbytes for value in guide.cache.to_numpy().values())
        held.append((states.bytes_of(guide.state), states.bytes_of(guide.estimates), cache, len(guide.cache.table)))
    assert guide.bytes_per_record < 2048
    for size in np.array(held).T:
        assert size[-1] < 1.02 * size[-8] < 1.1 * size[3]


def test_camera_paths_may_teach_all_but_where_light_comes_from(scene):
    """What records return, for the roulette, and how often to sample the BSDF."""
    changes = {"passes": 1, "camera_passes": 8, "learn_radiance": False}
    seen, learn = [], settings.with_changes(SMALL, changes)
    guide = train(scene, "gaussian_mixture", learn, PATHS, on_pass=seen.append)
    assert seen[0].kept == guide.particles > 10_000 and all(s.kept == 0 and s.stored > 10_000 for s in seen[1:])
    _, fraction, outgoing, _ = guide.rows.numpy().reshape(-1, 4).T
    assert np.mean(outgoing > 0) > 0.5 and np.unique(fraction[fraction > 0]).size > 100


def test_a_pixel_that_is_not_finite_is_told_and_left_out_of_what_pixels_are_worth(scene, monkeypatch):
    """As a texture with one such texel makes it: one of them would be in the mean, and so in every pixel's estimate."""
    training = Training(scene, "jensen", SMALL, PATHS)
    render = training.integrator.render_paths

    def with_a_hole(*arguments: object) -> mi.TensorXf:
        image = render(*arguments).numpy()
        image[3, 4] = np.nan
        return mi.TensorXf(image)

    monkeypatch.setattr(training.integrator, "render_paths", with_a_hole)
    told = [message for statistics in training.run() for message in statistics.warnings]
    assert sum("1 pixels of a training image are NaN or infinite" in message for message in told) == SMALL.camera_passes
    worth = training.radiance.pixels.values.numpy()
    assert np.isfinite(worth).all() and worth.min() > 0


def test_a_full_cache_is_among_the_warnings(scene, monkeypatch):
    monkeypatch.setattr("olpm_bench.transport.cache.MOST_RECORDS", 50)
    told = [statistics.warnings for statistics in Training(scene, "jensen", SMALL, PATHS).run()]
    assert all(any(m.startswith("50 records, the most there can be: ") for m in messages) for messages in told)


def test_another_camera_than_the_first(scene):
    """One that sees nothing: importons and camera paths are its own."""
    away = mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().look_at((0, 0, 5), (0, 0, 9), (0, 1, 0))})
    few = {"passes": 1, "photons": 2_000, "importons": 1_000, "camera_passes": 1, "camera_paths": 1024, "max_depth": DEPTH}
    with pytest.warns(UserWarning, match="the camera sees no surface"):
        olpm_bench.train(scene, "cosine", sensor=away, **few)


def test_a_guide_that_cannot_be_written_leaves_the_old_one(scene, tmp_path, monkeypatch):
    guide, path = train(scene, "cosine", settings.with_changes(PARTICLES, {"passes": 1}), PATHS), tmp_path / "guide.npz"
    guide.save(path)
    before = path.read_bytes()

    def full(file, **_: object) -> None:
        file.write(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="No space left"):
        guide.save(path)
    assert path.read_bytes() == before and [file.name for file in tmp_path.iterdir()] == ["guide.npz"]


def test_single_batch_is_one_unguided_fit(scene):
    seen = []
    single = settings.with_changes(PARTICLES, {"schedule": "single_batch"})
    guide = train(scene, "jensen", single, PATHS, on_pass=seen.append)
    assert len(seen) == 1 and seen[0].photons == 60_000 and seen[0].importons == 0
    assert guide.count.numpy().max() <= SMALL.neighbours


def test_records_of_a_single_batch_shrink_before_the_fit(scene):
    """To what the paper's records reach on-line, from the same photons again and again: nothing is learnt twice."""
    single = settings.with_changes(PARTICLES, {"schedule": "single_batch", "gather": "nearest", **SHRINKING})
    guide = train(scene, "jensen", single, PATHS)
    radii = guide.cache.radii / guide.cache.radius
    assert np.mean(radii < 0.8) > 0.3 and radii.min() >= 0.0999
    assert guide.count.numpy().max() <= SHRINKING["neighbours"]


def test_importons_first_guide_photons_that_teach_them_nothing(scene):
    first = settings.with_changes(PARTICLES, {"schedule": "importons_first", "passes": 2})
    training = Training(scene, "gaussian_mixture", first, PATHS)
    passes = [(p.importons, p.photons, training.radiance.records > 0, training.importance.particles) for p in training.run()]
    n, known = first.importons, [p[3] for p in passes]
    assert [p[:3] for p in passes] == [(n, 0, False), (n, 0, False), (0, first.photons, True), (0, first.photons, True)]
    assert 0 < known[0] < known[1] == known[2] == known[3]


def test_no_passes_leave_the_bsdf(scene):
    guide = train(scene, "gaussian_mixture", settings.with_changes(PARTICLES, {"passes": 0}), PATHS)
    a, b = (mi.render(scene, integrator=olpm_bench.integrator(g, max_depth=DEPTH), spp=8, seed=3) for g in (guide, None))
    assert guide.records == 0
    np.testing.assert_array_equal(a.numpy(), b.numpy())


def test_guides_are_saved_and_loaded(scene, tmp_path):
    guide = train(scene, {"type": "gaussian_mixture", "components": 4}, SMALL, PATHS)
    guide.save(tmp_path / "guide.npz")
    again = Guide.load(tmp_path / "guide.npz")
    assert repr(again) == repr(guide) and again.bytes_per_record == guide.bytes_per_record
    a, b = (mi.render(scene, integrator=olpm_bench.integrator(g, max_depth=DEPTH), spp=8, seed=1).numpy() for g in (guide, again))
    np.testing.assert_array_equal(a, b)
    (tmp_path / "broken.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"broken.npz: not a whole .npz file"):
        Guide.load(tmp_path / "broken.npz")


def test_plugin_trains_once_a_scene(scene):
    olpm_bench.register()
    plugin = mi.load_dict({"type": "guided_path", "representation": "jensen", "passes": 1, "photons": 5_000, "importons": 0,
                           "record_radius": 0.1, "max_depth": DEPTH, "camera_passes": 0})
    first = mi.render(scene, integrator=plugin, spp=4)
    guide = plugin.guide
    dr.eval(first)
    mi.render(scene, integrator=plugin, spp=4, seed=1)
    assert plugin.guide is guide and guide.particles > 0
    other = mi.load_dict(box(grey(0.5), lamp=lamp()))
    mi.render(other, integrator=plugin, spp=4)
    assert plugin.guide is not guide


@pytest.mark.parametrize(("given", "message"), [
    ({"passes": -1}, "passes = -1: must be >= 0"),
    ({"roulete": "none"}, r"unknown setting 'roulete'; known: .*; did you mean 'roulette'\?"),
    ({"representation": "gmmm"}, "unknown representation 'gmmm'"),
    ({"preset": "slow"}, "unknown preset 'slow'"),
])
def test_plugin_refuses_bad_parameters(given, message):
    olpm_bench.register()
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "guided_path", **given})


@pytest.mark.parametrize(("change", "message"), [
    (lambda s: s.pop("lamp"), "the scene has no emitter"),
    (lambda s: s.pop("sensor"), "the scene has no camera"),
    (lambda s: s.update(fog={"type": "sphere", "radius": 0.2, "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}),
     "participating medium"),
])
def test_scenes_that_cannot_be_traced_are_refused(change, message):
    content = box(grey(0.6), lamp=lamp())
    change(content)
    with pytest.raises(ValueError, match=message):
        train(mi.load_dict(content), "jensen", SMALL, PATHS)


@pytest.mark.parametrize(("change", "message"), [
    (lambda s: s["lamp"]["emitter"]["radiance"].update(value=0.0), "the photons carry nothing: the emitters have no power"),
    (lambda s: s["sensor"].update(to_world=mi.ScalarTransform4f().look_at((0, 0, 5), (0, 0, 9), (0, 1, 0))),
     "the camera sees no surface"),
    (lambda s: s.update({k: {**v, "bsdf": grey(0.0)} for k, v in s.items() if k.startswith("wall")}),
     "none of 20000 photons met a second surface"),
])
def test_what_cannot_be_learnt_is_told_and_images_are_right(change, message):
    content = box(grey(0.6), lamp=lamp())
    change(content)
    scene = mi.load_dict(content, optimize=False)
    with pytest.warns(UserWarning, match=message):
        guide = train(scene, "gaussian_mixture", SMALL, PATHS)
    path = mi.load_dict({"type": "path", "max_depth": DEPTH})
    ours, theirs = (mi.render(scene, integrator=i, spp=256, seed=s).numpy() for s, i in enumerate(
        (olpm_bench.integrator(guide, max_depth=DEPTH), path)))
    assert np.isfinite(ours).all() and ours.mean() == pytest.approx(theirs.mean(), rel=0.05, abs=1e-6)


def test_a_room_that_no_light_enters_is_told_and_black():
    """The camera's room is closed: photons land beside it, importons never leave it."""
    scene = load("door_ajar", {"gap": 0}, 16, 9)
    with pytest.warns(UserWarning, match="no camera path has met light"):
        guide = train(scene, "gaussian_mixture", SMALL, PATHS)
    assert guide.records and not mi.render(scene, integrator=olpm_bench.integrator(guide, max_depth=DEPTH), spp=16).numpy().any()


def test_a_room_that_no_light_enters_is_told_without_camera_passes():
    """Photons land beside it, in records that no camera path meets."""
    few = settings.training("paper2014", passes=2, photons=5_000, importons=2_000, record_radius=0.03)
    with pytest.warns(UserWarning, match="of what the camera sees is guided: too few"):
        guide = train(load("door_ajar", {"gap": 0}, 16, 9), "gaussian_mixture", few, PATHS)
    assert guide.trained > 0.2


@pytest.mark.filterwarnings("ignore:none of")
def test_particles_that_never_land_leave_the_bsdf():
    """Black walls: nothing is kept, nothing is learnt, and the image is direct light."""
    scene = mi.load_dict(box(grey(0.0), lamp=lamp()))
    for gather in ("binned", "nearest"):
        guide = train(scene, "gaussian_mixture", settings.with_changes(SMALL, {"gather": gather}), PATHS)
        assert guide.trained == 0 and guide.particles == 0
        assert np.isfinite(mi.render(scene, integrator=olpm_bench.integrator(guide, max_depth=DEPTH), spp=4).numpy()).all()
