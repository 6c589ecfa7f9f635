"""The worker: takes tasks from Redis and runs each in a child of its own, its horse.

What differs from RQ's: it announces itself, survives a Redis that goes away, kills a horse that was dismissed
or is over time, bounds its memory, leaves no process behind, and on SIGTERM hands its task back at once.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import resource
import secrets
import signal
import socket
import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import TYPE_CHECKING, Final

import redis
from rq.exceptions import InvalidJobOperation, StopRequested
from rq.executions import Execution
from rq.job import Job, JobStatus
from rq.queue import Queue
from rq.timeouts import HorseMonitorTimeoutException
from rq.worker import Worker

from worker import attempts, presence
from worker.attempts import Attempts, TaskJob
from worker.plan import MAX_DEATHS
from worker.tasks import blas_pools

if TYPE_CHECKING:
    from worker.tasks import Workplace

_log = logging.getLogger("softmaps.worker")

#: How often a worker looks at its horse and announces itself, in seconds.
WATCH_SECONDS: Final = 1
#: RQ's heartbeat lifetime; its blocking pop lasts 15 s less.
WORKER_TTL: Final = 15 + 3 * WATCH_SECONDS
#: How long a horse past its timeout may take to notice by itself, in seconds; native code does not.
OVERTIME_SECONDS: Final = 5
#: prctl: send this process a signal when its parent ends.
_PR_SET_PDEATHSIG: Final = 1


class SoftmapsWorker(Worker):
    """A worker of one store's tasks, one at a time.

    Parameters
    ----------
    workplace : Workplace
        Settings, store and outcomes, shared with the tasks.
    name : str
        Unique among workers.
    interactive : bool
        Take only tasks estimated below two seconds.
    """

    #: RQ would wait up to a minute between two tries to reach Redis.
    max_connection_wait_time = 2.0

    def __init__(self, workplace: Workplace, name: str, *, interactive: bool) -> None:
        self._workplace = workplace
        self._attempts: Attempts = workplace.attempts
        self._interactive = interactive
        self._running = ""
        self._end = ""
        wanted = ("interactive",) if interactive else ("interactive", "batch")
        super().__init__(
            [self._attempts.queues[each] for each in wanted],
            name=name,
            connection=workplace.connection,
            job_class=TaskJob,
            serializer=attempts.SERIALIZER,
            default_result_ttl=attempts.KEPT_SECONDS,
            worker_ttl=WORKER_TTL,
            job_monitoring_interval=WATCH_SECONDS,
            log_job_description=False,
        )
        self.log_result_lifespan = False

    @property
    def stopping(self) -> bool:
        """Whether it was told to stop."""
        return bool(self._stop_requested)

    # Announcing

    def heartbeat(self, timeout: int | None = None, pipeline: redis.client.Pipeline | None = None) -> None:
        """Tell RQ and ourselves that this worker lives."""
        super().heartbeat(timeout, pipeline)
        if not self.is_horse:
            self._announce()

    def get_heartbeat_ttl(self, job: Job, working_time: float = 0.0) -> int:
        """Seconds after which a silent run counts as abandoned."""
        return presence.ANNOUNCED_SECONDS

    def _announce(self) -> None:
        said = presence.Worker(
            self.name, self.hostname or "", self.pid or 0, self._interactive, self._running
        )
        self._attempts.presence.announce(said)

    def register_death(self) -> None:
        """Take leave of RQ and of our own list."""
        self._attempts.presence.withdraw(self.name)
        super().register_death()  # type: ignore[no-untyped-call]

    def unsubscribe(self) -> None:
        """Let the thread that listens for commands end by itself: waiting for it takes a second."""
        if self.pubsub_thread is not None:
            self.pubsub_thread.stop()

    def run_maintenance_tasks(self) -> None:
        """Do nothing: reconciling is the API's, and RQ's own would run one attempt twice at a time."""

    # Running

    def execute_job(self, job: Job, queue: Queue) -> None:
        """Run an attempt in a horse and see to its end."""
        self._running, self._end = job.id, ""
        try:
            self._announce()
            super().execute_job(job, queue)
        finally:
            self._running = ""
        self._announce()

    def fork_work_horse(self, job: Job, queue: Queue) -> None:
        """Fork the horse into a process group of its own, in both processes, whichever comes first."""
        worker = os.getpid()
        horse = os.fork()
        if horse == 0:
            os.setpgid(0, 0)
            die_with(worker)
            settle_blas()
            restrain(self._workplace.settings.task_memory_bytes)
            self.main_work_horse(job, queue)
            os._exit(0)
        with contextlib.suppress(OSError):  # it may have done so itself, or be gone
            os.setpgid(horse, horse)
        self._horse_pid = horse

    def kill_horse(self, sig: signal.Signals = signal.SIGKILL) -> None:
        """Kill the horse and all its children; without a horse, nothing (RQ's would kill the worker)."""
        if self.horse_pid:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.horse_pid, sig)

    def wait_for_horse(self) -> tuple[int | None, int | None, resource.struct_rusage | None]:
        """Wait for the horse, then end what it left behind while its process group still has a name."""
        with contextlib.suppress(ChildProcessError):
            if hasattr(os, "waitid"):
                os.waitid(os.P_PID, self.horse_pid, os.WEXITED | os.WNOWAIT)
            self.kill_horse()
        return super().wait_for_horse()

    def monitor_work_horse(self, job: Job, queue: Queue, execution: Execution) -> None:
        """Watch the horse until it ends, and record an end that it could not record itself."""
        job.started_at = attempts.utc_now()
        begun = time.monotonic()
        while True:
            try:
                with self.death_penalty_class(WATCH_SECONDS, HorseMonitorTimeoutException):
                    _, status, _ = self.wait_for_horse()
                break
            except HorseMonitorTimeoutException:
                self._look_after(job, execution, time.monotonic() - begun)
        self._horse_pid = 0
        self.executions.pop(execution.id, None)
        if status != os.EX_OK:
            self._patiently(lambda: self._see_to_end(job, queue, execution, status))

    def _look_after(self, job: Job, execution: Execution, seconds: float) -> None:
        """Keep a run alive in Redis, or end it."""
        try:
            self.maintain_heartbeats(job, execution)
        except redis.exceptions.RedisError as error:
            _log.warning("Redis is away while %s runs: %s", job.id, error)
        if self._stop_requested:
            self._end = "handed back"
        elif seconds > float(job.timeout or 0) + OVERTIME_SECONDS:
            self._end = "overtime"
        elif self._stopped_job_id == job.id or self._workplace.dismissed(attempts.task_of(job.id)):
            self._stopped_job_id = job.id
            self._end = "stopped"
        if self._end:
            self.kill_horse()

    def _see_to_end(self, job: Job, queue: Queue, execution: Execution, status: int | None) -> None:
        """Record how a horse ended that did not end by itself."""
        try:
            state = job.get_status()
        except InvalidJobOperation:  # forgotten meanwhile: dismissed, or Redis was emptied
            return
        if state in (JobStatus.FINISHED, JobStatus.FAILED, JobStatus.STOPPED):
            return
        job.ended_at = attempts.utc_now()
        if self._stop_requested and self._stopped_job_id != job.id:
            self._hand_back(job, queue, execution)
            return
        if self._end == "overtime":
            self._workplace.fail_overtime(attempts.task_of(job.id), float(job.timeout or 0))
            job.retries_left = 0
        elif self._stopped_job_id != job.id and not self._workplace.store.has(attempts.task_of(job.id)):
            self._count_death(job, status)
        self.handle_job_failure(
            job, queue=queue, exc_string=f"the run ended with {status}", execution=execution
        )

    def _count_death(self, job: Job, status: int | None) -> None:
        task = attempts.task_of(job.id)
        deaths = self._attempts.died(task)
        _log.warning("%s: its run died with status %s, for the %d. time", task, status, deaths)
        if deaths >= MAX_DEATHS:
            self._workplace.fail_died(task, deaths)
            job.retries_left = 0

    def _hand_back(self, job: Job, queue: Queue, execution: Execution) -> None:
        """Put an attempt back in front of its queue; its horse is gone, so its name is free again."""
        with self.connection.pipeline() as pipeline:
            self.cleanup_execution(job, pipeline=pipeline, execution=execution)
            queue._enqueue_job(job, pipeline=pipeline, at_front=True)
            pipeline.execute()
        _log.info("%s: handed back", attempts.task_of(job.id))

    def _patiently(self, act: Callable[[], None]) -> None:
        """Act, and again while Redis is away; told to stop, leave it to the reconciling loop."""
        while True:
            try:
                act()
                return
            except (redis.exceptions.ConnectionError, redis.exceptions.TimeoutError):
                if self._stop_requested:
                    return
                time.sleep(WATCH_SECONDS)

    # Stopping

    def request_stop(self, signum: int, frame: FrameType | None) -> None:
        """Stop now: kill the horse, hand its task back. No Redis here: a signal may come amid a reply."""
        self._stop_requested = True
        if not self._running:
            raise StopRequested
        self.kill_horse()

    def setup_work_horse_signals(self) -> None:
        """In the horse: Ctrl-C is the supervisor's affair, and SIGTERM ends it."""
        super().setup_work_horse_signals()  # type: ignore[no-untyped-call]
        signal.signal(signal.SIGALRM, signal.SIG_DFL)


