"""The results of an experiment: its folder, and the cells in it.

A result folder (`results/<stem of the TOML>`):

    experiment.toml  env.json  summary.json  table.csv  report.html  sheet.png
    {figure,gains,sweep}.{png,pdf,svg}  crops.{png,pdf}
    cells/<scene>/<method>/<seed>/cell.json         written last: with it the cell is complete
                                  trace.jsonl       one line a checkpoint
                                  image.exr         parts mean, variance (of the mean), count
                                  checkpoints.exr   parts 0, 1, ...: the mean at each line of the trace
                                  failed.json       why there is no cell.json
                                  lock              who is at work on it

Every file is written beside its place and renamed, so that it is whole or not there.  JSON has no NaN: null.  Images, traces
and cell.json carry digests: what a disk, a copy or an editor has changed is not believed.
"""
from __future__ import annotations

import json
import os
import shutil
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from olpm_bench.bench.exr import read_exr, write_exr
from olpm_bench.bench.files import (
    SCHEMA_VERSION,
    NewerSchemaError,
    ResultError,
    check_schema,
    clean_up,
    digest,
    plain,
    read_json,
    slug,
    write_json,
    write_text,
    writer,
)

# What a report draws, as far as there is something to draw.
DRAWN = (*(f"{name}.{suffix}" for name in ("figure", "gains", "sweep") for suffix in ("png", "pdf", "svg")),
         "sheet.png", "crops.png", "crops.pdf", "report.html")


@dataclass
class Cell:
    """A complete cell: what was measured, and where its images are."""
    scene: str
    method: str
    seed: int
    info: dict[str, Any]            # cell.json
    trace: list[dict[str, Any]]     # one dict a checkpoint
    folder: Path

    def image(self) -> dict[str, np.ndarray]:
        """``mean`` (h, w, 3), ``variance`` of the mean (h, w, 3; infinite after a single pass), ``count`` (h, w, 1)."""
        parts, _ = read_exr(self.folder / "image.exr")
        for name in ("mean", "variance", "count"):
            if name not in parts:
                raise ResultError(f"{self.folder / 'image.exr'} is broken: no part '{name}'")
        return parts

    def config(self) -> dict[str, Any]:
        """What determined it, from the header of its image."""
        return read_exr(self.folder / "image.exr")[1]

    def checkpoints(self) -> list[np.ndarray]:
        """The mean image (h, w, 3) at each line of the trace."""
        parts, _ = read_exr(self.folder / "checkpoints.exr")
        if set(parts) != {str(i) for i in range(len(self.trace))}:
            raise ResultError(f"{self.folder / 'checkpoints.exr'} is broken: {len(parts)} images for {len(self.trace)} "
                              "checkpoints")
        return [parts[str(i)] for i in range(len(self.trace))]


def _digests(info: dict[str, Any], trace: Path) -> dict[str, str]:
    """What cell.json says of itself and of the trace.  Its key is compared with the experiment's instead."""
    measured = {name: value for name, value in info.items() if name != "key"}
    try:
        content = trace.read_bytes()
    except OSError as error:
        raise ResultError(f"{trace} is broken: {error}") from None
    return {"cell.json": digest(json.dumps(measured, sort_keys=True).encode()), "trace.jsonl": digest(content)}


