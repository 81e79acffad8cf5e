"""One image by one method: `olpm-bench render`, with the same clock and the same loop as a cell of an experiment."""
from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from olpm_bench import scenes
from olpm_bench.bench import environment, probe
from olpm_bench.bench.cell import load_scene, measure, warm_up
from olpm_bench.bench.config import CellSpec, ConfigError
from olpm_bench.bench.experiment_file import parse
from olpm_bench.bench.exr import write_exr
from olpm_bench.bench.files import check_writable, replacing
from olpm_bench.bench.progress import Bar, activity
from olpm_bench.bench.run import require_memory
from olpm_bench.report import records, tonemap
from olpm_bench.suggest import closest
from olpm_bench.transport.guide import MIN_PARTICLES, Guide
from olpm_bench.transport.view import records_seen

WIDTH, HEIGHT = 320, 180    # of images of embedded scenes [pixels]
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


def cell(scene: str, method: str, assignments: list[str], *, seconds: float | None = None, spp: int | None = None,
         width: int | None = None, height: int | None = None, max_depth: int | None = None, seed: int = 0,
         load_guide: Path | None = None) -> CellSpec:
    """The cell that the options of `olpm-bench render` describe.

    What is left out is as a scene file says: the size of its image, of whose aspect `width` or `height` alone leaves an image,
    its `max_depth`, and its samples a pixel.  Embedded scenes have `WIDTH` x `HEIGHT` pixels.

    Args:
        load_guide: the guide that takes the place of training, which then has nothing to set.

    Raises:
        ConfigError: any of them is wrong.
        SceneError: the scene file can't be loaded.
    """
    if seconds is not None and spp is not None:
        raise ConfigError("give one of --seconds and --spp")
    tables = settings(assignments)
    for table in ("representation", "training"):
        if load_guide is not None and tables[table]:
            raise ConfigError(f"--set {table}.{next(iter(tables[table]))}: the guide of --load-guide is trained already; "
                              "scene.* and integrator.* can be set")
    scene_table: dict[str, Any] = {"name": scene}
    if scenes.is_file(scene):
        path = Path(scene).resolve()
        stated = probe.check(Path(scene), tables["scene"])
        spp = stated.spp if spp is None and seconds is None else spp
        if max_depth is None and "max_depth" not in tables["integrator"]:
            max_depth = stated.max_depth
        scene_table |= {"name": path.parent.name if path.stem == "scene" else path.stem, "file": scene,
                        "overrides": tables["scene"], **_size(width, height, stated.width, stated.height)}
    else:
        scene_table |= {"parameters": tables["scene"], **_size(width, height, WIDTH, HEIGHT)}
    if seconds is None and spp is None:
        raise ConfigError("give one of --seconds and --spp")
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


def _size(width: int | None, height: int | None, own_width: int, own_height: int) -> dict[str, int]:
    """Width and height [pixels]; one of them alone keeps the aspect of the scene's own."""
    if width is None and height is not None:
        width = max(1, round(height * own_width / max(own_height, 1)))
    if height is None and width is not None:
        height = max(1, round(width * own_height / max(own_width, 1)))
    return {"width": own_width if width is None else width, "height": own_height if height is None else height}


def render(spec: CellSpec, out: Path, *, save_guide: Path | None = None,
           load_guide: Path | None = None, records_map: Path | None = None) -> dict[str, Any]:
    """Render one image to `out` (EXR: mean, variance of the mean, count) and, tone-mapped, to the PNG beside it.

    Args:
        save_guide, load_guide: where to leave the trained guide; which guide to use in place of training.
        records_map: where to draw the guide's records over the image.

    Returns:
        Timings, counts and versions, for JSON; `summary` puts them into words.

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
    with activity("compiling, and timing a pass"):
        warm = warm_up(spec, scene, guide)
    with Bar(1.0) as bar:
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
    return {**info, **config, "noise": noise(done.image), "out": str(out), "png": str(png),
            "guide": str(save_guide or load_guide) if save_guide or load_guide else None,
            "records_map": str(records_map) if records_map else None, "trace": done.trace,
            "versions": environment.versions(), "variant": mi.variant(), "commit": environment.commit()}


def noise(image: dict[str, np.ndarray]) -> float | None:
    """Root mean square of the pixels' standard errors, over that of the pixels; None: not known, or of a black image.

    Args:
        image: mean and variance (h, w, 3) of each pixel.
    """
    variance, square = (float(np.mean(x, dtype=np.float64)) for x in (image["variance"], np.square(image["mean"])))
    return math.sqrt(variance / square) if math.isfinite(variance) and square > 0 else None


def summary(done: dict[str, Any]) -> list[str]:
    """What `render` has returned, for people: what was rendered, where it is, how long it took and how good it is."""
    depth = done["integrator"]["max_depth"]
    paths = f"paths of up to {depth} segments" if depth >= 0 else "paths of any length"
    what = (f"{done['scene']} by {done['method']}: {done['width']} x {done['height']} pixels of {done['spp']} samples, {paths}")
    files = {"": done["png"], "guide ": done["guide"], "map of the records ": done["records_map"]}
    where = ", ".join([done["out"], *(f"{label}{file}" for label, file in files.items() if file)])
    parts = [("training", done["train_seconds"]), ("rendering", done["render_seconds"])]
    share = ", ".join(f"{seconds:.1f} s {part}" for part, seconds in parts if seconds)
    long = f"{done['charged_seconds']:.1f} s charged ({share}), and {done['compile_seconds']:.1f} s compiling"
    good = f"mean {done['mean']:.4g}"
    if done["noise"] is not None:
        good += f" +- {done['mean_stderr']:.1g}, noise {100 * done['noise']:.2g} % of the signal"
    if done["trained"] is not None:
        good += f", {done['trained']:.0%} of what the camera sees is guided by {done['records']} records"
    return [what, where, f"{long}; {good}"]


def _load_guide(path: Path, spec: CellSpec) -> Guide:
    if not path.is_file():
        raise ConfigError(f"--load-guide {path}: there is no such file")
    return Guide.load(path, spec.method.representation_name)
