"""What ids mean: the specs behind them, what making them reads, and how failures read."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

from worker import questions, specs
from worker.fields import SpecError, kind_of
from worker.specs import Spec
from worker.store import JobRecord, Store, UnknownJob, now

Problem = dict[str, Any]


class Library:
    """Specs by id, each read once: make a new one for each question.

    Parameters
    ----------
    store : Store
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._specs: dict[str, Spec | None] = {}

    def __call__(self, id_: str) -> Spec | None:
        """Spec of an artifact, a job or something forgotten; None if unknown or of another version."""
        if id_ not in self._specs:
            self._specs[id_] = None if kind_of(id_) in specs.UPLOADED_KINDS else self._found(id_)
        return self._specs[id_]

    def know(self, id_: str, spec: Spec) -> None:
        """Remember a spec that is not in the store yet."""
        self._specs[id_] = spec

    def _found(self, id_: str) -> Spec | None:
        for source in (self._store.manifest, self._store.job, self._store.gone):
            found = source(id_)
            if found is not None and found.spec is not None:
                return spec_named(id_, found.spec)
        return None

    def needs(self, spec: Spec) -> tuple[str, ...]:
        """Ids of all that making a spec reads, uploads included."""
        return questions.needs(spec, self)


def spec_named(id_: str, fields: dict[str, Any]) -> Spec | None:
    """Spec of recorded fields, or None if another version of its kind gave it that id."""
    try:
        spec = specs.load(fields)
    except SpecError:
        return None
    return spec if specs.spec_id(spec) == id_ else None


def needs_of(record: JobRecord, known: Library) -> frozenset[str]:
    """Ids of all that a job reads, shards included."""
    spec = spec_named(record.id, record.spec)
    return frozenset() if spec is None else frozenset(known.needs(spec) + planned_shards(record))


def planned_shards(record: JobRecord | None) -> tuple[str, ...]:
    """Ids of the shards in a job's plan, in order."""
    if record is None or specs.KINDS[kind_of(record.id) or ""].private:
        return ()
    return tuple(task.id for task in record.tasks if task.id != record.id and specs.KINDS[task.kind].private)


def problem(
    slug: str,
    title: str,
    detail: str,
    *,
    task: str,
    index: int | None = None,
    value: float | str | None = None,
) -> Problem:
    """Why a task failed, as its job's `error` shows it.

    Parameters
    ----------
    slug : str
        End of the problem's type.
    title, detail : str
        What kind of failure, and what exactly.
    task : str
        Id of the task that failed first.
    index, value : optional
        The culprit.

    Returns
    -------
    dict
    """
    return {
        "type": f"urn:softmaps:{slug}",
        "title": title,
        "detail": detail,
        "index": index,
        "value": value,
        "task": task,
    }


def inherited(parent: str, found: Problem | None) -> Problem:
    """What a task's failure is when a parent has failed."""
    found = found or problem("internal-error", "Internal error", "no reason was recorded", task=parent)
    if specs.KINDS[kind_of(parent) or ""].private:
        return found  # nobody asked for a shard: its failure is that of the whole
    detail = f"parent {parent} failed: {found['detail']}"
    return found | {"type": "urn:softmaps:parent-failed", "title": "A parent failed", "detail": detail}


def lost_upload(id_: str, *, task: str) -> Problem:
    """What a task's failure is when a mesh or an array is no longer there."""
    detail = f"the {kind_of(id_)} {id_} is no longer here: upload it again"
    return problem("gone", "An upload is gone", detail, task=task)


def fail(store: Store, id_: str, found: Problem, *, started_at: str | None = None) -> None:
    """Record that a task failed, unless it has an outcome or its artifact stands.

    Parameters
    ----------
    store : Store
    id_ : str
    found : dict
        See `problem`.
    started_at : str, optional
        When its job began to run.
    """
    if not store.has(id_):
        _end(store, id_, outcome="failed", problem=found, started_at=started_at, finished_at=now())


def fail_dependants(store: Store, id_: str, found: Problem, *, started_at: str | None) -> None:
    """Fail all open jobs that read what has failed, and drop the other shards of the same whole.

    They would find out by themselves, but only when their last parent has ended, perhaps hours later.

    Parameters
    ----------
    store : Store
    id_ : str
        Of the task that failed.
    found : dict
        Why.
    started_at : str or None
        When that task's job began to run.
    """
    known = Library(store)
    records = list(store.open_jobs())
    failed = {id_: found}
    while failed:
        cause, why = failed.popitem()
        for record in records:
            if cause in needs_of(record, known):
                inner = failed[record.id] = inherited(cause, why)
                fail(store, record.id, inner, started_at=started_at)
                for shard in planned_shards(record):
                    _end(store, shard, outcome="dismissed", finished_at=now())
        records = [record for record in records if record.id not in failed]


def _end(store: Store, id_: str, **fields: Any) -> None:
    """Give a job its outcome, unless it has one."""

    def change(record: JobRecord) -> JobRecord:
        return record if record.outcome is not None else replace(record, **fields)

    with suppress(UnknownJob):
        store.update_job(id_, change)
