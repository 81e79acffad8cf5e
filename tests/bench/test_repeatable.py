"""Budgets in samples give the same images bit for bit: in any process, on any number of threads, and resumed or not."""
from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from olpm_bench.bench import experiment_file, run
from olpm_bench.bench.config import Experiment
from olpm_bench.bench.results import TRAINED, Results

TOML = """
title = "Repeatable"
[budget]
spp = 11
[[scene]]
name = "lamps"
file = "scene.xml"
width = 16
height = 12
reference = "none"
[training]
passes = 1
photons = 20_000
importons = 10_000
camera_passes = 2
camera_paths = 4096
record_radius = 0.2
"""
GMM = """
[[scene]]
name = "cornell_box"
width = 16
height = 12
reference = "none"
[[method]]
name = "GMM"
representation = { type = "gaussian_mixture" }
"""
OTHERS = """
[[scene]]
name = "classroom"
parameters = { sky = 0.5 }
width = 16
height = 12
reference = "none"
[[method]]
name = "Path tracing"
[[method]]
name = "GMM, while rendering"
representation = { type = "gaussian_mixture" }
training = { while_rendering = true, emission = "guided" }
[[method]]
name = "GMM, paper2014"
representation = { type = "gaussian_mixture" }
training = { preset = "paper2014", passes = 2, photons = 20_000, importons = 10_000, record_radius = 0.2 }
[[method]]
name = "Jensen"
representation = { type = "jensen" }
[[method]]
name = "Hey"
representation = { type = "hey" }
"""

# A room lit by eight cubes.  Which of them next-event estimation samples goes by their order: that of the file, unless a loader
# puts together meshes whose materials are the same, of which there are three here.
LAMP = """<shape type="cube"><transform name="to_world"><scale value="0.1"/><translate x="{x}" y="{y}" z="1"/></transform>
  <bsdf type="{bsdf}"/><emitter type="area"><rgb name="radiance" value="{radiance}, 2, 1"/></emitter></shape>"""
SCENE = """<scene version="3.0.0">
  <sensor type="perspective"><transform name="to_world">
    <lookat origin="0, -4, 3" target="0, 0, 0.3" up="0, 0, 1"/></transform></sensor>
  <shape type="cube"><transform name="to_world"><scale value="5"/><translate x="0" y="0" z="5"/></transform>
    <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
  <shape type="sphere"><point name="center" x="0.3" y="0" z="0.4"/><float name="radius" value="0.4"/></shape>""" + "".join(
    LAMP.format(x=i % 4 - 1.5, y=i // 4, bsdf=("diffuse", "plastic", "conductor")[i % 3], radiance=i + 1) for i in range(8)
) + "</scene>"

# In another process, where strings hash otherwise.
CHILD = """
import sys, representations, drjit as dr
from pathlib import Path
from olpm_bench.bench import experiment_file, environment, run
environment.select_variant(int(sys.argv[3]))
assert run.run(experiment_file.load(Path(sys.argv[1])), Path(sys.argv[2])) == []
"""


@pytest.mark.parametrize(("seeds", "methods"), [pytest.param([0, 1], GMM, id="GMM"),
                                                pytest.param([1], OTHERS, id="others", marks=pytest.mark.slow)])
def test_images_repeat_in_another_process_on_other_threads_and_resumed(tmp_path: Path, seeds: list[int], methods: str):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "test.toml").write_text(f"seeds = {seeds}" + TOML + methods)
    experiment, root = experiment_file.load(tmp_path / "test.toml"), tmp_path / "results"
    assert run.run(experiment, root) == []
    images = _images(experiment, root)
    for cell in experiment.cells():
        if cell.seed == 1:
            (Results(root / "test").cell_folder(cell.scene.name, cell.method.name, cell.seed) / "cell.json").unlink()
    environment = {**os.environ, "PYTHONHASHSEED": "5", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", CHILD, tmp_path / "test.toml", root, "1" if dr.thread_count() > 1 else "2"],
                   env=environment, check=True, capture_output=True, text=True)
    for (where, before), after in zip(images.items(), _images(experiment, root).values(), strict=True):
        assert np.isfinite(before).all() and before.mean() > 0.01
        np.testing.assert_array_equal(before, after, err_msg=where)


def _images(experiment: Experiment, root: Path) -> dict[str, np.ndarray]:
    cells = [Results(root / "test").verified_cell(c.scene.name, c.method.name, c.seed) for c in experiment.cells()]
    assert all(cells)
    assert all(cell.info["trained"] is None or cell.info["trained"] > TRAINED for cell in cells), "guides that guide few paths"
    return {f"{cell.scene}, {cell.method}, seed {cell.seed}": cell.image()["mean"] for cell in cells}
