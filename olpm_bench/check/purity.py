"""update() depends on nothing but its arguments, and on those only as the contract says."""
from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

import representations
from olpm_bench.check.density import ROUNDING, direction
from olpm_bench.check.particles import Particles, batch, equal, lobes, many, normalised, nothing, uniform_directions, vector
from olpm_bench.check.picture import of_density
from olpm_bench.check.population import population
from olpm_bench.check.trained import as_numpy
from olpm_bench.check.verdict import Failure, Picture, PValues, Verdict, exact, sidak, worst_of
from representations.interface import ParticleBatch
from representations.state import append, copied, copy_records, from_numpy, to_numpy

COPIES = 2                  # records in each condition
QUERIES = 256               # directions at which densities are compared, for each record
REORDERED = 256             # records whose order is changed, ...
CROWD = 1_500               # ... and particles of each, at least: more than a state may keep, so that it draws some
DEEPEST = 4                 # containers within containers of an instance that are looked into
FEWER_QUERIES = 64          # for each of those
BESIDE = (0.05, -0.03, 0.01)        # where states with parallax are asked [scene units]; particles land within 0.1
OFTEN = 150                 # batches: what loses half with each one has lost all that a float32 holds
SCALE = 80                  # exponents of two by which weights are scaled: over and above 12 decades, and sums of thousands
FAINT = 1e-6                # densities [1/sr] and differences of densities that count as nothing


