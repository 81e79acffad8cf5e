"""All checks of a representation, one verdict each; and many runs of them, to see how often they cry wolf.

The checks share one level: a run in which nothing is wrong fails with probability `LEVEL` or less, by Sidak over the checks that
leave something to chance and over the tests of each.
"""
from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import representations
from olpm_bench.check import (
    aiming,
    density,
    kernel,
    learning,
    long_run,
    many_records,
    memory,
    new_records,
    purity,
    samples,
    unbiased,
)
from olpm_bench.check.population import population, population_with_parallax
from olpm_bench.check.trained import Trained
from olpm_bench.check.trials import Trials
from olpm_bench.check.verdict import Verdict, combined, sidak, worst_of
from olpm_bench.suggest import closest
from olpm_bench.transport.settings import InputError

LEVEL = 1e-4            # false alarms of a whole run

DECLARATIONS = {"constant": "learns nothing on purpose", "grows": "keeps all of its particles on purpose",
                "coarse": "keeps too little to fit several narrow lobes on purpose"}


class Subject:
    """A representation under examination; made, and its states trained, when a check first asks for them.

    Args:
        specification: as in a TOML, ``{"type": "gaussian_mixture", "components": 8}``.
        seed: all random numbers of the checks follow from it.
        declared: of `DECLARATIONS`, what it does on purpose.

    Raises:
        InputError: there is no such declaration.
    """

    def __init__(self, specification: dict[str, Any], seed: int = 0, declared: Sequence[str] = ()) -> None:
        for name in declared:
            if name not in DECLARATIONS:
                raise InputError(f"--declare {name}: must be one of {', '.join(DECLARATIONS)}")
        self.specification, self.seed, self.declared = specification, seed, declared

    @property
    def name(self) -> str:
        return str(self.specification["type"])

    @cached_property
    def representation(self) -> Any:
        """
        Raises:
            RepresentationError: there is no such representation, or it can't be made.
        """
        return representations.create(**self.specification)

    @cached_property
    def trained(self) -> Trained:
        return Trained(self.representation, population(self.seed))

    @cached_property
    def aimed(self) -> Trained:
        return Trained(self.representation, population_with_parallax(self.seed))

    @cached_property
    def aimed_everywhere(self) -> dict[str, Trained]:
        """The state with parallax, by how it is asked."""
        return {"": self.aimed, "asked without a place": self.aimed.without_place()}

    @cached_property
    def trials(self) -> list[Trials]:
        """Without and with parallax."""
        return [Trials(self.specification, self.seed, parallax, "grows" in self.declared) for parallax in (False, True)]


@dataclass(frozen=True)
class Check:
    """A sentence of the contract.  `run` takes the subject and the level of this check."""
    name: str
    sentence: str
    run: Callable[[Subject, float], Verdict]
    statistical: bool = False


def _with_parallax(check: Callable[..., Verdict], statistical: bool = False) -> Callable[[Subject, float], Verdict]:
    """The check of states with parallax, however they are asked."""
    def run(subject: Subject, level: float) -> Verdict:
        asked = subject.aimed_everywhere
        levels = (sidak(level, len(asked)),) * statistical
        return worst_of({how: check(aimed, *levels) for how, aimed in asked.items()})
    return run


