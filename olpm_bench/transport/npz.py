"""Arrays from files that may be broken, or made by somebody else: either they are what they have to be, or there is one error."""
from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from olpm_bench.transport import headroom
from olpm_bench.transport.settings import InputError

COPIES = 2              # of arrays that are read: NumPy's, and what is made of them


def read(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file; none of them can hold objects, and so no code.

    Raises:
        InputError: it is no such file, or not a whole one, or its arrays take more memory than is free.
        OSError: it can't be opened.
    """
    with open(path, "rb") as stream:
        try:
            archive = np.load(stream, allow_pickle=False)
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("it holds a single array")
            unpacked = sum(array.file_size for array in zipfile.ZipFile(stream).infolist())
            headroom.require(COPIES * unpacked, f"{path}: its arrays", "it can only be read where there is more")
            return dict(archive)
        except InputError:
            raise
        except Exception as error:          # NumPy, zipfile and zlib between them raise a dozen types
            raise InputError(f"{path}: not a whole .npz file: {str(error) or type(error).__name__}") from error


def checked(arrays: dict[str, np.ndarray], name: str, dtype: type | np.dtype, *shape: int) -> np.ndarray:
    """
    Raises:
        ValueError: there is no such array, or it is not of that type and shape.
    """
    if name not in arrays:
        raise ValueError(f"no array {name!r}")
    array = arrays[name]
    if array.dtype != dtype or array.shape != shape:
        raise ValueError(f"array {name!r} is {array.dtype} {array.shape}, must be {np.dtype(dtype)} {shape}")
    return array


def require(ok: bool | np.bool, name: str) -> None:
    """
    Raises:
        ValueError: not ok.
    """
    if not ok:
        raise ValueError(f"array {name!r} has impossible values")
