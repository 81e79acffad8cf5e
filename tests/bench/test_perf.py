"""`olpm-bench perf`: what it prints, on tiny work."""
from __future__ import annotations

import json
import math

import pytest
from typer.testing import CliRunner

import representations
from olpm_bench.bench import perf
from olpm_bench.cli import app
from olpm_bench.scenes.load import load


@pytest.mark.slow
def test_figures_of_the_issue(monkeypatch):
    monkeypatch.setattr(perf, "REPEATS", 1)
    monkeypatch.setattr(perf, "RECORDS", 8)
    monkeypatch.setattr(perf, "EACH", 16)
    monkeypatch.setattr(perf, "MAX_DEPTH", 4)
    monkeypatch.setattr(perf, "PARTICLES", {"photons": 2000, "importons": 500})
    monkeypatch.setattr(perf, "CAMERA_PATHS", 400)
    monkeypatch.setattr(representations, "names", lambda: ["cosine", "gaussian_mixture"])
    figures = json.loads(json.dumps(perf.measure("cornell_box", 16, 12, spp=2, passes=3), allow_nan=False))
    assert figures["scene"] == "cornell_box" and (figures["width"], figures["height"]) == (16, 12)
    assert isinstance(figures["recompiles_after_warmup"], int) and isinstance(figures["camera_recompiles_after_warmup"], int)
    assert {"trace", "gather", "update"} <= figures["pass_seconds"].keys() == figures["pass_seconds_nearest"].keys()
    assert figures["camera_pass_seconds"].keys() == figures["pass_seconds"].keys() and len(figures["camera_rss_mb_by_pass"]) == 3
    assert figures["guided_vertex_ns"].keys() == {"cosine", "gaussian_mixture"} and len(figures["rss_mb_by_pass"]) == 3
    for value in (figures["em_ns_per_particle"], figures["path_vertex_ns"], figures["unguided_vertex_ns"],
                  *figures["guided_vertex_ns"].values(), figures["peak_rss_mb"]):
        assert value > 0 and math.isfinite(value)


@pytest.mark.slow
def test_training_on_the_default_scene_compiles_nothing_after_warm_up(monkeypatch):
    """As `measure` runs it, with fewer particles."""
    monkeypatch.setattr(perf, "PARTICLES", {"photons": 30_000, "importons": 10_000})
    monkeypatch.setattr(perf, "CAMERA_PATHS", 2 ** 14)
    scene = load("door_ajar", width=64, height=36, max_depth=perf.MAX_DEPTH)
    for particles, camera in ((8, 0), (1, 8)):
        perf.training_passes(scene, min(particles, 4), min(camera, 4))
        assert perf.training_passes(scene, particles, camera)[2] == 0


@pytest.mark.parametrize("arguments, expected", [
    ((), ("door_ajar", 160, 90, 20)),
    (("--scene", "a/room.xml", "--width", "32", "--height", "18", "--passes", "3"), ("a/room.xml", 32, 18, 3))])
def test_the_command_passes_its_options_on(monkeypatch, arguments, expected):
    def measure(scene, width, height, passes):
        return {"given": [scene, width, height, passes]}

    monkeypatch.setattr(perf, "measure", measure)
    result = CliRunner().invoke(app, ["perf", *arguments])
    assert json.loads(result.stdout)["given"] == list(expected)
