"""Learning takes no more memory with more particles."""
from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from olpm_bench.check.particles import MILLION, batch, many
from olpm_bench.check.verdict import Verdict
from representations.state import bytes_of

COUNTS = (100, 10_000, MILLION)     # particles of each of two records, one batch after the other


def stay_bounded(representation: Any, seed: int, grows: bool) -> Verdict:
    """Bytes of a record don't depend on how many particles it has seen, unless that is declared by `grows`."""
    rng, state = np.random.default_rng([11, seed]), representation.init(2, seed)
    seen, found = [0], [bytes_of(state) / 2]
    for index, n in enumerate(COUNTS):
        state = representation.update(state, batch([many(n, rng)] * 2), seed + index)
        dr.eval(state)
        seen.append(seen[-1] + n)
        found.append(bytes_of(state) / 2)
    bounded = len(set(found)) == 1
    words = f"{', '.join(f'{b:.0f} bytes after {n}' for n, b in zip(seen, found, strict=True))} particles a record"
    note = f"{found[0]:.0f} bytes a record, whatever it has seen" if bounded else words
    return Verdict(bounded or grows, "bytes a record, over those at first", max(found) / max(found[0], 1), None if grows else 1.0,
                   words, note=f"{note}{', as declared' if grows and not bounded else ''}")
