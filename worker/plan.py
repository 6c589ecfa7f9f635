"""Planning: which tasks a question still needs, and an attempt for each that has none.

Parents come first. What the store holds is skipped, a living attempt is joined, anything else gets a new one.
Everything here is repeatable: a plan that was cut short is finished by the next.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Final

import redis

from worker import library, sizes, specs
from worker.attempts import INTERACTIVE_SECONDS, Attempt, Attempts
from worker.fields import kind_of
from worker.library import Library
from worker.settings import Settings
from worker.sizes import Cost, Sizes
from worker.specs import Spec
from worker.stages import stage
from worker.store import JobRecord, Store, TaskRecord, UnknownJob, now

_log = logging.getLogger("softmaps.queue")

#: A lock's holder is believed dead after this many seconds; planning takes milliseconds.
LOCK_SECONDS: Final = 30
#: Runs that may die with their worker before the task counts as failed.
MAX_DEATHS: Final = 3
#: Tasks may take this many times their estimate, which another machine made, and at least the floor.
TIMEOUT_FACTOR: Final = 10
TIMEOUT_FLOOR: Final = 300


@dataclass(frozen=True, eq=False)
class Node:
    """A task to be done.

    Attributes
    ----------
    id : str
    spec : Spec
    parents : tuple of str
        Ids of computed artifacts that must stand first; shards included.
    cost : Cost
    flaw : dict or None
        Why it cannot be done at all.
    """

    id: str
    spec: Spec
    parents: tuple[str, ...]
    cost: Cost
    flaw: library.Problem | None = None


@contextmanager
def planning(attempts: Attempts, wait: float) -> Iterator[bool]:
    """Hold the store's planning lock; yields whether it was free within `wait` seconds."""
    lock = attempts.connection.lock(attempts.key("lock"), timeout=LOCK_SECONDS, blocking_timeout=wait)
    held = lock.acquire()
    try:
        yield held
    finally:
        # A FLUSHALL takes locks too; two planners at once make a task run twice, which is harmless.
        if held:
            with suppress(redis.exceptions.LockError):
                lock.release()


