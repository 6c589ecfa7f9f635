"""Job records: what was asked for and what became of it, written by several processes at once.

A record is a chain of numbered revisions, each created only if its number is free: whoever loses the race
reads again and repeats its change, so no change is ever lost. Empty markers make the two listings cheap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final, Literal

from pydantic import TypeAdapter

from worker.fields import kind_of
from worker.manifests import seal, unseal
from worker.objects import Objects

#: Revisions younger than this many seconds stay: no writer stalls for that long between reading and writing.
_KEPT_SECONDS: Final = 3_600.0
#: Revisions that a record may have before old ones are looked for.
_MANY_REVISIONS: Final = 8
#: A marker without a record is left alone for this many seconds: its record may be about to be written.
_PATIENCE_SECONDS: Final = 60.0
#: Milliseconds are counted down from here, so that newer jobs are listed first. (The year 5138.)
_LAST_MILLISECOND: Final = 10**14 - 1


class UnknownJob(LookupError):
    """A job that has no record."""


@dataclass(frozen=True)
class TaskRecord:
    """One task of a job's plan.

    Attributes
    ----------
    id, kind : str
        Of the artifact that the task makes.
    seconds : float
        Estimated time.
    bytes : int
        Estimated memory.
    """

    id: str
    kind: str
    seconds: float
    bytes: int


@dataclass(frozen=True)
class JobRecord:
    """A question that was asked, or that another one led to.

    Attributes
    ----------
    id : str
        Also the id of the artifact that answers it.
    spec : dict
        The flat spec.
    asked : bool
        False if it is only somebody's parent.
    created_at : str
        ISO 8601, UTC; never changes.
    tasks : tuple of TaskRecord
        The latest plan.
    outcome : {"failed", "dismissed"} or None
        None while it is open, and when its artifact stands.
    problem : dict or None
        Why it failed.
    started_at : str or None
        When the first of its tasks began, once it has an outcome.
    finished_at : str or None
        When it got its outcome.
    """

    id: str
    spec: dict[str, Any]
    asked: bool
    created_at: str
    tasks: tuple[TaskRecord, ...] = ()
    outcome: Literal["failed", "dismissed"] | None = None
    problem: dict[str, Any] | None = None
    started_at: str | None = None
    finished_at: str | None = None


_RECORD = TypeAdapter(JobRecord)


def now() -> str:
    """Now, ISO 8601 in UTC with microseconds."""
    return datetime.now(UTC).isoformat(timespec="microseconds")


def age(timestamp: str) -> float:
    """Seconds since a time that `now` wrote."""
    return (datetime.now(UTC) - datetime.fromisoformat(timestamp)).total_seconds()


class JobRecords:
    """The job records of a store.

    Parameters
    ----------
    objects : Objects
        Where they are kept: ``jobs/{end of id}/{id}.{revision}``, and the empty markers ``open/{id}`` and
        ``recent/{when}-{id}``, which a power cut may take and `remark` restores.
    answered : callable
        Whether the artifact of an id stands, or did until it was forgotten.
    """

    def __init__(self, objects: Objects, answered: Callable[[str], bool]) -> None:
        self._objects = objects
        self._answered = answered

    def write(self, record: JobRecord) -> JobRecord:
        """Create a record; returns the one that stands, which is somebody else's if it came first."""
        if kind_of(record.id) is None:
            raise ValueError(f"{record.id!r} is no id")
        # Markers first: one without a record is passed over, a record without them would be forgotten.
        self._objects.touch(f"recent/{cursor(record)}")
        self._mark(record)
        while True:
            revision, standing = self._newest(record.id)
            if standing is not None:
                return standing
            if self._create(record, revision + 1):
                self._mark(record)
                return record

    def update(self, id_: str, change: Callable[[JobRecord], JobRecord]) -> JobRecord:
        """Change a record as if nobody else did at the same time.

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
        while True:
            revision, standing = self._newest(id_)
            if standing is None:
                raise UnknownJob(id_)
            changed = change(standing)
            if changed == standing:
                return standing
            if (changed.id, changed.created_at) != (standing.id, standing.created_at):
                raise ValueError("the id and created_at of a job never change")
            # Before, lest a crash in between forgets it; and after, for `unfinished` may have deleted it.
            self._mark(changed)
            if self._create(changed, revision + 1):
                self._mark(changed)
                self._prune(id_, revision + 1)
                return changed

    def read(self, id_: str) -> JobRecord | None:
        """The record of an id, or None."""
        return self._newest(id_)[1]

    def newest_first(self, after: str | None = None) -> Iterator[JobRecord]:
        """All records, the newest first, read one by one; `after` is the `cursor` of the last one seen."""
        for name in self._objects.names("recent"):
            if after is None or name > after:
                record = self.read(name.partition("-")[2])
                # Two that created the same record at once left two markers; the record knows which is true.
                if record is not None and cursor(record) == name:
                    yield record

    def unfinished(self) -> Iterator[JobRecord]:
        """Records without outcome and without artifact."""
        for marker in self._objects.listing("open"):
            record = self.read(marker.name)
            if record is not None and self._unfinished(record):
                yield record
            elif record is not None or marker.age > _PATIENCE_SECONDS:
                self._objects.delete(f"open/{marker.name}")
                # Somebody may have asked again between the reading and the deleting.
                self.reopen(marker.name)

    def reopen(self, id_: str) -> None:
        """List a record as unfinished again, if it is: its artifact may be gone."""
        record = self.read(id_)
        if record is not None and self._unfinished(record):
            self._mark(record)

    def remark(self) -> int:
        """Restore markers that were lost; returns of how many records."""
        restored = 0
        for folder in self._objects.names("jobs"):
            for id_ in {name.partition(".")[0] for name in self._objects.names(f"jobs/{folder}")}:
                record = self.read(id_)
                if record is not None:
                    markers = [f"recent/{cursor(record)}"] + [f"open/{id_}"] * self._unfinished(record)
                    missing = [marker for marker in markers if not self._objects.exists(marker)]
                    for marker in missing:
                        self._objects.touch(marker)
                    restored += bool(missing)
        return restored

    def delete(self, id_: str) -> None:
        """Delete a record."""
        record = self.read(id_)
        if record is None:
            return
        for name in reversed(self._revisions(id_)):
            self._objects.delete(f"{_folder(id_)}/{name}")
        self._objects.delete(f"open/{id_}")
        self._objects.delete(f"recent/{cursor(record)}")

    def _unfinished(self, record: JobRecord) -> bool:
        return record.outcome is None and not self._answered(record.id)

    def _mark(self, record: JobRecord) -> None:
        if record.outcome is None and not self._objects.exists(f"open/{record.id}"):
            self._objects.touch(f"open/{record.id}")

    def _revisions(self, id_: str) -> list[str]:
        """Names of all revisions, oldest first."""
        return self._objects.names(_folder(id_), prefix=f"{id_}.") if kind_of(id_) else []

    def _newest(self, id_: str) -> tuple[int, JobRecord | None]:
        """Highest revision number, -1 without any, and the newest record that is as it was written."""
        names = self._revisions(id_)
        newest = int(names[-1].rpartition(".")[2]) if names else -1
        for name in reversed(names):
            content = self._objects.read(f"{_folder(id_)}/{name}")
            record = unseal(_RECORD, content) if content is not None else None
            if record is not None:
                return newest, record
        return newest, None

    def _create(self, record: JobRecord, revision: int) -> bool:
        return self._objects.create(f"{_folder(record.id)}/{record.id}.{revision:08d}", seal(record))

    def _prune(self, id_: str, newest: int) -> None:
        """Delete old revisions, but none that a stalled writer could create anew."""
        if newest % _MANY_REVISIONS == 0:
            for one in self._objects.listing(_folder(id_), prefix=f"{id_}."):
                if one.name < f"{id_}.{newest - 1:08d}" and one.age > _KEPT_SECONDS:
                    self._objects.delete(f"{_folder(id_)}/{one.name}")


def _folder(id_: str) -> str:
    """Folder of a record's revisions: 256 of them keep listings short."""
    return f"jobs/{id_[-2:]}"


def cursor(record: JobRecord) -> str:
    """Where a record stands among `newest_first`; sorts newer before older."""
    milliseconds = round(datetime.fromisoformat(record.created_at).timestamp() * 1000)
    return f"{_LAST_MILLISECOND - milliseconds:014d}-{record.id}"
