"""Jobs as people see them: status, progress and phase, put together from the store and Redis. Reads only."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import redis

from worker import specs
from worker.attempts import Attempt, Attempts
from worker.fields import kind_of
from worker.store import JobRecord, Manifest, Store

Status = Literal["accepted", "running", "successful", "failed", "dismissed"]

#: How long Redis remembers how far a task is, in seconds since it last said so.
STEP_SECONDS: Final = 3600


@dataclass(frozen=True)
class Task:
    """One task of a job."""

    id: str
    kind: str
    status: Status


@dataclass(frozen=True)
class Job:
    """A question, and how far its answer is.

    Attributes
    ----------
    id, kind : str
        Of the artifact that will answer it.
    status : str
    progress : float
        Percent of the estimated work that is done.
    phase : str
        What happens, in words.
    created_at, started_at, finished_at : str or None
        ISO 8601, UTC.
    error : dict or None
        ``{type, title, detail, index, value, task}`` if it failed.
    values : mapping
        What is known so far: what a running task says beside its phase, and the artifact's values at the end.
    tasks : tuple of Task
        Parents first, itself last.
    asked : bool
        Whether anybody asked for it, beyond needing it for something else.
    """

    id: str
    kind: str
    status: Status
    progress: float
    phase: str
    created_at: str | None
    started_at: str | None
    finished_at: str | None
    error: dict[str, Any] | None
    values: Mapping[str, Any]
    tasks: tuple[Task, ...]
    asked: bool


@dataclass(frozen=True)
class Step:
    """How far a running task is: when it began, the fraction done, what it does, and what it knows so far."""

    started_at: str
    fraction: float
    phase: str
    values: Mapping[str, Any] = field(default_factory=dict)

    def dump(self) -> str:
        """As Redis keeps it."""
        return json.dumps([self.started_at, round(self.fraction, 4), self.phase, dict(self.values)])

    @classmethod
    def load(cls, said: bytes | str) -> Step:
        """Read what `dump` wrote."""
        started_at, fraction, phase, values = json.loads(said)
        return cls(started_at, float(fraction), phase, values)


def steps(connection: redis.Redis, attempts: Attempts, tasks: Sequence[str]) -> dict[str, Step]:
    """How far some tasks are, those that said so lately."""
    if not tasks:
        return {}
    said = connection.mget([attempts.key("progress", task) for task in tasks])
    return {task: Step.load(one) for task, one in zip(tasks, said, strict=True) if one}


class Views:
    """Looks at many jobs with few questions to Redis.

    Parameters
    ----------
    store : Store
    attempts : Attempts
    """

    def __init__(self, store: Store, attempts: Attempts) -> None:
        self._store = store
        self._attempts = attempts

    def job(self, id_: str) -> Job | None:
        """Job of an id, done if there is only an artifact; None for uploads and unknown ids."""
        record = self._store.job(id_)
        if record is not None:
            return self.jobs([record])[0]
        manifest = self._store.manifest(id_) if kind_of(id_) in specs.KINDS else None
        return None if manifest is None else _answered(manifest)

    def jobs(self, records: Sequence[JobRecord]) -> list[Job]:
        """Jobs of some records, in their order."""
        manifests = {record.id: self._store.manifest(record.id) for record in records}
        unfinished = [record for record in records if not manifests[record.id]]
        tasks = sorted({task for record in unfinished for task in _tasks(record)})
        if any(record.outcome is None for record in unfinished):
            looks = _Looks(self._store, self._attempts, tasks)
        else:
            looks = _Looks(self._store, self._attempts, [])
        return [
            self._finished(record, manifest)
            if (manifest := manifests[record.id])
            else self._open(record, looks)
            for record in records
        ]

    def _finished(self, record: JobRecord, manifest: Manifest) -> Job:
        return Job(
            id=record.id,
            kind=manifest.kind,
            status="successful",
            progress=100.0,
            phase="done",
            created_at=record.created_at,
            started_at=manifest.made.get("started_at"),
            finished_at=manifest.created_at,
            error=None,
            values=manifest.values,
            tasks=tuple(Task(task.id, task.kind, "successful") for task in record.tasks)
            or (Task(record.id, manifest.kind, "successful"),),
            asked=record.asked,
        )

    def _open(self, record: JobRecord, looks: _Looks) -> Job:
        kind = kind_of(record.id) or ""
        status: Status
        phase: str
        if record.outcome is not None:
            status, phase, progress = record.outcome, record.outcome, looks.progress(record)
        elif self._store.gone(record.id) is not None:
            # It was answered, and the answer forgotten since; asking again brings it back.
            status, phase, progress = "successful", "done, and forgotten since", 100.0
        elif looks.begun(record):
            status, phase, progress = "running", looks.phase(record), looks.progress(record)
        else:
            status, phase, progress = "accepted", "waiting for a worker", 0.0
        return Job(
            id=record.id,
            kind=kind,
            status=status,
            progress=progress,
            phase=phase,
            created_at=record.created_at,
            started_at=record.started_at or looks.started_at(record),
            finished_at=record.finished_at,
            error=record.problem,
            values=looks.values(record) if status == "running" else {},
            tasks=tuple(Task(task, kind_of(task) or "", looks.status(task)) for task in _tasks(record)),
            asked=record.asked,
        )


class _Looks:
    """What some tasks were doing at one moment."""

    def __init__(self, store: Store, attempts: Attempts, tasks: list[str]) -> None:
        self._store = store
        self._attempts: Mapping[str, Attempt] = attempts.current(tasks)
        self._steps: Mapping[str, Step] = steps(attempts.connection, attempts, tasks)
        self._statuses: dict[str, Status] = {}

    def status(self, task: str) -> Status:
        """Status of one task."""
        if task not in self._statuses:
            self._statuses[task] = self._status(task)
        return self._statuses[task]

    def _status(self, task: str) -> Status:
        attempt = self._attempts.get(task)
        if attempt is not None and attempt.state == "running":
            return "running"
        if self._store.has(task):
            return "successful"
        record = self._store.job(task)
        if record is None:
            # Shards vanish when they are gathered.
            return "successful" if specs.KINDS[kind_of(task) or ""].private else "accepted"
        return record.outcome or "accepted"

    def begun(self, record: JobRecord) -> bool:
        """Whether one of a job's tasks has started."""
        return any(self.status(task) != "accepted" or task in self._steps for task in _tasks(record))

    def started_at(self, record: JobRecord) -> str | None:
        """When the first of a job's tasks began, if Redis remembers."""
        return min(
            (self._steps[task].started_at for task in _tasks(record) if task in self._steps), default=None
        )

    def progress(self, record: JobRecord) -> float:
        """Percent of the estimated work: Σ estimate · fraction / Σ estimate."""
        done = total = 0.0
        for task in record.tasks:
            status = self.status(task.id)
            step = self._steps.get(task.id)
            fraction = step.fraction if step and status == "running" else float(status == "successful")
            done += task.seconds * fraction
            total += task.seconds
        return min(100.0, 100 * done / total) if total else 0.0

    def phase(self, record: JobRecord) -> str:
        """What a job's tasks are doing, in words."""
        tasks = _tasks(record)
        running = [task for task in tasks if self.status(task) == "running"]
        counted = f" ({sum(self.status(task) == 'successful' for task in tasks)} of {len(tasks)} tasks done)"
        if not running:
            return "waiting for a worker" + counted
        words = [_words(task, self._steps.get(task)) for task in running]
        more = f" and {len(words) - 1} more" if len(words) > 1 else ""
        return words[0] + more + (counted if len(tasks) > 1 else "")

    def values(self, record: JobRecord) -> Mapping[str, Any]:
        """What the last of a job's running tasks that says anything says."""
        running = [task for task in reversed(_tasks(record)) if self.status(task) == "running"]
        said = (self._steps[task].values for task in running if task in self._steps)
        return next(filter(None, said), {})


def _words(task: str, step: Step | None) -> str:
    kind = (kind_of(task) or "").replace("_", " ")
    return f"{kind}: {step.phase}" if step else f"{kind}: starting"


def _tasks(record: JobRecord) -> list[str]:
    return [task.id for task in record.tasks] or [record.id]


def _answered(manifest: Manifest) -> Job:
    return Job(
        id=manifest.id,
        kind=manifest.kind,
        status="successful",
        progress=100.0,
        phase="done",
        created_at=manifest.created_at,
        started_at=manifest.made.get("started_at"),
        finished_at=manifest.created_at,
        error=None,
        values=manifest.values,
        tasks=(Task(manifest.id, manifest.kind, "successful"),),
        asked=False,
    )
