"""Densities that reach whatever narrow ones may hide: half uniform, half around the particles at all scales."""
from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.check.particles import Particles, vector

SMALLEST, LARGEST = 2e-5, 2.0       # chords at which it looks around each particle
AROUND = 400                        # particles of a record that it looks around, at most: random ones
MANY = 10_000               # particles of a record among which identical ones are looked for, at most
LOG_RANGE = float(np.log(LARGEST / SMALLEST))


class Proposals:
    """q(wo) [1/sr] of each record; half of it lies around the record's particles, at times below the horizon.

    Particle i is chosen with probability (1/n + w_i / sum w) / 2.  Around it the chord c is log-uniform: per solid angle
    1 / (2 pi c^2 ln(LARGEST / SMALLEST)), since a cap within the chord c has the area pi c^2.  Records without particles have
    q = 1 / (2 pi).
    """

    def __init__(self, particles: Sequence[Particles], rng: np.random.Generator) -> None:
        particles = [_distinct(*own) if AROUND < len(own[1]) <= MANY else own for own in particles]
        self.complete = np.array([len(weight) <= AROUND for _, weight in particles])      # looks around all of them
        kept = []
        for wo, weight in particles:
            some = rng.choice(len(wo), AROUND, replace=False) if len(wo) > AROUND else slice(None)
            kept.append((wo[some], weight[some]))
        owner = np.repeat(np.arange(len(kept)), [len(weight) for _, weight in kept])
        owned = np.column_stack([owner, np.concatenate([wo for wo, _ in kept])])
        axes, index = np.unique(owned, axis=0, return_inverse=True)
        self.axis, owner = axes[:, 1:], axes[:, 0].astype(int)
        self.count = np.bincount(owner, minlength=len(kept))
        self.first = np.cumsum(self.count) - self.count
        mass, even = np.bincount(index.ravel(), np.concatenate([weight for _, weight in kept]), len(axes)), 1 / self.count[owner]
        total = np.bincount(owner, mass, len(kept))[owner]
        self.mass = np.where(total > 0, (even + mass / np.where(total > 0, total, 1)) / 2, even)
        below = np.cumsum(self.mass) - self.mass
        self.cumulative = owner + (below - below[self.first[owner]] + self.mass)

    def around(self, record: int) -> np.ndarray:
        """Distinct particles of a record [n, 3]."""
        return self.axis[self.first[record]:self.first[record] + self.count[record]]

    def at(self, record: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Directions [n, 3] of the records [n] from points of the unit cube [n, 3]."""
        z, phi = 1 - u[:, 1], 2 * np.pi * u[:, 2]
        r = np.sqrt(1 - z * z)
        wo = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
        near = (u[:, 0] < 0.5) & (self.count[record] > 0)
        if not near.any():
            return wo
        some = record[near]
        chosen = np.searchsorted(self.cumulative, some + 2 * u[near, 0], side="right")
        axis = self.axis[np.clip(chosen, self.first[some], self.first[some] + self.count[some] - 1)]
        c, phi = SMALLEST * np.exp(LOG_RANGE * u[near, 1]), phi[near]
        s = np.cross(axis, np.where(np.abs(axis[:, :1]) < 0.6, [[1, 0, 0]], [[0, 1, 0]]))
        s /= np.linalg.norm(s, axis=-1, keepdims=True)
        tangent = s * np.cos(phi)[:, None] + np.cross(axis, s) * np.sin(phi)[:, None]
        wo[near] = axis * (1 - c * c / 2)[:, None] + tangent * (c * np.sqrt(1 - c * c / 4))[:, None]
        return wo

    def pdf(self, record: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """q at directions above the horizon [n]."""
        if len(wo) == 0:                    # all samples have failed
            return np.zeros(0)
        order = np.argsort(record, kind="stable")           # neighbours loop over the same particles
        first, count = self.first[record[order]], self.count[record[order]]
        axes, mass = vector(self.axis), mi.Float(self.mass.astype(np.float32))
        i, end = mi.UInt32(first.astype(np.uint32)), mi.UInt32((first + count).astype(np.uint32))
        direction = vector(wo[order])

        def add(i: mi.UInt32, found: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            c2 = dr.squared_norm(dr.gather(mi.Vector3f, axes, i) - direction)
            inside = (c2 > SMALLEST**2) & (c2 < LARGEST**2)
            return i + 1, found + dr.select(inside, dr.gather(mi.Float, mass, i) / c2, 0)

        _, found = dr.while_loop((i, dr.zeros(mi.Float, len(wo))), lambda i, _: i < end, add, mode="symbolic")
        share, q = np.where(count > 0, 0.5, 0), np.empty(len(wo))
        q[order] = (1 - share) / (2 * np.pi) + share / (2 * np.pi * LOG_RANGE) * np.array(found, np.float64)
        return q


def _distinct(wo: np.ndarray, weight: np.ndarray) -> Particles:
    """Particles of the same direction as one."""
    axes, index = np.unique(wo, axis=0, return_inverse=True)
    return axes, np.bincount(index.ravel(), weight, len(axes))
