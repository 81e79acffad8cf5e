"""The same training in another process, at another time: what depends on more than its arguments comes out otherwise there."""
from __future__ import annotations

import atexit
import datetime
import functools
import hashlib
import time
from collections.abc import Callable, Sequence
from typing import Any

import drjit as dr

from olpm_bench.bench import other_process
from olpm_bench.check.trials import Trials, bits
from olpm_bench.check.verdict import Failure, Verdict, exact
from representations import RepresentationError
from representations.state import to_numpy

COMMAND = other_process.command("olpm_bench.check.elsewhere")
HASH_SEEDS = "11", "22"     # of Python's hash(), one process each: a single bit of a hash is the same in two of four cases
LATER = 123_456_789         # seconds by which clocks are ahead there: other years, days, hours, minutes and seconds
CLOCKS = "time", "monotonic", "perf_counter", "process_time", "thread_time"


def agree(trials: Sequence[Trials]) -> Verdict:
    """States, samples and densities have the same bits in other processes, where strings have other hashes, clocks are ahead,
    objects are at other addresses, and there is one thread.
    """
    wrong = []
    for one in trials:
        expected = fingerprint(one)
        for hash_seed in HASH_SEEDS:
            answer = _process(hash_seed).ask(one.specification, one.seed, one.parallax)
            if "refused" in answer:
                raise RepresentationError(answer["refused"])
            if "ok" not in answer:
                how = other_process.end(answer) or answer.get("traceback", "it hangs").strip().splitlines()[-1]
                wrong.append(f"training fails there: {how}")
            elif (what := next((k for k, v in expected.items() if answer["ok"].get(k) != v), None)) is not None:
                wrong.append(f"{what} is made of other bits{' with parallax' if one.parallax else ''}")
    note = f"the same bits in {len(HASH_SEEDS)} more processes"
    return exact([Failure(len(wrong), "; ".join(dict.fromkeys(wrong)))] if wrong else [], "violations", note)


def fingerprint(trials: Trials) -> dict[str, str]:
    """Hashes of all that a training makes."""
    state, found = trials.init(trials.n, trials.seed), {}
    for number, particles in enumerate([None, *trials.batches]):
        when = "at first"
        if particles is not None:
            state, when = trials.update(state, particles, trials.seed + number), f"after update number {number}"
        dr.eval(state)
        for name, array in to_numpy(state).items():
            found[f"{name} {when}"] = _hash(bits(array))
        for verb, answers in trials.answers(state).items():
            found[f"what {verb} gives {when}"] = _hash(answers)
    return found


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:32]


@functools.cache
def _process(hash_seed: str) -> other_process.Process:
    """One that serves all runs of this process: most of what it costs is its start."""
    process = other_process.Process(COMMAND, environment={"PYTHONHASHSEED": hash_seed})
    atexit.register(process.__exit__)
    return process


def _trained_here(specification: dict[str, Any], seed: int, parallax: bool) -> dict[str, str]:
    dr.set_thread_count(1)
    return fingerprint(Trials(specification, seed, parallax))


def _put_clocks_ahead() -> None:
    """Those of `time` and `datetime`, for all code that is loaded from now on."""
    def ahead(clock: Callable[[], Any], by: int) -> Callable[[], Any]:
        return lambda: clock() + by

    for name in CLOCKS:
        setattr(time, name, ahead(getattr(time, name), LATER))
        setattr(time, f"{name}_ns", ahead(getattr(time, f"{name}_ns"), LATER * 10**9))

    class Later(datetime.datetime):
        @classmethod
        def now(cls, tz: datetime.tzinfo | None = None) -> Later:
            return cls.fromtimestamp(time.time(), tz)

        @classmethod
        def utcnow(cls) -> Later:
            return cls.fromtimestamp(time.time(), datetime.UTC).replace(tzinfo=None)

    datetime.datetime = Later  # type: ignore[misc]


if __name__ == "__main__":
    _put_clocks_ahead()
    other_process.serve(_trained_here)
