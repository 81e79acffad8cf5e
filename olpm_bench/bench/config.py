"""What an experiment is: its tables, typed and checked, and complete descriptions of its cells.

Strict: an unknown key, a wrong type or a value out of range is an error, which :mod:`olpm_bench.bench.experiment_file` puts into
one line.  Names of representations and of embedded scenes are looked up in these two modules and nowhere else.
"""
from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.metadata
import itertools
import json
import os
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PrivateAttr, field_validator, model_validator

import representations
from olpm_bench import scenes as embedded
from olpm_bench import shipped, transport
from olpm_bench.bench import environment
from olpm_bench.bench.files import SCHEMA_VERSION, slug
from olpm_bench.bench.metrics import METRICS, VARIANCES
from olpm_bench.suggest import closest
from olpm_bench.transport.settings import InputError, IntegratorSettings, TrainingSettings, with_changes

LEAST_SECONDS = 1e-3        # of a budget: a pass takes longer
MAX_SEED = 2**15 - 1        # seeds of passes, cells and references share 32 bits, see cell.pass_seed
NO_REFERENCE = Path("none")
LOOKS = 8                   # methods that the figures' style tells apart


class ConfigError(InputError):
    """A mistake in an experiment file or on the command line; one line that says what is allowed."""


def _writable(name: str) -> str:
    if not name.isprintable() or "$" in name:
        raise ValueError("must be of printable characters, without $, for it is drawn in figures")
    return name


Label = Annotated[str, AfterValidator(_writable)]


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


class Budget(Table):
    """What a cell may spend: charged seconds, training included, or samples per pixel; exactly one of them.

    checkpoints: images kept on the way, at log-spaced times (or sample counts); the last is the final image.
    """
    seconds: float | None = Field(None, ge=LEAST_SECONDS, allow_inf_nan=False)
    spp: int | None = Field(None, ge=1, le=2**31)
    checkpoints: int = Field(8, ge=1, le=64)

    @model_validator(mode="after")
    def _one(self) -> Budget:
        if (self.seconds is None) == (self.spp is None):
            raise ValueError("give one of seconds and spp")
        return self


class Scene(Table):
    """A scene and the image made of it.

    name: an embedded scene; with `file`, a label of your choice.
    file: Mitsuba XML, relative to the TOML.
    parameters: of the embedded scene.
    overrides: of the XML's own ``<default>`` values.
    max_depth: wins over the integrator's.
    reference: a reference folder, or an EXR of another renderer; by default it is found by the scene's key.  "none": do
        without, and so without errors and speed-ups; variance, gains and means need none.
    crops: what the figures show enlarged: up to four boxes [x, y, width, height] in pixels, of one shape; by default two where
        the methods differ most.
    """
    name: Label = Field(min_length=1)
    file: Path | None = Field(None, strict=False)
    parameters: dict[str, Any] = {}
    overrides: dict[str, Any] = {}
    width: int = Field(ge=1, le=16384)
    height: int = Field(ge=1, le=16384)
    max_depth: int | None = None
    reference: Path | None = Field(None, strict=False)
    crops: list[list[int]] = Field([], max_length=4)

    @field_validator("max_depth")
    @classmethod
    def _depth(cls, value: int | None) -> int | None:
        if value is not None and value < 1 and value != -1:
            raise ValueError("must be >= 1, or -1 for no limit")
        return value

    @model_validator(mode="after")
    def _crops(self) -> Scene:
        for crop in self.crops:
            if len(crop) != 4:
                raise ValueError(f"crop {crop}: must be [x, y, width, height], in pixels")
            x, y, width, height = crop
            if not (0 <= x < x + width <= self.width and 0 <= y < y + height <= self.height):
                raise ValueError(f"crop {crop}, which is [x, y, width, height]: must be inside the image of {self.width} x "
                                 f"{self.height} pixels")
            if width * self.crops[0][3] != height * self.crops[0][2]:
                raise ValueError("crops: must be of one shape, the same width : height")
        return self

    @property
    def has_reference(self) -> bool:
        """Errors can be measured, once the reference is made."""
        return self.reference != NO_REFERENCE

    @property
    def source(self) -> str:
        """What `olpm_bench.scenes.load.load` takes: the embedded name or the path of the XML."""
        return str(self.file) if self.file is not None else self.name

    @property
    def arguments(self) -> dict[str, Any]:
        """Parameters of the embedded scene or overrides of the XML."""
        return dict(self.overrides if self.file is not None else self.parameters)

    def resolved_arguments(self) -> dict[str, Any]:
        """`arguments`, with every default of an embedded scene written out."""
        return dict(self.overrides) if self.file is not None else embedded.resolve(self.name, self.parameters)

    def digest(self) -> str:
        """Hash of all that determines the scene's radiance; its files are read once, for all cells and references of it."""
        what = json.dumps([self.source, self.arguments], sort_keys=True, default=str)
        if what not in self._digests:
            self._digests[what] = embedded.digest(self.file or self.name, self.arguments)
        return self._digests[what]

    @functools.cached_property
    def _digests(self) -> dict[str, str]:
        return {}


