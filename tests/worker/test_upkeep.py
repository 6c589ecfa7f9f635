"""What is forgotten when there is too much, and what never is."""

from __future__ import annotations

import redis

from tests.solver.shapes import torus
from tests.worker.conftest import ask, energy, finished, put_mesh, run
from worker.queue import Dispatcher
from worker.settings import Settings
from worker.store import Store
from worker.tasks import Workplace


def made(dispatcher: Dispatcher, place: Workplace, store: Store) -> str:
    job = ask(dispatcher, **energy(put_mesh(store, torus(12, 8)), 5))
    run(place, job)
    return finished(dispatcher, job.id).id


def reconciled(settings: Settings, store: Store, connection: redis.Redis, most: int | None) -> None:
    Dispatcher(settings.model_copy(update={"store_max_bytes": most}), store, connection).reconcile()


def test_without_a_limit_nothing_is_forgotten(
    dispatcher: Dispatcher, place: Workplace, store: Store, settings: Settings, connection: redis.Redis
) -> None:
    answer = made(dispatcher, place, store)
    reconciled(settings, store, connection, most=None)
    assert store.has(answer)


def test_results_go_before_uploads_and_can_be_asked_for_again(
    dispatcher: Dispatcher, place: Workplace, store: Store, settings: Settings, connection: redis.Redis
) -> None:
    answer = made(dispatcher, place, store)
    reconciled(settings, store, connection, most=0)
    assert store.gone(answer) is not None
    assert {manifest.kind for manifest in store.manifests()} <= {"mesh", "array"}
    assert made(dispatcher, place, store) == answer
    assert store.has(answer)


def test_what_an_unfinished_job_reads_stays(
    dispatcher: Dispatcher, place: Workplace, store: Store, settings: Settings, connection: redis.Redis
) -> None:
    answer = made(dispatcher, place, store)
    softmap = store.manifest(answer).parents["softmap"]
    waiting = ask(dispatcher, kind="energy", softmap=softmap, regularisation=1e-3)
    reconciled(settings, store, connection, most=0)
    assert store.gone(answer) is not None
    run(place, waiting)
    assert store.has(waiting.id)
