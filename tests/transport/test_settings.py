"""Settings: presets, changes, and what is refused with which words."""
from __future__ import annotations

from dataclasses import fields

import pytest

from olpm_bench.transport.settings import (
    InputError,
    IntegratorSettings,
    TrainingSettings,
    integrator,
    training,
    with_changes,
)


def test_changes_win_over_the_preset():
    settings = training("paper2014", photons=7)
    assert settings.gather == "nearest" and settings.photons == 7
    assert training() == TrainingSettings()


@pytest.mark.parametrize(("preset", "roulette"), [("paper2014", "throughput"), ("paper2014_norr", "none")])
def test_the_papers_presets_are_the_papers(preset, roulette):
    """Exact gather of 250 particles, photons and importons only, a fixed half for the BSDF, records of 1 % that shrink."""
    t = training(preset)
    assert (t.gather, t.neighbours, t.camera_passes, t.learn_fraction, t.fraction, t.record_radius, t.shrink, t.parallax,
            t.weight_window, t.schedule) == ("nearest", 250, 0, False, 0.5, 0.01, True, False, "flux", "interleaved")
    assert integrator(preset).roulette == roulette and integrator(preset).fraction == 0.5
    assert integrator("best").roulette == "contribution" and training("best").camera_passes > 0


@pytest.mark.parametrize("preset", ["slow", ["best"], None])
def test_unknown_presets(preset):
    with pytest.raises(InputError, match=r"unknown preset .*; known: best, paper2014"):
        training(preset)


@pytest.mark.parametrize("changes, message", [
    ({"pases": 3}, "unknown key 'pases'; known: schedule, passes"),
    ({"passes": -1}, "passes = -1: must be >= 0"),
    ({"passes": 2.5}, r"passes = 2\.5: must be a whole number"),
    ({"passes": True}, "passes = True: must be a whole number"),
    ({"photons": "many"}, "photons = 'many': must be a whole number"),
    ({"fraction": "half"}, "fraction = 'half': must be a number"),
    ({"fraction": float("nan")}, r"fraction = nan: must be in \(0, 1\]"),
    ({"gather": ["binned"]}, r"gather = \['binned'\]: must be a string"),
    ({"gather": "near"}, "gather = 'near': must be 'binned' or 'nearest'"),
    ({"emission": "guide"}, "emission = 'guide': must be 'guided' or 'emitter'"),
    ({"emission_fraction": 0.0}, r"emission_fraction = 0\.0: must be in \(0, 1\]"),
])
def test_wrong_values(changes, message):
    with pytest.raises(InputError, match=message):
        with_changes(TrainingSettings(), changes)


def test_a_whole_number_is_a_number():
    assert with_changes(IntegratorSettings(), {"fraction": 1}).fraction == 1


def test_names_are_told_apart_where_they_are_flat():
    """The plugin's parameters are one list: only `fraction` sets both, as its docstring says."""
    names = [{f.name for f in fields(cls)} for cls in (IntegratorSettings, TrainingSettings)]
    assert names[0] & names[1] == {"fraction"}