class Series(Table):
    """Where a method stands in the sweep that it comes from: the name before the sweep, the setting, and its value."""
    name: str
    setting: str
    value: float = Field(gt=0, allow_inf_nan=False)


class SweepFigure(Table):
    """What is drawn of methods that sweep a setting, a panel for each of `y`.

    x: the setting's value, or the photons traced in training.
    y: "bytes" are those of the guide and of the most particles stored at once.
    """
    x: Literal["setting", "photons"] = "setting"
    y: list[Literal["l1", "relmse", "bytes", "train_seconds"]] = Field(default=["l1"], min_length=1)


class Method(Table):
    """A method under test: the path tracer with one representation, or without a guide.

    representation: ``{ type = name, ...hyper-parameters }``; none traces unguided.
    integrator, training: what differs from the experiment's own tables.
    series: of a method that a ``sweep`` has made, see :mod:`olpm_bench.bench.sweep`.
    look: number of its colour, marker and dash in figures; by default its place among the methods, also at scales with fewer.
    """
    name: Label = Field(min_length=1)
    representation: dict[str, Any] | None = None
    integrator: dict[str, Any] = {}
    training: dict[str, Any] = {}
    series: Series | None = None
    look: int | None = Field(None, ge=0, lt=1000)

    @model_validator(mode="after")
    def _sensible(self) -> Method:
        if self.representation is not None and not isinstance(self.representation.get("type"), str):
            raise ValueError(f"representation needs a type; known: {', '.join(representations.names())}")
        for key, value in self.representation_parameters.items():
            if isinstance(value, int) and abs(value) >= 2**31:
                raise ValueError(f"representation: {key} = {value}: must be smaller than 2^31")
        if self.representation is None and self.training:
            raise ValueError("has [training] changes but no representation to train")
        if "max_depth" in self.integrator:
            raise ValueError("max_depth belongs in [integrator] or [[scene]]: all methods share one reference")
        return self

    @property
    def representation_name(self) -> str | None:
        return self.representation["type"] if self.representation is not None else None

    @property
    def representation_parameters(self) -> dict[str, Any]:
        return {k: v for k, v in (self.representation or {}).items() if k != "type"}

    def create(self) -> Any:
        """The representation, or None for the unguided path tracer."""
        if self.representation is None:
            return None
        return representations.create(self.representation["type"], **self.representation_parameters)


class Claim(Table):
    """What `olpm-bench gate` proves or refutes: in each scene, one method's expected error is at most `ratio` times another's.

    better, worse: names of methods.
    metric: an error (of a scene with reference), or the variance of a pixel; see `bench.metrics` and `bench.gate`.
    confidence: of the one-sided bound that must not exceed `ratio`.
    """
    better: str
    worse: str
    metric: str = "relmse"
    ratio: float = Field(1.0, gt=0, allow_inf_nan=False)
    confidence: float = Field(0.95, ge=0.5, lt=1)

    @field_validator("metric")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in (known := [*METRICS, *VARIANCES]):
            raise ValueError(f"must be one of {', '.join(known)}{closest(value, known)}")
        return value


@dataclass(frozen=True)
class CellSpec:
    """All that determines a cell: one scene, one method, one seed, one budget."""
    scene: Scene
    method: Method
    seed: int
    integrator: IntegratorSettings          # with the scene's max_depth
    training: TrainingSettings | None       # None: unguided
    budget: Budget

    @property
    def reference_key(self) -> str:
        return reference_key(self.scene, self.integrator.max_depth)

    def config(self) -> dict[str, Any]:
        """The cell as JSON, every default written out."""
        return {
            "scene": self.scene.name, "file": self.scene.file and self.scene.file.name,
            "parameters": self.scene.resolved_arguments(), "width": self.scene.width, "height": self.scene.height,
            "method": self.method.name, "representation": _representation_defaults(self.method), "seed": self.seed,
            "integrator": dataclasses.asdict(self.integrator),
            "training": self.training and dataclasses.asdict(self.training),
            "budget": self.budget.model_dump(),
        }

    @functools.cached_property
    def key(self) -> str:
        """Hash of everything that determines the cell, our code included: change any of it and the cell is redone."""
        config = {k: v for k, v in self.config().items() if k not in ("scene", "file", "method")}      # labels
        return _hash({**config, "scene": self.scene.digest(), "code": _representation_code(self.method),
                      "own_code": own_code(), "mitsuba": importlib.metadata.version("mitsuba"),
                      "variant": environment.wanted_variant(), "schema_version": SCHEMA_VERSION})

    def __str__(self) -> str:
        return f"{self.scene.name} / {self.method.name} / seed {self.seed}"


