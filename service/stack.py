"""`Stack`: Redis, the API and workers of one machine, watched over by one thread until told to stop."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import httpx
import redis
from pydantic import SecretStr

from service.embedded import EmbeddedRedis
from service.supervisor import Child, Plan, module
from worker.settings import Settings, usable_cores

#: Longest a stack may take to be ready; the first time, kernels are compiled meanwhile.
START_SECONDS = 300.0
#: Deaths of one child after which a stack that never was ready gives up.
HOPELESS_DEATHS = 3
#: Longest that workers, then the API, may take to end before they are killed.
STOP_SECONDS = 10.0
#: Longest that a Redis which the settings name may take to answer.
REDIS_SECONDS = 5.0
#: Seconds between two looks at the children.
LOOK_SECONDS = 0.1


class StackError(Exception):
    """A stack that cannot start, for a reason that its user can do something about."""


class Stack:
    """Redis (unless the settings name one), the API and workers, all on this machine.

    Started by `start` or ``with``; from then until `stop` a thread replaces whatever dies. Nothing outlives
    this process: on Linux the kernel ends the children even after ``kill -9``.

    Parameters
    ----------
    settings : Settings
        Of all parts; its `data` folder holds everything, and one stack at a time may use it.
    port : int
        Where the API listens; 0 for a free port.
    host : str
        Address that it listens on.
    workers : int, optional
        Workers for everything; one per four cores unless given. One more takes short tasks only.
    public : bool
        Whether other commands on this machine may find it, by the file ``{data}/endpoint``.
    report : callable, optional
        Told in words what happens while it starts.

    Attributes
    ----------
    url : str
        Address of the API.
    settings : Settings
        As given.
    workers, threads : int
        Workers for everything, and threads of each.

    Raises
    ------
    StackError
        If the data folder or the port is taken, or a part does not come up.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        port: int = 0,
        host: str = "127.0.0.1",
        workers: int | None = None,
        public: bool = True,
        report: Callable[[str], None] = lambda phase: None,
    ) -> None:
        cores = usable_cores()
        self.workers = workers or max(1, cores // 4)
        self.threads = settings.threads or max(1, cores // self.workers)
        self.settings, self._public, self._report = settings, public, report
        self._endpoint = settings.data / "endpoint"
        self._lock = _locked(settings.data)
        try:
            self._listener = _listener(host, port)
        except BaseException:
            self._lock.close()
            raise
        shown = "127.0.0.1" if host in {"0.0.0.0", "::", "localhost"} else host
        self.url = f"http://{f'[{shown}]' if ':' in shown else shown}:{self._listener.getsockname()[1]}"
        self._children: list[Child] = []
        self._ending, self._settled, self._ended = threading.Event(), threading.Event(), threading.Event()
        self._failure = ""
        # Children are started by one thread that outlives them: the kernel ties them to the thread.
        self._thread = threading.Thread(target=self._run, name="softmaps-stack", daemon=True)

    def start(self) -> None:
        """Start everything; returns when jobs can be done.

        Raises
        ------
        StackError
            If a part does not come up; everything is stopped again.
        """
        self._thread.start()
        _until(self._settled)
        if self._failure:
            self.stop()
            raise StackError(self._failure)

    def stop(self) -> None:
        """End everything: workers first, which hand back what they do, then the API, then Redis."""
        self._ending.set()
        if self._thread.ident is not None:
            # Not join(): interrupted by Ctrl-C, Python 3.11 takes the thread for ended.
            _until(self._ended)
        self._listener.close()
        self._lock.close()

    def watch(self, seconds: float) -> None:
        """Wait so long, or until the stack ends by itself.

        Parameters
        ----------
        seconds : float
            Short for whoever expects signals, see `_until`.

        Raises
        ------
        StackError
            If it ended by itself; says why.
        """
        if self._ended.wait(seconds):
            raise StackError(self._failure or "the stack was stopped")

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    # The thread

    def _run(self) -> None:
        server: EmbeddedRedis | None = None
        try:
            if self.settings.redis_url is None:
                self._report("starting Redis")
                server = EmbeddedRedis(self.settings.redis_folder)
            else:
                _check_redis(self.settings.redis_url)
            environment = self._environment(server.url if server else str(self.settings.redis_url))
            self._watch(server, environment)
        except (RuntimeError, OSError) as error:
            self._failure = str(error)
        except Exception as error:
            self._failure = f"{type(error).__name__}: {error}"
        finally:
            if self._public:
                self._endpoint.unlink(missing_ok=True)
            self._end_children()
            if server is not None:
                server.stop()
            self._settled.set()
            self._ended.set()

    def _watch(self, server: EmbeddedRedis | None, environment: dict[str, str]) -> None:
        logs = self.settings.data / "logs"
        logs.mkdir(parents=True, exist_ok=True)
        self._report("starting the API and a worker")
        fd = self._listener.fileno()
        api = Plan("api", tuple(module("service.server", "--fd", str(fd))), (fd,))
        first, *others = self._worker_plans()
        # One worker alone at first: should kernels have to be compiled, they are compiled once.
        self._children += [Child(plan, environment, logs) for plan in (api, first)]
        began = time.monotonic()
        with httpx.Client(trust_env=False, timeout=5.0) as http:
            while not self._ending.wait(LOOK_SECONDS):
                if server is not None and not server.alive:
                    server.revive()
                for child in self._children:
                    child.look_after()
                if self._settled.is_set():
                    continue
                if self._ready(http):
                    self._children += [Child(plan, environment, logs) for plan in others]
                    self._publish()
                    self._settled.set()
                    continue
                self._give_up_if_hopeless(time.monotonic() - began)

    def _worker_plans(self) -> list[Plan]:
        plain = [Plan(f"worker-{k}", tuple(module("worker"))) for k in range(1, self.workers + 1)]
        return [*plain, Plan("worker-interactive", tuple(module("worker", "--interactive")))]

    def _ready(self, http: httpx.Client) -> bool:
        try:
            return http.get(f"{self.url}/readyz").status_code == httpx.codes.OK
        except httpx.TransportError:
            return False

    def _give_up_if_hopeless(self, seconds: float) -> None:
        for child in self._children:
            if child.deaths >= HOPELESS_DEATHS:
                raise RuntimeError(
                    f"{child.name} does not start; the end of {child.log}:\n{child.last_words()}"
                )
        if seconds > START_SECONDS:
            logs = self.settings.data / "logs"
            raise RuntimeError(f"the stack was not ready after {seconds:.0f} s; its logs are in {logs}")

    def _publish(self) -> None:
        if self._public:
            fresh = self._endpoint.with_suffix(".new")
            fresh.write_text(f"{self.url}\n")
            fresh.replace(self._endpoint)

    def _end_children(self) -> None:
        api, workers = self._children[:1], self._children[1:]
        for group in (workers, api):
            for child in group:
                child.ask_to_end()
            deadline = time.monotonic() + STOP_SECONDS
            for child in group:
                child.end(deadline)

    def _environment(self, redis_url: str) -> dict[str, str]:
        """Environment of the children: these settings, whatever they came from."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith("SOFTMAPS_")}
        settings = self.settings.model_dump(exclude_none=True) | {
            "redis_url": redis_url,
            "threads": self.threads,
        }
        for name, value in settings.items():
            plain = value.get_secret_value() if isinstance(value, SecretStr) else value
            environment[f"SOFTMAPS_{name.upper()}"] = str(plain)
        return environment


def running(data: Path) -> str | None:
    """Address of the stack that uses a data folder, or None.

    Parameters
    ----------
    data : Path
        Folder that a stack was started with.

    Returns
    -------
    str or None
        What its endpoint file says, if a stack really is there.
    """
    try:
        with (data / "lock").open("r") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return (data / "endpoint").read_text().strip() or None
    except OSError:
        pass
    return None


def _until(event: threading.Event) -> None:
    """Wait for an event without missing a signal."""
    # Two signals at once may both be taken by another thread, which does not wake this one to handle them.
    while not event.wait(LOOK_SECONDS):
        pass


def _check_redis(url: str) -> None:
    try:
        with redis.Redis.from_url(
            url, socket_timeout=REDIS_SECONDS, socket_connect_timeout=REDIS_SECONDS
        ) as client:
            client.ping()
    except (redis.exceptions.RedisError, ValueError) as error:
        raise RuntimeError(f"SOFTMAPS_REDIS_URL: {error}") from None


def _locked(data: Path) -> IO[str]:
    try:
        data.mkdir(parents=True, exist_ok=True)
        lock = (data / "lock").open("a")
    except OSError as error:
        raise StackError(f"the data folder {data} cannot be used: {error.strerror}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        where = ""
        with contextlib.suppress(OSError):
            where = f" at {(data / 'endpoint').read_text().strip()}"
        raise StackError(
            f"another softmaps stack{where} is using {data}; stop it, or give another folder with --data"
        ) from None
    return lock


def _listener(host: str, port: int) -> socket.socket:
    """Listening socket; kept here, so that a new API process takes over the port without a gap."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=256)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise StackError(f"cannot listen on {host}:{port}: {reason}; choose another with --port") from None
