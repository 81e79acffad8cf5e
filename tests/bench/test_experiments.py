"""The experiments of this project: each can be loaded at each of its scales, and is what it says."""
from __future__ import annotations

import copy
import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from olpm_bench.bench import cell, config, experiment_file, plan, run
from olpm_bench.transport import settings

FOLDER = Path(__file__).resolve().parents[2] / "experiments"
FILES = {file.name: tomllib.loads(file.read_text()) for file in sorted(FOLDER.glob("*.toml"))}
SMALL_SECONDS = 120         # charged seconds of all cells of a small scale: with compilation about three minutes


def of_this_project(tmp_path: Path, name: str, scale: str | None = None) -> config.Experiment:
    """An experiment of ours, with an empty scene in the place of other people's."""
    (tmp_path / "room.xml").write_text('<scene version="3.0.0"/>')
    table = FILES[name]
    scene = table.get("scale", {}).get(scale, {}).get("scene")
    names = [s["name"] for s in scene] if isinstance(scene, list) else [s["name"] for s in table["scene"]]
    scenes = [s["name"] for s in table["scene"] if "file" in s and s["name"] in names]
    return experiment_file.load(FOLDER / name, dict.fromkeys(scenes, tmp_path / "room.xml"), scale)


def with_amounts(preset: settings.TrainingSettings, found: settings.TrainingSettings) -> settings.TrainingSettings:
    """A preset with another's passes of particles, which files may choose."""
    return dataclasses.replace(preset, **{key: getattr(found, key) for key in ("passes", "photons", "importons")})


SCALES = [(name, scale) for name, table in FILES.items() for scale in (None, *table.get("scale", {}))]


@pytest.mark.parametrize("name, scale", SCALES)
def test_every_experiment_loads_at_every_scale(tmp_path, name, scale):
    """A dry run: nothing is loaded, compiled or rendered."""
    experiment = of_this_project(tmp_path, name, scale)
    found = plan.plan(experiment, tmp_path)
    assert found.cells == found.todo and 0 < found.gigabytes < 24
    if scale == "small" and found.hours is not None:
        assert found.hours * 3600 <= SMALL_SECONDS
    assert "small" in experiment.scale or scale


@pytest.mark.parametrize("name", FILES)
def test_a_small_scale_needs_no_reference_of_its_own(tmp_path, name):
    """The full scale's, or the quickstart's, of a whole multiple of its size, is averaged."""
    there = {e.reference_key(s) for e in (of_this_project(tmp_path, name), of_this_project(tmp_path, "quickstart.toml"))
             for s in e.scene}
    small = of_this_project(tmp_path, name, "small")
    for scene in (s for s in small.scene if s.has_reference):
        sizes = ({"width": k * scene.width, "height": k * scene.height} for k in range(1, run.LARGER + 1))
        assert there & {small.reference_key(scene.model_copy(update=size)) for size in sizes}


@pytest.mark.parametrize("name", ["door_ajar.toml", "classroom.toml", "living_room.toml", "simple_scene.toml"])
@pytest.mark.parametrize("scale", [None, "small"])
def test_the_talks_method_and_its_modern_version_stand_side_by_side(tmp_path, name, scale):
    experiment = of_this_project(tmp_path, name, scale)
    scene, (plain, *guided) = experiment.scene[0], experiment.method
    presets = ["paper2014", "best"] if name == "simple_scene.toml" else ["paper2014", "paper2014_norr", "best"]
    assert plain.representation is None
    for method, preset in zip(guided, presets, strict=True):
        assert method.representation == {"type": "gaussian_mixture"}
        found = experiment.training_of(method)
        assert found == with_amounts(settings.training(preset), found) and method.name == f"GMM, {preset}"
        assert experiment.integrator_of(scene, method) == settings.integrator(preset)


def assert_is_of(preset, experiment, method, *others):
    """A method is that of a preset, but for amounts, and perhaps for other settings."""
    training, wanted = experiment.training_of(method), settings.training(preset)
    for key in {"gather", "record_radius", "shrink", "camera_passes", "learn_fraction", "weight_window", "parallax"} - {*others}:
        assert getattr(training, key) == getattr(wanted, key), key
    assert experiment.integrator_of(experiment.scene[0], method) == settings.integrator(preset)


