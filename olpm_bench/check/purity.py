"""update() depends on nothing but its arguments, and on those only as the contract says."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import numpy as np
from scipy import stats

from olpm_bench.check import elsewhere
from olpm_bench.check.particles import lobes, many, nothing
from olpm_bench.check.trials import FAINT, Trials, both, differing
from olpm_bench.check.verdict import Failure, PValues, Verdict, exact, worst_of

REORDERED = 256             # records whose order is changed, ...
CROWD = 1_500               # ... and particles of each, at least: more than a state may keep, so that it draws some
DEEPEST = 4                 # containers within containers of an instance that are looked into
FEWER_QUERIES = 64          # for each of those
SCALE = 80                  # exponents of two by which weights are scaled: over and above 12 decades, and sums of thousands
UNITS = 20                  # and lengths: from micrometres to a thousand kilometres, in units of a metre


def stay_pure(trials: Sequence[Trials]) -> Verdict:
    """In this process, and in others."""
    return worst_of({"": _stay_pure(trials), "in another process": elsewhere.agree(trials)})


@both
def _stay_pure(trials: Trials) -> Verdict:
    """The arguments of the four verbs are left alone, and the same arguments give the same bits.

    So nothing random comes from anywhere but the seed; who needs nothing random, or always the same, may leave that unused,
    which a note tells.
    """
    r, n, seed = trials.representation, trials.n, trials.seed
    state, wrong, pictures, unused, kept = trials.init(n, seed), [], [], True, None
    if differing(state, trials.init(n, seed)):
        wrong.append("init() with the same seed gives another state")
    told = trials.answers(state)
    for number, particles in enumerate(trials.batches, 1):
        dr.eval(state)
        given = trials.batch(particles)
        before, given_before = _bits(state), _bits(given)
        new, again = (r.update(state, given, seed + number) for _ in range(2))
        by_another = trials.another.update(state, given, seed + number)
        dr.eval(new, again, by_another)
        unused &= not differing(new, r.update(state, given, seed + len(trials.batches) + number))
        if differing(new, again):
            wrong.append(f"update number {number} with the same arguments gives other bits in {differing(new, again)}")
            pictures += [f.picture for f in trials.differences("once more", again, new, bits=True)]
        elif differing(new, by_another):
            wrong.append(f"update number {number} by another instance gives other bits in {differing(new, by_another)}")
        if _bits(state) != before:
            wrong.append(f"update number {number} changes the state that it was given, in place")
        if _bits(given) != given_before:
            wrong.append(f"update number {number} changes the particles that it was given")
        before, told_before, told = _bits(new), told, trials.answers(new)
        for what, found, expected in (
                ("with the same arguments gives other bits after", trials.answers(new), told),
                ("of another instance gives other bits after", trials.answers(new, trials.another), told),
                ("gives other bits in another lane after", trials.answers(new, backwards=True), told),
                ("gives other bits for the state that it had before", trials.answers(state), told_before)):
            wrong += [f"{verb} {what} update number {number}" for verb in found if found[verb] != expected[verb]]
        if _bits(new) != before:
            wrong.append(f"sample() or pdf() changes the state after update number {number}")
        if kept is not None and _attributes(r) != kept:         # after the first, which may keep tables for all that follow
            wrong.append(f"update number {number} changes attributes of the instance, of its class, or its module's variables")
        state, kept = new, _attributes(r)
    note = f"{len(trials.batches)} updates of {n} records, each twice" + ", the same with any seed" * unused
    return exact([Failure(len(wrong), "; ".join(wrong), next(iter(pictures), None))] if wrong else [], "violations", note)


def _attributes(instance: Any) -> Any:
    """All that an instance, its classes and their modules hold, in a form that compares; of other objects, which they are."""
    def form(value: Any, depth: int = 0) -> Any:
        if isinstance(value, np.ndarray) or (dr.is_array_v(value) and not isinstance(value, type)):
            return np.array(value).tobytes()
        if isinstance(value, dict) and depth < DEEPEST:
            return {key: form(v, depth + 1) for key, v in value.items()}
        if isinstance(value, list | tuple | set | frozenset) and depth < DEEPEST:
            return [form(v, depth + 1) for v in value]
        if isinstance(getattr(value, "__dict__", None), dict) and not callable(value) and depth < DEEPEST:
            return id(value), form(vars(value), depth + 1)
        return value if isinstance(value, bool | int | float | str | None) else id(value)
    classes = type(instance).__mro__[:-1]
    modules = {id(own): own for cls in classes for verb in vars(cls).values() if (own := getattr(verb, "__globals__", None))}
    return form(vars(instance)), [form(dict(vars(cls))) for cls in classes], [
        form({k: v for k, v in own.items() if not k.startswith("__")}) for own in modules.values()]


def _bits(arrays: Any) -> dict[str, bytes]:
    return {k: np.array(v).tobytes() for k, v in vars(arrays).items() if v is not None}


@both
def ignore_scale(trials: Trials) -> Verdict:
    """Weights times a constant of each record give the same density; so do lengths, if they are asked for in the same unit."""
    rng, expected = trials.records.rng(10), trials.train(trials.batches)
    exponent = rng.integers(-SCALE, SCALE + 1, trials.n)
    scaled = [[(wo, weight * np.float32(2.0**e)) for (wo, weight), e in zip(particles, exponent, strict=True)]
              for particles in trials.batches]
    found = trials.differences("with its weights scaled", trials.train(scaled), expected)
    unit = 2.0 ** rng.integers(-UNITS, UNITS + 1, trials.n)
    found += trials.differences("with all lengths scaled", trials.train(trials.batches, unit=unit), expected, unit=unit)
    return exact(found, "answers that differ", f"weights of {trials.n} records scaled by 2^-{SCALE} to 2^{SCALE}, lengths by "
                 f"2^-{UNITS} to 2^{UNITS}")


@both
def ignore_nothing(trials: Trials) -> Verdict:
    """A batch without particles, or with zero weights only, keeps every density."""
    state, rng, found = trials.train(trials.batches), trials.records.rng(11), []
    for what, particles in (("after a batch without particles", [nothing()] * trials.n),
                            ("after particles of zero weight", [(lobes(50, rng), np.zeros(50, np.float32))] * trials.n)):
        found += trials.differences(what, trials.update(state, particles, trials.seed + 7), state)
    return exact(found, "answers that differ", f"{trials.n} records, 2 batches with nothing to learn")


@both
def be_independent(trials: Trials, level: float) -> Verdict:
    """What a record learns doesn't depend on the particles of other records, nor on where among them it stands."""
    rng = trials.records.rng(13)
    kept = rng.random(trials.n) < 0.5
    others = [[p if k else many(int(rng.integers(0, 100)), rng) for p, k in zip(particles, kept, strict=True)]
              for particles in trials.batches]
    found = trials.differences("with other particles in other records", trials.train(others), trials.train(trials.batches),
                               np.flatnonzero(kept), bits=True)
    first = [[many(120, rng), *particles[1:]] for particles in trials.batches]      # of the first record, whose index it keeps
    found += trials.differences("as the only record", trials.train([particles[:1] for particles in first]),
                                trials.train(first), np.arange(1))
    return exact(found, "densities that differ") if found else _ignore_order(trials, rng, level)


