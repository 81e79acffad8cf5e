"""OpenEXR images, float32, with our header and a digest.

We write one part: the first image is its channels R, G and B, which every program shows, and each further one a layer,
`variance.R` and so on.  We read that, files of several parts as we wrote them earlier, and what other renderers write:
layers in one part (`ViewLayer.Combined.R` of Blender), several parts, or both.
"""
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

UNNAMED = "0"           # the image of the first part, where neither layer nor part have a name
COPIES = 3              # of images that are read: OpenEXR's, those in float32, and what is made of them


def write_exr(path: Path, images: dict[str, np.ndarray], header: dict[str, Any] | None = None) -> None:
    """One part with a layer for each image; the first is the layer without a name, its name is kept in the header.

    Args:
        images: name -> (h, w, 3) as RGB or (h, w) as Y, all of one size.
        header: kept as JSON in the attribute `olpm_bench`, beside a digest of header and pixels.

    Raises:
        ValueError: images of several sizes.
        OSError: cannot be written, e.g. the disk is full.
    """
    import OpenEXR

    images = {name or UNNAMED: np.ascontiguousarray(image, dtype=np.float32) for name, image in images.items()}
    if len({image.shape[:2] for image in images.values()}) > 1:
        raise ValueError(f"{path}: images of several sizes do not fit into one part")
    text = json.dumps(plain(header or {}), allow_nan=False)
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "olpm_bench": text,
                  "olpm_bench_digest": _digest_of_exr(images, text), "olpm_bench_layers": json.dumps(list(images))}
    channels = {}
    for index, (name, image) in enumerate(images.items()):
        prefix = f"{name}." if index > 0 else ""
        if image.ndim == 2:
            channels[f"{prefix}Y"] = image
        else:
            channels |= {f"{prefix}{colour}": np.ascontiguousarray(image[..., i]) for i, colour in enumerate("RGB")}
    with replacing(path) as beside:
        try:
            OpenEXR.File(attributes, channels).write(str(beside))
            read_exr(beside)                    # the last buffer is flushed without a check
        except (RuntimeError, ValueError) as error:
            full = shutil.disk_usage(path.parent).free < sum(i.nbytes for i in images.values())
            code = errno.ENOSPC if full or "No space" in str(error) else errno.EIO
            raise OSError(code, os.strerror(code) if code == errno.ENOSPC else str(error), str(path)) from None


def _digest_of_exr(images: dict[str, np.ndarray], header: str) -> str:
    """Of the pixels, row by row, and the header's text.  OpenEXR reads many files that were cut short without a complaint."""
    return digest(header.encode(), *(piece for name, image in sorted(images.items())
                                     for piece in (name.encode(), str(image.shape[:2]).encode(), image.tobytes())))


def _bytes_of(header: dict[str, Any]) -> int:
    """Of the pixels of a part, when they are float32."""
    first, last = header["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(first, last, strict=True))
    return width * height * len(header["channels"]) * 4


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """All images of a file, (h, w, 3) or (h, w, 1) float32, and the JSON of `write_exr`.

    Images are named by layer and part ("0" for one without either).  Ours come in the order in which they were written; of
    another renderer's, the first is what it shows: the layer without a name, or else one called "Combined".

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
        exr = OpenEXR.File(str(path), separate_channels=True)
        attributes = exr.parts[0].header if exr.parts else {}
        text, written = attributes.get("olpm_bench", "{}"), attributes.get("olpm_bench_digest")
        ours = json.loads(attributes.get("olpm_bench_layers", "[]"))
        images: dict[str, np.ndarray] = {}
        for index, part in enumerate(exr.parts):
            for layer, image in _layers(part.channels).items():
                root = part.name() or (ours[0] if ours else str(index))
                name = layer or root
                images[name if name not in images else f"{root}.{name}"] = image
        header = json.loads(text)
        first = {name: rank for rank, name in enumerate(ours)}
        images = dict(sorted(images.items(), key=lambda item: first.get(item[0], _rank(item[0], len(ours)))))
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, AttributeError, KeyError, IndexError, MemoryError, RecursionError) as error:
        raise ResultError(f"{path} is broken: {error}") from None
    if not images:
        raise ResultError(f"{path} is broken: no RGB or Y channel")
    if not isinstance(header, dict) or any(image.ndim != 3 or image.size == 0 for image in images.values()):
        raise ResultError(f"{path} is broken: it holds no image")
    if written is not None and written != _digest_of_exr(images, text):
        raise ResultError(f"{path} is broken: its digest is another")
    return images, header


def _layers(channels: dict[str, Any]) -> dict[str, np.ndarray]:
    """The images among the channels of a part by the name of their layer, which ends at the last dot; "" without one."""
    grouped: dict[str, dict[str, Any]] = {}
    for name, channel in channels.items():
        layer, _, component = name.rpartition(".")
        grouped.setdefault(layer, {})[component.upper()] = channel.pixels
    images = {}
    for layer, components in grouped.items():
        if {"R", "G", "B"} <= components.keys():
            images[layer] = np.stack([components[c] for c in "RGB"], axis=-1).astype(np.float32)
        elif components.keys() in ({"Y"}, {"Y", "A"}):          # with RY and BY it would be a colour image
            images[layer] = np.asarray(components["Y"], np.float32)[..., None]
    return images


def _rank(name: str, after: int) -> int:
    """Where an image of another renderer stands: behind `after` others, and what that renderer shows before its passes."""
    shown = name == UNNAMED or "Combined" in name.split(".")
    return after if shown else after + 1
