"""Attempts: tasks as RQ jobs. With `worker.horse` the only code that speaks RQ.

A task is tried under names of its own, ``{task id}-{8 hex}``, never used twice, so that a worker that was
given up cannot write over its successor. Redis holds only such names and what can be found again.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final, Literal

import redis
from rq.command import send_command
from rq.intermediate_queue import IntermediateQueue
from rq.job import Dependency, Job, JobStatus, Retry
from rq.queue import Queue
from rq.results import Result

from worker import presence
from worker.presence import Presence

#: The only function that a worker of ours runs.
FUNCTION: Final = "worker.tasks.run_task"
#: How long Redis remembers an attempt that ended, in seconds.
KEPT_SECONDS: Final = 3600
#: Runs of one attempt after the first, for machine faults alone.
RETRIES: Final = 2
#: An attempt that is neither waiting nor running for this long was lost between the two.
LOST_SECONDS: Final = 5
#: Sightings of a lost attempt further apart than this are two different stories.
_SIGHTING_SECONDS: Final = 15
#: Estimates below this go to the queue that never waits behind long solves.
INTERACTIVE_SECONDS: Final = 2.0
#: Longest time between two passes that remember how often a task's worker died.
_DEATHS_SECONDS: Final = 86_400

SERIALIZER: Final = "json"


class ForbiddenJobError(Exception):
    """A job on our queues that is no task of ours."""


class TaskJob(Job):
    """An RQ job that can be one thing only: a run of `worker.tasks.run_task` with a task's id.

    RQ imports and calls whatever name a job carries; a Redis that others write to must not become a shell.
    """

    def restore(self, raw_data: Any) -> Any:
        """Read the job from Redis, without the callbacks and addresses that RQ would call."""
        super().restore(raw_data)
        self._success_callback_name = self._failure_callback_name = self._stopped_callback_name = None
        self.webhooks = []

    @property
    def func(self) -> Any:
        """The one function.

        Raises
        ------
        ForbiddenJobError
            If the job names another, or arguments that are no task.
        """
        one_id = len(self.args) == 1 and isinstance(self.args[0], str) and not self.kwargs
        if self.func_name != FUNCTION or self.instance is not None or not one_id:
            raise ForbiddenJobError(f"refused to run the job {self.id}: it is no task")
        from worker.tasks import run_task  # noqa: PLC0415  (only the process that runs it needs it)

        return run_task


@dataclass(frozen=True)
class Attempt:
    """One try of a task, as Redis knows it.

    Attributes
    ----------
    name : str
        RQ id, or empty if the task has no current attempt.
    state : {"waiting", "deferred", "running", "ended", "gone"}
        Waiting in a queue; for its parents; running on an announced worker; ended in any way; unknown to
        Redis, lost, waiting for what never comes, or on a worker that is silent.
    died : bool
        Whether it ended by a fault of the machine: its worker fell silent, or RQ gave it up.
    known : bool
        Whether RQ knows it; a run that outlived a FLUSHALL is running but unknown.
    """

    name: str
    state: Literal["waiting", "deferred", "running", "ended", "gone"]
    died: bool = False
    known: bool = True

    @property
    def alive(self) -> bool:
        """Whether it may still end by itself."""
        return self.state in ("waiting", "deferred", "running")


class Attempts:
    """The attempts of one store's tasks on one Redis.

    Parameters
    ----------
    connection : redis.Redis
        Without ``decode_responses``.
    identity : str
        The store's; tasks of another store on the same Redis are never touched.
    versions : str
        Digest of all kinds' versions; workers of another version are never given our tasks.
    """

    def __init__(self, connection: redis.Redis, identity: str, versions: str) -> None:
        self.connection = connection
        self._prefix = f"softmaps:{identity}"
        self.presence = Presence(connection, self._prefix)
        self.queues: dict[str, Queue] = {
            name: Queue(
                f"softmaps-{identity}-{versions}-{name}",
                connection=connection,
                job_class=TaskJob,
                serializer=SERIALIZER,
            )
            for name in ("interactive", "batch")
        }

    def key(self, *parts: str) -> str:
        """Name of one of our own keys."""
        return ":".join((self._prefix, *parts))

    # Looking

    def current(self, tasks: Sequence[str], *, strict: bool = False) -> dict[str, Attempt]:
        """Look at the current attempt of each task, all at one moment.

        Parameters
        ----------
        tasks : sequence of str
        strict : bool
            Whether attempts that have been out of sight for some seconds count as lost: for those who plan.

        Returns
        -------
        dict of Attempt by task
        """
        if not tasks:
            return {}
        names = [_text(name) for name in self.connection.mget([self.key("task", task) for task in tasks])]
        pipeline = self.connection.pipeline()
        self.presence.ask(pipeline)
        for queue in self.queues.values():
            pipeline.lrange(queue.key, 0, -1)
        for queue in self.queues.values():
            pipeline.zrange(queue.started_job_registry.key, 0, -1)
        for name in names:
            pipeline.hmget(Job.key_for(name), "status", "origin", "dependency_ids")
        said, *answers = pipeline.execute()
        running = {worker.attempt for worker in presence.read(said) if worker.attempt}
        n_queues = len(self.queues)
        waiting = {_text(item) for queue in answers[:n_queues] for item in queue}
        begun = {
            _text(item).partition(":")[0] for queue in answers[n_queues : 2 * n_queues] for item in queue
        }
        found, unseen, deferred = {}, [], {}
        for task, name, answer in zip(tasks, names, answers[2 * n_queues :], strict=True):
            status, origin, dependencies = map(_text, answer)
            found[task] = self._judged(task, name, (status, origin), running)
            if found[task].state == "deferred":
                deferred[task] = json.loads(dependencies or "[]")
            elif found[task].state == "waiting" and name not in waiting:
                if name in begun:  # its worker died before the horse could say anything
                    found[task] = Attempt(name, "gone", died=True)
                else:
                    unseen.append(task)
        if strict:
            hopeless, idle = self._stuck(deferred)
            hopeless += [task for task in unseen + idle if self._lost(found[task].name)]
            found |= {task: Attempt(found[task].name, "gone") for task in hopeless}
        return found

    def _judged(self, task: str, name: str, told: tuple[str, str], running: set[str]) -> Attempt:
        status, origin = told
        if name in running:
            return Attempt(name, "running", known=bool(status))
        # After a FLUSHALL nothing names the attempt any more, but its worker still does.
        for other in running:
            if task_of(other) == task:
                return Attempt(other, "running", known=False)
        if origin not in {queue.name for queue in self.queues.values()}:
            return Attempt(name, "gone")
        if status in (JobStatus.QUEUED, JobStatus.READY_TO_ENQUEUE):
            return Attempt(name, "waiting")
        if status == JobStatus.STARTED:
            return Attempt(name, "gone", died=True)
        # RQ's failures are faults that struck again and again; failures of tasks are recorded in the store.
        return Attempt(
            name, "deferred" if status == JobStatus.DEFERRED else "ended", status == JobStatus.FAILED
        )

    def _stuck(self, deferred: Mapping[str, Sequence[str]]) -> tuple[list[str], list[str]]:
        """Tasks whose deferred attempts wait for what never comes, and those that should have begun by now.

        RQ releases a child when a parent finishes or fails, never when one is stopped or forgotten.
        """
        pipeline = self.connection.pipeline()
        parents = sorted({name for names in deferred.values() for name in names})
        for name in parents:
            pipeline.hget(Job.key_for(name), "status")
        states = dict(zip(parents, map(_text, pipeline.execute()), strict=True))
        over = {JobStatus.FINISHED, JobStatus.FAILED}
        never = {"", JobStatus.CANCELED, JobStatus.STOPPED}
        seen = {task: {states[name] for name in names} for task, names in deferred.items()}
        hopeless = [task for task, found in seen.items() if found & never]
        return hopeless, [task for task, found in seen.items() if found <= over]

    def _lost(self, name: str) -> bool:
        """Whether an attempt has been out of sight for some seconds: popped by a worker that died at once."""
        key = self.key("sighting", name)
        pipeline = self.connection.pipeline()
        pipeline.time()
        pipeline.set(key, 0, nx=True)
        pipeline.get(key)
        pipeline.expire(key, _SIGHTING_SECONDS)
        (now, _), _, first, _ = pipeline.execute()
        if int(first) == 0:
            self.connection.set(key, now, ex=_SIGHTING_SECONDS)
            return False
        return bool(now - int(first) >= LOST_SECONDS)

    # Acting

    def enqueue(self, task: str, parents: Sequence[str], *, interactive: bool, timeout: int) -> str:
        """Begin a new attempt of a task behind its parents' attempts; returns its name.

        Parameters
        ----------
        task : str
        parents : sequence of str
            RQ ids of attempts that must end first.
        interactive : bool
            Whether it belongs in the queue of short tasks.
        timeout : int
            Seconds after which the run is given up.
        """
        name = f"{task}-{secrets.token_hex(4)}"
        # Named before it exists: a crash in between leaves a name without attempt, replaced later
        self.connection.set(self.key("task", task), name)
        self.queues["interactive" if interactive else "batch"].enqueue_call(
            FUNCTION,
            args=(task,),
            job_id=name,
            timeout=timeout,
            result_ttl=KEPT_SECONDS,
            failure_ttl=KEPT_SECONDS,
            description=task,
            retry=Retry(max=RETRIES),
            depends_on=Dependency(list(parents), allow_failure=True) if parents else None,
        )
        return name

    def forget(self, task: str, name: str, *, running: bool = False) -> None:
        """Drop a task's attempt, whatever it waits for; a running one only loses its name."""
        if running or not name:
            self.connection.delete(self.key("task", task))
            return
        started = [
            member
            for queue in self.queues.values()
            for member in map(_text, self.connection.zrange(queue.started_job_registry.key, 0, -1))
            if member.startswith(f"{name}:")
        ]
        pipeline = self.connection.pipeline()
        for queue in self.queues.values():
            pipeline.lrem(queue.key, 0, name)
            pipeline.lrem(IntermediateQueue.get_intermediate_queue_key(queue.key), 0, name)
            pipeline.zrem(queue.deferred_job_registry.key, name)
            pipeline.zrem(queue.ready_job_registry.key, name)
            if started:
                pipeline.zrem(queue.started_job_registry.key, *started)
        job = TaskJob(name, connection=self.connection, serializer=SERIALIZER)
        pipeline.delete(job.key, job.dependents_key, job.dependencies_key, Result.get_key(name))  # type: ignore[no-untyped-call]
        pipeline.delete(self.key("task", task), self.key("sighting", name))
        pipeline.execute()

    def stop(self, tasks: Iterable[str]) -> int:
        """Tell workers to kill their runs of some tasks; returns how many still run."""
        wanted = set(tasks)
        running = [each for each in self.presence.workers() if task_of(each.attempt) in wanted]
        for worker in running:
            send_command(self.connection, worker.name, "stop-job", job_id=worker.attempt)
        return len(running)

    def died(self, task: str) -> int:
        """Count one more death of a task's worker; returns how many there were."""
        pipeline = self.connection.pipeline()
        pipeline.incr(self.key("deaths", task))
        pipeline.expire(self.key("deaths", task), _DEATHS_SECONDS)
        return int(pipeline.execute()[0])

    def revive(self, tasks: Iterable[str]) -> None:
        """Forget the deaths of some tasks: they were asked for again."""
        named = [self.key("deaths", task) for task in tasks]
        if named:
            self.connection.delete(*named)

    # Housekeeping

    def due(self, what: str, seconds: int) -> bool:
        """Whether something that is to happen every so many seconds should happen now; true for one asker."""
        return bool(self.connection.set(self.key("done", what), 1, nx=True, ex=seconds))

    def uptime(self) -> int:
        """Seconds since Redis was started."""
        return int(self.connection.info("server")["uptime_in_seconds"])

    def tidy(self) -> None:
        """Forget what ended long ago and release children that a dying worker left ready but not queued."""
        self.presence.prune()
        for queue in self.queues.values():
            queue.finished_job_registry.cleanup()
            queue.failed_job_registry.cleanup()
            queue.ready_job_registry.cleanup()
            # Not the registry's own cleanup: it would run an attempt again whose name may still be in use.
            self._drop_expired(queue)

    def _drop_expired(self, queue: Queue) -> None:
        registry = queue.started_job_registry
        self.connection.zremrangebyscore(registry.key, 0, f"({_now(self.connection) - KEPT_SECONDS}")
        intermediate = IntermediateQueue.get_intermediate_queue_key(queue.key)
        for item in map(_text, self.connection.lrange(intermediate, 0, -1)):
            if _text(self.connection.hget(Job.key_for(item), "status")) != JobStatus.QUEUED:
                self.connection.lrem(intermediate, 0, item)

    def counts(self) -> Mapping[str, int]:
        """How many attempts wait in each queue, wait for parents, and run."""
        pipeline = self.connection.pipeline(transaction=False)
        for queue in self.queues.values():
            pipeline.llen(queue.key)
            pipeline.zcard(queue.deferred_job_registry.key)
        answers = pipeline.execute()
        found = dict(zip(self.queues, answers[0::2], strict=True))
        found["deferred"] = sum(answers[1::2])
        found["running"] = sum(1 for worker in self.presence.workers() if worker.attempt)
        return found


def _text(answer: Any) -> str:
    """What Redis answered, empty where it knew nothing."""
    return answer.decode() if answer else ""


def task_of(name: str) -> str:
    """Id of the task that an attempt tries."""
    return name.rpartition("-")[0]


def utc_now() -> datetime:
    """Now, as RQ writes times."""
    return datetime.now(UTC)


def _now(connection: redis.Redis) -> int:
    """Redis's own clock: ours may differ."""
    return int(connection.time()[0])
