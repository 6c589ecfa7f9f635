"""Questions in, jobs out: what is planned, joined, refused, dropped and listed. No worker runs here."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import pytest
import redis

from tests.solver.shapes import icosphere
from tests.worker.conftest import ask, energy, put_mesh, run
from worker import specs
from worker.attempts import TaskJob
from worker.fields import SpecError
from worker.queue import Busy, Dispatcher, FinishedJob, TooCostly, UnknownJob
from worker.settings import Settings
from worker.store import JobRecord, Store, now
from worker.tasks import Workplace


@pytest.fixture
def mesh(store: Store) -> str:
    return put_mesh(store, icosphere(2))


def attempts_of(connection: redis.Redis, kind: str = "") -> list[TaskJob]:
    """All attempts that RQ knows."""
    names = [key.decode().removeprefix("rq:job:") for key in connection.keys(f"rq:job:{kind}*")]
    found = TaskJob.fetch_many([name for name in names if ":" not in name], connection, serializer="json")
    return [job for job in found if job is not None]


def test_parents_come_first_and_only_the_root_was_asked_for(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, mesh: str
) -> None:
    job = ask(dispatcher, **energy(mesh, 20))
    assert [task.kind for task in job.tasks] == ["basis", "softmap", "energy"]
    assert (job.status, job.progress, job.asked) == ("accepted", 0.0, True)
    assert [store.job(task.id).asked for task in job.tasks] == [False, False, True]  # type: ignore[union-attr]
    states = {job.args[0]: job.get_status().value for job in attempts_of(connection)}
    assert [states[task.id] for task in job.tasks] == ["queued", "deferred", "deferred"]


def test_the_same_question_from_many_sides_is_computed_once(
    dispatcher: Dispatcher, settings: Settings, store: Store, connection: redis.Redis, mesh: str
) -> None:
    together = threading.Barrier(8)

    def client(_: int) -> str:
        own = Dispatcher(settings, store, connection)
        together.wait()
        return ask(own, **energy(mesh, 20)).id

    with ThreadPoolExecutor(8) as pool:
        ids = set(pool.map(client, range(8)))
    assert len(ids) == 1
    assert sorted(job.args[0].partition("-")[0] for job in attempts_of(connection)) == [
        "basis",
        "energy",
        "softmap",
    ]


def test_a_finished_question_is_answered_at_once(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, place: Workplace, mesh: str
) -> None:
    first = ask(dispatcher, **energy(mesh, 20))
    run(place, first)
    connection.flushall()
    again = ask(dispatcher, **energy(mesh, 20))
    assert (again.status, again.progress, again.phase) == ("successful", 100.0, "done")
    assert first.created_at == again.created_at <= again.started_at <= again.finished_at  # type: ignore[operator]
    assert not attempts_of(connection)


def test_only_what_is_missing_is_planned(dispatcher: Dispatcher, place: Workplace, mesh: str) -> None:
    run(place, ask(dispatcher, kind="basis", mesh=mesh, size=20))
    assert [task.kind for task in ask(dispatcher, **energy(mesh, 20)).tasks] == ["softmap", "energy"]


def test_a_parent_becomes_a_job_when_it_is_asked_for(dispatcher: Dispatcher, mesh: str) -> None:
    whole = ask(dispatcher, **energy(mesh, 20))
    assert [job.id for job in dispatcher.jobs()[0]] == [whole.id]
    part = ask(dispatcher, kind="basis", mesh=mesh, size=20)
    assert part.id == whole.tasks[0].id
    assert {job.id for job in dispatcher.jobs()[0]} == {whole.id, part.id}


def test_a_flaw_is_named_by_its_place_in_the_body(dispatcher: Dispatcher, store: Store, mesh: str) -> None:
    with pytest.raises(SpecError) as refusal:
        ask(dispatcher, **energy(mesh, 163))
    assert [place for place, _ in refusal.value.errors] == ["/softmap/source/size"]
    assert not list(store.jobs())


def test_what_would_take_too_long_or_too_much_is_refused(
    settings: Settings, store: Store, connection: redis.Redis, mesh: str
) -> None:
    for limits in ({"max_cost_seconds": 0.01}, {"task_memory_bytes": 1000}):
        strict = Dispatcher(settings.model_copy(update=limits), store, connection)
        with pytest.raises(TooCostly):
            ask(strict, **energy(mesh, 20))
    assert not list(store.jobs())


def test_too_many_waiting_tasks_make_it_busy(
    settings: Settings, store: Store, connection: redis.Redis, mesh: str
) -> None:
    small = Dispatcher(settings.model_copy(update={"max_queued": 4}), store, connection)
    first = ask(small, **energy(mesh, 20))
    with pytest.raises(Busy):
        ask(small, **energy(mesh, 21))
    assert ask(small, **energy(mesh, 20)) == first  # asking for what is under way adds nothing
    assert small.queued() == 3


def test_inline_lists_become_arrays(dispatcher: Dispatcher, store: Store, mesh: str) -> None:
    ask(dispatcher, **energy(mesh, 20, map={"type": "points", "targets": list(range(162))}))
    (manifest,) = store.manifests("array")
    assert manifest.arrays["array"].dtype == "int64"


def test_dismissing_drops_what_only_it_needed(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, mesh: str
) -> None:
    plain, steep = ask(dispatcher, **energy(mesh, 20)), ask(dispatcher, **energy(mesh, 20, gradient=True))
    dismissal = dispatcher.dismiss(plain.id)
    assert (dismissal.job.status, dismissal.remains) == ("dismissed", False)
    # The other energy still needs both parents.
    assert [task.status for task in dismissal.job.tasks] == ["accepted", "accepted", "dismissed"]
    assert {job.args[0] for job in attempts_of(connection)} == {task.id for task in steep.tasks}
    dispatcher.dismiss(steep.id)
    assert not attempts_of(connection)
    assert not list(store.open_jobs())
    assert dispatcher.queued() == 0
    assert dispatcher.dismiss(steep.id).job.status == "dismissed"  # again is the same


def test_dismissing_spares_a_parent_that_was_asked_for(dispatcher: Dispatcher, mesh: str) -> None:
    basis = ask(dispatcher, kind="basis", mesh=mesh, size=20)
    whole = ask(dispatcher, **energy(mesh, 20))
    tasks = dispatcher.dismiss(whole.id).job.tasks
    assert [task.status for task in tasks] == ["accepted", "dismissed", "dismissed"]
    assert dispatcher.job(basis.id).status == "accepted"  # type: ignore[union-attr]


def test_what_a_live_job_needs_goes_on(dispatcher: Dispatcher, mesh: str) -> None:
    whole = ask(dispatcher, **energy(mesh, 20))
    basis = ask(dispatcher, kind="basis", mesh=mesh, size=20)
    dismissal = dispatcher.dismiss(basis.id)
    assert (dismissal.job.status, dismissal.job.asked, dismissal.remains) == ("accepted", False, True)
    dispatcher.dismiss(whole.id)
    assert dispatcher.job(basis.id).status == "dismissed"  # type: ignore[union-attr]


def test_a_dismissed_task_is_not_run(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, kind="basis", mesh=mesh, size=20)
    dispatcher.dismiss(job.id)
    place.run(job.id)
    assert not store.has(job.id)


def test_a_dismissed_question_may_be_asked_again(
    dispatcher: Dispatcher, connection: redis.Redis, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, **energy(mesh, 20))
    dispatcher.dismiss(job.id)
    again = ask(dispatcher, **energy(mesh, 20))
    assert (again.id, again.status, again.created_at) == (job.id, "accepted", job.created_at)
    assert len(attempts_of(connection)) == 3
    run(place, again)
    assert dispatcher.job(job.id).status == "successful"  # type: ignore[union-attr]


def test_what_cannot_be_dismissed(dispatcher: Dispatcher, place: Workplace, mesh: str) -> None:
    with pytest.raises(UnknownJob):
        dispatcher.dismiss(f"energy-{0:032x}")
    with pytest.raises(UnknownJob):
        dispatcher.dismiss(mesh)
    job = ask(dispatcher, kind="basis", mesh=mesh, size=20)
    run(place, job)
    with pytest.raises(FinishedJob) as refusal:
        dispatcher.dismiss(job.id)
    assert refusal.value.job.status == "successful"


def test_jobs_are_listed_in_pages(dispatcher: Dispatcher, place: Workplace, mesh: str) -> None:
    ids = [ask(dispatcher, kind="basis", mesh=mesh, size=size).id for size in range(20, 25)]
    place.run(ids[1])
    place.run(ids[3])
    dispatcher.dismiss(ids[4])
    pages, cursor = [], None
    while True:
        jobs, cursor = dispatcher.jobs(limit=2, cursor=cursor)
        pages.append([job.id for job in jobs])
        if cursor is None:
            break
    assert pages == [[ids[4], ids[3]], [ids[2], ids[1]], [ids[0]]]
    for status, expected in (
        ("accepted", [ids[2], ids[0]]),
        ("successful", [ids[3], ids[1]]),
        ("dismissed", [ids[4]]),
        ("failed", []),
    ):
        first, cursor = dispatcher.jobs(status=status, limit=1)  # type: ignore[arg-type]
        rest, over = dispatcher.jobs(status=status, cursor=cursor) if cursor else ([], None)  # type: ignore[arg-type]
        assert [job.id for job in first + rest] == expected
        assert over is None


def test_an_artifact_without_a_record_is_a_finished_job(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, kind="basis", mesh=mesh, size=20)
    run(place, job)
    store.delete_job(job.id)
    found = dispatcher.job(job.id)
    assert found is not None
    assert (found.status, found.asked) == ("successful", False)
    assert dispatcher.job(mesh) is None
    assert dispatcher.job(f"basis-{0:032x}") is None


def test_an_evicted_answer_is_not_made_again_until_somebody_asks(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, kind="basis", mesh=mesh, size=20)
    run(place, job)
    connection.flushall()
    assert store.evict(0) == (job.id,)
    assert dispatcher.job(job.id).status == "successful"  # type: ignore[union-attr]
    dispatcher.reconcile()
    assert not attempts_of(connection)
    assert ask(dispatcher, kind="basis", mesh=mesh, size=20).status == "accepted"
    run(place, job)
    assert store.has(job.id)


def test_an_evicted_parent_of_an_open_job_is_made_again(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, place: Workplace, mesh: str
) -> None:
    run(place, ask(dispatcher, kind="basis", mesh=mesh, size=20))
    job = ask(dispatcher, **energy(mesh, 20))
    (evicted,) = store.evict(0)
    connection.flushall()
    dispatcher.reconcile()
    for id_ in (evicted, *(task.id for task in job.tasks)):
        place.run(id_)
    assert dispatcher.job(job.id).status == "successful"  # type: ignore[union-attr]


def test_a_full_store_forgets_what_no_open_job_reads(
    settings: Settings, store: Store, connection: redis.Redis, place: Workplace, mesh: str
) -> None:
    tight = Dispatcher(settings.model_copy(update={"store_max_bytes": 0}), store, connection)
    for size in (20, 21):
        run(place, ask(tight, kind="basis", mesh=mesh, size=size))
    needed = ask(tight, **energy(mesh, 20))
    tight.reconcile()
    assert [(one.kind, one.spec["size"]) for one in store.manifests("basis") if one.spec] == [("basis", 20)]
    assert store.has(mesh)
    run(place, needed)
    assert store.has(needed.id)


def test_reconciling_brings_a_wiped_redis_back(
    dispatcher: Dispatcher, connection: redis.Redis, mesh: str
) -> None:
    jobs = [ask(dispatcher, **energy(mesh, size)) for size in (20, 21)]
    connection.flushall()
    assert dispatcher.queued() == 0
    dispatcher.reconcile()
    dispatcher.reconcile()
    expected = sorted(task.id for job in jobs for task in job.tasks)
    assert sorted(job.args[0] for job in attempts_of(connection)) == expected


def test_reconciling_replaces_an_attempt_that_was_lost_on_the_way(
    dispatcher: Dispatcher, connection: redis.Redis, mesh: str
) -> None:
    """A worker that dies between taking an attempt and beginning it leaves it nowhere."""
    job = ask(dispatcher, **energy(mesh, 20))
    (queue,) = (key for key in connection.keys("rq:queue:*") if connection.type(key) == b"list")
    lost = connection.lpop(queue).decode()
    dispatcher.reconcile()
    assert dispatcher.queued() == 2  # it may only just have been taken
    deadline = time.monotonic() + 10
    while dispatcher.queued() != 3:
        assert time.monotonic() < deadline
        time.sleep(0.5)
        dispatcher.reconcile()
    names = {attempt.args[0]: attempt.id for attempt in attempts_of(connection)}
    assert set(names) == {task.id for task in job.tasks}
    assert names[job.tasks[0].id] != lost


def test_reconciling_runs_what_only_the_store_remembers(
    dispatcher: Dispatcher, store: Store, connection: redis.Redis, mesh: str
) -> None:
    """An API that dies between recording and planning leaves records alone."""
    spec = specs.PoissonBasis(mesh=mesh, size=20)
    store.write_job(JobRecord(specs.spec_id(spec), specs.dump(spec), asked=True, created_at=now()))
    for _ in range(2):
        dispatcher.reconcile()
    assert [job.args[0] for job in attempts_of(connection)] == [specs.spec_id(spec)]


def test_a_question_of_another_version_fails_clearly(dispatcher: Dispatcher, store: Store, mesh: str) -> None:
    old = f"basis-{0:032x}"
    store.write_job(JobRecord(old, specs.dump(specs.PoissonBasis(mesh=mesh)), asked=True, created_at=now()))
    dispatcher.reconcile()
    job = dispatcher.job(old)
    assert job is not None
    assert (job.status, job.error["type"]) == ("failed", "urn:softmaps:outdated")  # type: ignore[index]


def test_two_stores_on_one_redis_do_not_meet(
    dispatcher: Dispatcher, settings: Settings, connection: redis.Redis, tmp_path: Any, mesh: str
) -> None:
    ask(dispatcher, kind="basis", mesh=mesh, size=20)
    other = Dispatcher(settings, Store(tmp_path / "other"), connection)
    assert (dispatcher.queued(), other.queued()) == (1, 0)
    assert other.jobs() == ([], None)


def test_progress_counts_estimated_seconds(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, **energy(mesh, 20))
    record = store.job(job.id)
    assert record is not None
    store.update_job(
        job.id,
        lambda found: replace(
            found,
            tasks=tuple(replace(t, seconds=s) for t, s in zip(found.tasks, (1.0, 3.0, 4.0), strict=True)),
        ),
    )
    seen = []
    for task in job.tasks:
        place.run(task.id)
        found = dispatcher.job(job.id)
        assert found is not None
        seen.append((found.status, found.progress))
    assert seen == [("running", 12.5), ("running", 50.0), ("successful", 100.0)]


def test_metrics_are_numbers(dispatcher: Dispatcher, mesh: str) -> None:
    ask(dispatcher, **energy(mesh, 20))
    metrics = dispatcher.metrics()
    assert metrics["jobs_open"] == 3
    assert (metrics["jobs_accepted"], metrics["jobs_running"]) == (1, 0)  # what was asked for
    assert metrics["tasks_queued_interactive"] == 1
    assert metrics["tasks_deferred"] == 2
    assert metrics["workers"] == dispatcher.workers() == 0


def test_shards_never_stand_in_the_queue_of_short_tasks(
    settings: Settings, store: Store, connection: redis.Redis
) -> None:
    eager = settings.model_copy(update={"shard_seconds": 1e-6})
    job = ask(Dispatcher(eager, store, connection), **energy(put_mesh(store, icosphere(4)), 20))
    origins = {attempt.args[0]: attempt.origin for attempt in attempts_of(connection)}
    shards = [task.id for task in job.tasks if task.kind == "energy_block"]
    short = [task.id for task in job.tasks if task.kind in {"basis", "softmap"}]
    assert len(shards) == 2 and short
    assert all("batch" in origins[shard] for shard in shards)
    assert all("interactive" in origins[id_] for id_ in short)
