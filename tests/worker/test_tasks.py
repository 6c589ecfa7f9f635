"""One task: from its parents to an artifact, or to a failure that says why. Most run in this very process."""

from __future__ import annotations

import logging
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import redis

from service.embedded import EmbeddedRedis
from solver import bijectivity, dirichlet
from tests.solver.shapes import grid, icosphere
from tests.worker.conftest import Workers, ask, energy, finished, put_mesh, run, until
from worker import specs
from worker.attempts import Attempts
from worker.jobs import Job
from worker.queue import Dispatcher
from worker.readers import read_softmap
from worker.settings import Settings
from worker.store import Store
from worker.tasks import Notes, Workplace


@pytest.fixture
def mesh(store: Store) -> str:
    return put_mesh(store, icosphere(2))


def seen(dispatcher: Dispatcher, id_: str) -> Job:
    job = dispatcher.job(id_)
    assert job is not None
    return job


def test_an_energy_is_the_solvers(dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str) -> None:
    targets = list(range(162))
    job = ask(dispatcher, **energy(mesh, 20, map={"type": "points", "targets": targets}, gradient=True))
    run(place, job)
    manifest = store.manifest(job.id)
    assert manifest is not None
    softmap = read_softmap(store, manifest.parents["softmap"])
    expected, returned = dirichlet(softmap, gradient=True), bijectivity(softmap)
    assert manifest.values["dirichlet"] == expected.energy > 0.1
    assert manifest.values["bijectivity"] == returned.energy
    for name, array in (
        ("dirichlet_density", expected.density),
        ("dirichlet_gradient", expected.gradient),
        ("bijectivity_density", returned.density),
        ("bijectivity_gradient", returned.gradient),
    ):
        np.testing.assert_array_equal(store.array(manifest, name), array)
    assert manifest.made["threads"] == 1
    assert manifest.made["versions"]["numpy"] == np.__version__


def test_a_failure_names_index_and_value_and_fails_its_children(
    dispatcher: Dispatcher, place: Workplace, mesh: str
) -> None:
    targets = [0] * 161 + [-1]
    job = ask(dispatcher, **energy(mesh, 20, map={"type": "points", "targets": targets}))
    run(place, job)
    softmap = job.tasks[1].id
    failed = seen(dispatcher, softmap)
    assert failed.status == "failed"
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:invalid-soft-map"
    assert (failed.error["index"], failed.error["value"], failed.error["task"]) == (161, -1.0, softmap)
    child = seen(dispatcher, job.id)
    assert child.error is not None
    assert child.error["detail"] == f"parent {softmap} failed: {failed.error['detail']}"
    assert (child.error["index"], child.error["task"]) == (161, softmap)
    assert [task.status for task in child.tasks] == ["successful", "failed", "failed"]
    assert child.started_at is not None
    assert child.finished_at is not None


def test_a_failed_question_is_run_again_parents_included(
    dispatcher: Dispatcher, connection: redis.Redis, place: Workplace, mesh: str
) -> None:
    spec = energy(mesh, 20, map={"type": "points", "targets": [0] * 161 + [-1]})
    job = ask(dispatcher, **spec)
    run(place, job)
    assert seen(dispatcher, job.id).status == "failed"
    connection.flushall()
    dispatcher.reconcile()
    assert dispatcher.queued() == 0  # a failure stays until somebody asks
    again = ask(dispatcher, **spec)
    assert (again.status, again.error) == ("accepted", None)
    assert dispatcher.queued() == 2
    run(place, again)
    assert seen(dispatcher, job.id).status == "failed"


def test_an_error_of_ours_says_nothing_to_the_outside(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str, caplog: pytest.LogCaptureFixture
) -> None:
    spectrum = specs.Spectrum(mesh=mesh)
    store.put(
        specs.spec_id(spectrum),
        kind="spectrum",
        spec=specs.dump(spectrum),
        parents=specs.parents(spectrum),
        values={},
        arrays={"eigenvalues": np.arange(5.0), "eigenfunctions": np.ones((3, 4))},  # no such shapes
        made={},
    )
    job = ask(dispatcher, kind="descriptor", mesh=mesh, type="hks")
    run(place, job)
    failed = seen(dispatcher, job.id)
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:internal-error"
    assert "shape" not in failed.error["detail"]
    assert "Traceback" in caplog.text


def test_a_mesh_that_is_gone_is_said_so(dispatcher: Dispatcher, store: Store, place: Workplace) -> None:
    mesh = put_mesh(store, icosphere(1))
    job = ask(dispatcher, kind="basis", mesh=mesh, size=5)
    (blob, *_) = (store_folder(place) / "blobs").iterdir()
    for blob in (store_folder(place) / "blobs").iterdir():
        blob.write_bytes(b"damaged")
    run(place, job)  # finds the damage, whereupon the mesh is withdrawn
    run(place, job)
    failed = seen(dispatcher, job.id)
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:gone"
    assert mesh in failed.error["detail"]