class Experiment(Table):
    """A whole experiment file.  `seeds = 3` means seeds 0, 1, 2.

    baseline: the method that gains and speed-ups are over; the first by default.
    sweep: how methods with a sweep are drawn.
    scale: other sizes of it, see :mod:`olpm_bench.bench.scale`.
    """
    schema_version: int = SCHEMA_VERSION
    title: Label
    description: str = ""
    seeds: list[int] = [0]
    baseline: str | None = None
    budget: Budget
    scene: list[Scene] = Field(min_length=1)
    integrator: IntegratorSettings = IntegratorSettings()
    training: TrainingSettings = TrainingSettings()
    method: list[Method] = Field(min_length=1)
    claim: list[Claim] = []
    sweep: SweepFigure = SweepFigure()
    scale: dict[str, dict[str, Any]] = {}
    _path: Path = PrivateAttr(Path("EXPERIMENT.toml"))
    _scale: str | None = PrivateAttr(None)
    _scenes: dict[str, Path] = PrivateAttr({})          # what `--scene` gave

    @property
    def path(self) -> Path:
        """The file it was read from."""
        return self._path

    @property
    def stem(self) -> str:
        """Name of its results folder: the file's, and the scale's."""
        return self.path.stem if self._scale is None else f"{self.path.stem}-{slug(self._scale)}"

    def command(self, name: str, root: Path) -> str:
        """The command `name` of this experiment, for a shell; `root` is the `--results` folder."""
        scale = ["--scale", self._scale] if self._scale is not None else []
        scenes = [f"--scene={scene}={file}" for scene, file in self._scenes.items()]
        return shlex.join(["olpm-bench", name, shipped.named(self.path), *scale, "--results", str(root), *scenes])

    @field_validator("schema_version")
    @classmethod
    def _schema(cls, value: int) -> int:
        if not 1 <= value <= SCHEMA_VERSION:
            raise ValueError(f"must be <= {SCHEMA_VERSION}, the newest this version of olpm-bench reads")
        return value

    @field_validator("seeds", mode="before")
    @classmethod
    def _count_of_seeds(cls, value: Any) -> Any:
        if isinstance(value, int) and not isinstance(value, bool):
            if not 1 <= value <= MAX_SEED + 1:
                raise ValueError(f"must be 1 to {MAX_SEED + 1} (a count), or a list of seeds")
            return list(range(value))
        return value

    @field_validator("seeds")
    @classmethod
    def _seeds(cls, value: list[int]) -> list[int]:
        if not value or len(set(value)) < len(value) or not all(0 <= s <= MAX_SEED for s in value):
            raise ValueError(f"must be different numbers from 0 to {MAX_SEED}")
        return value

    @model_validator(mode="after")
    def _distinct(self) -> Experiment:
        for kind, names in (("methods", [m.name for m in self.method]), ("scenes", [s.name for s in self.scene])):
            folders: dict[str, str] = {}
            count = Counter(names)
            for name in names:
                other = folders.setdefault(slug(name).lower(), name)
                if count[name] > 1:
                    raise ValueError(f"two {kind} of one name {name!r}; names must differ")
                if other != name:
                    raise ValueError(f"{kind} {other!r} and {name!r} would share the folder '{slug(name)}', at least where "
                                     "upper case is lower case; names must differ")
        if self.baseline_name not in (known := [m.name for m in self.method]):
            raise ValueError(f"baseline = {self.baseline!r}: no method of this name; known: {', '.join(known)}"
                             + closest(self.baseline_name, known))
        for number, claim in enumerate(self.claim, 1):
            for key, name in (("better", claim.better), ("worse", claim.worse)):
                if name not in known:
                    raise ValueError(f"[[claim]] {number}: {key} = {name!r}: no method of this name; known: {', '.join(known)}"
                                     + closest(name, known))
            if claim.better == claim.worse:
                raise ValueError(f"[[claim]] {number}: {claim.better!r} is compared with itself")
        depths = {scene.max_depth: scene for scene in self.scene}       # all that a scene changes of a method's settings
        for method in self.method:
            self.training_of(method)
            for scene in depths.values():
                self.integrator_of(scene, method)
        return self

    @property
    def baseline_name(self) -> str:
        """The method that the others are compared with."""
        return self.method[0].name if self.baseline is None else self.baseline

    @property
    def shown(self) -> list[Method]:
        """The methods that figures of single methods show: all, or where these are too many, of each sweep the last."""
        last = {m.series.name: m for m in self.method if m.series is not None}
        return [m for m in self.method if len(self.method) <= LOOKS or m.series is None or last[m.series.name] is m]

    @property
    def looks(self) -> dict[str, int]:
        """Name of a method or of a sweep -> number of its look, the same in all figures of a report.

        The methods of a sweep share one where there are too many to tell apart.  As a curve, a sweep looks as its last method.
        """
        return looks_of([(m.name, None if m.series is None else m.series.name, m.look) for m in self.method])

    def looking_as(self, known: Mapping[str, int]) -> Experiment:
        """The experiment whose methods have the looks that are known of their names, and others have looks that are free."""
        now, taken, wanted = self.looks, set(known.values()), {}
        free = (number for number in itertools.count() if number not in taken)
        for m in self.method:
            shared = m.series.name if m.series is not None and len(self.method) > LOOKS else m.name
            wanted[m.name] = known[m.name] if m.name in known else known[shared] if shared in known else next(free)
        if all(now[name] == look for name, look in wanted.items()):
            return self
        return self.model_copy(update={"method": [m.model_copy(update={"look": wanted[m.name]}) for m in self.method]})

    def integrator_of(self, scene: Scene, method: Method) -> IntegratorSettings:
        changes = dict(method.integrator)
        if scene.max_depth is not None:
            changes["max_depth"] = scene.max_depth
        try:
            return with_changes(self.integrator, changes)
        except InputError as error:
            raise InputError(f"method {method.name!r} integrator: {error}") from None

    def training_of(self, method: Method) -> TrainingSettings | None:
        """The method's training; None if it has no representation."""
        if method.representation is None:
            return None
        try:
            return with_changes(self.training, method.training)
        except InputError as error:
            raise InputError(f"method {method.name!r} training: {error}") from None

    def cells(self) -> list[CellSpec]:
        """Every cell in the order of running: methods innermost, so that they share the machine's good and bad
        hours."""
        cells = []
        trainings = [self.training_of(method) for method in self.method]
        for scene in self.scene:
            integrators = [self.integrator_of(scene, method) for method in self.method]
            settings = list(zip(self.method, integrators, trainings, strict=True))
            cells += [CellSpec(scene, method, seed, integrator, training, self.budget)
                      for seed in self.seeds for method, integrator, training in settings]
        return cells

    def of_scenes(self, names: Sequence[str]) -> Experiment:
        """The experiment with some of its scenes only; with all of them if none is named.

        Raises:
            ConfigError: no scene of that name.
        """
        known = [scene.name for scene in self.scene]
        for name in names:
            if name not in known:
                raise ConfigError(f"no scene {name!r} in {self.path.name}; known: {', '.join(known)}{closest(name, known)}")
        return self.model_copy(update={"scene": [scene for scene in self.scene if not names or scene.name in names]})

    def of_results(self, folder: Path) -> Experiment:
        """The experiment that was read from its results, under the name of the file that they were made from."""
        named, (stem, _, scale) = self.model_copy(), folder.name.rpartition("-")
        original, scaled = (shipped.experiment_file(Path("experiments") / f"{name}.toml") for name in (folder.name, stem))
        if scaled.is_file() and not original.is_file():
            named._path, named._scale = scaled, scale
        else:
            named._path = original if original.is_file() else Path(original.name)
        named._scenes = {scene.name: Path(os.path.relpath(scene.file)) for scene in self.scene if scene.file is not None}
        return named

    def reference_key(self, scene: Scene) -> str:
        return reference_key(scene, self.max_depth(scene))

    def max_depth(self, scene: Scene) -> int:
        return self.integrator.max_depth if scene.max_depth is None else scene.max_depth

    def resolved(self, relative_to: Path | None = None) -> dict[str, Any]:
        """The experiment with every default written out, as TOML holds it; paths relative to a folder if given."""
        def path(p: Path | str) -> str:
            return Path(os.path.relpath(p, relative_to)).as_posix() if relative_to is not None else str(p)

        scenes: list[dict[str, Any]] = []
        methods: list[dict[str, Any]] = []
        for scene in self.scene:
            table: dict[str, Any] = scene.model_dump(exclude={"file", "reference", "parameters", "overrides"})
            table["max_depth"] = self.max_depth(scene)
            if scene.file is None:
                table["parameters"] = scene.resolved_arguments()
            else:
                table |= {"file": path(scene.file), "overrides": scene.overrides}
            if scene.reference is not None:
                table["reference"] = path(scene.reference) if scene.has_reference else str(NO_REFERENCE)
            scenes.append(table)
        for method in self.method:
            table, training = {"name": method.name}, self.training_of(method)
            if training is not None:
                table["representation"] = _representation_defaults(method)
                if (found := representations.file_of(method.representation_name or "")) is not None:
                    table["representation"]["type"] = f"{path(found[0])}:{found[1]}"
                table["training"] = dataclasses.asdict(training)
            integrator = dataclasses.asdict(self.integrator_of(self.scene[0], method))
            table["integrator"] = {k: v for k, v in integrator.items() if k != "max_depth"}
            if method.series is not None:
                table["series"] = method.series.model_dump()
            if method.look is not None:
                table["look"] = method.look
            methods.append(table)
        return {
            "schema_version": SCHEMA_VERSION, "title": self.title, "description": self.description, "seeds": self.seeds,
            "baseline": self.baseline_name, "budget": self.budget.model_dump(exclude_none=True),
            "integrator": dataclasses.asdict(self.integrator), "training": dataclasses.asdict(self.training),
            "sweep": self.sweep.model_dump(), "scene": scenes, "method": methods,
            "claim": [claim.model_dump() for claim in self.claim]}

    def toml(self, relative_to: Path | None = None) -> str:
        """`resolved` as TOML; reading it back gives the same cells."""
        return tomli_w.dumps(_without_none(self.resolved(relative_to)))


