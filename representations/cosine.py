"""The cosine lobe: the null representation, which learns nothing.

It is what every other representation falls back to for a record without particles, and the smallest example of
the contract in :mod:`representations.interface`.
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from representations.interface import ParticleBatch


def sample_cosine(sample2: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
    """Direction proportional to cos(theta), and its density cos(theta) / pi [1/sr]."""
    wo = mi.warp.square_to_cosine_hemisphere(sample2)
    return wo, cosine_pdf(wo)


def cosine_pdf(wo: mi.Vector3f) -> mi.Float:
    """cos(theta) / pi above the horizon, else 0 [1/sr]."""
    return dr.maximum(wo.z, 0) * dr.inv_pi


@dataclass
class CosineState:
    """Nothing is learnt; `count` makes the number of records known."""
    count: mi.UInt32        # [n_records] particles seen


class CosineLobe:
    """p(wo) = cos(theta) / pi, whatever the particles."""

    def init(self, n_records: int, seed: int = 0, parallax: bool = False) -> CosineState:
        return CosineState(dr.zeros(mi.UInt32, n_records))

    def update(self, state: CosineState, batch: ParticleBatch, seed: int = 0) -> CosineState:
        if batch.n_records != len(state.count):
            raise ValueError(f"a batch of {batch.n_records} records for a state of {len(state.count)}")
        return CosineState(state.count + batch.count())

    def sample(self, state: CosineState, record: mi.UInt32, sample1: mi.Float, sample2: mi.Point2f,
               active: mi.Bool = True, at: mi.Vector3f | None = None) -> tuple[mi.Vector3f, mi.Float]:
        return sample_cosine(sample2)

    def pdf(self, state: CosineState, record: mi.UInt32, wo: mi.Vector3f, active: mi.Bool = True,
            at: mi.Vector3f | None = None) -> mi.Float:
        return cosine_pdf(wo)
