"""report.html: one page with all of an experiment, images to flip through among them; it needs no network.

Reads results and the figures drawn beside it, renders nothing.  The viewer is FlipViewer of SimpleImageIO; that and Jinja are in
the extra `report`.
"""
from __future__ import annotations

import base64
import html
import importlib.metadata
import itertools
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from olpm_bench.bench import summary
from olpm_bench.bench.files import read_json
from olpm_bench.bench.results import Results
from olpm_bench.report import sheet, tonemap

if TYPE_CHECKING:
    from olpm_bench.bench.config import Experiment
    from olpm_bench.bench.finished import Finished, FinishedScene
    from olpm_bench.bench.reference_file import Reference

TEMPLATE = "page.html.jinja"
LARGEST = 12e6                          # bytes of all images; base64 makes 16 MB of them
BYTES = {"single": 12, "rgbe": 4}       # of a pixel, by the viewer's name of the format
WHOLE_IMAGE = -1                        # as the viewer's zoom
ENLARGED = 1.7                          # figures are drawn for paper; at most
CAPTIONS = {
    "figure": "L1 error on the way to the budget.",
    "sweep": "Results over the setting that differs between methods.",
    "gains": "Gain in work-normalised variance, which needs no reference.",
}


class Number(NamedTuple):
    """A cell of the table: what it says, and what it is sorted by."""
    text: str
    value: float | str | None
    best: bool = False


class Picture(NamedTuple):
    """An image of the viewer, linear RGB (h, w, 3)."""
    name: str
    image: np.ndarray
    is_error: bool = False              # shown in false colours


def page(found: Finished, rows: Sequence[Mapping[str, Any]], blocks: Sequence[sheet.Block], figures: Sequence[str]) -> list[str]:
    """Write report.html into the results folder; return its name.

    Args:
        rows: of the summary; blocks: by `sheet.blocks`.
        figures: names of those in the results folder, as `figures.save` writes them.

    Raises:
        ImportError: Jinja or SimpleImageIO is not installed.
    """
    import jinja2
    import simpleimageio

    experiment, results = found.experiment, found.results
    made_by = commands(experiment, results, found.compared)
    environment = jinja2.Environment(loader=jinja2.PackageLoader("olpm_bench", "report"), autoescape=True, trim_blocks=True,
                                     lstrip_blocks=True, undefined=jinja2.StrictUndefined)
    text = environment.get_template(TEMPLATE).render(
        experiment=experiment, budget=sheet.budget(experiment), commands=made_by, command=made_by[-1],
        machines="; ".join(found.machines),
        viewers=viewers(found, blocks), headers=HEADERS, rows=table(rows), notes=summary.notes(rows),
        speed_ups=summary.speed_up_lines(found.speed_ups, experiment.baseline_name) + summary.bias_lines(rows),
        figures=[{"name": name, "svg": svg(results.folder / f"{name}.svg", CAPTIONS[name]), "caption": CAPTIONS[name]}
                 for name in figures],
        configuration=experiment.toml(results.folder), machine=machine(read_json(results.folder / "env.json")),
        viewer=simpleimageio.make_header(), licence=licence())
    results.write_text("report.html", text)
    return ["report.html"]


def commands(experiment: Experiment, results: Results, compared: Sequence[FinishedScene]) -> list[str]:
    """What makes these results: the references, if there are any, in as much time as they took, and then the run."""
    root = Path(os.path.relpath(results.folder.parent))
    seconds = [scene.reference.meta.get("seconds", 0) for scene in compared if scene.reference is not None]
    made = [f"{experiment.command('reference', root)} --seconds {math.ceil(max(seconds))}"] if any(seconds) else []
    return [*made, experiment.command("run", root)]


def origin(reference: Reference) -> str:
    """How a reference was made, as far as it says."""
    meta = reference.meta
    said = [meta.get("estimator", "of unknown origin")]
    if reference.has_halves:
        said.append(f"{meta['spp_a'] + meta['spp_b']:,} spp")
    if "seconds" in meta:
        said.append(f"{meta['seconds']:,.0f} s")
    if reference.noise_floor is not None:
        said.append(f"L1 of its noise {summary.number(reference.noise_floor)}")
    return "reference: " + ", ".join(said)


