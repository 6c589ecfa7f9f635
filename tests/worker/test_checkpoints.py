"""Checkpoints: the newest whole one is read, older ones go, and so do those nobody waits for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from worker.objects import Objects
from worker.store import JobRecord, Store, now

TASK, OTHER = f"softmap-{1:032x}", f"softmap-{2:032x}"


def files(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "checkpoints").iterdir())


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path)


def test_the_newest_is_read_and_one_before_it_kept(store: Store, tmp_path: Path) -> None:
    assert store.checkpoint(TASK) is None
    for k in range(5):
        store.write_checkpoint(TASK, {"iteration": k}, {"a": np.full((2, 3), k / 7), "b": np.arange(k)})
    store.write_checkpoint(OTHER, {}, {})
    found = store.checkpoint(TASK)
    assert found is not None
    assert (found.number, found.values) == (4, {"iteration": 4})
    np.testing.assert_array_equal(found.arrays["a"], np.full((2, 3), 4 / 7))
    np.testing.assert_array_equal(found.arrays["b"], np.arange(4))
    assert [path.name for path in files(tmp_path)][:2] == [f"{TASK}.00000003", f"{TASK}.00000004"]
    store.delete_checkpoints(TASK)
    assert store.checkpoint(TASK) is None
    assert store.checkpoint(OTHER) is not None


def test_a_damaged_one_is_passed_over(store: Store, tmp_path: Path) -> None:
    for k in range(2):
        store.write_checkpoint(TASK, {"iteration": k}, {"a": np.arange(3.0)})
    newest = files(tmp_path)[-1]
    content = bytearray(newest.read_bytes())
    content[200] ^= 1
    newest.write_bytes(content)
    found = store.checkpoint(TASK)
    assert found is not None
    assert found.values == {"iteration": 0}
    # The next one gets a number of its own.
    store.write_checkpoint(TASK, {"iteration": 2}, {"a": np.arange(3.0)})
    found = store.checkpoint(TASK)
    assert found is not None
    assert (found.number, found.values) == (2, {"iteration": 2})


def test_a_sweep_takes_those_that_no_open_job_needs(store: Store) -> None:
    for task in (TASK, OTHER):
        store.write_checkpoint(task, {}, {})
    store.write_job(JobRecord(TASK, {}, asked=True, created_at=now()))
    assert store.sweep().files == 0  # both are young
    assert store.sweep(older_than=0.0).files == 1
    assert store.checkpoint(TASK) is not None
    assert store.checkpoint(OTHER) is None


def test_what_is_no_id_has_no_checkpoint(store: Store) -> None:
    with pytest.raises(ValueError, match="no id"):
        store.write_checkpoint("../escape", {}, {})
    assert store.checkpoint("../escape") is None


def test_nan_is_no_value(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        Store(tmp_path).write_checkpoint(TASK, {"gap": float("nan")}, {})
    assert Objects(tmp_path).names("checkpoints") == []
