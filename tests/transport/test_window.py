"""The weight window: unbiased whatever the estimates, and particles that cross a slit because of it."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy import stats
from small_scenes import box, grey, lamp, wall

from olpm_bench.check.verdict import sidak
from olpm_bench.report import figures, landings
from olpm_bench.scenes import door_ajar
from olpm_bench.scenes.load import load
from olpm_bench.transport import settings
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.particles import emit_importons, emit_photons, trace
from olpm_bench.transport.training import Training
from olpm_bench.transport.window import Window, by_contribution

DEPTH, N, LEVEL = 7, 40_000, 0.01
SMALL = settings.training(passes=2, photons=20_000, importons=20_000, record_radius=0.08, camera_passes=0)


@pytest.fixture(scope="module")
def training() -> Training:
    """Two chambers of the box [-1, 1]^3; in the wall between them is a gap on one side."""
    parts = [wall((x, 0.4, 0), (0, y, 0), 1, bsdf=grey(0.7)) for x in (-0.4,) for y in (-1, 1)]
    scene = mi.load_dict(box(grey(0.7), lamp=lamp(), front=parts[0], back=parts[1]), optimize=False)
    training = Training(scene, "jensen", SMALL, settings.integrator(max_depth=DEPTH))
    for _ in training.run():
        pass
    return training


def _flux(training: Training, photons: bool, window: Window | None, seed: int) -> np.ndarray:
    """Weight left in each octant, mean over each lane's particles [8, lanes]."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, N)
    mode = mi.TransportMode.Importance if photons else mi.TransportMode.Radiance
    rays = emit_photons(training.scene, sampler) if photons else emit_importons(training.sensor, sampler)
    guide = training.importance if photons else training.radiance
    found = trace(training.scene, rays, sampler, guide, 0.5, DEPTH, mode, window)
    p, weight, _, _, _ = found.read(found.place)
    octant = sum((x.numpy() > 0).astype(int) << i for i, x in enumerate(p))
    lane = found.place.numpy() % found.lanes
    flux = np.bincount(octant * found.lanes + lane, weight.numpy(), 8 * found.lanes).reshape(8, -1)
    return flux / np.bincount(np.arange(N) % found.lanes)


def _garbage(guide: Guide) -> Window:
    rng = np.random.default_rng(3)
    value = rng.lognormal(0, 3, guide.records) * (rng.random(guide.records) < 0.8)
    return Window(mi.Float(value), mi.Float(5.0))


@pytest.mark.parametrize("photons", [True, False])
@pytest.mark.parametrize("estimates", ["learnt", "garbage"])
def test_expectations_do_not_depend_on_the_window(training, photons, estimates):
    guide, own = (training.importance, training.radiance)[::1 if photons else -1]
    window = _garbage(guide) if estimates == "garbage" else by_contribution(guide, own, 4.0, mi.Float(1e-4))
    on, off = _flux(training, photons, window, 11), _flux(training, photons, None, 12)
    p = stats.ttest_ind(on, off, axis=1, equal_var=False).pvalue
    assert p.min() > sidak(LEVEL, 4 * len(p)), (p, on.mean(1), off.mean(1))


def test_buffers_hold_whatever_splits(training):
    """Values that ask for more copies than there is room for: no hit is lost, none is out of place."""
    value = dr.full(mi.Float, 1e9, training.importance.records)
    on = _flux(training, True, Window(value, mi.Float(1.0)), 13).mean()
    off = _flux(training, True, None, 14).mean()
    assert on == pytest.approx(off, rel=0.02)


@pytest.mark.slow
def test_particles_cross_the_slit(tmp_path):
    """door_ajar, gap 7 cm: photons in the dark room and importons in the corridor, before and after they know of each other."""
    scene = load("door_ajar", width=96, height=54)
    shares = {}
    for window in ("flux", "contribution"):
        few = settings.training(passes=4, photons=100_000, importons=50_000, camera_passes=0, weight_window=window)
        seen = list(Training(scene, "gaussian_mixture", few, settings.integrator(), regions=(door_ajar.room, 2)).run())
        shares[window] = {kind: np.array([s.regions[kind][r] / s.regions[kind][:, 0].sum() for s in seen])
                          for r, kind in enumerate(("photons", "importons"))}
    photons, importons = (shares["contribution"][kind] for kind in ("photons", "importons"))
    assert photons[0, 0] < 0.03 and importons[0, 0] < 0.1
    assert photons[1:, 0].min() > 0.2 and importons[1:, 0].min() > 0.2          # .25 in the last pass
    assert photons[-1, 1] > 0.1 * photons[-1, 0]            # by their weights they count as a tenth of their number or more
    assert (photons[-1, 1] > 3 * photons[0, 1]) and (importons[-1, 1] > 1.2 * importons[0, 1])
    for kind in ("photons", "importons"):
        assert np.all(shares["contribution"][kind][-1] > 1.1 * shares["flux"][kind][-1]), (kind, shares)
    with figures.style():
        figures.save(landings.draw(seen, ("dark room", "corridor")), tmp_path, "particles")
    assert (tmp_path / "particles.png").stat().st_size > 5_000
