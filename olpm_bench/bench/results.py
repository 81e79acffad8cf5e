"""Where results live, and in which form: the only place that knows.

A result folder (`results/<stem of the TOML>`):

    experiment.toml  env.json  summary.json  table.csv  report.html  sheet.png
    {figure,gains}.{png,pdf,svg}  crops.{png,pdf}
    cells/<scene>/<method>/<seed>/cell.json         written last: with it the cell is complete
                                  trace.jsonl       one line a checkpoint
                                  image.exr         parts mean, variance (of the mean), count
                                  checkpoints.exr   parts 0, 1, ...: the mean at each line of the trace
                                  failed.json       why there is no cell.json
                                  lock              who is at work on it
    references/<scene-key>/{reference.exr, meta.json}

Every file is written beside its place and renamed, so that it is whole or not there.  JSON has no NaN: null.  Images, traces
and cell.json carry digests: what a disk, a copy or an editor has changed is not believed.
"""
from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import shutil
import socket
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from olpm_bench.transport.settings import InputError

SCHEMA_VERSION = 1
LONGEST_NAME = 80       # of a folder
DEVICE = r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?"


class ResultError(InputError):
    """A result that is missing, broken, or of a newer schema; the message names the file and what to do."""


class NewerSchemaError(ResultError):
    """A file of a later version of olpm-bench: read by nobody here, and overwritten by nobody here."""


def slug(name: str) -> str:
    """A name as a folder: letters, digits, dot, dash and underscore, not too many, and none that Windows keeps for devices."""
    folder = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "unnamed"
    if re.fullmatch(DEVICE, folder, re.IGNORECASE):
        folder = f"_{folder}"
    if len(folder) > LONGEST_NAME:
        folder = f"{folder[:LONGEST_NAME - 9]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return folder


# ---------------------------------------------------------------- files

@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a path beside `path` to write to; it takes the place of `path` if the body succeeds, else it goes.

    Raises:
        OSError: cannot be written; it names `path`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{writer()}.tmp{path.suffix}")
    try:
        yield beside
        os.replace(beside, path)
    except OSError as error:
        if error.filename in (None, str(beside), beside):
            error.filename, error.filename2 = str(path), None
        raise
    finally:
        clean_up(lambda: beside.unlink(missing_ok=True))


def clean_up(remove: Callable[[], None]) -> None:
    """Remove something, also if Ctrl-C comes in the middle."""
    try:
        remove()
    except KeyboardInterrupt:
        remove()
        raise


def check_writable(folder: Path) -> None:
    """
    Raises:
        OSError: no file can be made in the folder, e.g. as it is read-only; it names the folder.
    """
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None


def writer() -> str:
    """Who writes, in the names of unfinished files."""
    return f"{socket.gethostname()}-{os.getpid()}"


