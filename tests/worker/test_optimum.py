"""Optimal soft maps as tasks: the solver's, said as they come, gone on with after an interruption."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from solver import LinearConstraint, landmark_distances, maxent_basis, optimal_softmap
from tests.solver.shapes import grid, icosphere
from tests.worker.conftest import ask, put_mesh, run
from worker import specs
from worker.bench import Bench, Report
from worker.fields import SpecError
from worker.optimum import Earlier, make_optimal
from worker.queue import Dispatcher
from worker.readers import Reader
from worker.store import Store
from worker.tasks import Workplace

LANDMARKS = [[0, 0], [20, 21], [41, 40]]
FIRST = [[v0 for v0, _ in LANDMARKS], [v for _, v in LANDMARKS]]


def softmap(mesh: str, **fields: Any) -> dict[str, Any]:
    """Spec of an optimal map from a sphere to itself, on bases of 16 functions."""
    source, target = (
        {"kind": "basis", "mesh": mesh, "size": 16, "method": "maxent", "first": first} for first in FIRST
    )
    return {
        "kind": "softmap",
        "source": source,
        "target": target,
        "map": {"type": "optimal", "landmarks": LANDMARKS, **fields},
    }


@pytest.fixture
def mesh(store: Store) -> str:
    return put_mesh(store, icosphere(2))


def test_an_optimal_map_is_the_solvers(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, **softmap(mesh, bijectivity_weight=0.5, tolerance=1e-2, max_iterations=30))
    run(place, job)
    manifest = store.manifest(job.id)
    assert manifest is not None
    source, target = (maxent_basis(icosphere(2), 16, first=first) for first in FIRST)
    pairs = [(v0, v) for v0, v in LANDMARKS]
    expected = optimal_softmap(source, target, pairs, 0.5, 1e-2, 30)
    assert expected.converged
    np.testing.assert_array_equal(store.array(manifest, "coefficients"), expected.softmap.coefficients)
    for name in ("energy", "dirichlet", "bijectivity", "attachment", "gap", "converged", "iterations"):
        assert manifest.values[name] == getattr(expected, name)
    for name in ("energy", "gap", "evaluations"):
        found = store.array(manifest, f"history_{name}")
        np.testing.assert_allclose(found, [getattr(one, name) for one in expected.history], rtol=1e-12)
    assert store.array(manifest, "history_seconds").shape == (expected.iterations + 1,)
    assert store.checkpoint(job.id) is None
    # Once it is done, a job knows what its artifact does.
    done = dispatcher.job(job.id)
    assert done is not None
    assert done.values == manifest.values


def test_a_search_goes_on_where_it_stopped(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, **softmap(mesh))
    source, target = (maxent_basis(icosphere(2), 16, first=first) for first in FIRST)
    pairs = [(v0, v) for v0, v in LANDMARKS]
    whole = optimal_softmap(source, target, pairs)
    assert whole.iterations > 5
    begun = optimal_softmap(source, target, pairs, max_iterations=5)
    history = np.array([[one.energy, one.gap, one.evaluations, one.seconds] for one in begun.history])
    store.write_checkpoint(
        job.id, {"iteration": 5}, {"coefficients": begun.softmap.coefficients, "history": history}
    )
    run(place, job)
    manifest = store.manifest(job.id)
    assert manifest is not None
    columns = [
        store.array(manifest, f"history_{name}") for name in ("energy", "gap", "evaluations", "seconds")
    ]
    np.testing.assert_array_equal(np.stack(columns, axis=1)[:6], history)
    assert manifest.values["iterations"] == len(columns[0]) - 1 > 5
    assert manifest.values["converged"]
    assert all((np.diff(columns[k]) >= -1e-12).all() for k in (2, 3))
    # Both are within their gaps of the one optimum.
    gaps = manifest.values["gap"] + whole.gap
    assert abs(manifest.values["energy"] - whole.energy) <= gaps
    assert store.checkpoint(job.id) is None


def test_what_was_proven_once_stays_proven() -> None:
    earlier = Earlier(np.array([[5.0, 4.0, 1, 0.1], [3.0, 0.5, 2, 0.2]]))
    assert earlier.bound == 2.5

    class Now:
        energy, gap, evaluations, seconds = 2.75, 3.0, 4, 0.5

    joined = earlier.joined([Now(), Now()])  # type: ignore[list-item]
    np.testing.assert_array_equal(joined[:2], earlier.history)
    np.testing.assert_allclose(joined[2], [2.75, 0.25, 6, 0.7])
    assert len(joined) == 3


def test_a_running_search_says_what_it_knows(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, **softmap(mesh))
    for task in job.tasks[:-1]:
        place.run(task.id)
    said: list[tuple[str, float, Mapping[str, Any]]] = []
    fractions: list[float] = []

    def step(words: str, start: float, stop: float, values: Mapping[str, Any] | None = None) -> Report:
        said.append((words, start, values or {}))
        return lambda done: fractions.append(start + (stop - start) * done)

    record = store.job(job.id)
    assert record is not None
    made = make_optimal(specs.load(record.spec), Bench(Reader(store), 1, step, job.id))
    assert said[0][0] == "first evaluation"
    assert [values["iteration"] for _, _, values in said[1:]] == list(range(made.values["iterations"] + 1))
    words, _, values = said[-1]
    gap = f"{100 * values['gap'] / values['energy']:.3g} %"
    assert words == f"iteration {values['iteration']}: energy {values['energy']:.4f}, gap {gap}"
    assert set(values) == {"iteration", "energy", "gap", "evaluations"}
    assert fractions == sorted(fractions)
    assert (fractions[0], fractions[-1]) == (0.0, pytest.approx(1.0))
    # The first iteration is written down at once, for those who want to look.
    checkpoint = store.checkpoint(job.id)
    assert checkpoint is not None
    assert checkpoint.arrays["coefficients"].shape == (16, 16)


def test_an_attachment_sharpens_by_distances_or_descriptors(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    distances = [landmark_distances(icosphere(2), side).tolist() for side in FIRST]
    by_landmarks = ask(dispatcher, **softmap(mesh, attachment=10))
    by_arrays = ask(dispatcher, **softmap(mesh, attachment=10, source=distances[0], target=distances[1]))
    plain = ask(dispatcher, **softmap(mesh))
    for job in (by_landmarks, by_arrays, plain):
        run(place, job)
    np.testing.assert_array_equal(
        store.array(by_landmarks.id, "coefficients"), store.array(by_arrays.id, "coefficients")
    )
    manifest = store.manifest(by_landmarks.id)
    assert manifest is not None
    assert manifest.values["attachment"] > 0
    assert manifest.values["converged"]
    assert (store.array(by_landmarks.id, "coefficients") ** 2).sum() > (
        store.array(plain.id, "coefficients") ** 2
    ).sum()
    with pytest.raises(SpecError, match=r"/map/target: .* cannot be compared"):
        ask(dispatcher, **softmap(mesh, attachment=1, source=[[1.0]] * 162, target=[[1.0, 2.0]] * 162))


def test_regions_go_where_they_are_sent(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    constraints = [{"source": [5, 6, 7], "target": [8, 9]}, {"source": 30, "target": 31}]
    job = ask(dispatcher, **softmap(mesh, landmarks=[], constraints=constraints, tolerance=0.05))
    run(place, job)
    source, target = (maxent_basis(icosphere(2), 16, first=first) for first in FIRST)
    coefficients = store.array(job.id, "coefficients")
    for one in constraints:
        ends = ([one["source"]], [one["target"]]) if isinstance(one["source"], int) else one.values()
        expected = LinearConstraint.on_region(source, target, *ends)
        np.testing.assert_allclose(expected.weights @ coefficients, expected.values, atol=1e-8)


def test_constraints_that_contradict_landmarks_fail_by_name(
    dispatcher: Dispatcher, place: Workplace, mesh: str
) -> None:
    job = ask(dispatcher, **softmap(mesh, constraints=[{"source": 0, "target": 41}]))
    run(place, job)
    failed = dispatcher.job(job.id)
    assert failed is not None
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:invalid-soft-map"
    assert "no soft map satisfies constraint 0" in failed.error["detail"]
    assert failed.values == {}


def test_it_can_start_from_a_coarser_map(
    dispatcher: Dispatcher, store: Store, place: Workplace, mesh: str
) -> None:
    coarse = softmap(mesh)
    fine = softmap(mesh, start=coarse)
    for side in ("source", "target"):
        fine[side] = fine[side] | {"size": 24}
    job = ask(dispatcher, **fine)
    run(place, job)
    # Within a few per cent of the optimum from the first evaluation on.
    energies = store.array(job.id, "history_energy")
    assert energies[0] < 1.3 * energies[-1]
    elsewhere = ask(dispatcher, **softmap(put_mesh(store, icosphere(1))))
    with pytest.raises(SpecError, match=r"/map/start: .* between the same two meshes"):
        ask(dispatcher, **softmap(mesh, start=elsewhere.id))


@pytest.mark.parametrize(
    ("fields", "pointers"),
    [
        ({"landmarks": [[0, 0], [162, 162]]}, ["/map/landmarks/1/0", "/map/landmarks/1/1"]),
        ({"constraints": [{"source": [0, 162], "target": 5}]}, ["/map/constraints/0/source"]),
    ],
)
def test_vertices_that_do_not_exist_are_refused(
    dispatcher: Dispatcher, mesh: str, fields: dict[str, Any], pointers: list[str]
) -> None:
    with pytest.raises(SpecError) as refusal:
        ask(dispatcher, **softmap(mesh, **fields))
    assert [place for place, _ in refusal.value.errors] == pointers


def test_a_target_of_dependent_functions_is_refused_by_name(
    dispatcher: Dispatcher, store: Store, place: Workplace
) -> None:
    """Two cells that touch: both functions are the same."""
    basis = {"kind": "basis", "mesh": put_mesh(store, grid()), "size": 2, "method": "poisson"}
    job = ask(dispatcher, kind="softmap", source=basis, target=basis, map={"type": "uniform"})
    run(place, job)
    failed = dispatcher.job(job.id)
    assert failed is not None
    assert failed.error is not None
    assert failed.error["type"] == "urn:softmaps:invalid-basis"
    assert "is a combination of others" in failed.error["detail"]