def looks_of(methods: Sequence[tuple[str, str | None, int | None]]) -> dict[str, int]:
    """Name of a method or of a sweep -> number of its look, see `Experiment.looks`.

    Args:
        methods: their names, those of their sweeps, and the looks that they ask for.
    """
    alike = {name: series if series is not None and len(methods) > LOOKS else name for name, series, _ in methods}
    numbers = {name: number for number, name in enumerate(dict.fromkeys(alike.values()))}
    found = {name: numbers[alike[name]] if look is None else look for name, _, look in methods}
    return found | {series: found[name] for name, series, _ in methods if series is not None}


def reference_key(scene: Scene, max_depth: int) -> str:
    """Folder of a scene's reference: readable, and different whenever the converged image may differ."""
    digest = _hash({"scene": scene.digest(), "width": scene.width, "height": scene.height, "max_depth": max_depth})
    return f"{slug(scene.name)}-{scene.width}x{scene.height}-{digest[:8]}"


def _representation_defaults(method: Method) -> dict[str, Any] | None:
    """The representation's table with every hyper-parameter."""
    if method.representation is None:
        return None
    return {**_defaults(method.representation["type"], _representation_code(method)), **method.representation}


@functools.cache
def _defaults(representation: str, code: str | None) -> dict[str, Any]:
    """The hyper-parameters of a representation; found once for all methods that have it, as long as its file stays as it is.

    Args:
        code: hash of that file, if it has one.
    """
    parameters = representations.parameters_of(representations.find(representation))
    return {name: p.default for name, p in parameters.items()
            if isinstance(p.default, (bool, int, float, str, list))}


def _without_none(value: Any) -> Any:
    """`value` without the keys that have no value, which TOML cannot say."""
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return [_without_none(v) for v in value] if isinstance(value, list) else value


def _hash(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:16]


@functools.cache
def own_code() -> str:
    """Hash of the sources of cells, scenes, path tracing, training and representations, so that figures never mix versions."""
    files = [Path(__file__).with_name(name) for name in ("cell.py", "clock.py", "accumulator.py")]
    for package in (embedded, transport, representations):
        files += sorted(Path(package.__path__[0]).glob("*.py"))
    return _hash([[file.name, file.read_text(encoding="utf-8")] for file in files])


def _representation_code(method: Method) -> str | None:
    """The source behind ``FILE.py:Class``; a registered name stands for itself."""
    found = representations.file_of(method.representation_name or "")
    return hashlib.sha256(found[0].read_bytes()).hexdigest() if found is not None else None