class Trials:
    """Trainings of the same representation on variations of the same particles.

    parallax: of states with parallax, which are asked from `BESIDE` the record.
    grows: declared so.
    """

    def __init__(self, specification: dict[str, Any], seed: int, parallax: bool = False, grows: bool = False) -> None:
        self.representation, self.another = (representations.create(**specification) for _ in range(2))
        self.seed, self.parallax, self.grows = seed, parallax, grows
        self.records = population(seed, COPIES, long=False)
        self.batches, self.n = self.records.batches, len(self.records)
        rng, directions = self.records.rng(8), []
        for r in range(self.n):
            near = self.records.of(r)[0][:QUERIES // 2]
            near = normalised(near + 10 ** rng.uniform(-4, -1, (len(near), 1)) * rng.normal(size=near.shape))
            directions.append(np.concatenate([near, uniform_directions(QUERIES - len(near), rng)]))
        self.wo = np.stack(directions)          # [n, QUERIES, 3]

    def train(self, batches: list[list[Particles]], seed: int | None = None) -> Any:
        seed = self.seed if seed is None else seed
        state = self.init(len(batches[0]), seed)
        for index, particles in enumerate(batches):
            state = self.update(state, particles, seed + index)
            dr.eval(state)
        return state

    def init(self, n_records: int, seed: int) -> Any:
        return self.representation.init(n_records, seed, self.parallax)

    def update(self, state: Any, particles: list[Particles], seed: int) -> Any:
        return self.representation.update(state, self.batch(particles), seed)

    def batch(self, particles: list[Particles]) -> ParticleBatch:
        return batch(particles, self.parallax)

    def at(self, n: int) -> mi.Vector3f | None:
        return vector(np.tile(BESIDE, (n, 1))) if self.parallax else None

    def density(self, state: Any, index: np.ndarray, wo: np.ndarray, by: Any = None) -> np.ndarray:
        """Of the state's records `index` [n] at directions [n, m, 3]."""
        n, record = len(index) * wo.shape[1], mi.UInt32(np.repeat(index, wo.shape[1]).astype(np.uint32))
        pdf = (by or self.representation).pdf(state, record, vector(wo.reshape(-1, 3)), True, self.at(n))
        return as_numpy(pdf, n).reshape(wo.shape[:2])

    def differences(self, what: str, new: Any, old: Any, records: np.ndarray | None = None, new_at: int = 0, old_at: int = 0,
                    bits: bool = False, by: Any = None) -> list[Failure]:
        """Between two states, in the densities of some records of the population; record r has the index `new_at` + r.

        by: the instance that is asked for the new ones.
        """
        records = np.arange(self.n) if records is None else records
        wo = self.wo[records]
        found, expected = self.density(new, records + new_at, wo, by), self.density(old, records + old_at, wo)
        close = np.isclose(found, expected, rtol=0 if bits else ROUNDING, atol=0 if bits else FAINT)
        if close.all():
            return []
        r, i = (int(k[0]) for k in np.nonzero(~close))
        record = int(records[r])
        words = (f"{self.records.name(record)}: {what}: pdf {found[r, i]:.5g} instead of {expected[r, i]:.5g} 1/sr at "
                 f"{direction(wo[r, i])}; {(~close).sum()} of {close.size} densities differ")
        return [Failure((~close).sum(), words, self.beside((f"pdf of {self.records.name(record)}", old, record + old_at),
                                                           (what, new, record + new_at)))]

    def beside(self, *shown: tuple[str, Any, int]) -> Picture:
        """Densities of records in states, each with a title."""
        return lambda: [of_density(title, lambda wo, s=state, i=index: self.density(s, np.array([i]), wo[None])[0])  # type: ignore[misc]
                        for title, state, index in shown]


def both(check: Callable[..., Verdict]) -> Callable[..., Verdict]:
    """The check of states without and with parallax, in one verdict, that of the worse ones."""
    @functools.wraps(check)
    def of_both(trials: Sequence[Trials], *level: float) -> Verdict:
        return worst_of({"with parallax" if one.parallax else "": check(one, *(sidak(a, len(trials)) for a in level))
                         for one in trials})
    return of_both


@both
def stay_pure(trials: Trials) -> Verdict:
    """The arguments of the four verbs are left alone, and the same arguments give the same bits.

    So nothing random comes from anywhere but the seed; who needs nothing random, or always the same, may leave that unused,
    which a note tells.
    """
    r, n, seed = trials.representation, trials.n, trials.seed
    state, wrong, pictures, unused, kept = trials.init(n, seed), [], [], True, None
    if _differing(state, trials.init(n, seed)):
        wrong.append("init() with the same seed gives another state")
    record = mi.UInt32(np.repeat(np.arange(n, dtype=np.uint32), QUERIES))
    wo, u = vector(trials.wo.reshape(-1, 3)), trials.records.rng(9).random((3, n * QUERIES), np.float32)
    at = trials.at(n * QUERIES)
    for number, particles in enumerate(trials.batches, 1):
        dr.eval(state)
        given = trials.batch(particles)
        before, given_before = _bits(state), _bits(given)
        new, again = (r.update(state, given, seed + number) for _ in range(2))
        dr.eval(new, again)
        unused &= not _differing(new, r.update(state, given, seed + len(trials.batches) + number))
        if _differing(new, again):
            wrong.append(f"update number {number} with the same arguments gives other bits in {_differing(new, again)}")
            pictures += [f.picture for f in trials.differences("once more", again, new, bits=True)]
        if _bits(state) != before:
            wrong.append(f"update number {number} changes the state that it was given, in place")
        if _bits(given) != given_before:
            wrong.append(f"update number {number} changes the particles that it was given")
        before = _bits(new)
        drawn = [r.sample(new, record, mi.Float(u[0]), mi.Point2f(u[1], u[2]), True, at) for _ in range(2)]
        asked = [(r.pdf(new, record, wo, True, at),) for _ in range(2)]
        dr.eval(drawn, asked)
        for verb, (a, b) in (("sample()", drawn), ("pdf()", asked)):
            if not all(np.array_equal(np.array(x), np.array(y), equal_nan=True) for x, y in zip(a, b, strict=True)):
                wrong.append(f"{verb} with the same arguments gives other bits after update number {number}")
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


def _differing(a: Any, b: Any) -> str:
    """Names of the fields in which two states differ, bit for bit."""
    x, y = to_numpy(a), to_numpy(b)
    return ", ".join(k for k in x if k not in y or x[k].tobytes() != y[k].tobytes())


@both
def ignore_scale(trials: Trials) -> Verdict:
    """Weights times a constant of each record give the same density."""
    exponent = trials.records.rng(10).integers(-SCALE, SCALE + 1, trials.n)
    scaled = [[(wo, weight * np.float32(2.0**e)) for (wo, weight), e in zip(particles, exponent, strict=True)]
              for particles in trials.batches]
    found = trials.differences("with its weights scaled", trials.train(scaled), trials.train(trials.batches))
    return exact(found, "densities that differ", f"weights of {trials.n} records scaled by 2^-{SCALE} to 2^{SCALE}")


@both
def ignore_nothing(trials: Trials) -> Verdict:
    """A batch without particles, or with zero weights only, keeps every density; so do many in which others learn."""
    state, rng, found = trials.train(trials.batches), trials.records.rng(11), []
    for what, particles in (("after a batch without particles", [nothing()] * trials.n),
                            ("after particles of zero weight", [(lobes(50, rng), np.zeros(50, np.float32))] * trials.n)):
        found += trials.differences(what, trials.update(state, particles, trials.seed + 7), state)
    later, others = state, [nothing()] * (trials.n - 1) + [equal(lobes(1, rng))]
    for index in range(OFTEN):
        later = trials.update(later, others, trials.seed + index)
        dr.eval(later)
    found += trials.differences(f"after {OFTEN} batches for another record", later, state, np.arange(trials.n - 1))
    return exact(found, "densities that differ", f"{trials.n} records, {OFTEN + 2} batches with nothing to learn")


@both
def take_new_records(trials: Trials) -> Verdict:
    """A state is arrays of so many numbers a record, and nothing else: it can be stored, and records can be appended to it, which
    begin as init() makes them, leave the old ones alone, and learn.
    """
    old, new = np.arange(trials.n // 2), np.arange(trials.n // 2, trials.n)
    state = trials.train([particles[:len(old)] for particles in trials.batches])
    fresh = trials.init(len(new), trials.seed + 1)
    if wrong := _misfits(trials, state, len(old)):
        return exact([Failure(len(wrong), "; ".join(wrong))], "fields that are no records")
    like = trials.another.init(2, 0, trials.parallax)
    stored = from_numpy(like, {k: copied(type(getattr(like, k)), v) for k, v in to_numpy(state).items()})
    found = trials.differences("stored, and asked through another instance", stored, state, old, bits=True, by=trials.another)
    longer = append(append(trials.init(0, trials.seed), state), fresh)
    found += trials.differences("with records appended to it", longer, state, old, bits=True)
    found += trials.differences("appended", longer, fresh, new, old_at=-len(old), bits=True)
    particles = [nothing()] * len(old) + [many(300, trials.records.rng(12))] * len(new)
    taught = trials.update(longer, particles, trials.seed + 9)
    found += trials.differences("when those appended to it learnt", taught, longer, old)
    found += _copies(trials, longer, old, new)
    alone = trials.update(fresh, particles[len(old):], trials.seed + 9)
    if not trials.differences("", alone, fresh, new, -len(old), -len(old)):
        return exact(found, "densities that differ", f"{len(old)} records, {len(new)} appended, which learn nothing anyway")
    if not trials.differences("", taught, longer, new):
        found.append(Failure(len(new), "appended records don't learn"))
    return exact(found, "densities that differ", f"{len(old)} records, {len(new)} appended")


def _copies(trials: Trials, longer: Any, old: np.ndarray, new: np.ndarray) -> list[Failure]:
    """Records may begin as copies of others: they have the densities of those, and keep them when those learn."""
    source, target = (mi.UInt32(r.astype(np.uint32)) for r in (old, new))
    copies = replace(longer, **{f.name: copy_records(getattr(longer, f.name), trials.n, source, target) for f in fields(longer)})
    at = len(old)
    found = trials.differences("copied to another place", copies, longer, old, new_at=at, bits=True)
    taught = trials.update(copies, [many(300, trials.records.rng(14))] * len(old) + [nothing()] * len(new), trials.seed + 9)
    return found + trials.differences("a copy of it, when it learnt itself", taught, copies, old, new_at=at, old_at=at)


def _misfits(trials: Trials, state: Any, n: int) -> list[str]:
    """What can't be cut into records, of a state of n."""
    found, like = [], trials.init(2, trials.seed)
    for field in fields(like):
        of_two, array = getattr(like, field.name), getattr(state, field.name)
        if not (dr.is_array_v(of_two) and dr.depth_v(of_two) == 1 and type(array) is type(of_two)):
            found.append(f"{field.name} is {type(of_two).__name__} and, trained, {type(array).__name__}: no flat Dr.Jit array")
        elif len(of_two) % 2 or (len(array) * 2 != len(of_two) * n and not trials.grows):
            found.append(f"{field.name} has {len(of_two)} numbers for 2 records and, trained, {len(array)} for {n}")
    return found


@both
def be_independent(trials: Trials, level: float) -> Verdict:
    """What a record learns doesn't depend on the particles of other records, nor on where among them it stands."""
    rng = trials.records.rng(13)
    kept = rng.random(trials.n) < 0.5
    others = [[p if k else many(int(rng.integers(0, 100)), rng) for p, k in zip(particles, kept, strict=True)]
              for particles in trials.batches]
    found = trials.differences("with other particles in other records", trials.train(others), trials.train(trials.batches),
                               np.flatnonzero(kept), bits=True)
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
    log_pdf = [np.log(np.maximum(trials.density(state, at, wo), FAINT)) for state, at in (
        (base, same), (reordered, place), (reseeded, same))]
    if np.array_equal(log_pdf[0], log_pdf[1]):
        return exact([], "densities that differ", f"{REORDERED} records reordered: the same bits")
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
