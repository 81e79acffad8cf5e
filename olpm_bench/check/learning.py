"""update() learns: known densities become more likely with more particles."""
from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from olpm_bench.check.particles import Particles, batch, equal, uniform_directions, vector
from olpm_bench.check.picture import of_density, over_disk
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import Panel, Picture, PValues, Verdict, sidak, worst_of
from representations.square import to_hemisphere

COUNTS = (100, 1_000, 10_000)       # particles of a record
PARTS = 10                  # on-line batches of the second count
REPLICATES = 8              # records that learn the same density from particles of their own
HELD_OUT = 2_000            # directions of each density
LEAST = 0.02                # nats that each `HARD` density must gain over the untrained one, and all on average by their weights
MORE = 0.05                 # nats that one of them must gain by both halves over either; ours gain 0.27, a single Gaussian 0.09
LIGHT = 0.1                 # weight of decoys, of which there are 1 / LIGHT as many as particles; those weigh 1
LITTLE = 0.1                # of the cosine in q where weights are judged: more would do for the decoys
ASIDE = 0.05                # deviation of the points from which states with parallax are asked [scene units]
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


def learn(representation: Any, seed: int, declared: Sequence[str], level: float) -> Verdict:
    """As `learn_known`, without parallax, and with it of light that is infinitely far."""
    return worst_of({"with parallax" if parallax else "": learn_known(representation, seed, declared, parallax, sidak(level, 2))
                     for parallax in (False, True)})


