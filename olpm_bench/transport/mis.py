"""Multiple importance sampling: the weights of two techniques that can make the same direction (Veach 1997).

Densities come from BSDFs, emitters and representations, which other people write too.  Mitsuba's black
environment map answers NaN, for one.  `density` says what each odd value counts as, and everything that
weighs by a density goes through it, so that the weights of two techniques always add up to 1 where one of
them can make the direction.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi


def density(pdf: mi.Float) -> mi.Float:
    """A density as far as it can be used.

    NaN and negative values count as 0, infinity as the largest finite number.
    """
    return dr.select(pdf > 0, dr.minimum(pdf, dr.largest(mi.Float)), 0)


def relative_density(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """How many times as densely technique b makes a direction as technique a; infinite where a can't."""
    return dr.select(pdf_a > 0, density(pdf_b) / dr.minimum(pdf_a, dr.largest(mi.Float)), dr.inf)


def power_heuristic(relative: mi.Float) -> mi.Float:
    """Weight of a sample of technique a by the power heuristic, from the `relative_density` of technique b.

    It takes the ratio of the densities: their squares overflow where a rough interface is nearly specular.
    """
    return dr.rcp(1 + dr.square(relative))


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Weight of a sample of technique a by the power heuristic; 0 where technique a can't make it."""
    return power_heuristic(relative_density(pdf_a, pdf_b))


def balance_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Weight of a sample of technique a by the balance heuristic; 0 where technique a can't make it."""
    return dr.rcp(1 + relative_density(pdf_a, pdf_b))