def store_folder(place: Workplace) -> Path:
    return place.settings.store_folder


def test_a_damaged_parent_is_made_again(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, **energy(mesh, 20))
    for task in job.tasks[:-1]:
        place.run(task.id)
    softmap = store.manifest(job.tasks[1].id)
    assert softmap is not None
    for blob in softmap.blobs:
        (store_folder(place) / "blobs" / blob).write_bytes(b"damaged")
    place.run(job.id)
    assert not store.has(softmap.id)
    connection.flushall()
    dispatcher.reconcile()
    assert dispatcher.queued() == 2
    run(place, job)
    assert seen(dispatcher, job.id).status == "successful"


@pytest.mark.parametrize("kind", ["energy", "potential"])
def test_shards_make_the_same_bits(
    settings: Settings, tmp_path: Path, connection: redis.Redis, kind: str
) -> None:
    """Two blocks of faces, solved apart and gathered, against one task; only the threshold differs."""
    sphere = icosphere(4)
    found = []
    for threshold in (1e-6, 1e6):
        chosen = settings.model_copy(update={"shard_seconds": threshold, "data": tmp_path / str(threshold)})
        store = Store(chosen.store_folder)
        dispatcher, place = Dispatcher(chosen, store, connection), Workplace(chosen)
        whole = energy(put_mesh(store, sphere), 12, map={"type": "points", "targets": list(range(2562))})
        softmap = whole["softmap"]
        spec = {"kind": kind, "softmap": softmap} | ({"gradient": True} if kind == "energy" else {})
        job = ask(dispatcher, **spec)
        run(place, job)
        place.close()
        manifest = store.manifest(job.id)
        assert manifest is not None
        shards = [task.id for task in job.tasks if task.kind == f"{kind}_block"]
        assert len(shards) == (2 if threshold < 1 else 0)
        # Adopted or dropped: nothing is left of them, and nothing is open.
        assert not any(store.has(shard) or store.job(shard) or store.gone(shard) for shard in shards)
        assert not list(store.open_jobs())
        assert store.usage().blobs == len(set().union(*(m.blobs for m in store.manifests(limit=99))))
        assert {task.status for task in seen(dispatcher, job.id).tasks} == {"successful"}
        found.append((manifest.values, {name: array.sha256 for name, array in manifest.arrays.items()}))
    assert found[0] == found[1]


def test_a_failed_shard_fails_the_whole_for_its_own_reason(
    settings: Settings, store: Store, connection: redis.Redis
) -> None:
    """Two functions at one place are dependent: no face has a solution. Nobody tries the other faces then."""
    eager = settings.model_copy(update={"shard_seconds": 1e-6})
    dispatcher, place = Dispatcher(eager, store, connection), Workplace(eager)
    sphere = icosphere(4)
    mesh = put_mesh(store, sphere)
    basis = specs.PoissonBasis(mesh=mesh, size=2)
    halves = np.full((2562, 2), 0.5)
    put_basis(store, basis, halves)
    softmap = specs.SoftMap(source=specs.spec_id(basis), target=specs.spec_id(basis), map=specs.Uniform())
    store.put(
        specs.spec_id(softmap),
        kind="softmap",
        spec=specs.dump(softmap),
        parents=specs.parents(softmap),
        values={},
        arrays={"coefficients": np.full((2, 2), 0.5)},
        made={},
    )
    job = ask(dispatcher, kind="energy", softmap=specs.spec_id(softmap))
    run(place, job)
    place.close()
    failed = seen(dispatcher, job.id)
    assert failed.error is not None
    assert failed.error["type"] != "urn:softmaps:parent-failed"
    shards = [task for task in failed.tasks if task.kind == "energy_block"]
    assert failed.error["task"] == shards[0].id
    assert [shard.status for shard in shards] == ["failed", "dismissed"]
    assert not list(store.open_jobs())


def put_basis(store: Store, spec: specs.Basis, functions: np.ndarray) -> None:
    """A basis of the given functions, as if a task had made it."""
    n_vertices, size = functions.shape
    store.put(
        specs.spec_id(spec),
        kind="basis",
        spec=specs.dump(spec),
        parents=specs.parents(spec),
        values={"n_functions": size},
        arrays={
            "functions_data": functions.ravel(),
            "functions_indices": np.tile(np.arange(size), n_vertices),
            "functions_indptr": np.arange(n_vertices + 1) * size,
            "samples": np.arange(size),
            "cells": np.zeros(n_vertices, dtype=np.int64),
        },
        made={},
    )


def test_one_line_a_task(
    dispatcher: Dispatcher, place: Workplace, mesh: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "softmaps.worker")
    job = ask(dispatcher, **energy(mesh, 20))
    run(place, job)
    lines = [record.getMessage() for record in caplog.records if record.name == "softmaps.worker"]
    assert [line.partition(":")[0] for line in lines] == [task.id for task in job.tasks]
    assert "energy, 320 faces, 20 functions, " in lines[-1]
    assert " s, residual " in lines[-1]


