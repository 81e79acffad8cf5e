"""Cones around particles: an adaptive kernel density estimate.

Hey & Purgathofer 2002, "Importance sampling with hemispherical particle footprints"; constants as used for the
comparison in Vorba et al. 2014.  Two departures, both our choice.  The original draws a direction uniformly on the
cone's disk and reports the density of a cone uniform in solid angle; here it is uniform in solid angle in both.  The
original fits one batch; here a record keeps a uniform sample of all particles that it has seen, so that it can go on
learning in constant memory.
"""
from __future__ import annotations

import functools
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from representations import discrete
from representations.cosine import cosine_pdf, sample_cosine
from representations.interface import ParticleBatch
from representations.parallax import aim
from representations.state import join

GRID = 64                   # cells along each side of the square around the projected hemisphere
FOOTPRINT = 240             # radius of a cone, in units of solid angle of a cell / particles around the cell
SMALLEST_RADIUS = 5e-5      # narrower cones fall between the unit vectors that float32 can hold
CHUNK = 1024                # records whose grids (17 kB each) are in memory at once


@dataclass
class HeyState:
    """A record that has seen no particle is the cosine lobe."""
    seen: mi.UInt32         # [n_records] particles of positive weight so far
    weight: mi.Float        # [n_records * cones] of the particles kept; 0 in free slots, which are the last ones
    cumulative: mi.Float    # [n_records * cones] inclusive sum of `weight` over the slots of a record
    cone: mi.Float          # [n_records * cones * 4] axis (x, y, z), chord^2: wo is inside if |wo - axis|^2 < chord^2
    near: mi.Float          # [n_records * cones] 1 / distance of where the particle came from; empty without parallax


