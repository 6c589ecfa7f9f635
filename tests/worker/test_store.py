import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from worker.store import JobRecord, Store, Swept, now

ENERGY, OTHER = "energy-" + "0" * 32, "energy-" + "1" * 32
WHOLE = {
    "kind": "energy",
    "spec": {"kind": "energy"},
    "parents": {},
    "values": {},
    "arrays": {"density": np.arange(10.0)},
    "made": {},
}


def record(name):
    return JobRecord(name, {"kind": "energy"}, asked=True, created_at=now())


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "store"


@pytest.fixture
def store(folder):
    return Store(folder)


def test_a_store_has_one_identity_for_everyone(store, folder):
    barrier, answers = threading.Barrier(8), []

    def read():
        barrier.wait()
        answers.append(Store(folder).identity)

    threads = [threading.Thread(target=read) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(answers) == 8
    assert set(answers) == {store.identity}
    assert len(store.identity) == 16


def test_a_sweep_removes_old_orphans_alone(store, folder):
    manifest = store.put(ENERGY, **WHOLE)
    (folder / "blobs" / "orphan").write_bytes(b"half a block")
    (folder / "aside" / "orphan").write_bytes(b"half a manifest")
    assert store.sweep(older_than=60) == Swept(blobs=0, files=0, jobs=0)
    for orphan in ("blobs/orphan", "aside/orphan"):
        os.utime(folder / orphan, (time.time() - 100,) * 2)
    swept = store.sweep(older_than=60)
    assert (swept.blobs, swept.files) == (1, 1)
    assert store.array(manifest, "density").shape == (10,)
    assert list((folder / "aside").iterdir()) == []


def test_a_sweep_restores_markers_that_were_lost(store, folder):
    store.write_job(record(ENERGY))
    store.write_job(replace(record(OTHER), outcome="failed"))
    for marker in [*(folder / "open").iterdir(), *(folder / "recent").iterdir()]:
        marker.unlink()
    assert store.sweep(0).jobs == 2
    assert [job.id for job in store.open_jobs()] == [ENERGY]
    assert {job.id for job in store.jobs()} == {ENERGY, OTHER}
    assert store.sweep(0).jobs == 0


def test_a_tombstone_learns_its_question_from_the_job(store, folder):
    store.write_job(record(ENERGY))
    store.put(ENERGY, **WHOLE)
    (folder / "artifacts" / ENERGY).write_bytes(b"nonsense")
    assert store.manifest(ENERGY) is None
    assert store.gone(ENERGY).spec == {"kind": "energy"}
