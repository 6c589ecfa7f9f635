"""Artifacts: immutable blobs under random names, and a manifest that comes last and is created only once.

Where a manifest stands its artifact is whole. This is no more than an object store can keep: creating what is
absent, ranged reads, listings, deletions.
"""

from __future__ import annotations

import math
import secrets
import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy.typing as npt
from pydantic import TypeAdapter

from worker import blocks
from worker.fields import kind_of
from worker.manifests import (
    BorrowedBlocks,
    CorruptArtifact,
    GoneArtifact,
    Manifest,
    StoredArray,
    StoreError,
    Tombstone,
    UnknownArtifact,
    seal,
    unseal,
)
from worker.objects import Objects
from worker.records import age, now

#: Seconds between two recordings of reads of one artifact by one process.
_READ_SECONDS: Final = 60.0
#: Recorded reads that a process remembers before it starts anew.
_MANY_READS: Final = 10_000
#: Uploads: nobody but their owner can make them again.
_UPLOADED_KINDS: Final = ("mesh", "array")

_MANIFEST = TypeAdapter(Manifest)
_TOMBSTONE = TypeAdapter(Tombstone)

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Usage:
    """What a store holds: artifacts, blobs, and the bytes of all blobs."""

    artifacts: int
    blobs: int
    bytes: int


