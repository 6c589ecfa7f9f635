"""The function that RQ runs: one task, from its parents' artifacts to its own, or to a recorded failure.

A bad mesh is an answer, not a retry: it is recorded and the run ends well. Only faults of the machine raise.
"""

from __future__ import annotations

import importlib.metadata
import logging
import platform
import time
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, Final

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry
from rq.timeouts import JobTimeoutException

from worker import jobs, library, specs
from worker.attempts import Attempts
from worker.bench import Bench, Made, Report
from worker.fields import kind_of
from worker.jobs import Step
from worker.library import Library, Problem
from worker.plan import MAX_DEATHS, died
from worker.readers import Reader
from worker.settings import Settings, usable_cores
from worker.stages import stage
from worker.store import JobRecord, Store, StoreError, now

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

    from solver.errors import SolverError

_log = logging.getLogger("softmaps.worker")

#: Shortest time between two notes of a fraction, in seconds; a new phase waits only for the last but one.
NOTE_SECONDS: Final = 0.5
#: Longest that a note may hold up a task when Redis does not answer, and how long notes then pause.
_NOTE_TIMEOUT: Final = 0.5
_NOTE_PAUSE: Final = 5.0
#: Packages whose versions decide the bits of a result.
_PACKAGES: Final = ("softmaps", "numpy", "scipy", "numba")


def run_task(task: str) -> None:
    """Run one task of the store that the settings name; the only function a worker runs.

    Parameters
    ----------
    task : str
        Id of the artifact to make.

    Raises
    ------
    OSError
        If the machine fails: a full disk, a lost mount. Everything else is recorded.
    """
    workplace().run(task)


@cache
def workplace() -> Workplace:
    """The workplace of this process, as the environment describes it."""
    return Workplace(Settings())


class Workplace:
    """Where tasks of one store are done.

    Parameters
    ----------
    settings : Settings
        With a ``redis_url``.

    Raises
    ------
    ValueError
        If no Redis is named.
    """

    def __init__(self, settings: Settings) -> None:
        if settings.redis_url is None:
            raise ValueError("a worker needs SOFTMAPS_REDIS_URL")
        self.settings = settings
        self.store = Store(settings.store_folder)
        # The worker has its own patience; redis-py's would be added to it, up to ten seconds a command.
        self.connection = redis.Redis.from_url(settings.redis_url, retry=Retry(NoBackoff(), 1))
        # Notes of progress must never hold up a task: their own connection, with none.
        self._notes = redis.Redis.from_url(
            settings.redis_url,
            socket_timeout=_NOTE_TIMEOUT,
            socket_connect_timeout=_NOTE_TIMEOUT,
            retry=Retry(NoBackoff(), 0),
        )
        self.attempts = Attempts(self.connection, self.store.identity, specs.versions_digest())
        self.threads = settings.threads or usable_cores()

    def prepare(self) -> None:
        """Load what every task needs, before the worker forks; nothing of it is run, no thread is begun."""
        import scipy.sparse.linalg  # noqa: F401, PLC0415  (half a second that every horse inherits)

        import solver  # noqa: F401, PLC0415

        blas_pools()
        versions()

    def close(self) -> None:
        """Close the connections to Redis."""
        self.connection.close()
        self._notes.close()

    def dismissed(self, task: str) -> bool:
        """Whether a task was dismissed."""
        try:
            record = self.store.job(task)
        except OSError as error:
            _log.warning("the store cannot be read: %s", error)
            return False
        return record is not None and record.outcome == "dismissed"

    def fail_overtime(self, task: str, seconds: float) -> None:
        """Record that a task did not end in time."""
        self._fail(task, overtime(task, seconds))

    def fail_died(self, task: str, deaths: int) -> None:
        """Record that a task's worker died too often."""
        self._fail(task, died(task, deaths))

    def run(self, task: str) -> None:
        """Make an artifact or record why not; see `run_task`."""
        record = self.store.job(task)
        if record is None or record.outcome is not None or self.store.has(task):
            return
        spec = library.spec_named(task, record.spec)
        if spec is None:
            return  # another version's; reconciling says so
        shards = library.planned_shards(record)
        known = Library(self.store)
        for need in known.needs(spec) + shards:
            if self.store.has(need):
                continue
            if kind_of(need) in specs.UPLOADED_KINDS:
                self._fail(task, library.lost_upload(need, task=task))
            elif (parent := self.store.job(need)) is not None and parent.outcome == "failed":
                self._fail(task, library.inherited(need, parent.problem))
            else:
                _log.info("%s: waits for %s", task, need)  # the reconciling loop brings both
            return
        notes = Notes(self._notes, self.attempts, task)
        self._make(record, spec, shards, notes)

    def _make(self, record: JobRecord, spec: specs.Spec, shards: tuple[str, ...], notes: Notes) -> None:
        from solver import SolverError  # noqa: PLC0415  (planning does without)

        task = record.id
        begun = time.perf_counter()
        bench = Bench(Reader(self.store), self.threads, notes.step, task, shards)
        try:
            with blas_pools().limit(limits=1):
                notes.step("reading", 0.0, 0.0)
                made = stage(spec).make(spec, bench)
            seconds = time.perf_counter() - begun
            self._keep(record, spec, made, seconds, notes)
        except SolverError as error:
            self._fail(task, refused(task, error))
        except MemoryError:
            self._fail(task, memory(task, self.settings.task_memory_bytes))
        except JobTimeoutException:
            self._fail(task, overtime(task, time.perf_counter() - begun))
        except (StoreError, OSError, redis.exceptions.RedisError) as error:
            self._fault(task, error)
        except Exception:
            _log.exception("%s: internal error", task)
            detail = "an error in softmaps itself; its log says more"
            self._fail(task, library.problem("internal-error", "Internal error", detail, task=task))
        else:
            words = "%s: %s, %s, %.2f s, residual %.1e"
            _log.info(words, task, spec.kind, made.sizes, seconds, made.residual)

    def _keep(self, record: JobRecord, spec: specs.Spec, made: Made, seconds: float, notes: Notes) -> None:
        """Put what was made into the store."""
        for shard in made.adopts:
            self.store.delete_job(shard)  # first, or it would be open again once its artifact is adopted
        self.store.put(
            record.id,
            kind=spec.kind,
            spec=specs.dump(spec),
            parents=specs.parents(spec),
            values=made.values,
            arrays=made.arrays,
            made={
                "seconds": round(seconds + made.seconds, 3),
                "threads": self.threads,
                "versions": versions(),
                "started_at": self._begun(record) or notes.started_at,
            },
            adopts=made.adopts,
        )
        self.store.delete_checkpoints(record.id)

    def _fail(self, task: str, found: Problem) -> None:
        """Record a failure."""
        record = self.store.job(task)
        if record is not None:
            started_at = self._begun(record)
            library.fail(self.store, task, found, started_at=started_at)
            library.fail_dependants(self.store, task, found, started_at=started_at)
            _log.info("%s: failed: %s", task, found["detail"])

    def _begun(self, record: JobRecord) -> str | None:
        """When the first of a job's tasks began, as far as Redis tells."""
        try:
            steps = jobs.steps(self._notes, self.attempts, [each.id for each in record.tasks])
        except redis.exceptions.RedisError:
            return None
        return min((step.started_at for step in steps.values()), default=None)

    def _fault(self, task: str, error: Exception) -> None:
        """Have a task run again after a fault of the machine, but not for ever."""
        _log.warning("%s: %s: %s", task, type(error).__name__, error)
        try:
            faults = self.attempts.died(task)
        except redis.exceptions.RedisError:
            faults = 0
        if faults >= MAX_DEATHS:
            detail = f"the machine failed {faults} times: {_words(error)}"
            self._fail(task, library.problem("machine-fault", "Machine fault", detail, task=task))
        elif not isinstance(error, StoreError):
            raise error
        # A parent that was damaged or forgotten is made again by the reconciling loop, then this task.