@pytest.mark.parametrize("name", ["progressive_training.toml", "interleaving.toml", "emission.toml"])
@pytest.mark.parametrize("scale", [None, "small"])
def test_methods_name_their_preset(tmp_path, name, scale):
    experiment = of_this_project(tmp_path, name, scale)
    presets = set()
    for method in (m for m in experiment.method if m.representation):
        preset = next(preset for preset in settings.PRESETS if preset in method.name.split(", "))
        assert_is_of(preset, experiment, method)
        presets.add(preset)
    assert presets == set(settings.PRESETS)


@pytest.mark.parametrize("name", ["single_batch.toml", "single_batch_time.toml", "memory.toml"])
@pytest.mark.parametrize("scale", [None, "small"])
def test_titles_name_the_preset_of_all_methods_but_the_modern_version(tmp_path, name, scale):
    experiment = of_this_project(tmp_path, name, scale)
    assert "(paper2014_norr)" in experiment.title
    *others, modern = (m for m in experiment.method if m.representation)
    for method in others:
        assert_is_of("paper2014_norr", experiment, method, *(["shrink"] if name == "memory.toml" else []))
    assert modern.name == "GMM, best"
    assert_is_of("best", experiment, modern)


@pytest.mark.parametrize("name", ["single_batch.toml", "single_batch_time.toml"])
@pytest.mark.parametrize("scale", [None, "small"])
def test_methods_of_one_batch_differ_in_nothing_but_the_representation(tmp_path, name, scale):
    experiment = of_this_project(tmp_path, name, scale)
    trained = {}
    for method in (m for m in experiment.method if m.representation and m.name != "GMM, best"):
        training = experiment.training_of(method)
        assert (training.schedule, training.passes, training.camera_passes, training.neighbours) == ("single_batch", 1, 0, 250)
        series = method.series.name if method.series else method.name
        trained.setdefault(series, []).append((training, experiment.integrator_of(experiment.scene[0], method)))
    assert list(trained) == ["Jensen", "Hey", "GMM"] and trained["Jensen"] == trained["Hey"] == trained["GMM"]


@pytest.mark.parametrize("scale", [None, "small"])
def test_who_guides_whom_is_compared_with_as_many_particles(tmp_path, scale):
    experiment = of_this_project(tmp_path, "interleaving.toml", scale)
    trained = [experiment.training_of(method) for method in experiment.method[1:4]]      # without roulette; then others
    assert len({t.passes * (t.photons + t.importons) for t in trained}) == 1
    assert [t.importons > 0 for t in trained] == [False, True, True] and {t.share for t in trained} == {1}
    assert [t.schedule for t in trained] == ["interleaved", "importons_first", "interleaved"]


OWN = {"ablation.toml", "gate.toml", "presets.toml", "quickstart.toml", "smoke.toml", "targets.toml", "veach_ajar.toml"}


@pytest.mark.parametrize("name", sorted(FILES.keys() - OWN))
def test_claims_of_the_talk_say_which(tmp_path, name):
    experiment = of_this_project(tmp_path, name)
    assert experiment.description.startswith("Slides " if name != "simple_scene.toml" else "Slide ")


def test_the_first_step_of_progressive_training_differs_in_nothing_but_training(tmp_path):
    experiment = of_this_project(tmp_path, "progressive_training.toml")
    plain = next(m for m in experiment.method if m.name == "Path tracing, no roulette")
    one = next(m for m in experiment.method if m.series and m.series.value == 1)
    assert experiment.integrator_of(experiment.scene[0], plain) == experiment.integrator_of(experiment.scene[0], one)


EMBEDDED = [name for name, table in FILES.items() if not any("file" in scene for scene in table["scene"])]


@pytest.mark.parametrize("name", EMBEDDED)
def test_embedded_scenes_come_with_their_reference(name):
    """At the experiment's resolution or a multiple, of an unguided estimator, with halves and their variance; a key that moves
    orphans it."""
    experiment = experiment_file.load(FOLDER / name)
    references = run.references(experiment, FOLDER.parent / "results")
    for scene in (scene for scene in experiment.scene if scene.has_reference):
        reference = references[scene.name]
        assert reference.has_halves and reference.mean.shape == (scene.height, scene.width, 3)
        assert 0 < reference.noise_floor < 0.1 * reference.mean.mean()


