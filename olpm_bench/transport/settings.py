"""What can be set: the parameters of the path tracer and of training, with their defaults and limits.

Ordinary data without Mitsuba, so that experiment files are checked without loading it.  The keys of the
TOML, of ``--set`` and of the Mitsuba plugin are these names.
"""
from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

from representations import wrong_type
from representations.suggest import closest

UNBOUNDED_DEPTH = 32                # where camera paths have no limit, particle paths end, and roulette ends camera paths
MOST = 2 ** 31 - 1                  # of whole numbers, which become 32-bit ones
STRICT = {"extra": "forbid"}        # read by pydantic: unknown keys are errors


class InputError(ValueError):
    """Something that the user gave can't be used; the message, one line, names it and says what is allowed."""


def _require(ok: bool, name: str, value: object, allowed: str) -> None:
    if not ok:
        raise InputError(f"{name} = {value!r}: must be {allowed}")


def _require_types(settings: Any, *apart: str) -> None:
    """All fields but those `apart` have the types of their defaults."""
    for f in dataclasses.fields(settings):
        value = getattr(settings, f.name)
        allowed = wrong_type(value, f.default) if f.name not in apart else None
        _require(allowed is None, f.name, value, allowed or "")


@dataclass(frozen=True)
class IntegratorSettings:
    """The guided path tracer.

    max_depth: longest path in segments, as Mitsuba counts: 1 shows emitters only, 2 adds direct light; -1 has no limit.
    roulette: "contribution" ends paths by what they can still be expected to bring to their pixel (adjoint-driven, Vorba
        & Křivánek 2016), and where nothing is known of that, so without a guide, by throughput; "throughput" ends them by it
        from vertex `rr_depth` on, as Mitsuba's `path` does; "none" leaves all paths alone.
    rr_depth: see above [vertices].
    window: "contribution" lets paths live that are expected to bring at least this share of their pixel's radiance.
    fraction: probability of sampling the BSDF rather than the guide where both can be used and it is not learnt [T 76-77: 0.5].
    """
    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT
    max_depth: int = 13
    roulette: Literal["contribution", "throughput", "none"] = "contribution"
    rr_depth: int = 5
    window: float = 0.25
    fraction: float = 0.5

    def __post_init__(self) -> None:
        _require_types(self)
        _require(1 <= self.max_depth <= MOST or self.max_depth == -1, "max_depth", self.max_depth, ">= 1, or -1 for no limit")
        _require_choice(self, "roulette", "contribution", "throughput", "none")
        _require(self.max_depth >= 1 or self.roulette != "none", "max_depth", self.max_depth, ">= 1 without roulette")
        _require(1 <= self.rr_depth <= MOST, "rr_depth", self.rr_depth, ">= 1")
        _require(0 < self.window < math.inf, "window", self.window, "> 0")
        _require(0 < self.fraction <= 1, "fraction", self.fraction, "in (0, 1]")