def test_notes_are_few_and_say_what_happens(
    connection: redis.Redis, dispatcher: Dispatcher, mesh: str
) -> None:
    job = ask(dispatcher, **energy(mesh, 20))
    attempts = Attempts(connection, dispatcher._store.identity, specs.versions_digest())
    notes = Notes(connection, attempts, job.tasks[0].id)
    sets = "cmdstat_set"
    before = connection.info("commandstats")[sets]["calls"]
    notes.step("reading", 0.0, 0.0)
    report = notes.step("geodesic samples", 0.0, 0.5)
    for k in range(1000):
        report(k / 1000)
        notes.step("geodesic samples", 0.0, 0.5)
    assert connection.info("commandstats")[sets]["calls"] == before + 2
    assert "geodesic samples" in connection.get(attempts.key("progress", job.tasks[0].id)).decode()
    assert connection.ttl(attempts.key("progress", job.tasks[0].id)) > 0


def test_a_run_does_without_redis(settings: Settings, store: Store, tmp_path: Path) -> None:
    """Redis may go away in the midst of a task: it is only told less."""
    with EmbeddedRedis(tmp_path / "redis") as server:
        here = settings.model_copy(update={"redis_url": server.url})
        place = Workplace(here)
        job = ask(
            Dispatcher(here, store, place.connection),
            kind="basis",
            mesh=put_mesh(store, icosphere(1)),
            size=5,
        )
    place.run(job.id)
    place.close()
    assert store.has(job.id)


def test_a_full_disk_is_tried_again_and_then_recorded(
    dispatcher: Dispatcher, settings: Settings, store: Store
) -> None:
    """A limit on file sizes makes writing fail as a full disk does."""
    mesh = put_mesh(store, icosphere(3))
    job = ask(dispatcher, kind="basis", mesh=mesh, size=200)
    code = f"""
import resource
from worker.settings import Settings
from worker.tasks import Workplace
place = Workplace(Settings(redis_url={settings.redis_url!r}, data={str(settings.data)!r}))
place.prepare()
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
for _ in range(2):
    try:
        place.run({job.id!r})
    except OSError as error:
        print(error.strerror)
place.run({job.id!r})
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines() == ["File too large"] * 2
    failed = seen(dispatcher, job.id)
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:machine-fault"
    assert str(settings.data) not in str(failed.error)
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY


def test_a_worker_does_all_this_in_a_process_of_its_own(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, workers: Workers, tmp_path: Path
) -> None:
    """A real worker: an energy, a refused job, and callbacks that are never called."""
    mesh = put_mesh(store, grid())
    workers.start()
    quick = workers.start("--interactive")
    witness = tmp_path / "witness"
    queue = dispatcher._attempts.queues["batch"]
    forbidden = queue.enqueue_call(
        "os.system", args=(f"touch {witness}",), job_id="forbidden", result_ttl=60, failure_ttl=60
    )
    job = ask(dispatcher, **energy(mesh, 20))
    called = queue.enqueue_call("worker.tasks.run_task", args=("basis-0",), job_id="called", result_ttl=60)
    connection.hset(
        called.key, mapping={"success_callback_name": "os.mkdir", "failure_callback_name": "os.mkdir"}
    )
    assert finished(dispatcher, job.id).status == "successful"
    until(lambda: forbidden.get_status() == "failed" and called.get_status() in ("finished", "failed"))
    assert not witness.exists()
    assert called.get_status() == "finished"
    assert "is no task" in (forbidden.latest_result().exc_string or "")
    assert dispatcher.workers() == 2
    assert dispatcher.metrics()["workers_interactive"] == 1
    quick.terminate()
    assert quick.wait(10) == 0
    until(lambda: dispatcher.workers() == 1)


def test_what_needs_too_much_memory_fails_and_the_worker_goes_on(
    settings: Settings, store: Store, connection: redis.Redis, tmp_path: Path
) -> None:
    """The limit is the horse's: the estimate let it pass since this dispatcher allows more."""
    mesh = put_mesh(store, icosphere(4))
    workers = Workers(settings.model_copy(update={"task_memory_bytes": 30_000_000}), tmp_path / "log")
    workers.start()
    try:
        dispatcher = Dispatcher(settings, store, connection)
        large = ask(dispatcher, kind="spectrum", mesh=mesh, eigenpairs=1300)
        failed = finished(dispatcher, large.id)
        assert failed.error is not None
        assert failed.error["type"] == "urn:softmaps:out-of-memory"
        small = ask(dispatcher, kind="basis", mesh=put_mesh(store, icosphere(1)), size=5)
        assert finished(dispatcher, small.id).status == "successful"
    finally:
        workers.stop()