@pytest.mark.parametrize("name", sorted(set(EMBEDDED) - OWN - {"slit.toml"}))      # which shows no images
def test_claims_say_where_to_look_closer(name):
    assert all(scene.has_reference and scene.crops for scene in experiment_file.load(FOLDER / name).scene)


def test_the_ablation_leaves_out_one_addition_at_a_time(tmp_path):
    experiment = of_this_project(tmp_path, "ablation.toml")
    best, *others = ({**dataclasses.asdict(c.integrator), **dataclasses.asdict(c.training)} for c in
                     experiment.cells()[:len(experiment.method)])
    assert experiment.baseline_name == experiment.method[0].name == "best" and len(experiment.seeds) >= 8
    for method, other in zip(experiment.method[1:], others, strict=True):
        together = {"camera_passes", "roulette"} if method.name == "no camera paths, no roulette" else set()
        left_out = {key for key in best if other[key] != best[key]}
        assert left_out == together or (len(left_out) == 1 and not together)


def test_the_targets_compare_presets_with_plain_path_tracing(tmp_path):
    for file in ("door_ajar.toml", "presets.toml", "targets.toml"):
        experiment = of_this_project(tmp_path, file)
        assert experiment.budget.seconds == 60 and len(experiment.seeds) >= 6
        assert experiment.baseline_name == "Path tracing" and experiment.method[0].representation is None
        for method in experiment.method[1:]:
            preset = method.name.removeprefix("GMM, ") if method.name != "GMM" else "best"
            assert with_amounts(settings.training(preset), experiment.training_of(method)) == experiment.training_of(method)
            assert experiment.integrator_of(experiment.scene[0], method) == settings.integrator(preset)


def with_preset(tmp_path: Path, name: str, preset: str, **tiny: object) -> config.Experiment:
    """An experiment of ours whose methods all have a preset, and differ in nothing else from what they are."""
    table = copy.deepcopy(FILES[name])
    table["training"] = {**table.get("training", {}), "preset": preset}
    for method in table["method"]:
        method.get("training", {}).pop("preset", None)
    for scene in (s for s in table["scene"] if "file" in s):
        scene["file"] = str(tmp_path / "room.xml")
        (tmp_path / "room.xml").write_text('<scene version="3.0.0"/>')
    (tmp_path / name).write_text(tomli_w.dumps(table | tiny))
    return experiment_file.load(tmp_path / name)


@pytest.mark.parametrize("preset", settings.PRESETS)
@pytest.mark.parametrize("name", FILES)
def test_every_preset_fits_every_experiment(tmp_path, name, preset):
    experiment = with_preset(tmp_path, name, preset)
    roulette = settings.integrator(preset).roulette
    for spec in (c for c in experiment.cells() if c.training is not None):
        assert spec.integrator.roulette == spec.method.integrator.get("roulette", roulette)


@pytest.mark.slow
@pytest.mark.parametrize("preset", settings.PRESETS)
@pytest.mark.parametrize("name", FILES)
def test_every_preset_runs_in_every_experiment(tmp_path, name, preset):
    """Its first guided method, with few particles and pixels, and a scene of ours in the place of other people's."""
    found = next(c for c in with_preset(tmp_path, name, preset).cells() if c.training is not None)
    ours = {"name": "cornell_box", "file": None} if found.scene.file else {}
    few = {"passes": 1, "photons": 500, "importons": min(found.training.importons, 500),
           "camera_passes": min(found.training.camera_passes, 2), "camera_paths": 256}
    spec = dataclasses.replace(found, training=dataclasses.replace(found.training, **few),
                               scene=found.scene.model_copy(update={"width": 16, "height": 9, **ours}),
                               budget=config.Budget(spp=2, checkpoints=1))
    done = cell.measure(spec, cell.load_scene(spec), cell.WarmUp(0.0, spp_seconds=1.0))
    assert done.info["spp"] >= 2 and done.info["records"] > 0 and np.isfinite(done.image["mean"]).all()
