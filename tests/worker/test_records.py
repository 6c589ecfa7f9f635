import multiprocessing
import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from worker.records import JobRecord, TaskRecord, UnknownJob, cursor, now
from worker.store import Store

spawn = multiprocessing.get_context("spawn")


def id_(number=0):
    return f"energy-{number:032x}"


def record(number=0, **fields):
    return replace(JobRecord(id_(number), {"kind": "energy"}, asked=True, created_at=now()), **fields)


def answer(store, number=0):
    store.put(id_(number), kind="energy", spec={}, parents={}, values={}, arrays={"a": np.ones(1)}, made={})


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def store(folder):
    return Store(folder)


def open_ids(store):
    return {job.id for job in store.open_jobs()}


def test_a_record_comes_back_as_it_was_written(store, folder):
    tasks = (TaskRecord("basis-" + "0" * 32, "basis", 0.5, 10**9), TaskRecord(id_(), "energy", 12.25, 3))
    written = record(tasks=tasks, outcome="failed", problem={"title": "no ρ", "index": 3}, finished_at=now())
    assert store.write_job(written) == written
    assert Store(folder).job(id_()) == written


def test_the_first_record_of_a_name_stands(store):
    first = store.write_job(record())
    assert store.write_job(record(asked=False)) == first
    assert store.job(id_()) == first


def test_what_is_no_id_has_no_record(store):
    with pytest.raises(ValueError, match="no id"):
        store.write_job(record(id="../energy"))
    with pytest.raises(UnknownJob):
        store.update_job(id_(), lambda job: job)
    with pytest.raises(UnknownJob):
        store.update_job("..", lambda job: job)
    assert store.job(id_()) is None


def test_a_change_is_kept_and_no_change_writes_nothing(store, folder):
    store.write_job(record())
    changed = store.update_job(id_(), lambda job: replace(job, outcome="dismissed"))
    assert changed.outcome == "dismissed"
    before = sorted((folder / "jobs").rglob("*.*"))
    assert store.update_job(id_(), lambda job: job) == changed
    assert sorted((folder / "jobs").rglob("*.*")) == before
    assert store.job(id_()) == changed


@pytest.mark.parametrize("fields", [{"id": id_(1)}, {"created_at": "2020-01-01T00:00:00+00:00"}])
def test_a_name_and_a_birthday_never_change(store, fields):
    store.write_job(record())
    with pytest.raises(ValueError, match="never change"):
        store.update_job(id_(), lambda job: replace(job, **fields))


def count_up(folder, times):
    store = Store(folder)
    for _ in range(times):
        store.update_job(id_(), lambda job: replace(job, problem={"count": job.problem["count"] + 1}))


def test_no_update_of_several_processes_is_lost(store, folder):
    store.write_job(record(problem={"count": 0}))
    children = [spawn.Process(target=count_up, args=(folder, 20)) for _ in range(3)]
    for child in children:
        child.start()
    for child in children:
        child.join()
        assert child.exitcode == 0
    assert store.job(id_()).problem == {"count": 60}


def test_a_writer_that_is_killed_never_spoils_a_record(store, folder):
    store.write_job(record(problem={"count": 0}))
    for _ in range(2):
        child = spawn.Process(target=count_up, args=(folder, 10**9))
        before = store.job(id_()).problem["count"]
        child.start()
        while store.job(id_()).problem["count"] < before + 5:
            time.sleep(0.001)
        child.kill()
        child.join()
    assert store.job(id_()).problem["count"] >= 10


def revisions(folder):
    return sorted(path.name for path in (folder / "jobs").rglob("*.*"))


def test_old_revisions_go_and_young_ones_stay(store, folder):
    store.write_job(record(problem={"count": 0}))
    count_up(folder, 20)
    assert len(revisions(folder)) == 21
    for path in (folder / "jobs").rglob("*.*"):
        os.utime(path, (time.time() - 4_000,) * 2)
    count_up(folder, 10)
    assert len(revisions(folder)) < 15
    assert store.job(id_()).problem == {"count": 30}


@pytest.mark.parametrize("position", [0, 64, 70, -1])
def test_a_damaged_revision_is_passed_over(store, folder, position):
    store.write_job(record(problem={"count": 0}))
    count_up(folder, 1)
    path = next((folder / "jobs").rglob("*.00000001"))
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)
    assert store.job(id_()).problem == {"count": 0}
    count_up(folder, 1)
    assert store.job(id_()).problem == {"count": 1}