class Artifacts:
    """Artifacts by id; safe for many processes and threads.

    Parameters
    ----------
    objects : Objects
        Where they are kept: ``artifacts/{id}``, ``blobs/{random}``, ``gone/{id}`` and ``reads/{id}``.
    """

    def __init__(self, objects: Objects) -> None:
        self._objects = objects
        self._read_at: dict[str, float] = {}

    def put(
        self,
        id_: str,
        *,
        kind: str,
        spec: dict[str, Any] | None,
        parents: Mapping[str, str],
        values: Mapping[str, Any],
        arrays: Mapping[str, Array | BorrowedBlocks],
        made: Mapping[str, Any],
        adopts: Sequence[str] = (),
    ) -> Manifest:
        """Write an artifact, unless it stands.

        Parameters
        ----------
        id_, kind, spec, parents, values, made
            See `Manifest`; `spec` is None for uploads.
        arrays : mapping of ndarray or BorrowedBlocks
            float64, int64, int32 or bool, with at least one axis.
        adopts : sequence of str
            Artifacts that only this one reads, dropped once it stands. Blocks are borrowed from such alone.

        Returns
        -------
        Manifest
            The one that stands: another writer's if it came first.

        Raises
        ------
        GoneArtifact, UnknownArtifact, CorruptArtifact
            If blocks were to be borrowed from an artifact that is no longer whole.
        TypeError, ValueError
            If an array has another element type or no axis, or values hold NaN.
        """
        if kind_of(id_) != kind:
            raise ValueError(f"{id_!r} is no id of the kind {kind}")
        standing = self.manifest(id_)
        if standing is None:
            standing = self._written(
                Manifest(
                    id=id_,
                    kind=kind,
                    spec=spec,
                    parents=dict(parents),
                    values=dict(values),
                    arrays={},
                    made=dict(made),
                    created_at=now(),
                    copy=secrets.token_hex(8),
                ),
                arrays,
            )
        self._adopt(standing, adopts)
        return standing

    def _written(self, manifest: Manifest, arrays: Mapping[str, Array | BorrowedBlocks]) -> Manifest:
        """Write blobs, then a manifest; returns the one that stands."""
        own = {name: array for name, array in arrays.items() if not isinstance(array, BorrowedBlocks)}
        written: list[str] = []
        lenders: list[Manifest] = []
        try:
            stored = blocks.write_arrays(self._objects, own, written)
            for name, array in arrays.items():
                if isinstance(array, BorrowedBlocks):
                    stored[name] = self._borrowed(array, lenders)
            self._objects.settle_blobs()
            return self._established(replace(manifest, arrays=stored), lenders)
        finally:
            # A deadline may strike after the manifest was created: then its blobs are in use.
            if not self._stands(manifest.id, manifest.copy):
                self._delete_blobs(written)

    def _borrowed(self, array: BorrowedBlocks, lenders: list[Manifest]) -> StoredArray:
        borrowed = [(self._required(id_), name) for id_, name in array.pieces]
        lenders += [lender for lender, _ in borrowed]
        try:
            return blocks.join(self._objects, [_array_of(lender, name) for lender, name in borrowed])
        except blocks.DamagedBlock:
            for lender, name in borrowed:  # one of them says which it was
                deque(self.raw(lender, name), maxlen=0)
            raise

    def _established(self, manifest: Manifest, lenders: Sequence[Manifest]) -> Manifest:
        """Create a manifest if none stands; returns the one that does."""
        key = f"artifacts/{manifest.id}"
        while not self._objects.create(key, seal(manifest)):
            if standing := self.manifest(manifest.id):
                return standing
        # Whoever forgets a lender leaves a tombstone, deletes its manifest, and only then looks who else uses
        # its blobs. So if no lender was forgotten by now, this manifest will be seen. One missing without a
        # tombstone was adopted by a twin of this writer, on behalf of this very manifest.
        for lender in lenders:
            if not self._stands(lender.id, lender.copy) and (self.has(lender.id) or self.gone(lender.id)):
                self._objects.delete(key)
                raise GoneArtifact(lender.id, "was forgotten while its blocks were borrowed")
        self.forget_gone(manifest.id)
        return manifest

    def _adopt(self, standing: Manifest, ids: Sequence[str]) -> None:
        """Drop artifacts that only another one read, and their blobs unless that one borrowed them."""
        for id_ in ids:
            adopted = self.manifest(id_)
            if adopted is not None:
                self._objects.delete(f"artifacts/{id_}")
                self._delete_blobs(adopted.blobs - standing.blobs)
                self._objects.delete(f"reads/{id_}")
            self.forget_gone(id_)

    def has(self, id_: str) -> bool:
        """Whether an artifact stands."""
        return kind_of(id_) is not None and self._objects.exists(f"artifacts/{id_}")

    def manifest(self, id_: str) -> Manifest | None:
        """The manifest of an artifact, or None if it does not stand."""
        content = self._objects.read(f"artifacts/{id_}") if kind_of(id_) else None
        if content is None:
            return None
        manifest = unseal(_MANIFEST, content)
        if manifest is None:
            self._bury(Tombstone(id_, kind_of(id_) or "", None, "corrupt"))
            self._objects.delete(f"artifacts/{id_}")
        return manifest

    def manifests(self, kind: str | None = None, after: str = "", limit: int = 50) -> list[Manifest]:
        """Manifests in order of their ids: at most `limit`, of one kind or all, those after an id."""
        found: list[Manifest] = []
        for id_ in self._objects.names("artifacts"):
            if id_ > after and kind in (None, kind_of(id_)) and (manifest := self.manifest(id_)):
                found.append(manifest)
                if len(found) >= limit:
                    break
        return found

    def array(
        self, artifact: str | Manifest, name: str, start: int | None = None, stop: int | None = None
    ) -> Array:
        """Rows of an array, verified; `start` and `stop` as in a slice.

        Raises
        ------
        UnknownArtifact, GoneArtifact
            If there is no such artifact or array.
        CorruptArtifact
            If its bytes have changed; the artifact is withdrawn.
        """
        manifest, stored = self._located(artifact, name)
        first, last, _ = slice(start, stop).indices(stored.shape[0])
        try:
            return blocks.read_rows(self._objects, stored, first, last)
        except blocks.DamagedBlock as damage:
            raise self._withdrawn(manifest, damage) from None

    def raw(
        self, artifact: str | Manifest, name: str, start: int = 0, stop: int | None = None
    ) -> Iterator[memoryview]:
        """Bytes [start, stop) of an array, little-endian and in C order, verified.

        Raises
        ------
        UnknownArtifact, GoneArtifact
            At once, if there is no such artifact or array.
        CorruptArtifact
            While iterating, before any byte of a block that has changed; the artifact is withdrawn.
        """
        manifest, stored = self._located(artifact, name)
        return self._raw(manifest, stored, start, stored.nbytes if stop is None else stop)

    def _raw(self, manifest: Manifest, stored: StoredArray, start: int, stop: int) -> Iterator[memoryview]:
        try:
            yield from blocks.chunks(self._objects, stored, start, stop)
        except blocks.DamagedBlock as damage:
            raise self._withdrawn(manifest, damage) from None

    def _located(self, artifact: str | Manifest, name: str) -> tuple[Manifest, StoredArray]:
        manifest = artifact if isinstance(artifact, Manifest) else self._required(artifact)
        self.record_read(manifest.id)
        return manifest, _array_of(manifest, name)

    def _required(self, id_: str) -> Manifest:
        manifest = self.manifest(id_)
        if manifest is not None:
            return manifest
        if self.gone(id_):
            raise GoneArtifact(id_, "has been forgotten")
        raise UnknownArtifact(id_, "is not known")

    def _stands(self, id_: str, copy: str) -> bool:
        """Whether that very copy of an artifact stands."""
        standing = self.manifest(id_)
        return standing is not None and standing.copy == copy

    def _withdrawn(self, manifest: Manifest, damage: Exception) -> StoreError:
        """Take a damaged artifact away, if it is still the one that stands; returns what to raise."""
        if not self._forget(manifest, "corrupt"):
            return GoneArtifact(manifest.id, "was forgotten while it was read")
        return CorruptArtifact(manifest.id, f"is damaged and has been withdrawn: {damage}")

    def record_read(self, id_: str) -> None:
        """Remember that an artifact was wanted just now, for `evict`. Cheap to repeat."""
        if kind_of(id_) in _UPLOADED_KINDS:
            return
        if len(self._read_at) > _MANY_READS:
            self._read_at.clear()
        if time.monotonic() - self._read_at.get(id_, -_READ_SECONDS) >= _READ_SECONDS:
            self._objects.touch(f"reads/{id_}")
            self._read_at[id_] = time.monotonic()

    def gone(self, id_: str) -> Tombstone | None:
        """What is left of an artifact that was forgotten and has not been made again, or None."""
        content = self._objects.read(f"gone/{id_}") if kind_of(id_) and not self.has(id_) else None
        return unseal(_TOMBSTONE, content) if content is not None else None

    def forget_gone(self, id_: str) -> None:
        """Remove a tombstone, because the artifact is being made again."""
        self._objects.delete(f"gone/{id_}")

    def usage(self) -> Usage:
        """Count artifacts and blobs, and add up their bytes."""
        sizes = [blob.size for blob in self._objects.listing("blobs")]
        return Usage(len(self._objects.names("artifacts")), len(sizes), sum(sizes))

    def evict(self, max_bytes: int, keep: Collection[str] = ()) -> tuple[str, ...]:
        """Forget the least recently read artifacts until the blobs take `max_bytes` or less.

        Parameters
        ----------
        max_bytes : int
        keep : collection of str
            Ids that must stay, beside all uploads.

        Returns
        -------
        tuple of str
            Ids of what was forgotten; each leaves a tombstone.
        """
        sizes = {blob.name: blob.size for blob in self._objects.listing("blobs")}
        total = sum(sizes.values())
        if total <= max_bytes:
            return ()
        reads = {read.name: read.age for read in self._objects.listing("reads")}

        def unread(manifest: Manifest) -> float:
            return min(age(manifest.created_at), reads.get(manifest.id, math.inf))

        standing = list(self._all())
        holders = Counter(blob for manifest in standing for blob in manifest.blobs)
        forgotten: list[Manifest] = []
        for manifest in sorted(standing, key=unread, reverse=True):
            if total <= max_bytes:
                break
            if manifest.kind not in _UPLOADED_KINDS and manifest.id not in keep:
                forgotten.append(manifest)
                holders.subtract(manifest.blobs)
                total -= sum(sizes.get(blob, 0) for blob in manifest.blobs if not holders[blob])
        forgotten = [manifest for manifest in forgotten if self._forget(manifest, "evicted")]
        self._delete_blobs({blob for manifest in forgotten for blob in manifest.blobs} - self._referenced())
        return tuple(manifest.id for manifest in forgotten)

    def discard_orphans(self, older_than: float) -> int:
        """Delete blobs of that age, in seconds, that no artifact refers to; returns how many."""
        old = {blob.name for blob in self._objects.listing("blobs") if blob.age >= older_than}
        orphans = old - self._referenced()
        if orphans:
            # A borrower may have been created behind the first look, its lenders dropped ahead of it. As they
            # are not dropped before it stands, a second look sees it.
            orphans -= self._referenced()
        self._delete_blobs(orphans)
        for read in self._objects.listing("reads"):
            if read.age >= older_than and not self.has(read.name):
                self._objects.delete(f"reads/{read.name}")
        return len(orphans)

    def _all(self) -> Iterator[Manifest]:
        return filter(None, map(self.manifest, self._objects.names("artifacts")))

    def _referenced(self) -> set[str]:
        """Names of all blobs that some manifest refers to."""
        return {blob for manifest in self._all() for blob in manifest.blobs}

    def _forget(self, manifest: Manifest, reason: Literal["evicted", "corrupt"]) -> bool:
        """Put a tombstone in an artifact's place; False if it is not that copy that stands."""
        if not self._stands(manifest.id, manifest.copy):
            return False
        self._bury(Tombstone(manifest.id, manifest.kind, manifest.spec, reason))
        self._objects.delete(f"artifacts/{manifest.id}")
        return True

    def _bury(self, tombstone: Tombstone) -> None:
        key = f"gone/{tombstone.id}"
        while not self._objects.create(key, seal(tombstone)):
            self._objects.delete(key)

    def _delete_blobs(self, names: Collection[str]) -> None:
        for name in names:
            self._objects.delete(f"blobs/{name}")


def _array_of(manifest: Manifest, name: str) -> StoredArray:
    if name not in manifest.arrays:
        raise UnknownArtifact(manifest.id, f"has no array {name!r}")
    return manifest.arrays[name]