class Results:
    """The result folder of one experiment.

    Args:
        folder: `<results>/<stem of the TOML>`; need not exist.

    Raises:
        NewerSchemaError: the folder was written by a later version.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        for name in ("summary.json", "env.json"):
            try:
                read_json(self.folder / name)
            except NewerSchemaError:
                raise
            except ResultError:         # missing or broken: both are written anew
                continue
        try:
            path = self.folder / "experiment.toml"
            check_schema(path, tomllib.loads(path.read_text(encoding="utf-8"))["schema_version"])
        except NewerSchemaError:
            raise
        except (OSError, ValueError, KeyError):
            return

    def write_json(self, name: str, value: dict[str, Any]) -> None:
        write_json(self.folder / name, value)

    def write_text(self, name: str, text: str) -> None:
        write_text(self.folder / name, text)

    def has_environment(self) -> bool:
        """Whether there is an env.json that can be read."""
        try:
            read_json(self.folder / "env.json")
        except ResultError:
            return False
        return True

    def cell_folder(self, scene: str, method: str, seed: int) -> Path:
        return self.folder / "cells" / slug(scene) / slug(method) / str(seed)

    def read_cell(self, scene: str, method: str, seed: int) -> Cell | None:
        """The cell if it is complete, else None.

        Raises:
            ResultError: it has a cell.json, but that or the trace is broken.
            NewerSchemaError: of a later version.
        """
        folder = self.cell_folder(scene, method, seed)
        if not (folder / "cell.json").exists():
            return None
        info = read_json(folder / "cell.json")
        digests = info.pop("digests", {})           # older cells have none
        if digests and digests != _digests(info, folder / "trace.jsonl"):
            raise ResultError(f"{folder / 'cell.json'} or trace.jsonl is broken: their digests are others")
        try:
            lines = (folder / "trace.jsonl").read_text(encoding="utf-8").splitlines()
            trace = [json.loads(line) for line in lines if line.strip()]
        except (OSError, ValueError) as error:
            raise ResultError(f"{folder / 'trace.jsonl'} is broken: {error}") from None
        return Cell(scene, method, seed, info, trace, folder)

    def verified_cell(self, scene: str, method: str, seed: int) -> Cell | None:
        """As `read_cell`, and its images can be read."""
        cell = self.read_cell(scene, method, seed)
        if cell is not None:
            cell.image()
            cell.checkpoints()
        return cell

    def write_cell(self, scene: str, method: str, seed: int, info: dict[str, Any], trace: list[dict[str, Any]],
                   image: dict[str, np.ndarray], checkpoints: list[np.ndarray],
                   config: dict[str, Any] | None = None) -> Cell:
        """Write a complete cell, cell.json last.

        Args:
            image: ``mean`` and ``variance`` (h, w, 3), ``count`` (h, w).
            config: what goes into the header of the image.

        Raises:
            OSError: cannot be written; what was there stays as it was.
        """
        folder = self.cell_folder(scene, method, seed)
        new = folder / f".cell.{writer()}.tmp"
        info = plain({"schema_version": SCHEMA_VERSION, "scene": scene, "method": method, "seed": seed, **info})
        try:
            write_exr(new / "image.exr", image, config)
            write_exr(new / "checkpoints.exr", {str(i): c for i, c in enumerate(checkpoints)})
            write_text(new / "trace.jsonl", "".join(json.dumps(plain(line), allow_nan=False) + "\n" for line in trace))
            write_json(new / "cell.json", {**info, "digests": _digests(info, new / "trace.jsonl")})
            (folder / "cell.json").unlink(missing_ok=True)      # an old cell.json never stands beside new images
            for name in ("image.exr", "checkpoints.exr", "trace.jsonl", "cell.json"):
                os.replace(new / name, folder / name)
        except OSError as error:
            error.filename = str(error.filename).replace(str(new), str(folder))
            raise
        finally:
            clean_up(lambda: shutil.rmtree(new, ignore_errors=True))
        (folder / "failed.json").unlink(missing_ok=True)
        return Cell(scene, method, seed, info, trace, folder)

    def failure(self, scene: str, method: str, seed: int) -> tuple[int, str] | None:
        """When a run of the cell failed [ns] and why; None if none did since it last was complete."""
        path = self.cell_folder(scene, method, seed) / "failed.json"
        try:
            return path.stat().st_mtime_ns, str(read_json(path).get("reason"))
        except (OSError, ResultError):
            return None

    def write_failure(self, scene: str, method: str, seed: int, reason: str) -> None:
        """Say why a cell is not complete.  One of other settings that is there stays."""
        write_json(self.cell_folder(scene, method, seed) / "failed.json",
                   {"schema_version": SCHEMA_VERSION, "scene": scene, "method": method, "seed": seed, "reason": reason})
