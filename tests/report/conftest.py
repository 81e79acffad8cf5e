"""A results folder as a run leaves it, with images whose noise falls as 1/sqrt(t)."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.bench import experiment_file
from olpm_bench.bench.finished import Finished, read
from olpm_bench.bench.reference_file import Reference
from olpm_bench.bench.results import Results

NOISE = {"Path tracing": 0.5, "Quick & dirty": 0.2}         # standard deviation of a pixel after 1 s
TRAINING = {"Path tracing": 0.0, "Quick & dirty": 1.5}      # [s]
ENDED = {"Path tracing": None, "Quick & dirty": 3.0}        # [s]: half of the last 2 s of training went into the image
SIZE = (18, 32)


@pytest.fixture()
def finished(tmp_path) -> Finished:
    """One scene, two methods, three seeds, 16 seconds."""
    experiment = experiment_file.parse({
        "title": "Synthetic", "seeds": 3, "budget": {"seconds": 16, "checkpoints": 5},
        "scene": [{"name": "door_ajar", "width": SIZE[1], "height": SIZE[0]}],
        "method": [{"name": name} for name in NOISE]}, "synthetic.toml", tmp_path)
    results = Results(tmp_path / "results" / "synthetic")
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.1, 1, (*SIZE, 3)).astype(np.float32)
    for cell in experiment.cells():
        name, times = cell.method.name, np.geomspace(2, 16, 5)
        images = [truth + rng.normal(0, NOISE[name] / np.sqrt(t), truth.shape).astype(np.float32) for t in times]
        trace = [{"seconds": t, "train_seconds": min(t / 2, TRAINING[name]), "spp": round(10 * t)} for t in times]
        info = {"key": cell.key, "spp": 160, "charged_seconds": 16.0, "training_passes": 0, "train_seconds": TRAINING[name],
                "training_ended": ENDED[name] and ENDED[name] + 0.1 * cell.seed,
                "render_seconds": 16 - TRAINING[name], "compile_seconds": 1.0, "wait_fraction": 0.0, "records": 0,
                "bytes_per_record": 0, "particles": 0, "image_passes": 8,
                "mean": 0.5, "mean_stderr": 0.01}
        results.write_cell(cell.scene.name, name, cell.seed, info, trace,
                           {"mean": images[-1], "variance": truth, "count": truth[..., 0]}, images)
    results.write_json("env.json", {"schema_version": 1, "cpu": "Abacus 2", "threads": 2})
    a, b = (truth + rng.normal(0, 0.005, truth.shape).astype(np.float32) for _ in range(2))
    reference = Reference(a, b, truth, truth, {"spp_a": 600, "spp_b": 700, "seconds": 299.5, "estimator": "path, unguided"})
    return read(experiment, results, {"door_ajar": reference})
