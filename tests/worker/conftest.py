"""A store, a dispatcher and real worker processes for whoever tests with them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest
import redis

from service.embedded import EmbeddedRedis
from solver import Mesh
from worker import specs
from worker.questions import parse
from worker.queue import Dispatcher, Job
from worker.settings import Settings
from worker.store import Store
from worker.tasks import Workplace

#: Between two passes, as the API does it.
RECONCILE_SECONDS = 3.0
FINISHED = ("successful", "failed", "dismissed")


def put_mesh(store: Store, mesh: Mesh) -> str:
    """Upload a mesh as the API does; returns its id."""
    id_ = specs.mesh_id(mesh.vertices, mesh.faces)
    store.put(
        id_,
        kind="mesh",
        spec=None,
        parents={},
        values={"n_vertices": mesh.n_vertices, "n_faces": mesh.n_faces, "n_components": mesh.n_components},
        arrays={"vertices": mesh.vertices, "faces": mesh.faces},
        made={},
    )
    return id_


def ask(dispatcher: Dispatcher, **spec: Any) -> Job:
    """Post a spec."""
    return dispatcher.submit(parse(json.dumps(spec)))


def energy(mesh: str, size: int, **fields: Any) -> dict[str, Any]:
    """Spec of the energy of a map from a mesh to itself, parents inline; uniform unless `map` is given."""
    basis = {"kind": "basis", "mesh": mesh, "size": size}
    inner = fields.pop("map", {"type": "uniform"})
    softmap = {"kind": "softmap", "source": basis, "target": basis, "map": inner}
    return {"kind": "energy", "softmap": softmap, **fields}


Found = TypeVar("Found")


def until(look: Callable[[], Found], seconds: float = 30.0) -> Found:
    """What `look` returns as soon as it is true."""
    deadline = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
    return found


def finished(dispatcher: Dispatcher, id_: str, seconds: float = 30.0) -> Job:
    """The job once it is finished."""

    def look() -> Job | None:
        job = dispatcher.job(id_)
        assert job is not None
        return job if job.status in FINISHED else None

    found = until(look, seconds)
    assert found is not None
    return found


def descendants(pid: int) -> list[int]:
    """Processes below one, from /proc."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except (FileNotFoundError, ProcessLookupError):
                continue
            if int(fields[1]) == pid and fields[0] != "Z":
                found += [int(entry.name), *descendants(int(entry.name))]
    return found


class Workers:
    """Real worker processes of one store, started and killed at will."""

    def __init__(self, settings: Settings, log: Path) -> None:
        self._settings = settings
        self.log = log
        self.started: list[subprocess.Popen[bytes]] = []

    def start(self, *options: str) -> subprocess.Popen[bytes]:
        """Start one; returns when it listens."""
        fields = self._settings.model_dump(exclude_none=True, exclude={"token"})
        environment = {f"SOFTMAPS_{name.upper()}": str(value) for name, value in fields.items()}
        with self.log.open("ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "worker", *options],
                env=os.environ | environment,
                stderr=log,
                start_new_session=True,
            )
        self.started.append(process)
        return process

    def horse(self, process: subprocess.Popen[bytes], seconds: float = 30.0) -> int:
        """Process id of a worker's horse, as soon as there is one; it is stopped there and then."""

        def look() -> int:
            found = descendants(process.pid)
            return found[0] if found else 0

        pid = until(look, seconds)
        os.kill(pid, signal.SIGSTOP)
        return pid

    def kill(self, process: subprocess.Popen[bytes]) -> None:
        """Kill -9 a worker and all below it."""
        below = descendants(process.pid)
        for pid in [process.pid, *below]:
            os.kill(pid, signal.SIGKILL)
        process.wait()

    def stop(self) -> None:
        """End all that still run, and see that nothing of them is left."""
        below = {process.pid: descendants(process.pid) for process in self.started}
        for process in self.started:
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self.started:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                raise
        assert not [pid for pids in below.values() for pid in pids if Path(f"/proc/{pid}").exists()]


@pytest.fixture
def settings(tmp_path: Path, redis_server: EmbeddedRedis, connection: redis.Redis) -> Settings:
    return Settings(redis_url=redis_server.url, data=tmp_path, threads=1)


@pytest.fixture
def store(settings: Settings) -> Store:
    return Store(settings.store_folder)


@pytest.fixture
def dispatcher(settings: Settings, store: Store, connection: redis.Redis) -> Dispatcher:
    return Dispatcher(settings, store, connection)


@pytest.fixture
def workers(settings: Settings, tmp_path: Path) -> Iterator[Workers]:
    some = Workers(settings, tmp_path / "workers.log")
    try:
        yield some
    finally:
        some.stop()


@pytest.fixture
def reconciling(dispatcher: Dispatcher) -> Iterator[None]:
    """What the API does all the time, and nothing else."""
    over = threading.Event()

    def loop() -> None:
        while not over.wait(RECONCILE_SECONDS):
            try:
                dispatcher.reconcile()
            except redis.exceptions.RedisError:
                continue

    thread = threading.Thread(target=loop)
    thread.start()
    yield
    over.set()
    thread.join()


@pytest.fixture
def place(settings: Settings, store: Store) -> Iterator[Workplace]:
    """A workplace in this very process, for tests that need no worker."""
    here = Workplace(settings)
    yield here
    here.close()


def run(place: Workplace, job: Job) -> None:
    """Run a job's tasks here and now, parents first."""
    for task in job.tasks:
        place.run(task.id)
