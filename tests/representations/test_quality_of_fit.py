"""Mixed log density on six synthetic sets, against the figures of the study that the sets come from.

Needs the script that draws the sets, beside the repository; skipped without it.
"""
from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import representations
from olpm_bench.check.particles import vector
from representations.interface import ParticleBatch

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).resolve().parents[3] / "shared" / "fit" / "make_sets.py"
SEEDS, N, HELD_OUT = 8, 1000, 50_000

# Mean ln(0.5 cos / pi + 0.5 fit) of held-out directions, 1,000 particles in one batch, 8 seeds; "+" are heavy weights.
SETS = ["lobes", "lobes+", "window", "slit", "grazing", "ring", "sun"]
FIGURES = {
    ("jensen", ()): [-0.600, -0.653, -0.458, -1.271, 0.169, -0.972, 0.738],
    ("hey", (("cones", 1000),)): [-0.468, -0.685, -0.762, -1.013, 0.207, -0.392, 4.273],
}


@pytest.fixture(scope="module")
def make_sets() -> Any:
    if not SCRIPT.is_file():
        pytest.skip(f"{SCRIPT} is not there")
    spec = importlib.util.spec_from_file_location("make_sets", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def records(n: int) -> mi.UInt32:
    """n lanes of each seed."""
    return mi.UInt32(np.repeat(np.arange(SEEDS, dtype=np.uint32), n))


@pytest.mark.parametrize("method", FIGURES, ids=[name for name, _ in FIGURES])
@pytest.mark.parametrize("column", range(len(SETS)), ids=SETS)
def test_reaches_the_figure(make_sets: Any, method: tuple[str, tuple], column: int) -> None:
    """Within .02, which is about two standard deviations over seeds."""
    name, parameters = method
    kind, heavy = SETS[column].rstrip("+"), SETS[column].endswith("+")
    representation = representations.create(name, **dict(parameters))
    sets = [make_sets.draw(kind, N, seed, heavy) for seed in range(SEEDS)]
    wo, weight = (np.concatenate([s[i] for s in sets]) for i in (0, 1))
    particles = ParticleBatch.from_arrays(vector(wo), mi.Float(weight), records(N), SEEDS)
    state = representation.update(representation.init(SEEDS), particles)
    wo = make_sets.draw(kind, HELD_OUT, 1000)[0]
    pdf = representation.pdf(state, records(HELD_OUT), vector(np.tile(wo, (SEEDS, 1))))
    mixed = 0.5 * wo[:, 2] / np.pi + 0.5 * np.array(pdf, np.float64).reshape(SEEDS, -1)
    assert abs(np.log(mixed).mean() - FIGURES[method][column]) < 0.02
