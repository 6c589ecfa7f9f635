"""Momentum and paths as tasks: what the solver says, from the store and back, and what is refused."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest

from solver import momentum, pointmap, trace, velocity
from tests.solver.shapes import icosphere
from tests.worker.conftest import ask, energy, put_mesh, run
from worker.fields import SpecError
from worker.queue import Dispatcher
from worker.readers import read_softmap
from worker.store import Store
from worker.tasks import Workplace


@pytest.fixture
def softmap(dispatcher: Dispatcher, store: Store, place: Workplace) -> str:
    """Id of the identity of a sphere of 162 vertices and 320 faces."""
    points = {"type": "points", "targets": list(range(162))}
    spec = energy(put_mesh(store, icosphere(2)), 30, map=points)["softmap"]
    job = ask(dispatcher, **spec)
    run(place, job)
    return job.id


@pytest.mark.parametrize(
    ("face", "direction"),
    [(7, [1, 0.5, -0.25]), ([7, 300, 7], [[1, 0.5, -0.25], [0, 1, 0], [0, 0, 3]]), ([7], [[1, 0, 0]])],
)
def test_momentum_is_the_solvers(
    dispatcher: Dispatcher, store: Store, place: Workplace, softmap: str, face: Any, direction: Any
) -> None:
    job = ask(dispatcher, kind="momentum", softmap=softmap, face=face, direction=direction)
    run(place, job)
    expected = read_softmap(store, softmap)
    shape = (320, 3) if isinstance(face, int) else (len(face), 320, 3)
    assert store.array(job.id, "velocity").shape == shape
    np.testing.assert_array_equal(store.array(job.id, "velocity"), velocity(expected, face, direction))
    np.testing.assert_array_equal(store.array(job.id, "momentum"), momentum(expected, face, direction))
    assert sum(task.seconds for task in store.job(job.id).tasks) < 2  # what the interactive queue takes


def test_a_path_is_the_solvers(dispatcher: Dispatcher, store: Store, place: Workplace, softmap: str) -> None:
    job = ask(dispatcher, kind="path", softmap=softmap, source_path=[3, 40, 100], start=3, step=0.05)
    run(place, job)
    expected = trace(read_softmap(store, softmap), [3, 40, 100], 3, 0.05)
    manifest = store.manifest(job.id)
    assert manifest is not None
    assert manifest.values == {"length": expected.length, "stopped": "end"}
    names = ("points", "faces", "barycentric", "source_points", "source_faces", "source_barycentric")
    assert set(manifest.arrays) == set(names)
    for name in names:
        np.testing.assert_array_equal(store.array(manifest, name), getattr(expected, name))


@pytest.mark.parametrize("method", ["peak", "barycentre"])
def test_a_point_map_is_the_solvers(
    dispatcher: Dispatcher,
    store: Store,
    place: Workplace,
    softmap: str,
    method: Literal["peak", "barycentre"],
) -> None:
    job = ask(dispatcher, kind="pointmap", softmap=softmap, method=method)
    run(place, job)
    expected = pointmap(read_softmap(store, softmap), method)
    np.testing.assert_array_equal(store.array(job.id, "targets"), expected.targets)
    np.testing.assert_array_equal(store.array(job.id, "confidence"), expected.confidence)


@pytest.mark.parametrize(
    ("fields", "pointers"),
    [
        ({"kind": "momentum", "face": 320, "direction": [1, 0, 0]}, ["/face"]),
        ({"kind": "momentum", "face": [0, 320], "direction": [[1, 0, 0]] * 2}, ["/face/1"]),
        ({"kind": "path", "source_path": [0, 162, 200], "start": 0}, ["/source_path/1", "/source_path/2"]),
        ({"kind": "path", "source_path": [0], "start": 162}, ["/start"]),
    ],
)
def test_what_is_not_on_the_surfaces_is_refused(
    dispatcher: Dispatcher, softmap: str, fields: dict[str, Any], pointers: list[str]
) -> None:
    with pytest.raises(SpecError) as refusal:
        ask(dispatcher, softmap=softmap, **fields)
    assert [place for place, _ in refusal.value.errors] == pointers


def test_a_direction_across_its_face_is_a_failure_that_names_it(
    dispatcher: Dispatcher, place: Workplace, softmap: str
) -> None:
    sphere = icosphere(2)
    directions = [sphere.frames[4, 0].tolist(), sphere.normals[9].tolist()]
    job = ask(dispatcher, kind="momentum", softmap=softmap, face=[4, 9], direction=directions)
    run(place, job)
    failed = dispatcher.job(job.id)
    assert failed is not None
    assert failed.error is not None
    assert failed.error["detail"] == "direction 1 has no part along face 9"
    assert failed.error["index"] == 1