def test_a_record_whose_every_revision_is_damaged_can_be_written_again(store, folder):
    store.write_job(record())
    for path in (folder / "jobs").rglob("*.*"):
        path.write_bytes(b"")
    assert store.job(id_()) is None
    again = record(1, id=id_())
    assert store.write_job(again) == again
    assert store.job(id_()) == again


# Listings


def test_jobs_are_listed_newest_first_in_pages(store):
    written = [store.write_job(record(number)) for number in (3, 1, 2, 0)]
    for _ in range(3):
        time.sleep(0.002)
        written.append(store.write_job(record(len(written) + 10)))
    listed = list(store.jobs())
    assert {job.id for job in listed} == {job.id for job in written}
    assert [job.created_at for job in listed[:3]] == [job.created_at for job in written[:3:-1]]
    assert [cursor(job) for job in listed] == sorted(cursor(job) for job in listed)
    page = next(store.jobs(after=cursor(listed[2])))
    assert page == listed[3]
    assert list(store.jobs(after=cursor(listed[-1]))) == []


def test_a_job_that_two_created_at_once_is_listed_once(store):
    first = record()
    second = replace(first, created_at=f"2020{first.created_at[4:]}")
    store.write_job(first)
    store.write_job(second)
    assert list(store.jobs()) == [first]


def test_thousands_of_jobs_are_listed_quickly(store, folder):
    for number in range(50):
        store.write_job(record(number, outcome="dismissed"))
    for number in range(50, 5_000):  # what is listed is names; most need no record to be in the way
        (folder / "recent" / cursor(record(number))).touch()
    begun = time.perf_counter()
    oldest = list(store.jobs(after=cursor(next(store.jobs()))))[-1]
    seconds = time.perf_counter() - begun
    assert oldest.id == id_(0)
    assert seconds < 5
    begun = time.perf_counter()
    assert open_ids(store) == set()
    assert time.perf_counter() - begun < 2


def test_open_jobs_are_those_without_outcome_and_artifact(store, folder):
    for number in range(4):
        store.write_job(record(number))
    assert open_ids(store) == {id_(number) for number in range(4)}
    store.update_job(id_(1), lambda job: replace(job, outcome="failed"))
    answer(store, 2)
    assert open_ids(store) == {id_(0), id_(3)}
    assert open_ids(Store(folder)) == {id_(0), id_(3)}


def test_a_failed_job_that_is_asked_again_is_open_again(store):
    store.write_job(record())
    store.update_job(id_(), lambda job: replace(job, outcome="failed"))
    assert open_ids(store) == set()
    store.update_job(id_(), lambda job: replace(job, outcome=None))
    assert open_ids(store) == {id_()}


def test_a_job_whose_artifact_was_forgotten_is_open_when_it_is_asked_again(store):
    store.write_job(record())
    answer(store)
    store.evict(0)
    assert open_ids(store) == set()
    assert store.sweep(0).jobs == 0
    store.reopen_job(id_())
    assert open_ids(store) == {id_()}
    assert store.gone(id_()) is None


def test_an_open_job_is_listed_whatever_races(store):
    """A reconciler deletes the marker of a finished job while somebody asks for it again."""
    store.write_job(record())
    stop = threading.Event()

    def reconcile():
        while not stop.is_set():
            list(store.open_jobs())

    reconciler = threading.Thread(target=reconcile)
    reconciler.start()
    try:
        for _ in range(50):
            store.update_job(id_(), lambda job: replace(job, outcome="failed"))
            store.update_job(id_(), lambda job: replace(job, outcome=None))
            deadline = time.monotonic() + 5
            while id_() not in open_ids(store):
                assert time.monotonic() < deadline
    finally:
        stop.set()
        reconciler.join()


def test_a_marker_without_record_is_passed_over_and_goes_when_it_is_old(store, folder):
    store.write_job(record())
    marker = folder / "open" / id_(1)
    marker.touch()
    assert open_ids(store) == {id_()}
    assert marker.exists()
    os.utime(marker, (time.time() - 100,) * 2)
    assert open_ids(store) == {id_()}
    assert not marker.exists()


def test_a_deleted_record_is_nowhere(store):
    store.write_job(record(0))
    store.write_job(record(1))
    store.update_job(id_(0), lambda job: replace(job, asked=False))
    store.delete_job(id_(0))
    store.delete_job(id_(2))
    assert store.job(id_(0)) is None
    assert [job.id for job in store.jobs()] == [id_(1)]
    assert open_ids(store) == {id_(1)}