def die_with(parent: int) -> None:
    """Have the kernel kill this process when its parent ends (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it ended before the kernel was told
            os._exit(1)


def settle_blas() -> None:
    """Pin BLAS to one thread, and have it take its work space now: refused that later, it asks for ever."""
    import numpy as np  # noqa: PLC0415  (loaded long before the fork, but not by those who only plan)
    from scipy.linalg import blas  # noqa: PLC0415

    blas_pools().limit(limits=1)
    square = np.eye(128)
    blas.dgemm(1.0, square @ square, square)


def restrain(memory_bytes: int) -> None:
    """Bound what this process may allocate beyond what it has, and offer it first should memory run out.

    An allocation beyond the bound is a `MemoryError`, an answer like any other, where the kernel would kill.
    """
    if sys.platform != "linux":
        return
    with open("/proc/self/status") as status:  # noqa: PTH123  (a proc file, read once)
        held = next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (held + memory_bytes, held + memory_bytes))
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as score:  # noqa: PTH123
        score.write("1000")


def work(workplace: Workplace, *, interactive: bool = False) -> None:
    """Work until told to stop, through any absence of Redis.

    Parameters
    ----------
    workplace : Workplace
    interactive : bool
        Take only tasks estimated below two seconds.
    """

    def stop(signum: int, frame: FrameType | None) -> None:
        raise StopRequested

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    with contextlib.suppress(StopRequested):
        while _worked(workplace, interactive):
            time.sleep(WATCH_SECONDS)


def _worked(workplace: Workplace, interactive: bool) -> bool:
    """Work until told to stop or Redis is lost; False if told to stop."""
    # A fresh name each time: the old one may still be in Redis.
    name = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(2)}"
    worker: SoftmapsWorker | None = None
    try:
        worker = SoftmapsWorker(workplace, name, interactive=interactive)
        worker.work(logging_level="WARNING")
    except redis.exceptions.RedisError as error:
        _log.warning("Redis is away: %s", error)
    return worker is None or not worker.stopping
