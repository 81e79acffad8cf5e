"""Guided emission in real scenes by other people, where they are at hand beside the checkout: how many photons are of use.

A photon is of use if it leaves a hit on a surface that the camera sees: in a voxel, facing alike, that a camera ray hits.
`pytest -m slow -rP` prints the counts.
"""
from __future__ import annotations

from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import others
import pytest

from olpm_bench.scenes.load import load
from olpm_bench.transport import settings
from olpm_bench.transport.cache import Grid
from olpm_bench.transport.guide import Guide
from olpm_bench.transport.particles import LANES, emit_importons, emit_photons, trace
from olpm_bench.transport.training import PassStatistics, Training

SCENES = {"dining-room": 15, "classroom": 100}          # times as many photons of use as by the emitters' own samplers
RAYS, EDGE = 200_000, 0.005                             # of the camera; of the voxels, in units of the scene's diagonal
LEARNT = 40                                             # particles of a record
PARTICLES = {"passes": 3, "photons": 300_000, "importons": 100_000, "camera_passes": 0, "record_radius": 0.01}
BATCHES = 16                                            # of photons that are looked at

pytestmark = pytest.mark.slow


class Seen:
    """The surfaces that the camera sees."""

    def __init__(self, scene: mi.Scene, bounds: mi.ScalarBoundingBox3f) -> None:
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(99, RAYS)
        ray, _ = scene.sensors()[0].sample_ray(0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d())
        si = scene.ray_intersect(ray)
        self.valid = si.is_valid() & mi.has_flag(si.bsdf(ray).flags(), mi.BSDFFlags.Smooth)
        self.p, self.n = si.p, mi.Normal3f(dr.mulsign(si.n, -dr.dot(si.n, ray.d)))
        self.grid = Grid.over(bounds, EDGE * float(dr.norm(bounds.extents())))
        self.cells = dr.zeros(mi.Bool, self.grid.n_cells)
        dr.scatter(self.cells, mi.Bool(True), self.grid.cell(self.p, self.n), self.valid)
        dr.eval(self.p, self.n, self.valid, self.cells)

    def at(self, p: mi.Point3f, n: mi.Normal3f) -> np.ndarray:
        return dr.gather(mi.Bool, self.cells, self.grid.cell(p, n)).numpy()


def photons_of_use(training: Training, seen: Seen) -> float:
    """Share of photons, traced as in one more pass, that leave a hit which the camera sees."""
    emit, found = training.emission.emit if training.emission else partial(emit_photons, training.scene), 0
    for _ in range(BATCHES):                                    # so few that each has a lane of its own
        photons = training._trace(emit, LANES, training.importance, training.radiance, mi.TransportMode.Importance,
                                  PassStatistics(0, 1))
        p, _, _, _, n = photons.read(photons.place)
        found += len(np.unique(photons.place.numpy()[seen.at(p, n)] % photons.lanes))
    return found / (BATCHES * LANES)


def learnt_where(guide: Guide, p: mi.Point3f, n: mi.Normal3f, valid: mi.Bool) -> float:
    """Share of valid points whose record has learnt."""
    record, _, found = guide.cache.lookup(p, n, valid)
    return float((dr.gather(mi.UInt32, guide.count, record, found).numpy()[valid.numpy()] >= LEARNT).mean())


def learnt_later(training: Training) -> float:
    """Share of the surfaces that unguided camera paths meet after the first whose record has learnt."""
    training.sampler.seed(98, RAYS)
    rays = emit_importons(training.sensor, training.sampler)
    met = trace(training.scene, rays, training.sampler, None, 1.0, training.max_depth, mi.TransportMode.Radiance)
    p, weight, _, _, n = met.read(met.place)
    return learnt_where(training.radiance, p, n, weight > 0)


@pytest.mark.parametrize("name", SCENES)
def test_more_photons_are_of_use(name: str):
    scene, share, learnt = load(others.folder_of(name) / "scene.xml", width=96, height=54, max_depth=13), {}, {}
    for emission in ("emitter", "guided"):
        few = settings.training(**PARTICLES, emission=emission)
        training = Training(scene, "gaussian_mixture", few, settings.integrator(max_depth=13))
        for _ in training.run():
            pass
        guide, seen = training.radiance, Seen(scene, training.bounds)
        share[emission] = photons_of_use(training, seen)
        learnt[emission] = learnt_where(guide, seen.p, seen.n, seen.valid), learnt_later(training)
        print(f"{name}, {emission}: {share[emission]:.2%} of the photons are of use; a record with {LEARNT} particles have "
              f"{learnt[emission][0]:.0%} of the surfaces that the camera sees, {learnt[emission][1]:.0%} of those met later")
    assert share["guided"] > SCENES[name] * share["emitter"]
    assert min(learnt["guided"]) > 0.7          # .77 in the classroom, whose records are of the room's scale
