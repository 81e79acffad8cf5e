"""Distances are learnt, and what has been learnt is re-aimed at where it is."""
from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import representations
from representations.interface import ParticleBatch
from representations.parallax import STEEPEST, aim, inverse
from representations.state import bytes_of

LIGHTS = np.array([[0.5, 0, 1], [-4, 1, 2]], np.float32)        # in the record's frame: a near one, a far one, ...
SUN = np.array([0, -0.6, 0.8], np.float32)                      # ... and one at infinity
RADIUS = 0.2                                                    # of the disk on which particles land


def vector(v: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(*(mi.Float(np.ascontiguousarray(c, np.float32)) for c in np.atleast_2d(v).T))


def lit(n: int = 3000) -> ParticleBatch:
    """Particles of three small lights, as many of each, on the disk around one record."""
    rng = np.random.default_rng(0)
    r, phi = RADIUS * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    at = np.stack([r * np.cos(phi), r * np.sin(phi), 0 * r], -1)
    which = np.arange(n) % 3
    wo = np.array([*LIGHTS, SUN])[which] - np.where((which < 2)[:, None], at, 0) + 0.02 * rng.normal(size=(n, 3))
    distance = np.linalg.norm(wo, axis=1)
    return ParticleBatch.from_arrays(vector(wo / distance[:, None]), dr.ones(mi.Float, n), dr.zeros(mi.UInt32, n), 1,
                                     mi.Float(np.where(which < 2, distance, np.inf).astype(np.float32)), vector(at))


def test_aim_is_the_direction_to_the_point():
    x, at = np.array([[0.3, 0.4, 1.2], [-2, 1, 0.5]]), np.array([[0.1, -0.05, 0.02], [0.2, 0.1, 0]])
    r = np.linalg.norm(x, axis=1)
    *d, near = aim(tuple(vector(x / r[:, None])), inverse(mi.Float(r.astype(np.float32))), vector(at))
    np.testing.assert_allclose(np.stack(d, -1), (x - at) / np.linalg.norm(x - at, axis=1, keepdims=True), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(near, 1 / np.linalg.norm(x - at, axis=1), rtol=1e-5)


@pytest.mark.parametrize("distance", [0.0, 1e-3, 1.0, np.inf])
@pytest.mark.parametrize("at", [(0, 0, 0), (0, 0, 5), (-30, 0, -30), (1e-8, 0, 0)])
def test_aim_stays_above_the_horizon_and_finite(distance, at):
    """Whatever is near counts as 1 / STEEPEST times |at| away, so no lobe turns by more than that."""
    wo = mi.Vector3f(0.6, 0, 0.8)
    *d, near = (float(c[0]) for c in aim(tuple(wo), inverse(mi.Float(distance)), mi.Vector3f(*at)))
    assert np.isfinite([*d, near]).all() and d[2] > 0
    assert np.linalg.norm(d) == pytest.approx(1, rel=1e-5)
    assert np.dot(d, (0.6, 0, 0.8)) >= np.sqrt(1 - STEEPEST**2) - 1e-5
    if np.isinf(distance):
        np.testing.assert_allclose(d, (0.6, 0, 0.8), rtol=1e-5)


@pytest.mark.parametrize("name", ["gaussian_mixture", "hey"])
def test_lights_are_found_from_beside(name):
    """From a point beside the record the lights are where they are, which without parallax they are not."""
    representation, batch = representations.create(name), lit()
    state = representation.init(1, parallax=True)
    for _ in range(3):
        state = representation.update(state, batch)
    spread = 0.02 * np.random.default_rng(1).normal(size=(500, 3))
    for place in np.array([(0, 0, 0), (0.15, 0, 0), (-0.1, 0.1, 0)]):
        for i, light in enumerate((*(LIGHTS - place), SUN)):
            d = light + spread
            wo, record = vector(d / np.linalg.norm(d, axis=1, keepdims=True)), dr.zeros(mi.UInt32, len(d))
            blind, seen = (representation.pdf(state, record, wo, True, at).numpy().mean() for at in (None, vector(place)))
            assert seen > 20 / (2 * np.pi)
            if i == 0 and place.any():
                assert blind < 0.1 * seen


def test_the_mixture_learns_harmonic_mean_distances():
    mixture, batch = representations.create("gaussian_mixture"), lit()
    state = mixture.init(1, parallax=True)
    for _ in range(4):
        state = mixture.update(state, batch)
    x, y, z, near = state.aims.numpy().reshape(4, -1)
    weight = state.lobes.numpy()[:mixture.components]
    d = np.stack([x, y, z], -1)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1, rtol=1e-5)
    for light, expected in ((LIGHTS[0], 1 / np.linalg.norm(LIGHTS[0])), (LIGHTS[1], 1 / np.linalg.norm(LIGHTS[1])), (SUN, 0)):
        mine = (d @ light / np.linalg.norm(light) > 0.995) & (weight > 0.05)
        assert mine.any()
        np.testing.assert_allclose(near[mine], expected, rtol=0.03, atol=0.02)


@pytest.mark.parametrize("name", representations.names())
def test_at_the_record_nothing_changes(name):
    """at = 0 is what is seen without parallax, but for rounding."""
    representation, batch = representations.create(name), lit()
    state = representation.update(representation.init(1, parallax=True), batch)
    wo, record = batch.wo, dr.zeros(mi.UInt32, len(batch))
    a, b = (representation.pdf(state, record, wo, True, at).numpy() for at in (None, mi.Vector3f(0)))
    assert np.mean(np.isclose(a, b, rtol=0.02)) > 0.99


@pytest.mark.parametrize("name", representations.names())
def test_without_it_places_and_distances_are_ignored(name):
    """Nothing is kept for it, and states, samples and densities are bit for bit what they are without `at`."""
    representation, batch = representations.create(name), lit()
    plain = dataclasses.replace(batch, at=None, distance=dr.full(mi.Float, dr.inf, len(batch)))
    seen, blind = (representation.update(representation.init(1), b) for b in (batch, plain))
    for f in dataclasses.fields(seen):
        np.testing.assert_array_equal(getattr(seen, f.name).numpy(), getattr(blind, f.name).numpy(), err_msg=f.name)
    n, rng = 1000, np.random.default_rng(2)
    u, v, record = mi.Float(rng.random(n)), mi.Point2f(*(mi.Float(x) for x in rng.random((2, n)))), dr.zeros(mi.UInt32, n)
    for a, b in zip(*(representation.sample(seen, record, u, v, True, at) for at in (None, mi.Vector3f(0.1, 0, 0))), strict=True):
        np.testing.assert_array_equal(a.numpy(), b.numpy())
    assert bytes_of(representation.init(4)) == 4 * bytes_of(representation.init(1)) <= bytes_of(representation.init(4, 0, True))