def _ignore_order(trials: Trials, rng: np.random.Generator, level: float) -> Verdict:
    """Permuted records give permuted densities, bit for bit; or, if random numbers go by the index of a record, they differ no
    more than by another seed: Wilcoxon's test of the distances, two for each record.
    """
    particles = [many(CROWD + record, rng) for record in range(REORDERED)]      # in another order, batches of the same shape
    order, same = rng.permutation(REORDERED), np.arange(REORDERED)
    wo = np.stack([p[0][:FEWER_QUERIES] for p in particles])
    base, reordered, reseeded = (trials.train([[particles[i] for i in o]], s) for o, s in (
        (same, trials.seed), (order, trials.seed), (same, trials.seed + 1000)))
    place = np.argsort(order)
    log_pdf = [np.log(np.maximum(trials.density(state, at, wo, trials.places[0]), FAINT)) for state, at in (
        (base, same), (reordered, place), (reseeded, same))]
    if np.array_equal(log_pdf[0], log_pdf[1]):
        return exact([], "answers that differ", f"{REORDERED} records reordered: the same bits")
    if np.array_equal(log_pdf[0], log_pdf[2]):
        words = f"{REORDERED} records reordered: their densities are others, but not with another seed, which is ignored"
        return exact([Failure(REORDERED, words)], "densities that differ")
    by_order, by_seed = (np.abs(other - log_pdf[0]).mean(1)[order != same] for other in log_pdf[1:])
    difference = by_order - by_seed
    unequal = difference[difference != 0]
    p = stats.wilcoxon(unequal, alternative="greater").pvalue if len(unequal) else 1.0
    worst = int(np.flatnonzero(order != same)[difference.argmax()])
    words = f"{REORDERED} records reordered: ln pdf differs by {by_order.mean():.2g}, with another seed by {by_seed.mean():.2g}"
    p_values = PValues()
    picture = trials.beside((f"pdf of record {worst}", base, worst), ("in another order", reordered, int(place[worst])))
    p_values.add(p, f"{words}; most in record {worst}", picture)
    return p_values.verdict(level, words)