CHECKS = (
    Check("density", "pdf is finite, >= 0, and 0 below the horizon", lambda s, _: density.is_valid(s.trained)),
    Check("integral", "pdf integrates to at most 1: to the share of samples that don't fail",
          lambda s, level: density.integral(s.trained, level), statistical=True),
    Check("reported-pdf", "sample returns the density that pdf gives", lambda s, _: samples.report_pdf(s.trained)),
    Check("samples", "samples follow the pdf", lambda s, level: samples.follow_pdf(s.trained, level), statistical=True),
    Check("one-particle", "around a single particle, samples follow the pdf",
          lambda s, level: kernel.keep_balance(s.representation, s.seed, level), statistical=True),
    Check("inactive-lanes", "lanes that are switched off read and change nothing",
          lambda s, _: samples.mind_active((s.trained, s.aimed))),
    Check("parallax-density", "as density, asked from beside the record, or without a place", _with_parallax(density.is_valid)),
    Check("parallax-integral", "as integral, asked from beside the record, or without a place",
          _with_parallax(density.integral, statistical=True), statistical=True),
    Check("parallax-reported", "as reported-pdf, asked from beside the record, or without a place",
          _with_parallax(samples.report_pdf)),
    Check("parallax-samples", "as samples, asked from beside the record, or without a place",
          _with_parallax(samples.follow_pdf, statistical=True), statistical=True),
    Check("many-records", "none of ten thousands of records is wrong",
          lambda s, level: many_records.are_right(s.representation, s.seed, level), statistical=True),
    Check("purity", "same input, same bits; arguments are left alone", lambda s, _: purity.stay_pure(s.trials)),
    Check("independence", "other records, and the order of records, don't matter",
          lambda s, level: purity.be_independent(s.trials, level), statistical=True),
    Check("scale", "the scales of weights and of lengths don't matter", lambda s, _: purity.ignore_scale(s.trials)),
    Check("nothing-new", "no particles, or of no weight, teach nothing", lambda s, _: purity.ignore_nothing(s.trials)),
    Check("new-records", "states are stored; appended records begin fresh, learn, and disturb none",
          lambda s, _: new_records.take_new_records(s.trials)),
    Check("learning", "held-out directions become more likely with particles",
          lambda s, level: learning.learn(s.representation, s.seed, s.declared, level), statistical=True),
    Check("aiming", "aims at light nearby from where it is asked, if it minds that",
          lambda s, _: aiming.aim(s.representation, s.seed)),
    Check("long-run", "hundreds of batches wear out, inflate or enlarge no record",
          lambda s, level: long_run.last(s.trials, level), statistical=True),
    Check("memory", "bytes a record don't grow with particles",
          lambda s, _: memory.stay_bounded(s.trials)),
    Check("furnace", "guided, a closed box keeps its radiance",
          lambda s, level: unbiased.keep_the_furnace(s.specification, s.seed, level), statistical=True),
    Check("image", "guided, an image keeps its expectation",
          lambda s, level: unbiased.keep_the_image(s.specification, s.seed, level), statistical=True),
)
STATISTICAL = sum(check.statistical for check in CHECKS)


@dataclass
class Outcome:
    check: Check
    verdict: Verdict
    seconds: float


def named(names: Sequence[str]) -> list[Check]:
    """The checks of these names, all if there are none.

    Raises:
        InputError: an unknown name.
    """
    known = {check.name: check for check in CHECKS}
    for name in names:
        if name not in known:
            raise InputError(f"unknown check '{name}'; known: {', '.join(known)}{closest(name, known)}")
    return [known[name] for name in names] or list(CHECKS)


def run(subject: Subject, checks: Sequence[Check] = CHECKS, level: float = LEVEL) -> Iterator[Outcome]:
    """One check after the other; an error in the representation's code is a failure of the check that meets it.

    Raises:
        RepresentationError: it can't be made.
    """
    subject.representation      # noqa: B018
    for check in checks:
        start = time.perf_counter()
        try:
            verdict = check.run(subject, sidak(level, STATISTICAL))
        except (Exception, SystemExit) as error:        # of other people's code
            from olpm_bench.bench.progress import is_interrupt, reason
            if is_interrupt(error) and not isinstance(error, SystemExit):
                raise
            where = traceback.extract_tb(error.__traceback__)[-1]
            words = f"{type(error).__name__}: {reason(error)} ({where.filename}:{where.lineno})"
            verdict = Verdict(False, "error", None, None, words)
        yield Outcome(check, verdict, time.perf_counter() - start)


def p_value(outcomes: Sequence[Outcome]) -> float:
    """Of a whole run: below `LEVEL` with probability `LEVEL` or less if nothing is wrong."""
    p = [o.verdict.p for o in outcomes if o.verdict.p is not None]
    return combined(min(p), STATISTICAL) if p else 1.0
