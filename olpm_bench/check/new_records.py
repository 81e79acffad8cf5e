"""States as the owner of the records treats them: stored and loaded, appended to, copied from record to record."""
from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.check.particles import many, nothing
from olpm_bench.check.trials import Trials, both
from olpm_bench.check.verdict import Failure, Verdict, exact
from representations.state import append, copy_records, from_numpy, to_numpy

ATTEMPTS = 64               # to load a state where another one was in memory


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
    stored = _loaded(trials, to_numpy(state))
    found = trials.differences("stored, and asked through another instance", stored, state, old, bits=True, by=trials.another)
    longer = append(append(trials.init(0, trials.seed), state), fresh)
    found += trials.differences("with records appended to it", longer, state, old, bits=True)
    found += trials.differences("appended", longer, fresh, new, old_at=-len(old), bits=True)
    particles = [nothing()] * len(old) + [many(300, trials.records.rng(12))] * len(new)
    taught = trials.update(longer, particles, trials.seed + 9)
    found += trials.differences("when those appended to it learnt", taught, longer, old)
    found += _copies(trials, longer, old, new)
    found += _in_place_of_another(trials, state, old)
    alone = trials.update(fresh, particles[len(old):], trials.seed + 9)
    if not trials.differences("", alone, fresh, new, -len(old), -len(old)):
        return exact(found, "answers that differ", f"{len(old)} records, {len(new)} appended, which learn nothing anyway")
    if not trials.differences("", taught, longer, new):
        found.append(Failure(len(new), "appended records don't learn"))
    return exact(found, "answers that differ", f"{len(old)} records, {len(new)} appended")


def _copies(trials: Trials, longer: Any, old: np.ndarray, new: np.ndarray) -> list[Failure]:
    """Records may begin as copies of others: they have the densities of those, and keep them when those learn."""
    source, target = (mi.UInt32(r.astype(np.uint32)) for r in (old, new))
    copies = replace(longer, **{f.name: copy_records(getattr(longer, f.name), trials.n, source, target) for f in fields(longer)})
    at = len(old)
    found = trials.differences("copied to another place", copies, longer, old, new_at=at, bits=True)
    taught = trials.update(copies, [many(300, trials.records.rng(14))] * len(old) + [nothing()] * len(new), trials.seed + 9)
    found += trials.differences("a copy of it, when it learnt itself", taught, copies, old, new_at=at, old_at=at)
    # What a copy learns, it learns as the original would
    lessons = [many(300, trials.records.rng(17))] * trials.n
    taught = _loaded(trials, to_numpy(trials.update(longer, lessons, trials.seed + 9)))
    again = trials.update(_loaded(trials, to_numpy(longer)), lessons, trials.seed + 9)
    return found + trials.differences("stored, loaded and taught", again, taught, bits=True)


def _in_place_of_another(trials: Trials, state: Any, old: np.ndarray) -> list[Failure]:
    """A state that is in memory where another one was is not taken for that one.

    Python gives the address of an object that is gone to the next one, and Dr.Jit the index of an array: tables that are found
    by these belong to another state then.
    """
    arrays = to_numpy(state)
    other = {name: array.reshape(len(old), -1)[::-1].ravel() if len(array) else array for name, array in arrays.items()}
    expected, gone = _loaded(trials, other), _loaded(trials, arrays)
    trials.differences("", gone, gone, old)             # asks it
    address, indices, there, kept = id(gone), _indices(gone), replace(expected), []
    del gone
    for _ in range(ATTEMPTS):
        there = replace(expected)
        if id(there) == address:
            break
        kept.append(there)
    found = trials.differences("at the address of a state that is gone", there, expected, old, bits=True)
    fillers = [dr.zeros(mi.Float, 2)]
    while len(fillers) < ATTEMPTS and fillers[-1].index < indices[0]:
        fillers.append(mi.Float(np.zeros(2, np.float32)))
    del fillers[-1]
    there = _loaded(trials, other)
    return found + trials.differences("with the arrays' indices of a state that is gone", there, expected, old, bits=True)


def _indices(state: Any) -> list[int]:
    """Of the variables behind a state's arrays; 0: empty ones."""
    return [index for f in fields(state) if (index := int(getattr(state, f.name).index))]


def _loaded(trials: Trials, arrays: dict[str, np.ndarray]) -> Any:
    """A state from a file."""
    state = from_numpy(trials.like, arrays)
    dr.eval(state)
    return state


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
