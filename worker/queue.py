"""The dispatcher: takes questions, says how far they are, drops them, and keeps everything going.

Its state is the store's records; Redis may be emptied at any time and is filled again by `reconcile`.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Final

import redis

from worker import specs
from worker.attempts import Attempts
from worker.fields import SpecError, kind_of
from worker.jobs import Job, Status, Task, Views
from worker.library import Library, needs_of
from worker.plan import Node, Planner, planning
from worker.questions import Graph, SpecTree, flatten
from worker.settings import Settings
from worker.sizes import Sizes
from worker.stages import flaws
from worker.store import JobRecord, Store, UnknownJob, now
from worker.store import cursor as cursor_of
from worker.upkeep import keep_house

__all__ = ["Busy", "Dismissal", "Dispatcher", "FinishedJob", "Job", "Task", "TooCostly", "UnknownJob"]

_log = logging.getLogger("softmaps.queue")

#: Longest wait for somebody else's planning before a request is given up.
_PATIENCE_SECONDS: Final = 20.0
#: The same for a pass of reconciling, which comes again; and how many tasks it plans at once.
_PASS_SECONDS: Final = 1.0
_TOGETHER: Final = 50
#: How long a dismissal watches the dismissed work end.
DISMISSAL_SECONDS: Final = 10.0
#: Busy workers announce themselves again within this time after Redis was emptied.
_COMEBACK_SECONDS: Final = 2.5
#: And all workers within this time after Redis was started.
_RESTART_SECONDS: Final = 5


class Busy(Exception):
    """Too many tasks wait already."""


class TooCostly(SpecError):
    """A question that would take more time or memory than is allowed here."""


class FinishedJob(Exception):
    """A job that is finished and cannot be dismissed.

    Parameters
    ----------
    job : Job
    """

    def __init__(self, job: Job) -> None:
        super().__init__(f"{job.id} is {job.status}")
        self.job = job


@dataclass(frozen=True)
class Dismissal:
    """What became of a job that was dismissed.

    Attributes
    ----------
    job : Job
    remains : bool
        Whether something of it still runs: it would not stop, or another job needs it.
    """

    job: Job
    remains: bool


class Dispatcher:
    """Questions in, jobs out, for one store on one Redis. Safe for many threads and processes.

    Parameters
    ----------
    settings : Settings
    store : Store
    connection : redis.Redis
        Without ``decode_responses``.
    """

    def __init__(self, settings: Settings, store: Store, connection: redis.Redis) -> None:
        self._settings = settings
        self._store = store
        self._attempts = Attempts(connection, store.identity, specs.versions_digest())
        self._planner = Planner(settings, store, self._attempts)
        self._views = Views(store, self._attempts)

    def submit(self, tree: SpecTree) -> Job:
        """Ask a question: computed once, whoever asks; what failed or was dismissed is run again.

        Parameters
        ----------
        tree : SpecTree
            What `questions.parse` read.

        Returns
        -------
        Job

        Raises
        ------
        SpecError
            If manifests say that it cannot be answered; `TooCostly` if it would take too much.
        Busy
            If too many tasks wait.
        redis.exceptions.RedisError
            If Redis is away; what was recorded is run once it is back.
        """
        known = Library(self._store)
        graph = flatten(tree, known)
        for id_, spec in graph.specs.items():
            known.know(id_, spec)
        for id_, array in graph.arrays.items():
            self._store.put(
                id_,
                kind="array",
                spec=None,
                parents={},
                values={"name": None},
                arrays={"array": array},
                made={},
            )
        if self._store.has(graph.root):
            return self._answered(graph)
        self._check(graph, known)
        nodes = self._planner.missing([graph.root], known)
        self._weigh(nodes)
        with planning(self._attempts, _PATIENCE_SECONDS) as held:
            if not held:
                raise Busy("others are being planned; ask again")
            self._remember_epoch()
            self._planner.record(nodes, graph.root)
            self._planner.attempt(nodes, rerun=True)
        job = self._views.job(graph.root)
        assert job is not None  # its record was written
        return job

    def _answered(self, graph: Graph) -> Job:
        """Job of a question that has its answer, asked for from now on."""
        root = graph.root
        fresh = JobRecord(root, specs.dump(graph.specs[root]), asked=True, created_at=now())
        self._store.write_job(fresh)
        self._store.update_job(root, lambda record: replace(record, asked=True))
        job = self._views.job(root)
        assert job is not None
        return job

    def _check(self, graph: Graph, known: Library) -> None:
        """Refuse what manifests say is wrong, ancestors first: what follows from a flaw is not listed."""
        size = Sizes(self._store, known)
        for id_, spec in graph.specs.items():
            if self._store.has(id_):
                continue
            found = flaws(spec, size, self._settings)
            for need in () if found else known.needs(spec):
                if kind_of(need) in specs.UPLOADED_KINDS and not self._store.has(need):
                    found.append(
                        ("", f"The {kind_of(need)} {need} behind it is no longer here: upload it again")
                    )
            if found:
                pointer = graph.pointers[id_]
                raise SpecError(*((pointer + place, detail) for place, detail in found))

    def _weigh(self, nodes: Mapping[str, Node]) -> None:
        seconds = sum(node.cost.seconds for node in nodes.values())
        limit = self._settings.max_cost_seconds
        if seconds > limit:
            detail = f"This would take about {seconds:,.0f} s; here {limit:,.0f} s are allowed"
            raise TooCostly(("", detail))
        for node in nodes.values():
            if node.cost.bytes > self._settings.task_memory_bytes:
                needed, allowed = node.cost.bytes / 1e9, self._settings.task_memory_bytes / 1e9
                words = f"about {needed:,.1f} GB of memory; here {allowed:,.1f} GB are allowed"
                raise TooCostly(("", f"The {node.spec.kind} would take {words}"))
        waiting = self.queued()
        if waiting + len(nodes) > self._settings.max_queued:
            # A question that is under way already adds nothing.
            current = self._attempts.current(list(nodes))
            new = sum(not attempt.alive for attempt in current.values())
            if new and waiting + new > self._settings.max_queued:
                raise Busy(f"{waiting} tasks wait already; ask again later")

    def job(self, id_: str) -> Job | None:
        """Job of an id, also of an artifact without a record; None for uploads and unknown ids."""
        return self._views.job(id_)

    def jobs(
        self, status: Status | None = None, limit: int = 50, cursor: str | None = None
    ) -> tuple[list[Job], str | None]:
        """Jobs that were asked for, the newest first.

        Parameters
        ----------
        status : str, optional
            Only such.
        limit : int
        cursor : str, optional
            Where the last page ended.

        Returns
        -------
        list of Job
        str or None
            Cursor of the next page.
        """
        records = self._listed(status, cursor)
        found: list[Job] = []
        last: str | None = None
        while chunk := list(islice(records, limit + 1)):
            for record, job in zip(chunk, self._views.jobs(chunk), strict=True):
                if status in (None, job.status):
                    if len(found) == limit:
                        return found, last
                    found.append(job)
                    last = cursor_of(record)
        return found, None

    def _listed(self, status: Status | None, after: str | None) -> Iterator[JobRecord]:
        """Records that may have some status, as far as they tell themselves."""
        if status in ("accepted", "running"):
            records: Iterator[JobRecord] = iter(sorted(self._store.open_jobs(), key=cursor_of))
            return (each for each in records if each.asked and (after is None or cursor_of(each) > after))
        asked = (each for each in self._store.jobs(after) if each.asked)
        if status in ("failed", "dismissed"):
            return (each for each in asked if each.outcome == status)
        return asked

    def dismiss(self, id_: str) -> Dismissal:
        """Drop a job, its runs, and what only it needed.

        What another open job needs goes on; it is then no longer asked for itself, and goes with the last
        job that needs it.

        Parameters
        ----------
        id_ : str

        Returns
        -------
        Dismissal
            At the latest ten seconds later.

        Raises
        ------
        UnknownJob
            If there is no such job.
        FinishedJob
            If it has succeeded or failed.
        """
        if self._remember_epoch():
            time.sleep(_COMEBACK_SECONDS)  # until workers have said again what they run
        with planning(self._attempts, _PATIENCE_SECONDS) as held:
            if not held:
                raise Busy("others are being planned; ask again")
            job = self._required(id_)
            if job.status in ("successful", "failed"):
                raise FinishedJob(job)
            dropped = self._droppable(id_)
            if not dropped:
                self._store.update_job(id_, lambda record: replace(record, asked=False))
                return Dismissal(self._required(id_), remains=True)
            self._drop(dropped)
        deadline = time.monotonic() + DISMISSAL_SECONDS
        remains = self._attempts.stop(dropped)
        while remains and time.monotonic() < deadline:
            time.sleep(0.05)
            remains = self._attempts.stop(dropped)
        return Dismissal(self._required(id_), remains=remains > 0)

    def _required(self, id_: str) -> Job:
        job = self._views.job(id_)
        if job is None:
            raise UnknownJob(id_)
        return job

    def _droppable(self, id_: str) -> list[str]:
        """A job and those of its ancestors that nobody else needs or asked for; empty if it is needed."""
        records = {record.id: record for record in self._store.open_jobs()}
        known = Library(self._store)
        needs = {each: needs_of(record, known) for each, record in records.items()}
        record = self._store.job(id_)
        own = needs_of(record, known) if record is not None else frozenset()
        if any(id_ in needed for each, needed in needs.items() if each != id_):
            return []
        dropped = [id_]
        waiting = set(own)
        while candidates := sorted(
            each
            for each in waiting
            if each in records
            and not records[each].asked
            and not any(each in needed for other, needed in needs.items() if other not in dropped)
        ):
            dropped += candidates
            waiting -= set(candidates)
            waiting |= {need for each in candidates for need in needs[each]}
        return dropped

    def _drop(self, ids: list[str]) -> None:
        """Record first, so that whoever begins such a task sees it; then take the attempts away."""
        finished_at = now()

        def change(record: JobRecord) -> JobRecord:
            if record.outcome is not None:
                return record
            return replace(record, outcome="dismissed", finished_at=finished_at)

        for id_ in ids:
            self._store.update_job(id_, change)
        for id_, attempt in self._attempts.current(ids).items():
            self._attempts.forget(id_, attempt.name, running=attempt.state == "running")

    def reconcile(self) -> None:
        """Bring Redis in line with the store, once: recovery from killed workers, a wiped Redis, restarts.

        Raises
        ------
        redis.exceptions.RedisError
            If Redis is away; call again.
        """
        self._attempts.tidy()
        keep_house(self._settings, self._store, self._attempts)
        records = list(self._store.open_jobs())
        if not records:
            self._remember_epoch()
            return
        if self._remember_epoch():
            time.sleep(_COMEBACK_SECONDS)
        current = self._attempts.current([record.id for record in records], strict=True)
        idle = [id_ for id_, attempt in current.items() if not attempt.alive]
        if not idle:
            return
        if any(current[id_].died for id_ in idle) and self._attempts.uptime() < _RESTART_SECONDS:
            return  # Redis was away: workers have not had the time to announce themselves
        # A few at a time, so that whoever asks meanwhile need not wait for all.
        for start in range(0, len(idle), _TOGETHER):
            with planning(self._attempts, _PASS_SECONDS) as held:
                if not held:
                    return
                self._revive(idle[start : start + _TOGETHER])

    def _revive(self, ids: list[str]) -> None:
        """Give open tasks attempts, and what they need."""
        known = Library(self._store)
        for id_ in ids:
            if known(id_) is None:
                self._planner.outdated(id_)
        self._planner.attempt(self._planner.missing(ids, known), rerun=False)

    def _remember_epoch(self) -> bool:
        """Leave a key that a FLUSHALL takes away; True if it was not there."""
        return bool(self._attempts.connection.set(self._attempts.key("epoch"), 1, nx=True))

    def workers(self) -> int:
        """Number of workers that announced themselves lately."""
        return len(self._attempts.presence.workers())

    def queued(self) -> int:
        """Number of tasks that wait, for a worker or for their parents."""
        counts = self._attempts.counts()
        return counts["interactive"] + counts["batch"] + counts["deferred"]

    def metrics(self) -> dict[str, float]:
        """Numbers for those who watch this service, by name."""
        counts = self._attempts.counts()
        workers = self._attempts.presence.workers()
        records = list(self._store.open_jobs())
        statuses = Counter(job.status for job in self._views.jobs([each for each in records if each.asked]))
        return {
            "workers": len(workers),
            "workers_interactive": sum(worker.interactive for worker in workers),
            "workers_busy": sum(bool(worker.attempt) for worker in workers),
            "tasks_queued_interactive": counts["interactive"],
            "tasks_queued_batch": counts["batch"],
            "tasks_deferred": counts["deferred"],
            "jobs_open": len(records),
            "jobs_accepted": statuses["accepted"],
            "jobs_running": statuses["running"],
        }
