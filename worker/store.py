"""The store of one installation: its artifacts, its job records and its name."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy.typing as npt

from worker.artifacts import Artifacts, Usage
from worker.checkpoints import Checkpoint, Checkpoints
from worker.manifests import (
    Block,
    BorrowedBlocks,
    CorruptArtifact,
    GoneArtifact,
    Manifest,
    StoredArray,
    StoreError,
    Tombstone,
    UnknownArtifact,
)
from worker.objects import Objects
from worker.records import JobRecord, JobRecords, TaskRecord, UnknownJob, cursor, now

__all__ = [
    "Block",
    "BorrowedBlocks",
    "Checkpoint",
    "CorruptArtifact",
    "GoneArtifact",
    "JobRecord",
    "Manifest",
    "Store",
    "StoreError",
    "StoredArray",
    "Swept",
    "TaskRecord",
    "Tombstone",
    "UnknownArtifact",
    "UnknownJob",
    "Usage",
    "cursor",
    "now",
]


@dataclass(frozen=True)
class Swept:
    """What a sweep removed, blobs and files that nobody waits for, and jobs whose markers it restored."""

    blobs: int
    files: int
    jobs: int


class Store(Artifacts):
    """Artifacts and job records in one folder; safe for many processes and threads.

    Parameters
    ----------
    root : Path
        Made if it is missing. On one file system, with hard links.
    """

    def __init__(self, root: Path) -> None:
        super().__init__(Objects(root))
        self._checkpoints = Checkpoints(self._objects)
        self._records = JobRecords(self._objects, lambda id_: self.has(id_) or self.gone(id_) is not None)

    @cached_property
    def identity(self) -> str:
        """Random name of this store, made once: 16 hex digits."""
        self._objects.create("identity", secrets.token_hex(8).encode())
        return (self._objects.read("identity") or b"").decode()

    def gone(self, id_: str) -> Tombstone | None:
        """What is left of an artifact that was forgotten and has not been made again, or None."""
        tombstone = super().gone(id_)
        if tombstone is not None and tombstone.spec is None and (record := self.job(id_)):
            return replace(tombstone, spec=record.spec)  # its own manifest could not be read
        return tombstone

    def write_job(self, record: JobRecord) -> JobRecord:
        """Create a record unless there is one; returns the one that stands."""
        return self._records.write(record)

    def update_job(self, id_: str, change: Callable[[JobRecord], JobRecord]) -> JobRecord:
        """Change a record as if nobody else did at the same time; returns the new one.

        Parameters
        ----------
        id_ : str
        change : callable
            Pure: it is called again on the newer record whenever somebody else wrote in between.

        Raises
        ------
        UnknownJob
            If there is no such record.
        """
        return self._records.update(id_, change)

    def job(self, id_: str) -> JobRecord | None:
        """The record of a job, or None."""
        return self._records.read(id_)

    def jobs(self, after: str | None = None) -> Iterator[JobRecord]:
        """All records, the newest first, read one by one; `after` is the `cursor` of the last one seen."""
        return self._records.newest_first(after)

    def open_jobs(self) -> Iterator[JobRecord]:
        """Records without outcome and without artifact or tombstone."""
        return self._records.unfinished()

    def reopen_job(self, id_: str) -> None:
        """List a job among the open ones, because its artifact is to be made again; removes the tombstone."""
        self.forget_gone(id_)
        self._records.reopen(id_)

    def delete_job(self, id_: str) -> None:
        """Delete a record."""
        self._records.delete(id_)

    def write_checkpoint(
        self, id_: str, values: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]
    ) -> None:
        """Write how far a task came, for a later run to go on from."""
        self._checkpoints.write(id_, values, arrays)

    def checkpoint(self, id_: str) -> Checkpoint | None:
        """How far a task came, or None."""
        return self._checkpoints.read(id_)

    def delete_checkpoints(self, id_: str) -> None:
        """Delete what a task needs no more."""
        self._checkpoints.delete(id_)

    def sweep(self, older_than: float = 86_400.0) -> Swept:
        """Remove what dead writers and given-up tasks left, and restore what a power cut took from listings.

        Parameters
        ----------
        older_than : float
            Age in seconds below which nothing is removed. No writer may take that long.
        """
        files = self._objects.discard_aside(older_than)
        waiting = {record.id for record in self.open_jobs()}
        files += self._checkpoints.discard(older_than, waiting.__contains__)
        blobs = self.discard_orphans(older_than)
        return Swept(blobs=blobs, files=files, jobs=self._records.remark())