class Planner:
    """Makes plans for one store.

    Parameters
    ----------
    settings : Settings
    store : Store
    attempts : Attempts
    """

    def __init__(self, settings: Settings, store: Store, attempts: Attempts) -> None:
        self._settings = settings
        self._store = store
        self._attempts = attempts

    def missing(self, roots: Iterable[str], known: Library) -> dict[str, Node]:
        """Tasks that some questions still need, parents first; what stands is not in it.

        Parameters
        ----------
        roots : iterable of str
        known : Library

        Returns
        -------
        dict of Node by id
        """
        found: dict[str, Node] = {}
        made: dict[str, Node] = {}
        waiting = [(root, False) for root in reversed(list(roots))]
        while waiting:
            id_, parents_done = waiting.pop()
            if id_ in found or (not parents_done and (id_ in made or self._store.has(id_))):
                continue
            if parents_done:
                found[id_] = made[id_]
                continue
            node = self._node(id_, known)
            if node is None:
                continue
            made[id_] = node
            waiting.append((id_, True))
            waiting.extend((parent, False) for parent in reversed(node.parents))
        return found

    def _node(self, id_: str, known: Library) -> Node | None:
        spec = known(id_)
        if spec is None:
            return None
        needs = known.needs(spec)
        record = self._store.job(id_)
        flaw = None
        for need in needs:
            if kind_of(need) in specs.UPLOADED_KINDS:
                if not self._store.has(need):
                    flaw = flaw or library.lost_upload(need, task=id_)
            elif known(need) is None:
                detail = f"the {kind_of(need)} {need} is not known here: ask for the whole question again"
                flaw = flaw or library.problem("gone", "A parent is gone", detail, task=id_)
        if flaw:
            return Node(id_, spec, (), Cost(0.0, 0), flaw)
        size = Sizes(self._store, known)
        cost = stage(spec).cost(spec, size)
        parents = tuple(need for need in needs if kind_of(need) not in specs.UPLOADED_KINDS)
        shards = self._shards(spec, size, cost, record)
        if shards:
            cost = _gathering(spec, size)
            for shard in shards:
                known.know(specs.spec_id(shard), shard)
        return Node(id_, spec, parents + tuple(map(specs.spec_id, shards)), cost)

    def _shards(self, spec: Spec, size: Sizes, cost: Cost, record: JobRecord | None) -> tuple[Spec, ...]:
        """Shards of a task, as decided when it was first planned, or now."""
        parts = stage(spec).shards(spec, size)
        if len(parts) < 2:
            return ()
        if record is not None and record.tasks and record.outcome is None:
            return parts if library.planned_shards(record) else ()
        return parts if cost.seconds > self._settings.shard_seconds else ()

    def record(self, nodes: Mapping[str, Node], root: str) -> None:
        """Write the records of a question's tasks, open again where they had failed or been dismissed.

        Parameters
        ----------
        nodes : mapping of Node by id
            Parents first.
        root : str
            Id of the one that was asked for.
        """
        closures: dict[str, dict[str, None]] = {}
        for id_, node in nodes.items():
            closure: dict[str, None] = {}
            for parent in node.parents:
                closure |= closures.get(parent, {})
            closures[id_] = closure | {id_: None}
            tasks = tuple(_task(nodes[each]) for each in closures[id_])
            self._write(node, tasks, asked=id_ == root)

    def _write(self, node: Node, tasks: tuple[TaskRecord, ...], *, asked: bool) -> None:
        if self._store.gone(node.id) is not None:
            self._store.reopen_job(node.id)

        def change(record: JobRecord) -> JobRecord:
            covered = {task.id for task in record.tasks} >= {task.id for task in tasks}
            kept = record.outcome is None and covered
            return replace(
                record,
                asked=record.asked or asked,
                tasks=record.tasks if kept else tasks,
                outcome=None,
                problem=None,
                started_at=None,
                finished_at=None,
            )

        try:
            self._store.update_job(node.id, change)
        except UnknownJob:
            fresh = JobRecord(
                id=node.id, spec=specs.dump(node.spec), asked=asked, created_at=now(), tasks=tasks
            )
            if self._store.write_job(fresh) != fresh:
                self._store.update_job(node.id, change)

    def attempt(self, nodes: Mapping[str, Node], *, rerun: bool) -> None:
        """Give every task an attempt that has none; under the planning lock.

        Parameters
        ----------
        nodes : mapping of Node by id
            Parents first.
        rerun : bool
            Whether deaths are forgotten, since somebody asked again.
        """
        current = self._attempts.current(list(nodes), strict=True)
        names: dict[str, str] = {}
        begun: set[str] = set()
        failed: dict[str, library.Problem | None] = {}
        held_up: set[str] = set()
        if rerun:
            self._attempts.revive(id_ for id_, attempt in current.items() if not attempt.alive)
        for id_, node in nodes.items():
            attempt = current[id_]
            if attempt.state == "running" and not attempt.known:
                held_up.add(id_)  # outlived a FLUSHALL: its children come when it is done
            elif attempt.alive and not (attempt.state == "deferred" and begun.intersection(node.parents)):
                names[id_] = attempt.name
            elif held_up.intersection(node.parents):
                held_up.add(id_)
            elif name := self._replaced(node, attempt, names, failed):
                names[id_] = name
                begun.add(id_)

    def _replaced(
        self,
        node: Node,
        attempt: Attempt,
        names: Mapping[str, str],
        failed: dict[str, library.Problem | None],
    ) -> str:
        """Begin a new attempt in the place of a dead one, or record why not; returns its name, if any."""
        if attempt.name:
            self._attempts.forget(node.id, attempt.name)
        # It may have ended between the looks at the store and at Redis.
        if self._store.has(node.id):
            return ""
        record = self._store.job(node.id)
        if record is not None and record.outcome == "failed":
            failed[node.id] = record.problem
            return ""
        found = node.flaw or self._cause(node, failed)
        if found is None and attempt.died and (deaths := self._attempts.died(node.id)) >= MAX_DEATHS:
            found = died(node.id, deaths)
        if found is not None:
            library.fail(self._store, node.id, found)
            failed[node.id] = found
            return ""
        if record is None or record.outcome == "dismissed":
            self._write(node, record.tasks if record else (_task(node),), asked=False)
        parents = [names[parent] for parent in node.parents if parent in names]
        timeout = max(TIMEOUT_FLOOR, round(TIMEOUT_FACTOR * node.cost.seconds))
        # Shards may be short, but a long solve has many: they must not keep short questions waiting.
        interactive = node.cost.seconds < INTERACTIVE_SECONDS and not node.spec.private
        name = self._attempts.enqueue(node.id, parents, interactive=interactive, timeout=timeout)
        if attempt.died:
            _log.warning("%s: its worker died; it runs again as %s", node.id, name)
        return name

    def outdated(self, id_: str) -> None:
        """Record that a task cannot be done any more, since its kind has another version now."""
        detail = "this version of softmaps answers such questions differently: ask again"
        found = library.problem("outdated", "Another version", detail, task=id_)
        library.fail(self._store, id_, found)

    def _cause(self, node: Node, failed: dict[str, library.Problem | None]) -> library.Problem | None:
        return next(
            (library.inherited(parent, failed[parent]) for parent in node.parents if parent in failed), None
        )


def died(id_: str, deaths: int) -> library.Problem:
    """What a task's failure is when its worker died too often."""
    detail = f"worker died {deaths} times while making it; it may need more memory than there is"
    return library.problem("worker-died", "Worker died", detail, task=id_)


def tasks_of(nodes: Mapping[str, Node]) -> tuple[TaskRecord, ...]:
    """Tasks of a plan, as a job record lists them."""
    return tuple(map(_task, nodes.values()))


def _task(node: Node) -> TaskRecord:
    return TaskRecord(node.id, node.spec.kind, node.cost.seconds, node.cost.bytes)


def _gathering(spec: Spec, size: Sizes) -> Cost:
    """Cost of a task whose work its shards do."""
    assert isinstance(spec, specs.Energy | specs.Potential)
    ends = size.softmap(spec.softmap)
    gradient = isinstance(spec, specs.Energy) and spec.gradient
    return sizes.gathering_cost(ends, ends.source.mesh.n_faces, gradient)
