"""OpenEXR images with our header and a digest: multi-part, float32."""
from __future__ import annotations

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from olpm_bench.bench.files import ResultError, digest, plain, replacing
from olpm_bench.transport import headroom
from olpm_bench.transport.settings import InputError

COPIES = 3              # of images that are read: OpenEXR's, those in float32, and what is made of them


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


def _bytes_of(header: dict[str, Any]) -> int:
    """Of the pixels of a part, when they are float32."""
    first, last = header["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(first, last, strict=True))
    return width * height * len(header["channels"]) * 4


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """All parts, (h, w, 3) or (h, w, 1) float32, and the JSON of `write_exr`.

    Raises:
        ResultError: missing or broken; of a file with a digest, whatever in it has changed.
        InputError: its images take more memory than is free.
    """
    import OpenEXR

    if not path.is_file():
        raise ResultError(f"{path}: there is no such file")
    try:
        size = sum(_bytes_of(part.header) for part in OpenEXR.File(str(path), header_only=True).parts)
        headroom.require(COPIES * size, f"{path}: its images", "it can only be read where there is more")
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
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, StopIteration, AttributeError, KeyError, MemoryError, RecursionError) as error:
        raise ResultError(f"{path} is broken: {str(error) or 'no RGB or Y channel'}") from None
    if not parts or not isinstance(header, dict) or any(image.ndim != 3 or image.size == 0 for image in parts.values()):
        raise ResultError(f"{path} is broken: it holds no image")
    if written is not None and written != _digest_of_exr(parts, text):
        raise ResultError(f"{path} is broken: its digest is another")
    return parts, header
