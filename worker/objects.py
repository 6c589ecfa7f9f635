"""The folder behind the store, with no more than an object store has: create, read, list, delete.

Everything about files is in here: no other module knows a rename, a lock, a path or a file's time.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]

#: Where an object is written before it is linked to its name.
_ASIDE = "aside"


@dataclass(frozen=True)
class Listed:
    """An object in a listing.

    Attributes
    ----------
    name : str
        What follows the folder.
    size : int
        In bytes.
    age : float
        Seconds since it was written.
    """

    name: str
    size: int
    age: float


class Objects:
    """Objects under keys like ``artifacts/energy-…``, whole or absent, safe for many processes and threads.

    Parameters
    ----------
    folder : Path
        Made if it is missing. Must be on one file system, with hard links.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for made in (_ASIDE, "blobs"):
            self._make(folder / made)

    def create(self, key: str, content: bytes = b"") -> bool:
        """Write an object unless its key is taken; on disk for good when this returns True.

        Returns
        -------
        bool
            False if the key was taken, by whoever came first.
        """
        path = self._folder / key
        aside = self._folder / _ASIDE / secrets.token_hex(16)
        try:
            _write(aside, memoryview(content))
            while True:
                try:
                    os.link(aside, path)
                except FileNotFoundError:
                    self._make(path.parent)
                except FileExistsError:
                    return False
                else:
                    _flush(path.parent)
                    return True
        finally:
            aside.unlink(missing_ok=True)

    def write_blob(self, content: Bytes) -> str:
        """Write an object under a new random name in ``blobs/``; `settle_blobs` makes the name last."""
        path = self._folder / "blobs" / secrets.token_hex(16)
        try:
            _write(path, content.data)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return path.name

    def settle_blobs(self) -> None:
        """Return when every blob written so far is on disk for good."""
        _flush(self._folder / "blobs")

    def touch(self, key: str) -> None:
        """Make an empty object, or its age zero; a power cut may undo this."""
        path = self._folder / key
        try:
            path.touch()
        except FileNotFoundError:
            self._make(path.parent)
            path.touch()

    def read(self, key: str) -> bytes | None:
        """Content of an object, or None if there is none."""
        try:
            return (self._folder / key).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def read_into(self, key: str, buffer: Bytes) -> bool:
        """Fill a buffer with an object; False if it is missing or of another size."""
        try:
            with (self._folder / key).open("rb", buffering=0) as file:
                view, filled = buffer.data, 0
                while count := file.readinto(view[filled:]):
                    filled += count
                return filled == buffer.size and os.fstat(file.fileno()).st_size == filled
        except FileNotFoundError:
            return False

    def exists(self, key: str) -> bool:
        """Whether there is such an object."""
        return (self._folder / key).is_file()

    def names(self, folder: str, prefix: str = "") -> list[str]:
        """Names of all objects under ``{folder}/`` that begin with a prefix, sorted."""
        try:
            found = os.listdir(self._folder / folder)  # noqa: PTH208  (ten times faster than paths)
        except (FileNotFoundError, NotADirectoryError):
            return []
        return sorted(name for name in found if name.startswith(prefix))

    def listing(self, folder: str, prefix: str = "") -> Iterator[Listed]:
        """Objects under ``{folder}/`` that begin with a prefix, in no order, with sizes and ages."""
        now = time.time()
        try:
            entries = os.scandir(self._folder / folder)
        except (FileNotFoundError, NotADirectoryError):
            return
        with entries:
            for entry in entries:
                if not entry.name.startswith(prefix):
                    continue
                with suppress(FileNotFoundError):  # deleted meanwhile
                    status = entry.stat()
                    yield Listed(entry.name, status.st_size, now - status.st_mtime)

    def delete(self, key: str) -> bool:
        """Delete an object; False if there was none."""
        try:
            (self._folder / key).unlink()
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def discard_aside(self, older_than: float) -> int:
        """Delete what dead writers left behind, if it is that old in seconds; returns how many there were."""
        return sum(
            self.delete(f"{_ASIDE}/{one.name}") for one in self.listing(_ASIDE) if one.age >= older_than
        )

    def _make(self, folder: Path) -> None:
        """Make a folder and those above it, each on disk for good."""
        if folder.is_dir():
            return
        self._make(folder.parent)
        folder.mkdir(exist_ok=True)
        _flush(folder.parent)


def _write(path: Path, content: memoryview) -> None:
    """Write a new file to the disk."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        while content:
            content = content[os.write(descriptor, content) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _flush(folder: Path) -> None:
    """Write a folder's names to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
