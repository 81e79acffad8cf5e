"""One image by one method: `olpm-bench render`, with the same clock and the same loop as a cell of an experiment."""
from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import mitsuba as mi

from olpm_bench import scenes
from olpm_bench.bench import environment
from olpm_bench.bench.cell import load_scene, measure, warm_up
from olpm_bench.bench.config import CellSpec, ConfigError
from olpm_bench.bench.experiment_file import parse
from olpm_bench.bench.exr import write_exr
from olpm_bench.bench.files import check_writable, replacing
from olpm_bench.bench.progress import Bar
from olpm_bench.bench.run import require_memory
from olpm_bench.report import records, tonemap
from olpm_bench.suggest import closest
from olpm_bench.transport.guide import MIN_PARTICLES, Guide
from olpm_bench.transport.view import records_seen

TABLES = ("scene", "integrator", "training", "representation")


def settings(assignments: list[str], tables: tuple[str, ...] = TABLES) -> dict[str, dict[str, Any]]:
    """``["training.passes=5", ...]`` as nested tables; a value is TOML, or else a string.

    Raises:
        ConfigError: not ``table.key=value``, an unknown table, or the type of the representation, which has its option.
    """
    found: dict[str, dict[str, Any]] = {table: {} for table in tables}
    for text in assignments:
        left, equals, value = text.partition("=")
        table, dot, key = left.strip().partition(".")
        if not equals or not dot or not key:
            raise ConfigError(f"--set {text}: must be TABLE.KEY=VALUE with a table of {', '.join(tables)}")
        if table not in found:
            raise ConfigError(f"--set {text}: unknown table '{table}'; known: {', '.join(tables)}{closest(table, tables)}")
        if (table, key) == ("representation", "type"):
            raise ConfigError(f"--set {text}: the type is what --method (of `fit`: --representation) names")
        found[table][key] = parse_value(value.strip())
    return found


def parse_value(text: str) -> Any:
    """``5``, ``0.5``, ``true``, ``[1, 2]``, ``"nearest"`` as TOML reads them; anything else is a string."""
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):        # also numbers that are too long, and lists too deep
        return text
    return value if isinstance(value, (bool, int, float, str, list)) else text


def cell(scene: str, method: str, assignments: list[str], *, seconds: float | None, spp: int | None,
         width: int, height: int, max_depth: int | None, seed: int, load_guide: Path | None = None) -> CellSpec:
    """The cell that the options of `olpm-bench render` describe.

    Args:
        load_guide: the guide that takes the place of training, which then has nothing to set.

    Raises:
        ConfigError: any of them is wrong.
    """
    if (seconds is None) == (spp is None):
        raise ConfigError("give one of --seconds and --spp")
    tables = settings(assignments)
    for table in ("representation", "training"):
        if load_guide is not None and tables[table]:
            raise ConfigError(f"--set {table}.{next(iter(tables[table]))}: the guide of --load-guide is trained already; "
                              "scene.* and integrator.* can be set")
    is_file = scenes.is_file(scene)
    scene_table: dict[str, Any] = {"name": scene, "width": width, "height": height}
    if is_file:
        path = Path(scene).resolve()
        scene_table |= {"name": path.parent.name if path.stem == "scene" else path.stem, "file": scene,
                        "overrides": tables["scene"]}
    else:
        scene_table["parameters"] = tables["scene"]
    if max_depth is not None:
        scene_table["max_depth"] = max_depth
    method_table: dict[str, Any] = {"name": method}
    if method != "unguided":
        method_table["representation"] = {"type": method, **tables["representation"]}
    elif tables["representation"] or tables["training"]:
        raise ConfigError("--set training.* and representation.* need a --method with a representation")
    budget = {"seconds": seconds} if seconds is not None else {"spp": spp}
    data = {"title": "one image", "seeds": [seed], "budget": budget, "scene": [scene_table],
            "integrator": tables["integrator"], "training": tables["training"], "method": [method_table]}
    return parse(data, "command line", Path.cwd()).cells()[0]


def render(spec: CellSpec, out: Path, *, save_guide: Path | None = None,
           load_guide: Path | None = None, records_map: Path | None = None) -> dict[str, Any]:
    """Render one image to `out` (EXR: mean, variance of the mean, count) and, tone-mapped, to the PNG beside it.

    Args:
        save_guide, load_guide: where to leave the trained guide; which guide to use in place of training.
        records_map: where to draw the guide's records over the image.

    Returns:
        Timings, counts and versions, for JSON.

    Raises:
        InputError, OSError: wrong options or files; CellFailedError: an invalid image.
    """
    if out.suffix.lower() != ".exr":
        raise ConfigError(f"--out {out}: must end in .exr")
    if spec.training is None and (save_guide or load_guide or records_map):
        raise ConfigError("--save-guide, --load-guide and --records-map need a --method with a representation")
    if records_map is not None and records_map.suffix.lower() not in (".png", ".pdf"):
        raise ConfigError(f"--records-map {records_map}: must end in .png or .pdf")
    for path in (out, save_guide, records_map):
        if path is not None and not path.parent.is_dir():
            raise ConfigError(f"{path}: there is no folder {path.parent}")
        if path is not None:
            check_writable(path.parent)
    written = [path.resolve() for path in (out, out.with_suffix(".png"), save_guide, records_map) if path is not None]
    if len(set(written)) < len(written):
        raise ConfigError("--out, the PNG beside it, --save-guide and --records-map: two of them are the same file")
    require_memory([spec])
    guide = _load_guide(load_guide, spec) if load_guide is not None else None
    scene = load_scene(spec)
    with Bar(1.0) as bar:
        bar.at(0.0, "compiling")
        warm = warm_up(spec, scene, guide)
        done = measure(spec, scene, warm, guide, bar.at)
    config = spec.config()
    if guide is not None:
        config |= {"representation": guide.specification, "training": None}
    if save_guide is not None and done.guide is not None:
        with replacing(save_guide) as beside:
            done.guide.save(beside)
    if records_map is not None and done.guide is not None:
        records.records_map(records_seen(scene, done.guide), done.image["mean"], MIN_PARTICLES, records_map)
    info = {k: v for k, v in done.info.items() if k != "key"}
    write_exr(out, done.image, {**config, **info})
    png = out.with_suffix(".png")
    tonemap.write_png(png, tonemap.srgb(done.image["mean"], tonemap.auto_exposure(done.image["mean"])))
    return {**info, **config, "out": str(out), "png": str(png),
            "guide": str(save_guide or load_guide) if save_guide or load_guide else None,
            "records_map": str(records_map) if records_map else None, "trace": done.trace,
            "versions": environment.versions(), "variant": mi.variant(), "commit": environment.commit()}


def _load_guide(path: Path, spec: CellSpec) -> Guide:
    if not path.is_file():
        raise ConfigError(f"--load-guide {path}: there is no such file")
    return Guide.load(path, spec.method.representation_name)
