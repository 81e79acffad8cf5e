"""What can be set: the parameters of the path tracer and of training, with their defaults and limits.

Ordinary data without Mitsuba, so that experiment files are checked without loading it.  The keys of the
TOML, of ``--set`` and of the Mitsuba plugin are these names.
"""
from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

from representations import wrong_type

STRICT = {"extra": "forbid"}        # read by pydantic: unknown keys are errors


class InputError(ValueError):
    """Something that the user gave can't be used; the message, one line, names it and says what is allowed."""


def _require(ok: bool, name: str, value: object, allowed: str) -> None:
    if not ok:
        raise InputError(f"{name} = {value!r}: must be {allowed}")


def _require_types(settings: Any) -> None:
    for f in dataclasses.fields(settings):
        value = getattr(settings, f.name)
        allowed = wrong_type(value, f.default)
        _require(allowed is None, f.name, value, allowed or "")


@dataclass(frozen=True)
class IntegratorSettings:
    """The guided path tracer.

    max_depth: longest path in segments, as Mitsuba counts: 1 shows emitters only, 2 adds direct light; -1 has no limit.
    roulette: "none" leaves all paths alone: guided ones carry low throughput for a reason; "throughput" ends them by it
        from vertex `rr_depth` on, as Mitsuba's `path` does.
    fraction: probability of sampling the BSDF rather than the guide where both can be used [T 76-77: 0.5].
    """
    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT
    max_depth: int = 13
    roulette: Literal["none", "throughput"] = "none"
    rr_depth: int = 5
    fraction: float = 0.5

    def __post_init__(self) -> None:
        _require_types(self)
        _require(self.max_depth >= 1 or self.max_depth == -1, "max_depth", self.max_depth, ">= 1, or -1 for no limit")
        _require(self.roulette in ("throughput", "none"), "roulette", self.roulette, "'throughput' or 'none'")
        _require(self.max_depth >= 1 or self.roulette != "none", "max_depth", self.max_depth, ">= 1 without roulette")
        _require(self.rr_depth >= 1, "rr_depth", self.rr_depth, ">= 1")
        _require(0 < self.fraction <= 1, "fraction", self.fraction, "in (0, 1]")


@dataclass(frozen=True)
class TrainingSettings:
    """How a guide is trained.

    schedule: "interleaved" alternates importons and photons for `passes` passes, each with one on-line update;
        "single_batch" traces passes * photons photons without guiding and fits once (slides 51-52).
    passes: training passes; 0 leaves the guide untrained, which is plain BSDF sampling.
    photons, importons: paths emitted in a pass.
    gather: "binned": the particles whose look-up gives the record, at most `neighbours` of them;
        "nearest": exactly the `neighbours` nearest within the record radius, as in the paper.
    neighbours: particles of a pass used by a record [L: 250].
    record_radius: validity radius of a record, in units of the scene's diagonal [L: 0.01].
    fraction: probability of sampling the BSDF rather than the guide when particles scatter.
    """
    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT
    schedule: Literal["interleaved", "single_batch"] = "interleaved"
    passes: int = 5
    photons: int = 300_000
    importons: int = 100_000
    gather: Literal["binned", "nearest"] = "binned"
    neighbours: int = 250
    record_radius: float = 0.02
    fraction: float = 0.5

    def __post_init__(self) -> None:
        _require_types(self)
        _require(self.schedule in ("interleaved", "single_batch"), "schedule", self.schedule, "'interleaved' or 'single_batch'")
        _require(self.gather in ("binned", "nearest"), "gather", self.gather, "'binned' or 'nearest'")
        for name in ("passes", "importons"):
            _require(getattr(self, name) >= 0, name, getattr(self, name), ">= 0")
        for name in ("photons", "neighbours"):
            _require(getattr(self, name) >= 1, name, getattr(self, name), ">= 1")
        _require(0 < self.record_radius <= 0.25, "record_radius", self.record_radius, "in (0, 0.25] of the scene's diagonal")
        _require(0 < self.fraction <= 1, "fraction", self.fraction, "in (0, 1]")


PRESETS: dict[str, dict[str, Any]] = {
    # The fast gather and records that fill at few particles: what pays at equal time on two cores.
    "fast": {},
    # The talk's own particles and gather [T, L]; its records also shrink near sources, ours do not.
    "paper2014": {"gather": "nearest", "record_radius": 0.01, "photons": 300_000, "importons": 300_000},
}

Settings = TypeVar("Settings")


def training(preset: str = "fast", **changes: Any) -> TrainingSettings:
    """The settings of a preset, with changes.

    Raises:
        InputError: unknown preset or key, or a value of a wrong type or out of its range.
    """
    return with_changes(TrainingSettings(), without_preset({"preset": preset, **changes}))


def without_preset(table: dict[str, Any]) -> dict[str, Any]:
    """Training settings with their `preset`, if they have one, replaced by its values; the table's other keys win.

    Raises:
        InputError: unknown preset.
    """
    if "preset" not in table:
        return table
    preset = table["preset"]
    if not isinstance(preset, str) or preset not in PRESETS:
        raise InputError(f"unknown preset {preset!r}; known: {', '.join(PRESETS)}")
    return {**PRESETS[preset], **{k: v for k, v in table.items() if k != "preset"}}


def with_changes(settings: Settings, changes: dict[str, Any]) -> Settings:
    """`settings` with some fields changed.

    Raises:
        InputError: a key that is no field (the message lists them), or a value of a wrong type or out of its range.
    """
    known = [f.name for f in dataclasses.fields(settings)]  # type: ignore[arg-type]
    for key in changes:
        if key not in known:
            raise InputError(f"unknown key '{key}'; known: {', '.join(known)}")
    return dataclasses.replace(settings, **changes)  # type: ignore[type-var]
