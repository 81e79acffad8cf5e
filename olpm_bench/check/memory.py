"""Learning takes no more memory with more particles, or with more batches."""
from __future__ import annotations

import drjit as dr
import numpy as np

from olpm_bench.check.particles import MILLION, many
from olpm_bench.check.trials import Trials, both
from olpm_bench.check.verdict import Verdict
from representations.state import bytes_of

COUNTS = (100, 10_000, MILLION)     # particles of each of two records, one batch after the other


@both
def stay_bounded(trials: Trials) -> Verdict:
    """Bytes of a record don't depend on how many particles it has seen in a few large batches, unless it is declared that they
    grow; `long_run` sees many batches.
    """
    rng, state = np.random.default_rng([11, trials.seed]), trials.init(2, trials.seed)
    seen, found = 0, {"at first": bytes_of(state) / 2}
    for index, n in enumerate(COUNTS):
        state = trials.update(state, [many(n, rng)] * 2, trials.seed + index)
        dr.eval(state)
        seen += n
        found[f"after {seen} particles"] = bytes_of(state) / 2
    first, most = found["at first"], max(found.values())
    bounded = len(set(found.values())) == 1
    words = ", ".join(f"{size:.0f} bytes a record {when}" for when, size in found.items())
    note = f"{first:.0f} bytes a record, whatever it has seen" if bounded else words
    return Verdict(bounded or trials.grows, "bytes a record, over those at first", most / max(first, 1),
                   None if trials.grows else 1.0, words, note=f"{note}{', as declared' if trials.grows and not bounded else ''}")
