"""Learning takes no more memory with more particles."""
from __future__ import annotations

import drjit as dr
import numpy as np

from olpm_bench.check.particles import MILLION, many
from olpm_bench.check.purity import Trials, both
from olpm_bench.check.verdict import Verdict
from representations.state import bytes_of

COUNTS = (100, 10_000, MILLION)     # particles of each of two records, one batch after the other


@both
def stay_bounded(trials: Trials) -> Verdict:
    """Bytes of a record don't depend on how many particles it has seen, unless it is declared that they grow."""
    rng, state = np.random.default_rng([11, trials.seed]), trials.init(2, trials.seed)
    seen, found = [0], [bytes_of(state) / 2]
    for index, n in enumerate(COUNTS):
        state = trials.update(state, [many(n, rng)] * 2, trials.seed + index)
        dr.eval(state)
        seen.append(seen[-1] + n)
        found.append(bytes_of(state) / 2)
    bounded = len(set(found)) == 1
    words = f"{', '.join(f'{b:.0f} bytes after {n}' for n, b in zip(seen, found, strict=True))} particles a record"
    note = f"{found[0]:.0f} bytes a record, whatever it has seen" if bounded else words
    return Verdict(bounded or trials.grows, "bytes a record, over those at first", max(found) / max(found[0], 1),
                   None if trials.grows else 1.0, words, note=f"{note}{', as declared' if trials.grows and not bounded else ''}")
