"""The package as a library: arguments that are flat, and messages that say which of them is wrong."""
from __future__ import annotations

import io
from pathlib import Path

import mitsuba as mi
import pytest

import olpm_bench
from olpm_bench.transport.settings import InputError
from representations import RepresentationError

pytestmark = pytest.mark.filterwarnings("ignore:.*of what the camera sees is guided")
FEW = {"passes": 1, "photons": 2000, "importons": 500, "camera_passes": 2, "camera_paths": 500, "record_radius": 0.1,
       "max_depth": 3}


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    olpm_bench.register()
    return olpm_bench.load_scene("cornell_box", width=8, height=6)


def test_hyper_parameters_stand_beside_settings(scene):
    passes = []
    guide = olpm_bench.train(scene, "gaussian_mixture", components=4, progress=passes.append, **FEW)
    assert guide.specification == {"type": "gaussian_mixture", "components": 4}
    assert [statistics.index for statistics in passes] == [0, 1, 2]
    assert "components" in str(guide)


@pytest.mark.parametrize(("given", "error", "message"), [
    ({"componets": 4}, InputError, r"unknown setting 'componets'; known: schedule, .*components.*; did you mean 'components'\?$"),
    ({"camera_pases": 4}, InputError, r"did you mean 'camera_passes'\?$"),
    ({"roulette": "none"}, InputError, r"'roulette' is a setting of the integrator: give integrator={'roulette': ...}"),
    ({"components": 2.5}, RepresentationError, "components = 2.5: must be a whole number"),
    ({"components": [4, {}]}, RepresentationError, "components"),
    ({"passes": -1}, InputError, "passes = -1: must be >= 0"),
    ({"passes": {}}, InputError, "passes: must be a number, a string or a list, not a dict"),
])
def test_settings_that_cannot_be_used(scene, given, error, message):
    with pytest.raises(error, match=message):
        olpm_bench.train(scene, **given)


def test_settings_of_the_integrator_that_cannot_be_used():
    with pytest.raises(InputError, match=r"unknown setting 'roulete'; known: max_depth, roulette, .*; did you mean 'roulette'\?"):
        olpm_bench.integrator(roulete="none")
    with pytest.raises(InputError, match="guide: must be a guide, the file of one, or None, not a dict"):
        olpm_bench.integrator({})


def test_no_scene_is_printed_into_an_error(scene):
    """Its text is pages long."""
    for wrong in (lambda: olpm_bench.train("cornell_box"), lambda: olpm_bench.train("jensen", scene),
                  lambda: olpm_bench.train(scene, scene), lambda: olpm_bench.train(scene, {"type": scene}),
                  lambda: olpm_bench.train(scene, passes=scene), lambda: olpm_bench.train(scene, components=scene),
                  lambda: olpm_bench.train(scene, sensor=scene), lambda: olpm_bench.train(scene, preset=scene),
                  lambda: olpm_bench.train(scene, seed=scene), lambda: olpm_bench.train(scene, max_depth=scene),
                  lambda: olpm_bench.integrator(scene), lambda: olpm_bench.integrator(max_depth=scene),
                  lambda: olpm_bench.integrator(preset=scene), lambda: olpm_bench.load_guide(scene),
                  lambda: olpm_bench.load_scene(scene),
                  lambda: olpm_bench.train(scene, integrator={"max_depth": scene})):
        with pytest.raises((InputError, TypeError)) as error:
            wrong()
        assert len(str(error.value)) < 300 and "\n" not in str(error.value), str(error.value)


def test_the_plugin_says_what_was_meant_too():
    with pytest.raises(RuntimeError, match=r"unknown setting 'componets'.*; did you mean 'components'\?"):
        mi.load_dict({"type": "guided_path", "componets": 4})
    with pytest.raises(RuntimeError, match="unknown setting 'components'"):
        mi.load_dict({"type": "guided_path", "representation": "unguided", "components": 4})


def test_guides_are_read_from_their_file(scene, tmp_path):
    guide = olpm_bench.train(scene, "cosine", **FEW)
    guide.save(tmp_path / "guide.npz")
    assert str(olpm_bench.load_guide(tmp_path / "guide.npz")) == str(guide)
    with pytest.raises(InputError, match="holds a guide of type 'cosine', not 'jensen'"):
        olpm_bench.load_guide(tmp_path / "guide.npz", "jensen")
    images = [mi.render(scene, integrator=olpm_bench.integrator(g, max_depth=3), spp=4).numpy()
              for g in (guide, str(tmp_path / "guide.npz"), Path(tmp_path / "guide.npz"))]
    assert (images[0] == images[1]).all() and (images[0] == images[2]).all()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(("stream", "progress", "drawn"), [
    (Terminal, True, True), (Terminal, False, False), (io.StringIO, True, False)])
def test_training_draws_a_bar_on_a_terminal_only(scene, monkeypatch, stream, progress, drawn):
    stderr = stream()
    monkeypatch.setattr("sys.stderr", stderr)
    olpm_bench.train(scene, "cosine", progress=progress, **FEW)
    assert ("training pass 3 of 3" in stderr.getvalue()) == drawn
    assert drawn or stderr.getvalue() == ""