def remove_path(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def digest(*content: bytes) -> str:
    found = hashlib.sha256()
    for part in content:
        found.update(part)
    return found.hexdigest()[:16]


def write_text(path: Path, text: str) -> None:
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: NumPy scalars become Python's, NaN and infinity become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)


def write_json(path: Path, value: Any) -> None:
    write_text(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object of ours.

    Raises:
        ResultError: missing or broken.
        NewerSchemaError: written by a later version.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultError(f"{path}: there is no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ResultError(f"{path} is broken: {error}") from None
    if not isinstance(value, dict):
        raise ResultError(f"{path} is broken: not a JSON object")
    check_schema(path, value.get("schema_version"))
    return value


def check_schema(path: Path, version: Any) -> None:
    """
    Raises:
        ResultError: no version; NewerSchemaError: a newer one than ours.
    """
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise ResultError(f"{path}: schema_version = {version!r}; known: 1 to {SCHEMA_VERSION}")
    if version > SCHEMA_VERSION:
        raise NewerSchemaError(f"{path}: schema_version = {version} is newer than this olpm-bench, which reads up to "
                               f"{SCHEMA_VERSION}; update it, or use another --results folder")


def write_exr(path: Path, parts: dict[str, np.ndarray], header: dict[str, Any] | None = None) -> None:
    """A multi-part float32 EXR.

    Args:
        parts: name -> (h, w, 3) as RGB or (h, w) as Y.
        header: kept as JSON in the attribute `olpm_bench` of the first part, beside a digest of header and pixels.

    Raises:
        OSError: cannot be written, e.g. the disk is full.
    """
    import OpenEXR

    common = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    images = {name or "0": np.ascontiguousarray(image, dtype=np.float32) for name, image in parts.items()}
    text = json.dumps(plain(header or {}), allow_nan=False)
    first = {"olpm_bench": text, "olpm_bench_digest": _digest_of_exr(images, text)}
    exr: list[OpenEXR.Part] = []
    for name, image in images.items():
        attributes = dict(common) if exr else common | first
        exr.append(OpenEXR.Part(attributes, {"RGB" if image.ndim == 3 else "Y": image}, name))
    with replacing(path) as beside:
        try:
            OpenEXR.File(exr).write(str(beside))
            read_exr(beside)                    # the last buffer is flushed without a check
        except (RuntimeError, ValueError) as error:
            full = shutil.disk_usage(path.parent).free < sum(i.nbytes for i in parts.values())
            code = errno.ENOSPC if full or "No space" in str(error) else errno.EIO
            raise OSError(code, os.strerror(code) if code == errno.ENOSPC else str(error), str(path)) from None


def _digest_of_exr(parts: dict[str, np.ndarray], header: str) -> str:
    """Of the pixels, row by row, and the header's text.  OpenEXR reads many files that were cut short without a complaint."""
    return digest(header.encode(), *(piece for name, image in sorted(parts.items())
                                     for piece in (name.encode(), str(image.shape[:2]).encode(), image.tobytes())))


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """All parts, (h, w, 3) or (h, w, 1) float32, and the JSON of `write_exr`.

    Raises:
        ResultError: missing or broken; of a file with a digest, whatever in it has changed.
    """
    import OpenEXR

    if not path.is_file():
        raise ResultError(f"{path}: there is no such file")
    try:
        exr = OpenEXR.File(str(path))
        parts, text, written = {}, "{}", None
        for index, part in enumerate(exr.parts):
            channels = part.channels
            if {"R", "G", "B"} <= channels.keys():
                pixels = np.stack([channels[c].pixels for c in "RGB"], axis=-1)
            else:
                pixels = next(channels[c] for c in ("RGB", "RGBA", "Y") if c in channels).pixels
            pixels = pixels[..., :3] if pixels.ndim == 3 else pixels[..., None]
            parts[part.name() or str(index)] = np.asarray(pixels, np.float32)
            if index == 0:
                text, written = part.header.get("olpm_bench", "{}"), part.header.get("olpm_bench_digest")
        header = json.loads(text)
    except (RuntimeError, ValueError, TypeError, StopIteration, AttributeError, MemoryError, RecursionError) as error:
        raise ResultError(f"{path} is broken: {str(error) or 'no RGB or Y channel'}") from None
    if not parts or not isinstance(header, dict) or any(image.ndim != 3 or image.size == 0 for image in parts.values()):
        raise ResultError(f"{path} is broken: it holds no image")
    if written is not None and written != _digest_of_exr(parts, text):
        raise ResultError(f"{path} is broken: its digest is another")
    return parts, header


# ---------------------------------------------------------------- cells

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


@dataclass
class Accumulator:
    """Running mean of passes, and the variance of that mean from their spread (Welford 1962, weighted by samples).

    Pixels are float64: a long render adds many small passes.
    """
    mean: np.ndarray        # (h, w, 3)
    m2: np.ndarray          # (h, w, 3) sum over passes of spp (x - mean)^2
    spp: int = 0
    passes: int = 0

    @staticmethod
    def empty(height: int, width: int) -> Accumulator:
        return Accumulator(np.zeros((height, width, 3)), np.zeros((height, width, 3)))

    @staticmethod
    def resume(mean: np.ndarray, variance: np.ndarray, spp: int, passes: int) -> Accumulator:
        """The accumulator whose mean, variance and counts these are."""
        return Accumulator(mean.astype(np.float64), variance.astype(np.float64) * max(passes - 1, 0) * spp, spp, passes)

    def add(self, image: np.ndarray, spp: int) -> None:
        """Add a pass: an image (h, w, 3) of `spp` samples a pixel."""
        total, delta = self.spp + spp, image - self.mean
        mean = self.mean + delta * (spp / total)
        m2 = self.m2 + spp * delta * (image - mean)
        self.mean, self.m2, self.spp, self.passes = mean, m2, total, self.passes + 1       # at once: Ctrl-C tears nothing

    def variance(self) -> np.ndarray:
        """Variance of `mean` (h, w, 3); infinite before there are two passes."""
        if self.passes < 2:
            return np.full_like(self.mean, np.inf)
        return self.m2 / ((self.passes - 1) * self.spp)


@dataclass
class Reference:
    """A converged image, as two halves made with different seeds.

    An EXR of another renderer has no halves: then a and b are the same image and the noise floor is unknown.
    """
    a: np.ndarray               # (h, w, 3) linear RGB
    b: np.ndarray
    a_variance: np.ndarray      # (h, w, 3) variance of the mean
    b_variance: np.ndarray
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def has_halves(self) -> bool:
        return self.a is not self.b

    @property
    def mean(self) -> np.ndarray:
        """Both halves together, weighted by their samples (h, w, 3)."""
        if not self.has_halves:
            return self.a
        n_a, n_b = self.meta["spp_a"], self.meta["spp_b"]
        return ((n_a * self.a.astype(np.float64) + n_b * self.b) / (n_a + n_b)).astype(np.float32)

    @property
    def noise_floor(self) -> float | None:
        """mean |A - B| / 2: about the L1 error of the mean; None if unknown."""
        return float(np.mean(np.abs(self.a.astype(np.float64) - self.b))) / 2 if self.has_halves else None


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


# ---------------------------------------------------------------- references

def find_reference(key: str, folders: list[Path]) -> Path | None:
    """The first of `folders` (each a `references` folder) that has a reference with this key."""
    return next((f / key for f in folders if (f / key / "meta.json").exists()), None)


def read_reference(path: Path, width: int, height: int) -> Reference:
    """A reference folder, or an EXR of another renderer, for an image of `width` x `height`.

    Either may be larger by a whole factor: its pixels are averaged, which with the box filter is the smaller image.

    Raises:
        ResultError: missing, broken, newer, or of another size.
    """
    if path.is_file():
        parts, _ = read_exr(path)
        image = next(iter(parts.values()))
        if image.shape[2] != 3:
            raise ResultError(f"reference {path} has no RGB image")
        if not np.isfinite(image).all():
            raise ResultError(f"reference {path} has pixels that are not finite")
        image = _shrink(image, width, height, path)
        unknown = np.full_like(image, np.inf)
        return Reference(image, image, unknown, unknown, {"estimator": f"{path.name}, of another renderer"})
    try:
        meta = read_json(path / "meta.json")
        parts, header = read_exr(path / "reference.exr")
    except NewerSchemaError:
        raise
    except ResultError as error:
        raise ResultError(f"{error}; remove the folder and make it again") from None
    meta |= header          # of the same moment as the pixels, should the two files differ
    for name in ("a.mean", "b.mean", "a.variance", "b.variance"):
        if name not in parts or not np.isfinite(parts[name]).all():
            raise ResultError(f"{path / 'reference.exr'} is broken: no finite part '{name}'; "
                              "remove the folder and make it again")
    averaged = parts["a.mean"].shape[1] // width                # pixels that become one, along a side
    images = [_shrink(parts[name], width, height, path) for name in ("a.mean", "b.mean", "a.variance", "b.variance")]
    return Reference(images[0], images[1], images[2] / averaged ** 2, images[3] / averaged ** 2, meta)


def _shrink(image: np.ndarray, width: int, height: int, path: Path) -> np.ndarray:
    h, w, _ = image.shape
    factor = w // width
    if factor < 1 or (w, h) != (factor * width, factor * height):
        raise ResultError(f"reference {path} is {w}x{h}, the experiment's image is {width}x{height}: "
                          "must be the same, or that times a whole number")
    return image.reshape(height, factor, width, factor, 3).mean(axis=(1, 3), dtype=np.float64).astype(np.float32)


def write_reference(folder: Path, reference: Reference) -> None:
    """Write a reference, meta.json last."""
    parts = {"a.mean": reference.a, "b.mean": reference.b,
             "a.variance": reference.a_variance, "b.variance": reference.b_variance}
    write_exr(folder / "reference.exr", parts, reference.meta)
    write_json(folder / "meta.json", {"schema_version": SCHEMA_VERSION, **reference.meta})