class Notes:
    """Tells Redis how far a task is, at most twice a second and never at the task's expense.

    Parameters
    ----------
    connection : redis.Redis
    attempts : Attempts
    task : str
    """

    def __init__(self, connection: redis.Redis, attempts: Attempts, task: str) -> None:
        self._connection = connection
        self._attempts = attempts
        self._task = task
        self.started_at = now()
        self._phase = "starting"
        self._values: Mapping[str, Any] = {}
        self._noted = (0.0, 0.0)
        self._paused = 0.0

    def step(self, words: str, start: float, stop: float, values: Mapping[str, Any] | None = None) -> Report:
        """Say what happens from now on, and return how to say how much of that share is done."""
        self._phase, self._values = words, values or {}
        self._note(start, time.monotonic() - self._noted[0] >= 2 * NOTE_SECONDS)
        return self._report(start, stop)

    def _report(self, start: float, stop: float) -> Report:
        def report(done: float) -> None:
            self._note(start + (stop - start) * done, time.monotonic() - self._noted[1] >= NOTE_SECONDS)

        return report

    def _note(self, fraction: float, due: bool) -> None:
        moment = time.monotonic()
        if not due or moment < self._paused:
            return
        said = Step(self.started_at, min(1.0, max(0.0, fraction)), self._phase, self._values).dump()
        try:
            self._connection.set(self._attempts.key("progress", self._task), said, ex=jobs.STEP_SECONDS)
            self._noted = (self._noted[1], moment)
        except redis.exceptions.RedisError:
            self._paused = moment + _NOTE_PAUSE


def refused(task: str, error: SolverError) -> Problem:
    """Failure of a task that the solver refused."""
    name = type(error).__name__
    words = "".join(f" {letter.lower()}" if letter.isupper() else letter for letter in name).strip()
    value = error.value
    if isinstance(value, float) and not abs(value) < float("inf"):
        value = str(value)  # JSON has no NaN
    return library.problem(
        words.replace(" ", "-"), words.capitalize(), str(error), task=task, index=error.index, value=value
    )


def overtime(task: str, seconds: float) -> Problem:
    """Failure of a task that did not end in time."""
    detail = f"it did not end within {seconds:,.0f} s, many times what it was expected to take"
    return library.problem("overtime", "Out of time", detail, task=task)


def memory(task: str, limit: int) -> Problem:
    """Failure of a task that needed more memory than it may take."""
    detail = f"it needed more than the {limit / 1e9:,.1f} GB of memory that one task may take"
    return library.problem("out-of-memory", "Out of memory", detail, task=task)


def _words(error: Exception) -> str:
    """What a fault is, without the paths that only this machine's owner may see."""
    return (error.strerror if isinstance(error, OSError) else None) or type(error).__name__


@cache
def blas_pools() -> ThreadpoolController:
    """Thread pools of the BLAS libraries that the solver loads; finding them takes 15 ms."""
    import threadpoolctl  # noqa: PLC0415  (planning does without)

    import solver  # noqa: F401, PLC0415

    return threadpoolctl.ThreadpoolController()


@cache
def versions() -> dict[str, str]:
    """Versions that decide the bits of a result."""
    found: dict[str, str] = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # run from a checkout
            found[package] = "unknown"
    return found