# ---------------------------------------------------------------- images

def viewers(found: Finished, blocks: Sequence[sheet.Block]) -> list[dict[str, Any]]:
    """For each scene its name, a caption, and what the viewer is told."""
    experiment, shown_of = found.experiment, {block.scene: block for block in blocks}
    groups = [pictures(found, scene, shown_of.get(scene.scene.name)) for scene in found.scenes]
    pixels = sum(picture.image[..., 0].size for group in groups for picture in group)
    # The first that is small enough: float32, shared exponents, these averaged over 2 x 2 pixels, over 3 x 3, ...
    forms = itertools.chain([(1, "single")], ((k, "rgbe") for k in itertools.count(1)))
    k, kind = next((k, kind) for k, kind in forms if pixels / k**2 * BYTES[kind] <= LARGEST)
    shown = []
    for i, (finished, scene, group) in enumerate(zip(found.scenes, experiment.scene, groups, strict=True)):
        group = [picture._replace(image=sheet.resize(picture.image, scene.width // k)) for picture in group] if k > 1 else group
        height, width, _ = group[0].image.shape
        caption = f"{sheet.shown(experiment, scene.has_reference)}; {scene.width} \N{MULTIPLICATION SIGN} {scene.height} pixels"
        caption += f", averaged over {k} by {k}" if k > 1 else ""
        caption += f"; {origin(finished.reference)}" if finished.reference is not None else ""
        shown.append({"scene": scene.name, "caption": caption,
                      "aspect": width / height, "data": flip_book(f"viewer-{i}", group, kind)})
    return shown


def pictures(found: Finished, scene: FinishedScene, block: sheet.Block | None) -> list[Picture]:
    """Reference, methods and their error maps; without reference the first seed of each method."""
    if block is None:
        return [Picture(method.name, scene.cells[method.name][0].image()["mean"]) for method in found.experiment.shown]
    errors = [Picture(f"error of {method}", np.repeat(error[..., None], 3, axis=-1), True)
              for method, error in block.error_maps.items()]
    return [Picture("Reference", block.reference), *itertools.starmap(Picture, block.images.items()), *errors]


def flip_book(element: str, group: Sequence[Picture], kind: str) -> dict[str, Any]:
    """What FlipViewer is told of a scene."""
    exposure = tonemap.auto_exposure(np.median([picture.image for picture in group if not picture.is_error], axis=0))
    errors = [picture.image[..., 0] for picture in group if picture.is_error]
    plain = {"activeTMO": "exposure", "exposure": round(math.log2(exposure), 1), "min": 0,
             "max": float(f"{1 / exposure:.2g}"), "useLog": False, "script": "rgb = rgb / (rgb + 1.0);"}
    mapped = plain | {"activeTMO": "falsecolor", "max": sheet.error_scale(errors) if errors else 1}
    encode = rgbe if kind == "rgbe" else np.float32
    return {
        "containerId": element, "colorTheme": "light", "initialZoom": WHOLE_IMAGE, "hideTools": False,
        "width": group[0].image.shape[1], "height": group[0].image.shape[0], "names": [picture.name for picture in group],
        "types": [kind] * len(group), "initialTMO": plain,
        "initialTMOOverrides": [mapped if picture.is_error else None for picture in group],
        "dataUrls": ["data:;base64," + base64.b64encode(np.ascontiguousarray(encode(picture.image)).tobytes()).decode()
                     for picture in group]}


def rgbe(image: np.ndarray) -> np.ndarray:
    """(h, w, 3) -> bytes (h, w, 4): three mantissas and the exponent that they share [Ward 1991]."""
    _, exponent = np.frexp(image.max(axis=-1, keepdims=True))
    mantissas = np.minimum(np.round(np.ldexp(image, 8 - exponent)), 255)
    black = (mantissas == 0).all(axis=-1, keepdims=True)
    return np.concatenate([mantissas, np.where(black, 0, exponent + 128)], axis=-1).astype(np.uint8)


# ---------------------------------------------------------------- numbers

VARIANCE = "var\N{NO-BREAK SPACE}\N{MULTIPLICATION SIGN}\N{NO-BREAK SPACE}s"
HEADERS = ("scene", "method", "L1", "relMSE", "trimmed", VARIANCE, "gain", f"trimmed {VARIANCE}", "trimmed gain",
           f"mean {VARIANCE}", "mean gain", "seeds, passes", "training [s]", "rendering [s]", "spp", "records",
           "bytes a record", "mean", "waited")


def table(rows: Sequence[Mapping[str, Any]]) -> list[list[Number]]:
    """The cells of the table, one list a row of the summary, in the order of HEADERS."""
    lowest = {scene: min((row["l1"] for row in rows if row["scene"] == scene and row["l1"] is not None), default=None)
              for scene in {row["scene"] for row in rows}}
    return [_numbers(row, lowest[row["scene"]]) for row in rows]


def _numbers(row: Mapping[str, Any], lowest: float | None) -> list[Number]:
    def number(key: str, more: str = "") -> Number:
        return Number(summary.number(row[key]) + more, row[key])

    def spread(low: str, high: str) -> str:
        return f" ({summary.number(row[low])}\N{EN DASH}{summary.number(row[high])})" if row[low] is not None else ""

    l1 = number("l1", spread("l1_low", "l1_high") if len(row["seeds"]) > 1 else "")
    return [
        Number(row["scene"], row["scene"]), Number(row["method"], row["method"]),
        l1._replace(best=l1.value is not None and l1.value == lowest), number("relmse"), number("relmse_trimmed"),
        *(Number(summary.with_ends(row, column + kind, "\N{EN DASH}"), row[column + kind])
          for kind in ("", "_trimmed", "_mean") for column in ("work_normalised_variance", "gain")),
        Number(f"{len(row['seeds'])}, {row['variance_passes']:,}", row["variance_passes"]),
        Number(f"{row['train_seconds']:.1f} ({row['training_passes']})", row["train_seconds"]),
        Number(f"{row['render_seconds']:.1f}", row["render_seconds"]),
        *(Number(f"{row[key]:,}", row[key]) for key in ("spp", "records", "bytes_per_record")),
        number("mean", f" \N{PLUS-MINUS SIGN} {summary.number(row['mean_stderr'])}"),
        Number(f"{row['wait_fraction']:.1%}", row["wait_fraction"])]


def machine(environment: Mapping[str, Any]) -> dict[str, str]:
    """env.json, a line a key."""
    def text(value: Any) -> str:
        if isinstance(value, Mapping):
            return ", ".join(f"{key} {text(v)}" for key, v in value.items() if v is not None)
        return str(value)

    return {key.replace("_", " "): text(value) for key, value in environment.items()
            if value is not None and key != "schema_version"}


# ---------------------------------------------------------------- parts

def svg(path: Path, label: str) -> str:
    """A figure of Matplotlib as an element of a page, where several may stand: its identifiers become its own."""
    text = path.read_text(encoding="utf-8")
    head, _, body = text[text.index("<svg"):].partition(">")
    width, box = (re.search(rf' {key}="([^"]*)"', head)[1] for key in ("width", "viewBox"))      # type: ignore[index]
    body = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{path.stem}-", body)
    return (f'<svg xmlns:xlink="http://www.w3.org/1999/xlink" viewBox="{box}" role="img" aria-label="{html.escape(label)}" '
            f'style="max-width: calc({ENLARGED} * {width})">{body}')


def licence() -> str:
    """Of the viewer, which is part of the page."""
    files = importlib.metadata.distribution("simpleimageio")
    return files.read_text("licenses/LICENSE") or files.read_text("LICENSE") or ""
