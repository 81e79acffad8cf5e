"""The results of an experiment: its folder, and the cells in it.

A result folder (`results/<stem of the TOML>`):

    experiment.toml  env.json  summary.json  table.csv  report.html  sheet.png
    {figure,gains,sweep}.{png,pdf,svg}  crops.{png,pdf}
    cells/<scene>/<method>/<seed>/cell.json         written last: with it the cell is complete
                                  trace.jsonl       one line a checkpoint
                                  image.exr         layers mean, variance (of the mean), count
                                  checkpoints.exr   layers 0, 1, ...: the mean at each line of the trace
                                  failed.json       why there is no cell.json
                                  lock              who is at work on it

Every file is written beside its place and renamed, so that it is whole or not there.  JSON has no NaN: null.  cell.json holds
digests of itself and of the files beside it: what a disk, a copy or an editor has changed, or is another cell's, is not believed.
"""
from __future__ import annotations

import dataclasses
import json
import os
import shutil
import tomllib
from collections.abc import Mapping, Sequence
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
from olpm_bench.bench.lock import Alive

TRAINED = 0.5           # share of what the camera sees whose records guide, below which that is told
FIELD_BYTES = {"mi.Float": 16, "mi.UInt32": 4}      # of a field of `Particles`, for each: four numbers, or one index
# What a report draws, as far as there is something to draw.
DRAWN = (*(f"{name}.{suffix}" for name in ("figure", "gains", "sweep") for suffix in ("png", "pdf", "svg")),
         "sheet.png", "crops.png", "crops.pdf", "report.html")


@dataclasses.dataclass
class Cell:
    """A complete cell: what was measured, and where its images are."""
    scene: str
    method: str
    seed: int
    info: dict[str, Any]            # cell.json
    trace: list[dict[str, Any]]     # one dict a checkpoint
    folder: Path
    size: tuple[int, int] | None = None         # (height, width) that its images must have, where that is known

    def image(self) -> dict[str, np.ndarray]:
        """``mean`` (h, w, 3), ``variance`` of the mean (h, w, 3; infinite after a single pass), ``count`` (h, w, 1)."""
        parts = self._parts("image.exr")
        for name in ("mean", "variance", "count"):
            if name not in parts:
                raise ResultError(f"{self.folder / 'image.exr'} is broken: no part '{name}'")
        return parts

    def config(self) -> dict[str, Any]:
        """What determined it, from the header of its image."""
        return read_exr(self.folder / "image.exr")[1]

    def checkpoints(self) -> list[np.ndarray]:
        """The mean image (h, w, 3) at each line of the trace."""
        parts = self._parts("checkpoints.exr")
        if set(parts) != {str(i) for i in range(len(self.trace))}:
            raise ResultError(f"{self.folder / 'checkpoints.exr'} is broken: {len(parts)} images for {len(self.trace)} "
                              "checkpoints")
        return [parts[str(i)] for i in range(len(self.trace))]

    def memory(self) -> int | None:
        """Bytes of its guide, and of the most particles stored at once; None if it says nothing of its passes."""
        if "passes" not in self.info:
            return None
        stored = max((done["stored"] for done in self.info["passes"]), default=0)
        return int(self.info["records"] * self.info["bytes_per_record"] + bytes_per_particle() * stored)

    def _parts(self, name: str) -> dict[str, np.ndarray]:
        parts, _ = read_exr(self.folder / name)
        for image in parts.values():
            if (found := image.shape[:2]) != (size := self.size or found):
                raise ResultError(f"{self.folder / name} is broken: {found[1]}x{found[0]} pixels in place of {size[1]}x{size[0]}")
        return parts


def bytes_per_particle() -> int:
    """What a particle takes while it is stored; without the places that are kept free for particles that may split."""
    from olpm_bench.transport.particles import Particles  # imports Mitsuba

    return sum(FIELD_BYTES.get(str(field.type), 0) for field in dataclasses.fields(Particles))