@dataclass(frozen=True)
class TrainingSettings:
    """How a guide is trained: first `passes` passes of particles, then `camera_passes` passes of camera paths.

    schedule: "interleaved" alternates importons and photons for `passes` passes, each with one on-line update;
        "importons_first" traces `passes` passes of unguided importons, then as many of photons that they guide (Peter and
        Pietrek 1998); "single_batch" traces passes * photons photons without guiding and fits once (slides 51-52).
    passes: particle passes; without these and camera passes the guide stays untrained, which is plain BSDF sampling.
    photons, importons: paths emitted in a particle pass.
    camera_passes: at most so many passes of camera paths, which render the image and teach the guide.
    camera_paths: paths of such a pass: as many samples a pixel, rounded to a power of two, as come nearest; at least one.
    share: of a budget in seconds, after which training ends; 1: with its last pass, or with the budget.  "auto": when learning
        on is expected to cost more variance than it saves, at most half of the budget; see `bench.cell.end_of_training`, which
        alone knows of budgets, and so of `blend` and `while_rendering`.
    blend: let the images of camera passes of the second half of training into the result, sample for sample.
    while_rendering: go on learning from the paths of every rendering pass.
    gather: "binned": the particles whose look-up gives the record, at most `neighbours` of them;
        "nearest": exactly the `neighbours` nearest within the record radius, as in the paper.  (Camera paths are binned, too, and
        records with few vertices also learn from those around them.)
    neighbours: particles of a pass used by a record, at most [L: 250].
    record_radius: largest validity radius of a record, as a share of the diagonal of what the camera and its paths see, which
        is at most ten times as long as their median segment (`transport.seen_extent`) [L: 0.01, of the scene's diagonal].
    shrink: records shrink from there, to a tenth at most, where particles are dense, sources near or lobes sharp, as in the
        paper; off by default: at equal time it costs more than it gains.
    inherit: new records begin with what those beside them have learnt.
    fraction: probability of sampling the BSDF rather than the guide when particles scatter.
    learn_radiance: from camera paths, learn where light comes from, and not only what records return, for the roulette.
    learn_fraction: learn it from camera paths, record by record, for camera paths and importons.
    learn_direct: from camera paths, learn the direct light too that next-event estimation samples more rarely than it brings.
    emission: "guided" starts photons of lights at infinity (constant, envmap, sunsky, directional) where importons leave for
        them; "emitter" by the emitters' own samplers.
    emission_fraction: probability of the emitter's own sampler in guided emission, its defensive share [T 113-117].
    weight_window: what the particles' roulette and splitting keep alike: "contribution", their weights times a power of the
        contribution that they are expected to make to the image, or to the light that it receives (`transport.window`, after
        Vorba and Křivánek 2016); "flux", their weights, in a wide window [L].
    parallax: representations re-aim at what they have learnt from the point where they are asked, not from their record's.
    """
    __pydantic_config__: ClassVar[dict[str, Any]] = STRICT
    schedule: Literal["interleaved", "importons_first", "single_batch"] = "interleaved"
    passes: int = 2
    photons: int = 150_000
    importons: int = 50_000
    camera_passes: int = 64
    camera_paths: int = 2 ** 17
    share: float | Literal["auto"] = 0.35
    blend: bool = True
    while_rendering: bool = False
    gather: Literal["binned", "nearest"] = "binned"
    neighbours: int = 1000
    record_radius: float = 0.02
    shrink: bool = False
    inherit: bool = True
    fraction: float = 0.4
    learn_radiance: bool = True
    learn_fraction: bool = True
    learn_direct: bool = True
    emission: Literal["guided", "emitter"] = "guided"
    emission_fraction: float = 0.2
    weight_window: Literal["flux", "contribution"] = "contribution"
    parallax: bool = True

    def __post_init__(self) -> None:
        _require_types(self, "share")
        _require_choice(self, "schedule", "interleaved", "importons_first", "single_batch")
        _require_choice(self, "gather", "binned", "nearest")
        _require_choice(self, "emission", "guided", "emitter")
        _require_choice(self, "weight_window", "flux", "contribution")
        for name in ("passes", "importons", "camera_passes"):
            _require(0 <= getattr(self, name) <= MOST, name, getattr(self, name), f">= 0, at most {MOST}")
        for name in ("photons", "camera_paths", "neighbours"):
            _require(1 <= getattr(self, name) <= MOST, name, getattr(self, name), f">= 1, at most {MOST}")
        number = isinstance(self.share, int | float) and not isinstance(self.share, bool)
        _require(self.share == "auto" or (number and 0 < self.share <= 1), "share", self.share, "in (0, 1], or 'auto'")
        _require(0 < self.record_radius <= 0.25, "record_radius", self.record_radius,
                 "in (0, 0.25] of the diagonal of what the camera's paths see")
        _require(0 < self.fraction <= 1, "fraction", self.fraction, "in (0, 1]")
        _require(0 < self.emission_fraction <= 1, "emission_fraction", self.emission_fraction, "in (0, 1]")


def _require_choice(settings: Any, name: str, *choices: str) -> None:
    *most, last = map(repr, choices)
    _require(getattr(settings, name) in choices, name, getattr(settings, name), f"{', '.join(most)} or {last}")


# Photons and importons only, a fixed fraction; gather and particles of a pass are those of the paper's library [L], the talk
# has 30 passes of 100,000 photons and as many importons [T].
_PAPER = {"gather": "nearest", "neighbours": 250, "record_radius": 0.01, "shrink": True, "passes": 10, "photons": 300_000,
          "importons": 300_000, "camera_passes": 0, "learn_fraction": False, "weight_window": "flux", "fraction": 0.5,
          "parallax": False}

# What each preset changes of the defaults, which are those of `best`: it names its roulette, too, so that a method's own preset
# brings it where `[integrator]` names another for all.
PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "best": {"training": {}, "integrator": {"roulette": "contribution"}},
    "paper2014": {"training": _PAPER, "integrator": {"roulette": "throughput"}},
    "paper2014_norr": {"training": _PAPER, "integrator": {"roulette": "none"}},      # guided paths carry low throughput
}

Settings = TypeVar("Settings")


def training(preset: str = "best", **changes: Any) -> TrainingSettings:
    """The training settings of a preset, with changes.

    Raises:
        InputError: unknown preset or key, or a value of a wrong type or out of its range.
    """
    return with_changes(TrainingSettings(), {**preset_of(preset)["training"], **changes})


def integrator(preset: str = "best", **changes: Any) -> IntegratorSettings:
    """The integrator settings of a preset, with changes.

    Raises:
        InputError: as `training`.
    """
    return with_changes(IntegratorSettings(), {**preset_of(preset)["integrator"], **changes})


def preset_of(name: Any) -> dict[str, dict[str, Any]]:
    """What a preset changes: its tables `training` and `integrator`.

    Raises:
        InputError: unknown preset.
    """
    if not isinstance(name, str) or name not in PRESETS:
        raise InputError(f"unknown preset {name!r}; known: {', '.join(PRESETS)}{closest(str(name), PRESETS)}")
    return PRESETS[name]


def with_changes(settings: Settings, changes: dict[str, Any]) -> Settings:
    """`settings` with some fields changed.

    Raises:
        InputError: a key that is no field (the message lists them), or a value of a wrong type or out of its range.
    """
    if not changes:
        return settings
    known = [f.name for f in dataclasses.fields(settings)]  # type: ignore[arg-type]
    for key in changes:
        if key not in known:
            raise InputError(f"unknown key '{key}'; known: {', '.join(known)}{closest(key, known)}")
    return dataclasses.replace(settings, **changes)  # type: ignore[type-var]