def learn_known(representation: Any, seed: int, declared: Sequence[str], parallax: bool, level: float) -> Verdict:
    """Mean ln q of held-out directions, q = (cos / pi + pdf) / 2 as a path tracer uses it, rises with the number of particles.

    All of them count: directions of the left half of a density, then of the right half, in one batch or in many, teach more than
    either half.  So do their weights: of particles and more, but lighter uniform decoys, the density is half of either, and the
    weights teach that, not their square roots or squares, nor their products with the cosine, which they contain already.

    Declared `constant`, it must learn nothing.  Declared `coarse`, because what it keeps, such as a single cone,
    fits no known density better than a cosine does, it must only tell them apart: held-out directions are more
    likely after particles of their own density than after those of another one.
    """
    rng = np.random.default_rng([12, seed])
    owner = [name for name in DENSITIES for _ in range(REPLICATES)]
    particles = np.stack([DENSITIES[name].sample(max(COUNTS), rng) for name in owner])
    held_out = {name: DENSITIES[name].sample(HELD_OUT, rng) for name in DENSITIES}
    wo = np.concatenate([held_out[name] for name in owner])
    half_uniform = wo.copy()
    half_uniform[::2] = uniform_directions(len(wo) // 2, rng)
    record = mi.UInt32(np.repeat(np.arange(len(owner), dtype=np.uint32), HELD_OUT))
    at = vector(ASIDE * rng.normal(size=wo.shape)) if parallax else None

    def teach(batches: list[list[Particles]]) -> Any:
        state = representation.init(len(owner), seed, parallax)
        for index, given in enumerate(batches):
            state = representation.update(state, batch(given, parallax, far=parallax), seed + index)
            dr.eval(state)
        return state

    def likelihood(state: Any, wo: np.ndarray, cosine: float, asked: mi.UInt32 = record) -> np.ndarray:
        """Of q with so much of the cosine in it [densities, REPLICATES]."""
        pdf = as_numpy(representation.pdf(state, asked, vector(wo), True, at), len(wo))
        q = cosine * wo[:, 2] / np.pi + (1 - cosine) * pdf
        return np.log(q).reshape(len(DENSITIES), REPLICATES, HELD_OUT).mean(-1)

    def batches(directions: np.ndarray, n: int = 1) -> list[list[Particles]]:
        return [[equal(d) for d in part] for part in np.split(directions, n, axis=1)]

    def among_decoys(change: Callable[..., Any] = lambda weight, wo: weight) -> list[list[Particles]]:
        given, weight = [np.concatenate([p[:half], decoys]) for p in particles], np.repeat([1, LIGHT], [half, len(decoys)])
        return [[(wo[order], change(weight, wo).astype(np.float32)[order]) for wo, order in zip(given, orders, strict=True)]]

    some, half = particles[:, :COUNTS[1]], COUNTS[1] // 2
    decoys = uniform_directions(round(half / LIGHT), rng)
    orders = [rng.permutation(half + len(decoys)) for _ in particles]
    x = some[:, :, :1]
    in_turn = np.take_along_axis(some, np.argsort(x > np.median(x, axis=1, keepdims=True), axis=1, kind="stable"), axis=1)
    counts = {n: f"{n} particles" for n in (0, *COUNTS)}
    none, few, once, most = counts.values()
    weights, changes = "its weights", {
        "their square roots": lambda weight, wo: weight**0.5, "their squares": lambda weight, wo: weight**2,
        "weights times cosine": lambda weight, wo: weight * wo[:, 2], "weights over cosine": lambda weight, wo: weight / wo[:, 2]}
    online, both = f"{once} in {PARTS} batches", "its left half, then the right"
    both_online, another = f"{both}, in {PARTS} batches", f"{once} of another density"
    lessons = {none: [], **{counts[n]: batches(particles[:, :n]) for n in COUNTS}, online: batches(some, PARTS),
               weights: among_decoys(), **{what: among_decoys(change) for what, change in changes.items()},
               "its left half": batches(in_turn[:, :half]), "its right half": batches(in_turn[:, half:]),
               both: batches(in_turn), both_online: batches(in_turn, PARTS)}
    found = {what: likelihood(teach(given), *((half_uniform, LITTLE) if what in (weights, *changes) else (wo, 0.5)))
             for what, given in lessons.items()}

    def picture(name: str, what: str) -> Picture:
        return lambda: _beside(representation, teach(lessons[what]), owner.index(name), name, what, parallax)

    loss = zip((found[once] - found[online]).mean(1), DENSITIES, strict=True)
    note = (f"mean ln q {', '.join(f'{found[what].mean():.3f} ({n})' for n, what in counts.items())} particles; {COUNTS[1]} "
            f"in {PARTS} batches instead of 1 lose {', '.join(f'{v:.3f} ({name})' for v, name in loss)}")
    if "constant" in declared:
        same = all(np.array_equal(v, found[weights if what in changes else none]) for what, v in found.items() if what != weights)
        return Verdict(same, "densities that learn", float(not same), 0.0, "" if same else "it was declared constant, but learns",
                       note=f"{note}{', as declared' if same else ''}")

    asked: list[tuple[str, str, float, Callable[..., Any]]] = [
        *((what, none, LEAST, np.min) for what in (once, most, online)),
        *((weights, other, LEAST, np.mean) for other in changes),
        *((what, over, MORE, np.max) for what in (both, both_online) for over in ("its left half", "its right half"))]
    hint = " (who keeps too little to fit it, on purpose, is declared coarse)"
    if "coarse" in declared:
        others = (record + REPLICATES) % len(owner)
        found |= {another: likelihood(teach(lessons[once]), wo, 0.5, others)}
        asked, hint = [(what, another, LEAST, np.min) for what in (once, online)], ""
    missed = []
    for what, over, least, judge in asked:
        gains = dict(zip(DENSITIES, (found[what] - found[over]).mean(1), strict=True))
        gain = float(judge([gains[name] for name in HARD]))
        if not gain >= least:
            name = min(HARD, key=lambda name: abs(gains[name] - gain))
            words = f"'{name}' is {gain:+.3f} nats more likely after {what} than after {over}{hint}"
            missed.append(Verdict(False, "least gain [nats]", gain, least, words, note=note, picture=picture(name, what)))
    if missed:
        return missed[0]
    p_values = PValues()
    for over, what in itertools.pairwise((few, once, most)):
        for name, gain in zip(DENSITIES, found[what] - found[over], strict=True):
            p = stats.ttest_1samp(gain + SLACK, 0, alternative="less").pvalue
            words = f"'{name}' is {gain.mean():+.3f} nats more likely after {what} than after {over}"
            p_values.add(p, words, picture(name, what))
    return p_values.verdict(level, note)


def _beside(representation: Any, state: Any, record: int, name: str, what: str, parallax: bool) -> list[Panel]:
    """The known density beside what was learnt."""
    truth = DENSITIES[name].sample(1 << 20, np.random.default_rng(1))

    def pdf(wo: np.ndarray) -> np.ndarray:
        at = vector(np.zeros_like(wo)) if parallax else None
        return as_numpy(representation.pdf(state, dr.full(mi.UInt32, record, len(wo)), vector(wo), True, at), len(wo))

    return [Panel(f"'{name}': histogram of the truth", over_disk(truth, np.full(len(truth), 1 / len(truth)))),
            of_density(f"pdf after {what}", pdf)]
