"""What the store says about an artifact: manifest, blocks, tombstone, and the errors when it is not there.

StoreError
├── UnknownArtifact       never made here
├── GoneArtifact          was here and was forgotten; can be made again
└── CorruptArtifact       its bytes had changed; it has been withdrawn and can be made again
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, TypeVar

import numpy as np
from pydantic import TypeAdapter

#: Element types that arrays are stored in, little-endian.
DTYPES: Final[Mapping[str, np.dtype[Any]]] = {
    "float64": np.dtype("<f8"),
    "int64": np.dtype("<i8"),
    "int32": np.dtype("<i4"),
    "bool": np.dtype("?"),
}


class StoreError(Exception):
    """An artifact that cannot be read.

    Parameters
    ----------
    id_ : str
        Its id.
    message : str
        What became of it.
    """

    def __init__(self, id_: str, message: str) -> None:
        super().__init__(f"{id_} {message}")
        self.id = id_


class UnknownArtifact(StoreError):
    """An artifact, or an array of one, that was never made here."""


class GoneArtifact(StoreError):
    """An artifact that was here and has been forgotten."""


class CorruptArtifact(StoreError):
    """An artifact whose bytes are not what was written; it has been withdrawn."""


@dataclass(frozen=True)
class Block:
    """Some whole rows of an array.

    Attributes
    ----------
    blob : str
        Name of the object that holds their bytes.
    rows : int
        How many rows.
    sha256 : str
        Of the bytes.
    """

    blob: str
    rows: int
    sha256: str


@dataclass(frozen=True)
class StoredArray:
    """An array as it is stored: little-endian, C order, in blocks of rows.

    Attributes
    ----------
    shape : tuple of int
    dtype : {"float64", "int64", "int32", "bool"}
    sha256 : str
        Of all bytes.
    blocks : tuple of Block
        In order; none if there are no bytes.
    """

    shape: tuple[int, ...]
    dtype: str
    sha256: str
    blocks: tuple[Block, ...]

    @property
    def row_bytes(self) -> int:
        """Bytes of one row."""
        return DTYPES[self.dtype].itemsize * math.prod(self.shape[1:])

    @property
    def nbytes(self) -> int:
        """Bytes of all rows."""
        return self.shape[0] * self.row_bytes


@dataclass(frozen=True)
class BorrowedBlocks:
    """An array made of the rows of other artifacts' arrays, in order; nothing is copied.

    Attributes
    ----------
    pieces : tuple of (str, str)
        Id of an artifact and name of its array.
    """

    pieces: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Manifest:
    """An artifact: what it is, where it comes from, and where its bytes are.

    Attributes
    ----------
    id, kind : str
    spec : dict or None
        The flat spec; None for uploads.
    parents : dict of str
        Ids by path in the spec.
    values : dict
        Numbers and words, as JSON has them.
    arrays : dict of StoredArray
    made : dict
        Seconds, threads and versions of the making.
    created_at : str
        ISO 8601, UTC.
    copy : str
        Random name of this very copy: an artifact that was withdrawn and made again has another.
    """

    id: str
    kind: str
    spec: dict[str, Any] | None
    parents: dict[str, str]
    values: dict[str, Any]
    arrays: dict[str, StoredArray]
    made: dict[str, Any]
    created_at: str
    copy: str

    @property
    def blobs(self) -> frozenset[str]:
        """Names of all blobs that the arrays are in."""
        return frozenset(block.blob for array in self.arrays.values() for block in array.blocks)


@dataclass(frozen=True)
class Tombstone:
    """What is left of an artifact that is no more.

    Attributes
    ----------
    id, kind : str
    spec : dict or None
        What to ask for to have it again; None for uploads.
    reason : {"evicted", "corrupt"}
    """

    id: str
    kind: str
    spec: dict[str, Any] | None
    reason: Literal["evicted", "corrupt"]


Sealed = TypeVar("Sealed")


def seal(content: Any) -> bytes:
    """Write a dataclass as JSON after a line with its sha256.

    Raises
    ------
    ValueError
        If it holds NaN or an infinity.
    TypeError
        If it holds what JSON has no form for.
    """
    text = json.dumps(asdict(content), separators=(",", ":"), allow_nan=False).encode()
    return hashlib.sha256(text).hexdigest().encode() + b"\n" + text


def unseal(adapter: TypeAdapter[Sealed], content: bytes) -> Sealed | None:
    """Read what `seal` wrote; None if a byte of it has changed.

    Raises
    ------
    ValidationError
        If it is unchanged and yet no such dataclass: another version wrote it.
    """
    digest, _, text = content.partition(b"\n")
    if hashlib.sha256(text).hexdigest().encode() != digest:
        return None
    return adapter.validate_json(text)