class HeyCones:
    """p(wo) = sum_i w_i [wo in cone i] / (solid angle of cone i) / sum_i w_i.

    The sine of a cone's half angle is inversely proportional to the density of kept particles around it, and at most
    the cosine of its axis, so that the cone stays above the horizon.

    cones: particles that a record keeps, 1 to 4096 [250 in Vorba et al. 2014].
    """

    def __init__(self, cones: int = 250) -> None:
        if not 1 <= cones <= 4096:
            raise ValueError(f"cones = {cones!r}: must be in 1 .. 4096")
        self.cones = cones

    def init(self, n_records: int, seed: int = 0, parallax: bool = False) -> HeyState:
        n = n_records * self.cones
        return HeyState(seen=dr.zeros(mi.UInt32, n_records), weight=dr.zeros(mi.Float, n),
                        cumulative=dr.zeros(mi.Float, n), cone=dr.zeros(mi.Float, 4 * n),
                        near=dr.zeros(mi.Float, n if parallax else 0))

    def update(self, state: HeyState, batch: ParticleBatch, seed: int = 0) -> HeyState:
        """Add a batch.

        Raises:
            ValueError: the batch and the state have not as many records.
        """
        n_records = len(state.seen)
        if batch.n_records != n_records:
            raise ValueError(f"a batch of {batch.n_records} records for a state of {n_records}")
        if len(batch) == 0:
            return state
        wo, inverse_distance = batch.aimed() if len(state.near) else (batch.wo, None)
        newcomer, seen = self._reservoir(state.seen, batch, seed)
        replaced = newcomer > 0
        kept = dr.gather(mi.Vector4f, state.cone, dr.arange(mi.UInt32, len(newcomer)))
        axis = dr.select(replaced, dr.gather(mi.Vector3f, wo, newcomer - 1, replaced), mi.Vector3f(kept.xyz))
        weight = dr.select(replaced, dr.gather(mi.Float, batch.weight, newcomer - 1, replaced), state.weight)
        near = state.near if inverse_distance is None else dr.select(
            replaced, dr.gather(mi.Float, inverse_distance, newcomer - 1, replaced), state.near)
        dr.eval(axis, weight, near, seen)
        chord2 = self._chord2(axis, weight > 0, n_records)
        return HeyState(seen=seen, weight=weight, cumulative=discrete.accumulate(weight, self.cones),
                        cone=dr.ravel(mi.Vector4f(axis.x, axis.y, axis.z, chord2)), near=near)

    def sample(self, state: HeyState, record: mi.UInt32, sample1: mi.Float, sample2: mi.Point2f,
               active: mi.Bool = True, at: mi.Vector3f | None = None) -> tuple[mi.Vector3f, mi.Float]:
        total = discrete.total(state.cumulative, self.cones, record, active)
        chosen = discrete.choose(state.cumulative, self.cones, record, sample1 * total, active)
        cone = self._cone(state, record * self.cones + chosen, active, at)
        versine = 0.5 * cone.w * sample2.x              # 1 - cos of the angle to the axis
        sin_phi, cos_phi = dr.sincos(2 * dr.pi * sample2.y)
        sin_alpha = dr.safe_sqrt(versine * (2 - versine))
        local = mi.Vector3f(sin_alpha * cos_phi, sin_alpha * sin_phi, 1 - versine)
        wo = dr.select(total > 0, mi.Frame3f(mi.Vector3f(cone.xyz)).to_world(local), sample_cosine(sample2)[0])
        return wo, self._density(state, record, wo, total, active, at)

    def pdf(self, state: HeyState, record: mi.UInt32, wo: mi.Vector3f, active: mi.Bool = True,
            at: mi.Vector3f | None = None) -> mi.Float:
        return self._density(state, record, wo, discrete.total(state.cumulative, self.cones, record, active), active, at)

    def _density(self, state: HeyState, record: mi.UInt32, wo: mi.Vector3f, total: mi.Float,
                 active: mi.Bool, at: mi.Vector3f | None) -> mi.Float:
        """Density [1/sr] at `wo` of a record whose particles weigh `total`; a loop over all its cones."""
        first = record * self.cones
        end = first + dr.minimum(dr.gather(mi.UInt32, state.seen, record, active & (wo.z > 0)), self.cones)

        def add(i: mi.UInt32, found: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            cone = self._cone(state, i, True, at)
            inside = dr.squared_norm(wo - mi.Vector3f(cone.xyz)) < cone.w
            return i + 1, found + dr.gather(mi.Float, state.weight, i, inside) / cone.w

        _, found = dr.while_loop((first, mi.Float(0)), lambda i, _: i < end, add, mode="symbolic")
        # Archimedes: the cap of a unit sphere within the chord c of its pole has the area pi c^2.
        return dr.select(total > 0, found / total * dr.inv_pi, cosine_pdf(wo))

    def _cone(self, state: HeyState, i: mi.UInt32, active: mi.Bool, at: mi.Vector3f | None) -> mi.Vector4f:
        """Axis and squared chord of cone i, as seen from `at`.  What turns below the horizon is lost: those samples fail."""
        cone = dr.gather(mi.Vector4f, state.cone, i, active)
        if at is not None and len(state.near):
            x, y, z, _ = aim((cone.x, cone.y, cone.z), dr.gather(mi.Float, state.near, i, active), at)
            cone = mi.Vector4f(x, y, z, cone.w)
        return cone

    def _reservoir(self, seen: mi.UInt32, batch: ParticleBatch, seed: int) -> tuple[mi.UInt32, mi.UInt32]:
        """Which particles enter which slots so that every particle seen is equally likely to be kept.

        Algorithm R (Vitter 1985), all particles at once: number t replaces slot j = floor(u_t (t + 1)) if there is
        such a slot, and of those that want the same slot the last one gets it, as if they had come one by one.

        Returns:
            1 + the particle's index in the batch, or 0 where a slot stays as it was [n_records * cones]; and the
            number of particles seen with this batch [n_records].
        """
        n = len(batch)
        useful = (batch.weight > 0) & (batch.wo.z > 0)
        rank = dr.prefix_sum(join(mi.UInt32(useful), dr.zeros(mi.UInt32, 1)))       # [n + 1] useful ones before
        before = dr.gather(mi.UInt32, rank, batch.offset)                           # [n_records + 1]
        record = dr.arange(mi.UInt32, batch.n_records)
        start = seen - dr.gather(mi.UInt32, before, record)                         # wraps around, and back in `t`
        t = dr.gather(mi.UInt32, rank, dr.arange(mi.UInt32, n)) + dr.gather(mi.UInt32, start, batch.record)
        # With the default of 4 rounds, numbers for neighbouring t correlate (0.45 was seen).
        u = mi.sample_tea_32(t, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF), rounds=8)[0]
        slot = dr.select(t < self.cones, t, dr.mul_hi(u, t + 1))
        newcomer = dr.zeros(mi.UInt32, batch.n_records * self.cones)
        dr.scatter_reduce(dr.ReduceOp.Max, newcomer, dr.arange(mi.UInt32, 1, n + 1), batch.record * self.cones + slot,
                          useful & (slot < self.cones))
        return newcomer, start + dr.gather(mi.UInt32, before, record + 1)

    def _chord2(self, axis: mi.Vector3f, used: mi.Bool, n_records: int) -> mi.Float:
        """Squared chord of the cones around the particles in the slots [n_records * cones].

        Each particle is splatted on the 3 x 3 cells of a grid over the projected hemisphere that surround it; then
        sin(half angle) = FOOTPRINT * solid angle of the cell / particles on the cell.
        """
        width = GRID + 2                                            # a border: no clipping of the 3 x 3 cells
        chords = []
        for first in range(0, n_records, CHUNK):
            n = min(CHUNK, n_records - first)
            i = dr.arange(mi.UInt32, n * self.cones)
            slot = i + dr.opaque(mi.UInt32, first * self.cones)
            d, here = dr.gather(mi.Vector3f, axis, slot), dr.gather(mi.Bool, used, slot)
            x, y = (dr.clip(mi.Int32((v + 1) * (GRID / 2)), 0, GRID - 1) for v in (d.x, d.y))
            corner = mi.UInt32(y * width + x) + i // self.cones * (width * width)
            grid = dr.zeros(mi.UInt32, n * width * width)
            dr.scatter_add(grid, mi.UInt32(1), corner + (width + 1), here)
            count = mi.UInt32(0)
            for row in range(3):
                for column in range(3):
                    count += dr.gather(mi.UInt32, grid, corner + (row * width + column), here)
            # A cell of width 2 / GRID on the disk has the solid angle 4 / (GRID^2 cos theta); none outside the disk.
            cx, cy = ((mi.Float(v) + 0.5) * (2 / GRID) - 1 for v in (x, y))
            solid_angle = 4 / GRID**2 / dr.safe_sqrt(1 - cx * cx - cy * cy)
            radius = dr.minimum(FOOTPRINT * solid_angle / mi.Float(count), d.z)
            radius = dr.maximum(radius, SMALLEST_RADIUS)
            chord2 = 2 * radius * radius / (1 + dr.safe_sqrt(1 - radius * radius))      # sin -> 2 (1 - cos)
            chords.append(dr.select(here, chord2, 0))
            dr.eval(chords[-1])
        chord2 = functools.reduce(join, chords, mi.Float())
        dr.eval(chord2)         # `join` scatters, and what is built on a pending scatter can't be scattered again
        return chord2
