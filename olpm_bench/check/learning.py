"""update() learns: known densities become more likely with more particles."""
from __future__ import annotations

import itertools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.particles import batch, vector
from olpm_bench.check.picture import of_density, over_disk
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import Panel, Picture, PValues, Verdict
from representations.square import to_hemisphere

COUNTS = (100, 1_000, 10_000)       # particles of a record
PARTS = 10                  # on-line batches of the second count
REPLICATES = 8              # records that learn the same density from particles of their own
HELD_OUT = 2_000            # directions of each density
LEAST = 0.02                # nats that must be gained over the untrained density
SLACK = 0.05                # nats that more particles may lose: some keep a part of them, and kernels become narrower


class Known:
    """A density on the hemisphere: a mixture of normal distributions on the square, cut at its border, x and y independent."""

    def __init__(self, weight: list[float], mean: list[tuple[float, float]], width: list[tuple[float, float]]) -> None:
        self.weight, self.mean, self.width = np.array(weight) / sum(weight), np.array(mean), np.array(width)
        self.low, self.high = stats.norm.cdf((0 - self.mean) / self.width), stats.norm.cdf((1 - self.mean) / self.width)

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Directions [n, 3]."""
        j = rng.choice(len(self.weight), n, p=self.weight)
        u = self.low[j] + (self.high - self.low)[j] * rng.random((n, 2))
        s = np.clip(self.mean[j] + self.width[j] * stats.norm.ppf(u), 1e-6, 1 - 1e-6).astype(np.float32)
        wo = to_hemisphere(mi.Point2f(*(mi.Float(np.ascontiguousarray(s[:, i])) for i in (0, 1))))
        return np.array(wo).T


DENSITIES = {
    "lobes": Known([4, 3, 2, 1], [(.3, .3), (.7, .4), (.4, .8), (.8, .8)], [(.03, .05), (.1, .06), (.05, .02), (.02, .02)]),
    "window": Known([1, 1, 1, 1], [(.55, .55), (.65, .55), (.55, .65), (.65, .65)], [(.04, .04)] * 4),
    "grazing": Known([3, 1], [(.03, .4), (.5, .5)], [(.03, .08), (.3, .3)]),
    "wide": Known([1], [(.5, .5)], [(.35, .35)]),
}
HARD = [name for name in DENSITIES if name != "wide"]       # that a cosine does not fit anyway


def learn(representation: Any, seed: int, constant: bool, level: float) -> Verdict:
    """Mean ln q of held-out directions, q = (cos / pi + pdf) / 2 as a path tracer uses it, rises with the number of particles.

    `constant`: declared to learn nothing.
    """
    rng = np.random.default_rng([12, seed])
    owner = [name for name in DENSITIES for _ in range(REPLICATES)]
    particles = [DENSITIES[name].sample(max(COUNTS), rng) for name in owner]
    held_out = {name: DENSITIES[name].sample(HELD_OUT, rng) for name in DENSITIES}
    wo = np.concatenate([held_out[name] for name in owner])
    record = mi.UInt32(np.repeat(np.arange(len(owner), dtype=np.uint32), HELD_OUT))

    def train(*ends: int) -> Any:
        state = representation.init(len(owner), seed)
        for index, (begin, end) in enumerate(itertools.pairwise((0, *ends))):
            ones = np.ones(end - begin, np.float32)
            state = representation.update(state, batch([(p[begin:end], ones) for p in particles]), seed + index)
            dr.eval(state)
        return state

    def likelihood(state: Any) -> np.ndarray:
        """[densities, REPLICATES]."""
        pdf = as_numpy(representation.pdf(state, record, vector(wo)), len(wo))
        return np.log((wo[:, 2] / np.pi + pdf) / 2).reshape(len(DENSITIES), REPLICATES, HELD_OUT).mean(-1)

    middle = COUNTS[1]
    found = {0: likelihood(train()), **{n: likelihood(train(n)) for n in COUNTS}}
    online = likelihood(train(*range(middle // PARTS, middle + 1, middle // PARTS)))
    loss = (found[middle] - online).mean(1)
    note = (f"mean ln q {', '.join(f'{v.mean():.3f} ({n})' for n, v in found.items())} particles; {middle} in {PARTS} batches "
            f"instead of 1 lose {', '.join(f'{v:.3f} ({name})' for name, v in zip(DENSITIES, loss, strict=True))}")
    if constant:
        same = all(np.array_equal(v, found[0]) for v in (*found.values(), online))
        return Verdict(same, "densities that learn", float(not same), 0.0, "" if same else "it was declared constant, but learns",
                       note=f"{note}{', as declared' if same else ''}")

    def picture(name: str, n: int) -> Picture:
        return lambda: _beside(representation, train(n), owner.index(name), name, n)

    p_values = PValues()
    after = {f"{n} particles": found[n] for n in COUNTS[1:]} | {f"{middle} particles in {PARTS} batches": online}
    least, name, how = min(((v - found[0]).mean(1)[i], name, how) for how, v in after.items()
                           for i, name in enumerate(DENSITIES) if name in HARD)
    if not least >= LEAST:
        words = f"'{name}' is {least:+.3f} nats more likely after {how} than before: it does not learn"
        return Verdict(False, "least gain [nats]", float(least), LEAST, words, note=note, picture=picture(name, max(COUNTS)))
    for before, n in itertools.pairwise(COUNTS):
        for name, gain in zip(DENSITIES, found[n] - found[before], strict=True):
            p = stats.ttest_1samp(gain + SLACK, 0, alternative="less").pvalue
            words = f"'{name}' is {gain.mean():+.3f} nats more likely after {n} particles than after {before}"
            p_values.add(p, words, picture(name, n))
    return p_values.verdict(level, note)


def _beside(representation: Any, state: Any, record: int, name: str, n: int) -> list[Panel]:
    """The known density beside what was learnt."""
    truth = DENSITIES[name].sample(1 << 20, np.random.default_rng(1))

    def pdf(wo: np.ndarray) -> np.ndarray:
        return as_numpy(representation.pdf(state, dr.full(mi.UInt32, record, len(wo)), vector(wo)), len(wo))

    return [Panel(f"'{name}': histogram of the truth", over_disk(truth, np.full(len(truth), 1 / len(truth)))),
            of_density(f"pdf after {n} particles", pdf)]
