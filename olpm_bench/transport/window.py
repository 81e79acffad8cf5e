"""The weight window of particles: what roulette and splitting keep alike.

Vorba and Křivánek (2016) keep alike what particles are expected to contribute: weight times the fluence V of the
particles they are guided by, importons for photons.  Hits of photons then lie as densely as Phi V, Phi their own fluence: as
light that reaches the camera does.  In a bright room behind a gap most of it dwells on the wrong side.
Particles are there to teach records, all those of use: an error that falls as 1 / n a record, and counts by how much of the
light passes the record, is least over all if n goes as (Phi V)^(1/2).  So the value of a particle of weight 1 is

    U = (Phi V)^a / Phi,  a = `EXPONENT`,        photons and importons alike, with Phi and V exchanged

and particles of the same U times weight lie as densely as (Phi V)^a, those of both kinds.  Estimates decide
what is traced and never what is expected: any are unbiased.
"""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from olpm_bench.transport.guide import Guide

# [L], relative to the total flux of the emitters, or to 1 for importons.  Its lower end leaves nearly all particles alone:
# roulette on throughput kills exactly the guided ones, which carry little for a reason.
LIGHTEST, HEAVIEST = 1e-6, 2 + 1e-6
# Relative to the aim: Vorba and Křivánek's, whose upper end is 5 times the lower.
LOW, HIGH = 1 / 3, 5 / 3
LEAST_SURVIVAL = 0.05           # probability with which a particle passes its roulette: bounds what wrong estimates can do
# Of Phi V in the density of hits; 1: that of contributions, 0: alike everywhere.  The least error, at 1 / 2, is flat; a
# little less keeps a quarter of the photons in the dark room of door_ajar (gap 7 cm, passes 2 to 6, one seed: 28 to 25.5 %).
EXPONENT = 0.45


@dataclass
class Window:
    """Weight times `value` is to be about `aim`; where `value` is 0, or there is no record, the window of [L] holds."""
    value: mi.Float         # [records of the guide] of a particle of weight 1
    aim: mi.Float           # [1]


def by_contribution(guide: Guide, own: Guide, hits: float, least: mi.Float) -> Window:
    """The window for particles that `guide` guides and that `own` learns from; both have records.

    Args:
        hits: how many hits a particle shall leave on average.
        least: [1] flux [per emitted particle] of one particle of a pass: a record of no fluence may have missed so much.
    """
    p, n, *_ = guide.cache.row(dr.arange(mi.UInt32, guide.records))
    fluence = dr.maximum(own.fluence_at(p, n), least / guide.areas())
    density = (guide.estimates.fluence * fluence) ** EXPONENT
    window = Window(density / fluence, dr.sum(density * guide.areas()) / dr.opaque(mi.Float, hits))
    dr.eval(window)
    return window
