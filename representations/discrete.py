"""A discrete distribution in every record: entries with masses, chosen by one uniform number."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi


def accumulate(mass: mi.Float, size: int) -> mi.Float:
    """Inclusive sums of `mass` over the `size` entries of each record [n_records * size]."""
    return dr.block_prefix_sum(mass, size, exclusive=False) if len(mass) else mi.Float(mass)


def total(cumulative: mi.Float, size: int, record: mi.UInt32, active: mi.Bool = True) -> mi.Float:
    """Mass of all entries of a record."""
    return dr.gather(mi.Float, cumulative, record * size + (size - 1), active)


def choose(cumulative: mi.Float, size: int, record: mi.UInt32, target: mi.Float,
           active: mi.Bool = True) -> mi.UInt32:
    """The first entry of a record whose cumulative mass exceeds `target`, in [0, total): never an empty one.

    ``target = sample1 * total`` is below the total after rounding too, for sample1 <= 1 - 2^-24.
    """
    first = record * size
    entry = mi.UInt32(0)
    for bit in reversed(range((size - 1).bit_length())):        # binary search: all before `entry` are too low
        probe = entry + (1 << bit)
        inside = active & (probe < size)
        below = dr.gather(mi.Float, cumulative, first + probe - 1, inside) <= target
        entry = dr.select(inside & below, probe, entry)
    return entry
