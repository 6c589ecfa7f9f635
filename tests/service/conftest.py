"""A real service: uvicorn on a free port, a store, a Redis of its own, and a worker where one is needed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx
import pytest
import redis
import uvicorn
from fastapi import FastAPI
from hypothesis import HealthCheck
from hypothesis import settings as hypothesis_settings

from service.app import create_app
from service.embedded import EmbeddedRedis
from service.rooms import Rooms
from tests.service.files import FACES, TETRAHEDRON, off
from worker.settings import Settings

Found = TypeVar("Found")


def until(look: Callable[[], Found], seconds: float = 20.0) -> Found:
    """What `look` returns as soon as it is true."""
    deadline = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)
    return found


def children(pid: int) -> set[int]:
    """Descendants of a process."""
    found: set[int] = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if parent == pid:
            found |= {int(entry.name)} | children(int(entry.name))
    return found


#: For hypotheses that ask the one service again and again.
HTTP = hypothesis_settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def energy(mesh: str, size: int = 8, **fields: Any) -> dict[str, Any]:
    """A whole question: the energies of the uniform map of a mesh to itself, or of another map."""
    basis = {"kind": "basis", "mesh": mesh, "size": size}
    inner = fields.pop("map", {"type": "uniform"})
    return {
        "kind": "energy",
        "softmap": {"kind": "softmap", "source": basis, "target": basis, "map": inner},
        **fields,
    }


def is_problem(answer: httpx.Response, status: int, part: str = "") -> bool:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document = answer.json()
    assert document["status"] == status
    assert {"type", "title", "detail", "errors"} <= document.keys()
    assert part in answer.text
    return True


@dataclass(frozen=True)
class Service:
    """A running service and what is behind it."""

    url: str
    app: FastAPI
    settings: Settings

    @property
    def rooms(self) -> Rooms:
        rooms: Rooms = self.app.state.rooms
        return rooms

    def client(self, **options: Any) -> httpx.Client:
        return httpx.Client(base_url=self.url, timeout=30, **options)


@contextmanager
def serving(settings: Settings) -> Iterator[Service]:
    """Run the app of some settings in a thread, on a free port."""
    app = create_app(settings)
    config = uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1, lifespan="on")
    server = uvicorn.Server(config)
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        until(lambda: server.started or not thread.is_alive())
        yield Service(f"http://127.0.0.1:{listener.getsockname()[1]}", app, settings)
    finally:
        server.should_exit = True
        thread.join(20)
        listener.close()
        assert not thread.is_alive(), "the service does not end"


@pytest.fixture(scope="session")
def own_redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    """A Redis that no other test empties."""
    with EmbeddedRedis(tmp_path_factory.mktemp("redis-of-the-service")) as server:
        yield server


@pytest.fixture(scope="session")
def service(own_redis: EmbeddedRedis, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    settings = Settings(data=tmp_path_factory.mktemp("data"), redis_url=own_redis.url, threads=1)
    with serving(settings) as running:
        yield running


@pytest.fixture(scope="session")
def idle(own_redis: EmbeddedRedis, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service whose jobs wait for ever: it has no worker."""
    settings = Settings(data=tmp_path_factory.mktemp("idle"), redis_url=own_redis.url)
    with serving(settings) as running:
        yield running


@pytest.fixture(scope="session")
def tight(own_redis: EmbeddedRedis, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service with little room for anything, and no worker."""
    settings = Settings(
        data=tmp_path_factory.mktemp("tight"),
        redis_url=own_redis.url,
        max_upload_bytes=60_000,
        max_json_bytes=600,
        max_array_bytes=100,
        max_queued=4,
        max_cost_seconds=0.25,
    )
    with serving(settings) as running:
        yield running


@pytest.fixture
def http(service: Service) -> Iterator[httpx.Client]:
    with service.client() as client:
        yield client


@pytest.fixture(scope="session")
def worker(service: Service, tmp_path_factory: pytest.TempPathFactory) -> Iterator[subprocess.Popen[bytes]]:
    """A worker process of the service."""
    log = tmp_path_factory.mktemp("worker") / "log"
    environment = {"SOFTMAPS_DATA": str(service.settings.data), "SOFTMAPS_THREADS": "1"}
    environment["SOFTMAPS_REDIS_URL"] = str(service.settings.redis_url)
    with log.open("wb") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "worker"], env=os.environ | environment, stderr=out, start_new_session=True
        )
    try:
        until(lambda: service.rooms.dispatcher.workers() or process.poll() is not None, 60)
        assert process.poll() is None, log.read_text()
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def lonely(connection: redis.Redis, redis_server: EmbeddedRedis, tmp_path: Path) -> Settings:
    """Settings of a service of one's own, without workers, on a Redis that is empty."""
    return Settings(data=tmp_path / "data", redis_url=redis_server.url, threads=1)


def sphere(levels: int = 2) -> str:
    """An OFF file of an octahedron, its faces split `levels` times and pushed onto the unit sphere."""
    import numpy as np

    vertices = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(levels):
        edges, corner = np.unique(
            np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2), axis=0, return_inverse=True
        )
        a, b, c = (len(vertices) + corner.reshape(-1, 3)).T
        middles = vertices[edges].mean(axis=1)
        vertices = np.concatenate([vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
        x, y, z = faces.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((x, a, c), (a, y, b), (c, b, z), (a, b, c))])
    return off(vertices, faces)


@pytest.fixture(scope="session")
def tetrahedron(service: Service) -> str:
    """Id of an uploaded tetrahedron."""
    with service.client() as http:
        answer = http.post("/v1/meshes?format=off", content=off(TETRAHEDRON, FACES))
    assert answer.status_code in {200, 201}, answer.text
    return str(answer.json()["id"])


@pytest.fixture(scope="session")
def ball(service: Service) -> str:
    """Id of an uploaded sphere of 66 vertices and 128 faces."""
    with service.client() as http:
        answer = http.post("/v1/meshes?format=off&name=ball", content=sphere(2))
    assert answer.status_code in {200, 201}, answer.text
    return str(answer.json()["id"])
