"""Grouping particles by record."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from olpm_bench.check.particles import uniform_directions, vector
from representations.interface import ParticleBatch

N, RECORDS = 5000, 40


@pytest.fixture(scope="module")
def particles() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    record = rng.integers(0, RECORDS + 5, N).astype(np.uint32)
    record[record == 7] = 8                                     # one record without particles
    return {"wo": uniform_directions(N, rng), "weight": rng.random(N).astype(np.float32), "record": record,
            "distance": rng.random(N).astype(np.float32)}


def grouped(particles: dict[str, np.ndarray], **more: mi.Float) -> ParticleBatch:
    return ParticleBatch.from_arrays(vector(particles["wo"]), mi.Float(particles["weight"]), mi.UInt32(particles["record"]),
                                     RECORDS, **more)


def test_groups_are_stable(particles: dict[str, np.ndarray]) -> None:
    """The rows of a record are its particles in their original order; records beyond the last are left out."""
    batch = grouped(particles, distance=mi.Float(particles["distance"]))
    order = np.argsort(particles["record"], kind="stable")
    order = order[particles["record"][order] < RECORDS]
    assert batch.n_records == RECORDS and len(batch) == len(order)
    assert np.array_equal(batch.record, particles["record"][order])
    assert np.array_equal(batch.weight, particles["weight"][order])
    assert np.array_equal(batch.distance, particles["distance"][order])
    assert np.array_equal(np.array(batch.wo).T, particles["wo"][order])
    expected = np.bincount(particles["record"], minlength=RECORDS + 5)[:RECORDS]
    assert np.array_equal(batch.count(), expected)
    assert np.array_equal(batch.offset, np.concatenate([[0], np.cumsum(expected)]))


def test_repeats_bit_for_bit(particles: dict[str, np.ndarray]) -> None:
    runs = [grouped(particles) for _ in range(3)]
    for other in runs[1:]:
        assert np.array_equal(runs[0].weight, other.weight) and np.array_equal(runs[0].wo, other.wo)


def test_distance_is_optional(particles: dict[str, np.ndarray]) -> None:
    batch = grouped(particles)
    assert dr.all(dr.isinf(batch.distance))


@pytest.mark.parametrize(("field", "value"), [("weight", np.nan), ("weight", np.inf), ("weight", -1),
                                              ("wo", np.nan), ("wo", np.inf)])
def test_bad_particles(particles: dict[str, np.ndarray], field: str, value: float) -> None:
    bad = {k: v.copy() for k, v in particles.items()}
    bad[field][17] = value
    with pytest.raises(ValueError, match="NaN, infinite or negative"):
        grouped(bad)


@pytest.mark.parametrize("record", [[], [RECORDS, RECORDS + 3]])
def test_no_particles(record: list[int]) -> None:
    n = len(record)
    batch = ParticleBatch.from_arrays(dr.zeros(mi.Vector3f, n), dr.zeros(mi.Float, n), mi.UInt32(record), RECORDS)
    assert len(batch) == 0 and batch.n_records == RECORDS
    assert not np.array(batch.count()).any()
