"""The particles that representations are trained on: the states in which a density must be one."""
from __future__ import annotations

import zlib
from collections.abc import Callable

import mitsuba as mi
import numpy as np

from representations.interface import ParticleBatch

Particles = tuple[np.ndarray, np.ndarray]       # of one record in one batch: wo [n, 3], weight [n]
BATCHES = 3
MILLION = 1_000_000
IDENTICAL = 3_000       # particles of one direction
EDGE = 1e-4             # elevation z of grazing particles


def normalised(v: np.ndarray) -> np.ndarray:
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(np.float32)


def uniform_directions(n: int, rng: np.random.Generator) -> np.ndarray:
    """Uniform over the hemisphere [n, 3]."""
    z, phi = 1 - rng.random(n), 2 * np.pi * rng.random(n)
    r = np.sqrt(1 - z * z)
    return normalised(np.stack([r * np.cos(phi), r * np.sin(phi), z], -1))


def lobes(n: int, rng: np.random.Generator, modes: int = 12) -> np.ndarray:
    """A few lobes of about 1 to 20 degrees around random directions [n, 3]."""
    axis, width = uniform_directions(modes, rng), 10 ** rng.uniform(-1.8, -0.5, modes)
    j = rng.integers(0, modes, n)
    v = axis[j] + width[j, None] * rng.normal(size=(n, 3))
    v[:, 2] = np.abs(v[:, 2]) + 1e-3
    return normalised(v)


def collinear(n: int, rng: np.random.Generator) -> np.ndarray:
    """On one half of a great circle [n, 3]."""
    axes = normalised(rng.normal(size=(2, 3)))
    angle = np.pi * rng.random(n)[:, None]
    v = np.cos(angle) * axes[0] + np.sin(angle) * np.cross(axes[0], np.cross(axes[1], axes[0]))
    v[:, 2] = np.abs(v[:, 2]) + 1e-6
    return normalised(v)


def grazing(n: int, rng: np.random.Generator) -> np.ndarray:
    """At the elevation z = `EDGE` [n, 3]."""
    phi = 2 * np.pi * rng.random(n)
    r = np.sqrt(1 - EDGE**2)
    return normalised(np.stack([r * np.cos(phi), r * np.sin(phi), np.full(n, EDGE)], -1))


def identical_and(n: int, rng: np.random.Generator) -> np.ndarray:
    """`IDENTICAL` times the same direction, and n others of some lobes after them [IDENTICAL + n, 3]."""
    return np.concatenate([np.repeat(uniform_directions(1, rng), IDENTICAL, axis=0), lobes(n, rng)])


def vector(wo: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(*(mi.Float(np.ascontiguousarray(wo[:, i], np.float32)) for i in range(3)))


def nothing() -> Particles:
    return np.zeros((0, 3), np.float32), np.zeros(0, np.float32)


def equal(wo: np.ndarray) -> Particles:
    """Of weight one each."""
    return wo, np.ones(len(wo), np.float32)


def many(n: int, rng: np.random.Generator) -> Particles:
    """Of log-normal weights in a few lobes."""
    return lobes(n, rng), rng.lognormal(size=n).astype(np.float32)


def weighty(particles: Particles, rng: np.random.Generator) -> Particles:
    """A few of equal weights, which together weigh as much as the given ones."""
    return lobes(8, rng), np.full(8, particles[1].sum() / 8, np.float32)


def and_few(batches: list[Particles], rng: np.random.Generator) -> list[Particles]:
    """Batches, and one of few `weighty` particles: who puts off the work for small batches is out of date."""
    return [*batches, weighty(batches[-1], rng)]


# Condition -> the batches of a record in it; `copy` numbers the records of a condition.
Condition = Callable[[np.random.Generator, int], list[Particles]]
CONDITIONS: dict[str, Condition] = {
    "untrained": lambda rng, copy: [],
    "one particle": lambda rng, copy: [equal(uniform_directions(1, rng))],
    "ten identical": lambda rng, copy: [equal(np.repeat(uniform_directions(1, rng), 10, axis=0))],
    "collinear": lambda rng, copy: [equal(collinear(200, rng))],
    "grazing": lambda rng, copy: [equal(grazing((1, 150, 300)[copy % 3], rng))],
    "heavy tails": lambda rng, copy: [(lobes(150, rng), (10 ** rng.uniform(-6, 6, 150)).astype(np.float32))],
    "zero weights": lambda rng, copy: [(lobes(100, rng), (rng.random(100) < 0.5 * (copy % 2)).astype(np.float32))],
    "few at a time": lambda rng, copy: [many(int(n), rng) for n in rng.integers(0, 60, BATCHES)],
    "many modes": lambda rng, copy: [many(400, rng)],
    "on-line": lambda rng, copy: [many(120, rng) for _ in range(BATCHES)],
    "none at first": lambda rng, copy: [nothing(), nothing(), many(200, rng)],
    "more than a thousand": lambda rng, copy: and_few([many(100, rng), many(1_500, rng)], rng),
}
LONG: dict[str, Condition] = {          # that take time, of one record each
    "a million": lambda rng, copy: and_few([many(100, rng), many(MILLION, rng)], rng),
    "thousands identical": lambda rng, copy: [equal(np.repeat(uniform_directions(1, rng), IDENTICAL, axis=0))],
    "thousands identical and others": lambda rng, copy: [equal(identical_and(40, rng)), equal(identical_and(20, rng))],
}


def distances(n: int, rng: np.random.Generator) -> np.ndarray:
    """Lengths of last segments over three decades, a fifth of them infinite [n]."""
    finite = rng.random(n) < 0.8
    return np.where(finite, 10 ** rng.uniform(-1.5, 1.5, n), np.inf).astype(np.float32)


def landing(wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where on a disk of radius 0.1 around the record each particle has landed [n, 3], and its distance [n], some infinite.

    The same for the same directions; particles of one direction are identical, and land on one place.
    """
    rng = np.random.default_rng([11, zlib.crc32(wo.tobytes())])
    n = min(len(wo), 1) if (wo == wo[:1]).all() else len(wo)
    phi, r = 2 * np.pi * rng.random(n), 0.1 * np.sqrt(rng.random(n))
    distance = distances(n, rng)
    place = np.stack([r * np.cos(phi), r * np.sin(phi), 0.01 * rng.normal(size=n)], -1)
    return np.broadcast_to(place, (len(wo), 3)), np.broadcast_to(distance, len(wo))


def batch(particles: list[Particles], parallax: bool = False, far: bool = False,
          unit: np.ndarray | None = None) -> ParticleBatch:
    """The particles of all records as Dr.Jit arrays, with distances as in training; for `parallax` with places, too.

    far: all distances are infinite.
    unit: what lengths are multiplied by [n_records].
    """
    if not any(len(weight) for _, weight in particles):
        return ParticleBatch.empty(len(particles))
    wo, weight = (np.concatenate([p[i] for p in particles]).astype(np.float32) for i in (0, 1))
    record = np.repeat(np.arange(len(particles), dtype=np.uint32), [len(p[1]) for p in particles])
    landed = zip(*(landing(p[0]) for p in particles if len(p[1])), strict=True)
    at, distance = (np.concatenate(values).astype(np.float32) for values in landed)
    if unit is not None:
        scale = unit[record].astype(np.float32)
        at, distance = at * scale[:, None], distance * scale
    distance = np.full_like(distance, np.inf) if far else distance
    return ParticleBatch.from_arrays(vector(wo), mi.Float(weight), mi.UInt32(record), len(particles), mi.Float(distance),
                                     vector(at) if parallax else None)
