"""Uploaded arrays: .npy files and JSON lists → int64 or float64, finite, mapped from disk."""

from __future__ import annotations

import math
import mmap
import os
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from service.uploads import InvalidUpload, TooLargeUpload

#: The header of an array is short; a structured one may be long.
_MAX_HEADER_BYTES = 4096
_MAX_NDIM = 8
#: Numbers checked or converted at once.
_STEP = 2**20


def read_npy(file: IO[bytes], scratch: IO[bytes], limit: int) -> npt.NDArray[Any]:
    """Array of a .npy file, as int64 or float64 in C order; nothing in it is ever executed.

    Parameters
    ----------
    file : file
        The upload.
    scratch : file
        Empty; holds the numbers if they must be converted, so that memory stays small.
    limit : int
        Most bytes of the array as it is stored.

    Returns
    -------
    ndarray
        Mapped from `file` or `scratch`, read-only.

    Raises
    ------
    InvalidUpload
        If it is no such file, or holds objects, complex numbers, NaN or no numbers, or is truncated.
    TooLargeUpload
        If the array is larger than the limit.
    """
    shape, fortran, dtype = _header(file)
    start, size = file.tell(), os.fstat(file.fileno()).st_size
    if dtype.kind not in "iuf" or dtype.hasobject or dtype.itemsize > 8:
        raise InvalidUpload(f"arrays hold integers or real numbers of at most 64 bits, not {str(dtype)[:60]}")
    count = math.prod(shape)
    if not 1 <= len(shape) <= _MAX_NDIM or count == 0:
        wanted = f"one to {_MAX_NDIM} axes and at least one number"
        raise InvalidUpload(f"arrays have {wanted}, not the shape {str(shape)[:100]}")
    if 8 * count > limit:
        raise TooLargeUpload(f"the array takes {8 * count:,} bytes; this service takes at most {limit:,}")
    if start + count * dtype.itemsize != size:
        raise InvalidUpload(
            f"the header announces {count * dtype.itemsize:,} bytes of numbers; the file has {size - start:,}"
        )
    view = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    flat: npt.NDArray[Any] = np.frombuffer(view, dtype, count, start)
    _check_numbers(flat)
    kept = np.dtype(np.float64 if dtype.kind == "f" else np.int64)
    # A map of the file is as good as an array only where its numbers are aligned.
    if dtype == kept and dtype.isnative and start % 8 == 0 and (not fortran or len(shape) == 1):
        return flat.reshape(shape)
    scratch.truncate(8 * count)
    converted = np.frombuffer(mmap.mmap(scratch.fileno(), 8 * count), kept).reshape(shape)
    converted[...] = flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
    converted.flags.writeable = False
    return converted


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    try:
        version = np.lib.format.read_magic(file)
        reader = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, dtype = reader(file, max_header_size=_MAX_HEADER_BYTES)
    except (ValueError, KeyError, TypeError, SyntaxError, RecursionError, MemoryError, EOFError):
        raise InvalidUpload("the body is no .npy file of version 1 or 2 with a readable header") from None
    if any(type(length) is not int or length < 0 for length in shape):
        raise InvalidUpload("the shape in the .npy header is not made of counts")
    return tuple(shape), fortran, dtype


def _check_numbers(flat: npt.NDArray[Any]) -> None:
    for start in range(0, len(flat), _STEP):
        part = flat[start : start + _STEP]
        if part.dtype.kind == "f" and not (finite := np.isfinite(part)).all():
            bad = start + int(np.flatnonzero(~finite)[0])
            raise InvalidUpload(f"number {bad} of the array, in the order of the file, is {flat[bad]}")
        if part.dtype.kind == "u" and part.max() > np.iinfo(np.int64).max:
            raise InvalidUpload("the array holds integers beyond 63 bits")
