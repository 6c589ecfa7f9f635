"""Landmarks and linear constraints: what they hold, and what they refuse by name."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from solver.basis import Basis, poisson_basis
from solver.errors import InvalidSoftMap
from solver.feasible import LinearConstraint, feasible
from solver.fem import mass
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from tests.solver.shapes import fibonacci_sphere, grid


@pytest.fixture(scope="module")
def bases() -> tuple[Basis, Basis]:
    return maxent_basis(fibonacci_sphere(120), size=10), maxent_basis(grid(6, 6), size=9)


def test_a_landmark_holds_the_largest_functions(bases: tuple[Basis, Basis]) -> None:
    source, target = bases
    pairs = [(7, 20), (100, 3)]
    allowed = feasible(source, target, pairs)
    for v0, v in pairs:
        row = int(source.functions.toarray()[v0].argmax())
        column = int(target.functions.toarray()[v].argmax())
        assert np.flatnonzero(allowed.allowed[row]).tolist() == [column]
        np.testing.assert_array_equal(allowed.interior[row], np.eye(target.size)[column])
        assert row not in allowed.rows
    assert allowed.rows.size == source.size - len(
        {int(source.functions.toarray()[v].argmax()) for v, _ in pairs}
    )
    np.testing.assert_allclose(allowed.interior.sum(axis=1), 1, rtol=1e-15)


def test_landmarks_may_agree_but_not_contradict(bases: tuple[Basis, Basis]) -> None:
    source, target = bases
    columns = target.functions.toarray().argmax(axis=1)
    other = int(np.flatnonzero(columns != columns[0])[0])
    feasible(source, target, [(0, 0), (0, 0)])
    with pytest.raises(InvalidSoftMap, match="landmarks 0 and 2 contradict") as refused:
        feasible(source, target, [(0, 0), (0, 0), (0, other)])
    assert refused.value.index == 2


def test_a_point_constraint_is_the_value_at_a_point(bases: tuple[Basis, Basis]) -> None:
    source, target = bases
    constraint = LinearConstraint.at_point(source, target, 11, 5)
    np.testing.assert_array_equal(constraint.weights, source.functions.toarray()[11])
    np.testing.assert_array_equal(constraint.values, target.functions.toarray()[5])


def test_a_region_constraint_is_the_mean_over_a_region(bases: tuple[Basis, Basis]) -> None:
    source, target = bases
    some, others = np.array([3, 8, 3, 60]), np.array([0, 1, 7])
    constraint = LinearConstraint.on_region(source, target, some, others)
    areas = mass(source.mesh)[[3, 8, 60]]
    expected = areas @ source.functions.toarray()[[3, 8, 60]] / areas.sum()
    np.testing.assert_allclose(constraint.weights, expected, rtol=1e-14)
    assert constraint.values.sum() == pytest.approx(1, rel=1e-14)
    everywhere = LinearConstraint.on_region(source, target, np.arange(120), np.arange(49))
    np.testing.assert_allclose(everywhere.weights, source.functions.T @ mass(source.mesh), rtol=1e-13)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_some_map_satisfies_is_found_feasible(bases: tuple[Basis, Basis], seed: int) -> None:
    """Constraints taken off a sparse map: an interior map satisfies them, positive where any map is."""
    source, target = bases
    rng = np.random.default_rng(seed)
    witness = rng.dirichlet(np.full(target.size, 0.3), size=source.size) * (rng.random((10, 9)) < 0.6)
    witness[witness < 1e-6] = 0.0
    witness[:, 0] += 1 - witness.sum(axis=1)
    weights = rng.random((2, source.size)) * (rng.random((2, source.size)) < 0.5)
    constraints = [LinearConstraint(line, line @ witness) for line in weights]
    found = feasible(source, target, [], constraints)
    assert found.allowed[witness > 1e-4].all()
    assert (found.interior[found.allowed] > 0).all()
    assert (found.interior[~found.allowed] == 0).all()
    np.testing.assert_allclose(found.interior.sum(axis=1), 1, rtol=1e-12)
    np.testing.assert_allclose(weights @ found.interior, weights @ witness, atol=1e-12)


def test_constraints_that_nothing_satisfies_are_refused_by_number(bases: tuple[Basis, Basis]) -> None:
    source, target = bases
    here = LinearConstraint(np.eye(source.size)[4], np.eye(target.size)[0])
    there = LinearConstraint(np.eye(source.size)[4], np.eye(target.size)[1])
    anywhere = LinearConstraint(np.eye(source.size)[2], np.full(target.size, 1 / target.size))
    with pytest.raises(InvalidSoftMap, match="satisfies constraint 2 together") as refused:
        feasible(source, target, [], [here, anywhere, there, anywhere])
    assert refused.value.index == 2
    landmark = (int(source.samples[2]), int(target.samples[0]))
    with pytest.raises(InvalidSoftMap, match="satisfies constraint 0 together with the landmarks"):
        feasible(source, target, [landmark], [anywhere])


def test_a_constraint_that_is_out_of_balance_or_out_of_shape_is_refused(bases: tuple[Basis, Basis]) -> None:
    source, target = bases
    with pytest.raises(InvalidSoftMap, match=r"sum to 0\.5 more") as refused:
        LinearConstraint(np.eye(source.size)[0], 0.5 * np.eye(target.size)[0])
    assert refused.value.value == 0.5
    with pytest.raises(InvalidSoftMap, match="finite") as refused:
        LinearConstraint([1.0, np.nan], [1.0, 0.0])
    assert refused.value.index == 1
    with pytest.raises(InvalidSoftMap, match="finite"):
        LinearConstraint([[1.0]], [1.0])
    short = LinearConstraint(np.eye(source.size)[0], np.eye(target.size - 1)[0])
    with pytest.raises(InvalidSoftMap, match="constraint 1 is for bases of 10 and 8") as refused:
        feasible(source, target, [], [LinearConstraint.at_point(source, target, 0, 0), short])
    assert refused.value.index == 1


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ((120, 0), "landmark 0: source vertex 120 is not one of 0 … 119"),
        ((-1, 0), "source vertex -1"),
        ((0, 49), "target vertex 49 is not one of 0 … 48"),
        ((0.0, 1), "must be an integer"),
        ((True, 1), "must be an integer"),
        ((1, 2, 3), "pair"),
    ],
)
def test_a_landmark_that_does_not_exist_is_refused(bases: tuple[Basis, Basis], pair, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InvalidSoftMap, match=message):
        feasible(*bases, [pair])


def test_a_vertex_of_no_face_is_no_landmark() -> None:
    mesh = grid(3, 3)
    lonely = poisson_basis(Mesh(np.concatenate([mesh.vertices, [[9.0, 9.0, 9.0]]]), mesh.faces), size=3)
    with pytest.raises(InvalidSoftMap, match="vertex 16 belongs to no face") as refused:
        feasible(lonely, lonely, [(0, 0), (16, 0)])
    assert refused.value.index == 16
    with pytest.raises(InvalidSoftMap, match="no area"):
        LinearConstraint.on_region(lonely, lonely, [16], [0])
    for region in ([], [0.5], [17], [-1]):
        with pytest.raises(InvalidSoftMap):
            LinearConstraint.on_region(lonely, lonely, [0], region)
