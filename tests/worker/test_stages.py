"""What can be computed, what it costs and what is refused, without computing it."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from typing import Any

import numpy as np
import pytest

import solver
from solver import Mesh
from tests.solver.shapes import icosphere
from tests.worker.conftest import ask, energy, put_mesh, run
from worker import sizes, specs
from worker.fields import SpecError, kind_of
from worker.library import Library
from worker.questions import parse
from worker.queue import Dispatcher
from worker.readers import read_basis
from worker.sizes import Sizes
from worker.stages import STAGES, stage
from worker.store import Store
from worker.tasks import Workplace


def put_array(store: Store, array: np.ndarray) -> str:
    id_ = specs.array_id(array)
    store.put(id_, kind="array", spec=None, parents={}, values={}, arrays={"array": array}, made={})
    return id_


def two_spheres() -> Mesh:
    one = icosphere(1)
    vertices = np.concatenate([one.vertices, one.vertices + 3])
    return Mesh(vertices, np.concatenate([one.faces, one.faces + one.n_vertices]))


def test_every_kind_has_a_stage() -> None:
    assert set(STAGES) == set(specs.MODELS)


def test_shards_are_the_blocks_that_the_solver_sums_by() -> None:
    assert sizes.FACE_BLOCK == solver.FACE_BLOCK
    assert sizes.blocks(2 * 4096 + 1) == [(0, 4096), (4096, 8192), (8192, 8193)]


def test_planning_loads_no_solver() -> None:
    code = "import sys, worker.queue, worker.stages; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not {"solver", "scipy", "numba", "trimesh", "matplotlib"} & set(loaded.split())


FLAWS: list[tuple[str, dict[str, Any]]] = [
    ("/size", {"size": 43}),
    ("/size", {"size": 2001}),
    ("/first", {"size": 5, "first": 42}),
    ("/first/1", {"size": 5, "first": [0, 42]}),
]


@pytest.mark.parametrize(("pointer", "fields"), FLAWS)
def test_a_basis_that_does_not_fit_its_mesh_is_refused(
    dispatcher: Dispatcher, store: Store, pointer: str, fields: dict[str, Any]
) -> None:
    mesh = put_mesh(store, icosphere(1))
    with pytest.raises(SpecError) as refusal:
        ask(dispatcher, kind="basis", mesh=mesh, **fields)
    assert [place for place, _ in refusal.value.errors] == [pointer]


def test_what_is_not_there_is_refused_where_it_is_named(dispatcher: Dispatcher) -> None:
    with pytest.raises(SpecError) as refusal:
        ask(dispatcher, **energy(f"mesh-{0:032x}", 5))
    assert refusal.value.errors == (("/softmap/source/mesh", "There is no such mesh"),)


def test_a_target_must_be_connected_and_a_source_need_not_be(dispatcher: Dispatcher, store: Store) -> None:
    whole, parts = put_mesh(store, icosphere(1)), put_mesh(store, two_spheres())
    one, two = ({"kind": "basis", "mesh": mesh, "size": 5} for mesh in (whole, parts))
    ask(dispatcher, kind="softmap", source=two, target=one, map={"type": "uniform"})
    with pytest.raises(SpecError) as refusal:
        ask(dispatcher, kind="softmap", source=one, target=two, map={"type": "uniform"})
    ((place, detail),) = refusal.value.errors
    assert place == "/target"
    assert "2 components" in detail


def test_either_method_makes_the_solvers_basis(
    dispatcher: Dispatcher, store: Store, place: Workplace
) -> None:
    mesh, sphere = put_mesh(store, icosphere(1)), icosphere(1)
    for fields, expected in (
        ({"method": "maxent", "sharpness": 2.0}, solver.maxent_basis(sphere, 12, 2.0, [3, 4])),
        ({"method": "poisson", "cutoff": 0.3}, solver.poisson_basis(sphere, 12, 0.3, [3, 4])),
    ):
        job = ask(dispatcher, kind="basis", mesh=mesh, size=12, first=[3, 4], **fields)
        run(place, job)
        found = read_basis(store, job.id)
        np.testing.assert_array_equal(found.functions.toarray(), expected.functions.toarray())
        np.testing.assert_array_equal(found.samples, expected.samples)


@pytest.mark.parametrize(
    ("fields", "place", "owner"),
    [
        ({"method": "maxent", "cutoff": 0.1}, "/cutoff", "poisson"),
        ({"method": "poisson", "sharpness": 3.0}, "/sharpness", "maxent"),
    ],
)
def test_the_other_methods_field_is_refused(fields: dict[str, Any], place: str, owner: str) -> None:
    with pytest.raises(SpecError) as refusal:
        parse(json.dumps({"kind": "basis", "mesh": f"mesh-{0:032x}", **fields}))
    assert refusal.value.errors == ((place, f"This field belongs to the method '{owner}'"),)


MAPS: list[tuple[str, dict[str, Any]]] = [
    ("/map/targets", {"type": "points", "targets": [0, 1, 2]}),
    ("/map/barycentric", {"type": "points", "targets": [0] * 42, "barycentric": [[1.0, 0.0]] * 42}),
    ("/map/coefficients", {"type": "matrix", "coefficients": [[1.0, 0.0]]}),
    ("/map/source", {"type": "descriptors", "source": [[1.0], [2.0]], "target": [[1.0]] * 42}),
    ("/map/target", {"type": "descriptors", "source": [[1.0]] * 42, "target": [[1.0, 2.0]] * 42}),
]


@pytest.mark.parametrize(("pointer", "fields"), MAPS)
def test_a_map_whose_arrays_do_not_fit_is_refused(
    dispatcher: Dispatcher, store: Store, pointer: str, fields: dict[str, Any]
) -> None:
    basis = {"kind": "basis", "mesh": put_mesh(store, icosphere(1)), "size": 5}
    with pytest.raises(SpecError) as refusal:
        ask(dispatcher, kind="softmap", source=basis, target=basis, map=fields)
    assert [place for place, _ in refusal.value.errors] == [pointer]


def test_targets_are_integers(dispatcher: Dispatcher, store: Store) -> None:
    basis = {"kind": "basis", "mesh": put_mesh(store, icosphere(1)), "size": 5}
    targets = put_array(store, np.zeros(42))
    with pytest.raises(SpecError, match="integers, counted from 0"):
        ask(
            dispatcher,
            kind="softmap",
            source=basis,
            target=basis,
            map={"type": "points", "targets": targets},
        )


def test_a_descriptor_of_another_mesh_is_refused(dispatcher: Dispatcher, store: Store) -> None:
    here, there = put_mesh(store, icosphere(1)), put_mesh(store, two_spheres())
    basis = {"kind": "basis", "mesh": here, "size": 5}
    own, other = ({"kind": "descriptor", "mesh": mesh, "type": "hks"} for mesh in (here, there))
    with pytest.raises(SpecError, match="/map/target: This descriptor is of another mesh"):
        ask(
            dispatcher,
            kind="softmap",
            source=basis,
            target=basis,
            map={"type": "descriptors", "source": own, "target": other},
        )


def test_shards_are_never_asked_for(dispatcher: Dispatcher, store: Store, place: Workplace) -> None:
    job = ask(dispatcher, **energy(put_mesh(store, icosphere(1)), 5))
    run(place, job)
    softmap = next(task.id for task in job.tasks if task.kind == "softmap")
    with pytest.raises(SpecError, match="/kind"):
        ask(dispatcher, kind="energy_block", softmap=softmap, start=0, stop=10)


def test_more_faces_cost_more(store: Store) -> None:
    known = Library(store)
    costs = []
    for mesh in (icosphere(2), icosphere(3)):
        basis = specs.PoissonBasis(mesh=put_mesh(store, mesh), size=30)
        softmap = specs.SoftMap(source=specs.spec_id(basis), target=specs.spec_id(basis), map=specs.Uniform())
        for spec in (basis, softmap):
            known.know(specs.spec_id(spec), spec)
        question = specs.Energy(softmap=specs.spec_id(softmap))
        costs.append(stage(question).cost(question, Sizes(store, known)))
    assert costs[1].seconds > 1.5 * costs[0].seconds
    assert costs[1].bytes > costs[0].bytes


def test_estimates_of_memory_are_bounds(dispatcher: Dispatcher, store: Store, place: Workplace) -> None:
    """The numpy memory of each task stays within its estimate, which is what the limit is compared with."""
    mesh = put_mesh(store, icosphere(3))
    by_descriptors = ask(
        dispatcher, **energy(mesh, 60, map={"type": "descriptors", "descriptor": "wks"}, gradient=True)
    )
    softmap = next(task.id for task in by_descriptors.tasks if task.kind == "softmap")
    potential = ask(dispatcher, kind="potential", softmap=softmap)
    motion = [
        ask(dispatcher, kind="momentum", softmap=softmap, face=[1] * 50, direction=[[1, 2, 3]] * 50),
        ask(dispatcher, kind="pointmap", softmap=softmap),
        ask(dispatcher, kind="pointmap", softmap=softmap, method="barycentre"),
        ask(dispatcher, kind="path", softmap=softmap, source_path=[3, 400, 77], start=5),
    ]
    few = {"kind": "basis", "mesh": mesh, "size": 30}
    optimal = [
        ask(
            dispatcher,
            kind="softmap",
            source=few,
            target=few,
            map={"type": "optimal", "method": method, "max_iterations": 4},
        )
        for method in ("interior", "softmax")
    ]
    maxent = [
        ask(dispatcher, kind="basis", mesh=mesh, size=60, method="maxent", sharpness=sharpness)
        for sharpness in (1.0, 3.0)
    ]
    place.prepare()
    seen = set()
    for job in (by_descriptors, potential, *motion, *optimal, *maxent):
        record = store.job(job.id)
        assert record is not None
        for task in record.tasks:
            tracemalloc.start()
            place.run(task.id)
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            if task.id not in seen:
                seen.add(task.id)
                assert store.has(task.id)
                assert peak <= task.bytes, task.kind
    assert {kind_of(task) for task in seen} == set(specs.PUBLIC_KINDS)