def warnings(infos: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the training of a method's cells in a scene has warned of, once each; and how much of what the camera sees is
    guided, in the cell that has least, if that is little.

    Args:
        infos: of the cells, as `bench.cell.measure` yields them.
    """
    said = [warning for info in infos for warning in info.get("warnings", [])]              # older cells say less
    trained = min((share for info in infos if (share := info.get("trained")) is not None), default=1.0)
    if trained < TRAINED:
        said.append(f"only {trained:.0%} of the surfaces that the camera sees have records with particles enough to guide: more "
                    "photons or passes, or a larger record_radius; or light does not enter what it sees")
    return list(dict.fromkeys(said))


def _digests(info: dict[str, Any], folder: Path) -> dict[str, str]:
    """What cell.json says of itself and of the files beside it.

    Raises:
        ResultError: one is missing.
    """
    found = {"cell.json": digest(json.dumps(info, sort_keys=True).encode())}
    for name in ("trace.jsonl", "image.exr", "checkpoints.exr"):
        try:
            found[name] = digest((folder / name).read_bytes())
        except OSError as error:
            raise ResultError(f"{folder / name} is broken: {error}") from None
    return found


def _older_digest(info: dict[str, Any]) -> str:
    """What earlier versions said of cell.json: of all but its key."""
    return digest(json.dumps({name: value for name, value in info.items() if name != "key"}, sort_keys=True).encode())


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

    def read_cell(self, scene: str, method: str, seed: int, size: tuple[int, int] | None = None) -> Cell | None:
        """The cell if it is complete, else None.

        Args:
            size: (height, width) that its images must have.

        Raises:
            ResultError: it has a cell.json, but that or a file beside it is broken, or another cell's.
            NewerSchemaError: of a later version.
        """
        folder = self.cell_folder(scene, method, seed)
        if not (folder / "cell.json").exists():
            return None
        info = read_json(folder / "cell.json")
        digests = info.pop("digests", None)
        if not isinstance(digests, dict):
            raise ResultError(f"{folder / 'cell.json'} is broken: it has no digests")
        known = _digests(info, folder)
        if "cell.json" in digests and digests["cell.json"] == _older_digest(info):
            known["cell.json"] = digests["cell.json"]
        for name, found in known.items():
            if found != digests.get(name):
                raise ResultError(f"{folder / name} is broken: its digest is another")
        if (info.get("scene"), info.get("method"), info.get("seed")) != (scene, method, seed):
            raise ResultError(f"{folder / 'cell.json'} is of another cell")
        try:
            lines = (folder / "trace.jsonl").read_text(encoding="utf-8").splitlines()
            trace = [json.loads(line) for line in lines if line.strip()]
        except (OSError, ValueError) as error:
            raise ResultError(f"{folder / 'trace.jsonl'} is broken: {error}") from None
        return Cell(scene, method, seed, info, trace, folder, size)

    def verified_cell(self, scene: str, method: str, seed: int, size: tuple[int, int] | None = None) -> Cell | None:
        """As `read_cell`, and its images can be read."""
        cell = self.read_cell(scene, method, seed, size)
        if cell is not None:
            cell.image()
            cell.checkpoints()
        return cell

    def write_cell(self, scene: str, method: str, seed: int, info: dict[str, Any], trace: list[dict[str, Any]],
                   image: dict[str, np.ndarray], checkpoints: list[np.ndarray], config: dict[str, Any] | None = None,
                   alive: Alive | None = None) -> Cell:
        """Write a complete cell, cell.json last.

        Args:
            image: ``mean`` and ``variance`` (h, w, 3), ``count`` (h, w).
            config: what goes into the header of the image.
            alive: of the lock: who has lost it leaves what is there to who took it over.

        Raises:
            OSError, LockedError: cannot be written, or not by us any more; what was there stays as it was.
        """
        folder = self.cell_folder(scene, method, seed)
        new = folder / f".cell.{writer()}.tmp"
        info = plain({"schema_version": SCHEMA_VERSION, "scene": scene, "method": method, "seed": seed, **info})
        try:
            write_exr(new / "image.exr", image, config)
            write_exr(new / "checkpoints.exr", {str(i): c for i, c in enumerate(checkpoints)})
            write_text(new / "trace.jsonl", "".join(json.dumps(plain(line), allow_nan=False) + "\n" for line in trace))
            write_json(new / "cell.json", {**info, "digests": _digests(info, new)})
            if alive is not None:
                alive(at_once=True)         # after all that takes long
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
