"""Light nearby, which points around a record see in other directions than the record."""
from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.check.particles import normalised, uniform_directions, vector
from olpm_bench.check.picture import of_density
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import Panel, Verdict
from representations.interface import ParticleBatch

RECORDS, PARTICLES, HELD_OUT = 64, 400, 200     # HELD_OUT: directions of each record
DISTANCE = 1.0, 2.0         # of the light from the record [scene units]
SIZE, PLACES = 0.03, 0.1   # deviations of points of the light, and of those on the surface [scene units]
LITTLE = 0.1                # of the cosine in q, as a path tracer has some
LEAST = 0.02                # nats to be gained by asking from the right place, over asking from its mirror image
SHARE = 0.01                # of that gain, at least, over asking from the record: a quarter for Gaussians, less for wide cones
SLACK = 0.05                # nats that may be lost by learning from several places


def aim(representation: Any, seed: int) -> Verdict:
    """Who minds where it is asked makes held-out directions more likely if asked from where they were seen than from the record,
    or from its other side.  It minds where particles landed, too: that teaches as much as what they would be at the record.

    Who never minds, as the contract permits, passes.
    """
    rng = np.random.default_rng([15, seed])
    light = normalised(uniform_directions(RECORDS, rng) + np.array([0, 0, 0.5])) * rng.uniform(*DISTANCE, (RECORDS, 1))

    def seen(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Records, points around them, and points of their lights."""
        record = np.repeat(np.arange(RECORDS), n)
        place = PLACES * rng.standard_normal((len(record), 3)) * [1, 1, 0]
        return record, place, light[record] + SIZE * rng.standard_normal((len(record), 3))

    def teach(place: np.ndarray) -> Any:
        to_light = source - place
        distance = mi.Float(np.linalg.norm(to_light, axis=1).astype(np.float32))
        batch = ParticleBatch.from_arrays(vector(normalised(to_light)), dr.ones(mi.Float, len(record)),
                                          mi.UInt32(record.astype(np.uint32)), RECORDS, distance, vector(place))
        state = representation.update(representation.init(RECORDS, seed, True), batch, seed)
        dr.eval(state)
        return state

    def likelihood(state: Any, place: np.ndarray | None) -> float:
        at = None if place is None else vector(place)
        pdf = as_numpy(representation.pdf(state, mi.UInt32(asked.astype(np.uint32)), vector(wo), True, at), len(wo))
        return float(np.log(LITTLE * wo[:, 2] / np.pi + (1 - LITTLE) * pdf).mean())

    record, landed, source = seen(PARTICLES)
    asked, beside, target = seen(HELD_OUT)
    wo = normalised(target - beside)
    state = teach(landed)
    here, record_only, mirrored = (likelihood(state, place) for place in (beside, None, -beside))
    if here == record_only == mirrored:
        return Verdict(True, "does not mind where it is asked", None, None)
    at_record = likelihood(teach(np.zeros_like(landed)), beside)
    gain = here - mirrored
    margin = min(gain - LEAST, here - record_only - SHARE * gain, here - at_record + SLACK)
    words = (f"mean ln q of directions to light nearby: {here:.3f} asked from there, {record_only:.3f} from the record, "
             f"{mirrored:.3f} from its other side; {at_record:.3f} if learnt as seen from the record")
    return Verdict(margin >= 0, "gain, over the least [nats]", margin, 0.0, words, note=words,
                   picture=lambda: _picture(representation, state, beside[0]))


def _picture(representation: Any, state: Any, at: np.ndarray) -> list[Panel]:
    return [of_density(f"pdf of record 0, asked from {where}", lambda wo, p=place: as_numpy(  # type: ignore[misc]
        representation.pdf(state, dr.zeros(mi.UInt32, len(wo)), vector(wo), True, vector(np.tile(p, (len(wo), 1)))), len(wo)))
        for where, place in (("the record", 0 * at), (f"({at[0]:.2g}, {at[1]:.2g}, 0)", at))]
