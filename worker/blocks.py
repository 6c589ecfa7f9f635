"""Arrays as blocks of rows, each with its sha256: written from numpy, verified whenever they are read."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from worker.manifests import DTYPES, Block, StoredArray
from worker.objects import Bytes, Objects

#: Bytes of a block: one is read and verified in 10 ms, and a hundred make a large array.
BLOCK_BYTES: Final = 8 * 2**20
#: Threads that write blocks, beside the one that hashes whole arrays; they wait for the disk together.
_WRITERS: Final = 4

Array = npt.NDArray[Any]


class DamagedBlock(Exception):
    """A block that is missing or is not what was written."""


def write_arrays(objects: Objects, arrays: Mapping[str, Array], written: list[str]) -> dict[str, StoredArray]:
    """Write the rows of arrays into new blobs.

    Parameters
    ----------
    objects : Objects
    arrays : mapping of ndarray
        float64, int64, int32 or bool, with at least one axis; of any byte order and layout.
    written : list of str
        Gets the name of every blob as it is written, so that they can be deleted whatever happens.

    Raises
    ------
    TypeError, ValueError
        If one has another element type, or no axis; then nothing is written.
    """
    for array in arrays.values():
        if array.dtype.name not in DTYPES:
            raise TypeError(f"an array of {array.dtype} cannot be stored, only of {', '.join(DTYPES)}")
        if array.ndim == 0:
            raise ValueError("an array without axes cannot be stored")

    def write(content: Bytes, rows: int) -> Block:
        digest = hashlib.sha256(content.data).hexdigest()
        written.append(objects.write_blob(content))
        return Block(blob=written[-1], rows=rows, sha256=digest)

    digests: dict[str, str] = {}
    waiting: dict[str, list[Future[Block]]] = {}
    with ThreadPoolExecutor(_WRITERS) as pool:
        for name, array in arrays.items():
            whole = hashlib.sha256()
            waiting[name] = futures = []
            for rows, content in _pieces(array):
                futures.append(pool.submit(write, content, rows))
                whole.update(content.data)
                if len(futures) > 2 * _WRITERS:  # bounds the copies of an array that is not contiguous
                    futures[-2 * _WRITERS].result()
            digests[name] = whole.hexdigest()
    return {
        name: StoredArray(
            array.shape, array.dtype.name, digests[name], tuple(future.result() for future in waiting[name])
        )
        for name, array in arrays.items()
    }


def _pieces(array: Array) -> Iterator[tuple[int, Bytes]]:
    """Blocks of rows: how many, and their bytes."""
    row_bytes = array.dtype.itemsize * math.prod(array.shape[1:])
    if row_bytes:
        height = max(1, BLOCK_BYTES // row_bytes)
        for start in range(0, array.shape[0], height):
            piece = np.ascontiguousarray(array[start : start + height], dtype=DTYPES[array.dtype.name])
            yield piece.shape[0], piece.reshape(-1).view(np.uint8)


def join(objects: Objects, pieces: Sequence[StoredArray]) -> StoredArray:
    """Array of the rows of several, in order, in the very same blobs; reads them all to verify and hash them.

    Raises
    ------
    DamagedBlock
        If a block is not what was written.
    ValueError
        If there are no pieces, or their rows are not alike.
    """
    likes = {(piece.dtype, piece.shape[1:]) for piece in pieces}
    if len(likes) != 1:
        raise ValueError(f"rows of {len(likes)} shapes cannot be joined")
    dtype, row = likes.pop()
    whole = hashlib.sha256()
    for piece in pieces:
        for chunk in chunks(objects, piece, 0, piece.nbytes):
            whole.update(chunk)
    shape = (sum(piece.shape[0] for piece in pieces), *row)
    return StoredArray(
        shape, dtype, whole.hexdigest(), tuple(block for piece in pieces for block in piece.blocks)
    )


def read_rows(objects: Objects, stored: StoredArray, start: int, stop: int) -> Array:
    """Rows from `start` up to, not including, `stop` as a new array.

    Raises
    ------
    DamagedBlock
        If a block that holds some of them is not what was written.
    """
    out = np.empty((max(0, stop - start), *stored.shape[1:]), dtype=DTYPES[stored.dtype])
    flat = out.reshape(-1).view(np.uint8)
    first, last = start * stored.row_bytes, max(start, stop) * stored.row_bytes
    for block, begin, end in _blocks(stored):
        if first <= begin and end <= last:
            _fill(objects, block, flat[begin - first : end - first])
        elif begin < last and first < end:
            low, high = max(first, begin), min(last, end)
            flat[low - first : high - first] = _content(objects, block, end - begin)[
                low - begin : high - begin
            ]
    return out


def chunks(objects: Objects, stored: StoredArray, start: int, stop: int) -> Iterator[memoryview]:
    """Bytes from `start` up to, not including, `stop` of the array's C-order bytes, block by block.

    Raises
    ------
    DamagedBlock
        When it comes to a block that is not what was written.
    """
    for block, begin, end in _blocks(stored):
        if begin < stop and start < end:
            content = _content(objects, block, end - begin)
            yield content[max(start, begin) - begin : min(stop, end) - begin].data


def _blocks(stored: StoredArray) -> Iterator[tuple[Block, int, int]]:
    """Blocks with the bytes of the array that they hold."""
    begin = 0
    for block in stored.blocks:
        end = begin + block.rows * stored.row_bytes
        yield block, begin, end
        begin = end


def _content(objects: Objects, block: Block, size: int) -> Bytes:
    content = np.empty(size, dtype=np.uint8)
    _fill(objects, block, content)
    return content


def _fill(objects: Objects, block: Block, buffer: Bytes) -> None:
    """Read a block into a buffer of its size, and verify it."""
    if not objects.read_into(f"blobs/{block.blob}", buffer):
        raise DamagedBlock(f"blob {block.blob} is missing or has another size")
    if hashlib.sha256(buffer.data).hexdigest() != block.sha256:
        raise DamagedBlock(f"blob {block.blob} has other bytes")
