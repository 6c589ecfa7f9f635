"""Partitions of unity: against a dense twin, under every motion, on every kind of mesh."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.spatial import Delaunay

from solver import fem
from solver.basis import Basis, poisson_basis
from solver.errors import InvalidBasis, InvalidMesh
from solver.geodesics import farthest_point_samples
from solver.mesh import Mesh
from tests.solver import shapes

CASES: list[tuple[Callable[[], Mesh], int]] = [
    (shapes.icosphere, 60),
    (shapes.grid, 10),
    (shapes.torus, 30),
    (shapes.moebius, 12),
    (lambda: shapes.fibonacci_sphere(400), 25),
    (lambda: shapes.together(shapes.icosphere(2), shapes.grid(5, 5)), 20),
]


def obtuse() -> Mesh:
    """Return a squashed piece of plane; of 60 cells, the cotangent solution is negative on one."""
    points = np.random.default_rng(11).uniform(size=(60, 2))
    triangles = Delaunay(points).simplices
    flat = np.column_stack([points * [1, 0.3], np.zeros(60)])
    return Mesh(flat, triangles)


def dense_twin(mesh: Mesh, size: int, cutoff: float) -> np.ndarray:
    """Section 4.2 again, slowly and in full: every cell by its own dense solve."""
    samples = farthest_point_samples(mesh, size)
    cotangent, delaunay = fem.stiffness(mesh).toarray(), fem.intrinsic_delaunay_stiffness(mesh).toarray()
    masses = fem.mass(mesh)
    raw = np.zeros((mesh.n_vertices, size))
    for j in range(size):
        touched = {j}
        for v, w in mesh.edges:
            pair = {int(samples.cells[v]), int(samples.cells[w])}
            if j in pair:
                touched |= pair
        ring = np.isin(samples.cells, list(touched))
        component = mesh.components == mesh.components[samples.vertices[j]]
        if ring.sum() == component.sum():
            raw[component, j] = 1
            continue
        f = np.zeros(mesh.n_vertices)
        f[ring] = np.linalg.solve(cotangent[np.ix_(ring, ring)], masses[ring])
        if f[samples.cells == j].min() <= 0:
            f[ring] = np.linalg.solve(delaunay[np.ix_(ring, ring)], masses[ring])
        m = f[samples.cells == j].min()
        for v, value in enumerate(f):
            t = (value - cutoff * m) / (m - cutoff * m)
            if value >= m:
                raw[v, j] = value
            elif t > 0:
                raw[v, j] = m * t**2 * ((2 + cutoff) - (1 + cutoff) * t)
    sums = raw.sum(axis=1, keepdims=True)
    return raw / np.where(sums > 0, sums, 1)


@pytest.mark.parametrize(("make", "size"), [*CASES, (obtuse, 60), (obtuse, 9)])
@pytest.mark.parametrize("cutoff", [0.1, 0.7])
def test_the_functions_are_those_of_dense_solves(make: Callable[[], Mesh], size: int, cutoff: float) -> None:
    mesh = make()
    basis = poisson_basis(mesh, size, cutoff)
    np.testing.assert_allclose(basis.functions.toarray(), dense_twin(mesh, size, cutoff), atol=1e-11)


def test_obtuse_triangles_need_the_delaunay_laplacian() -> None:
    mesh = obtuse()
    samples = farthest_point_samples(mesh, 60)
    stiffness, masses = fem.stiffness(mesh).toarray(), fem.mass(mesh)
    lowest = []
    for j in range(60):
        cells = samples.cells[mesh.edges]
        ring = np.isin(samples.cells, cells[(cells == j).any(axis=1)])
        f = np.zeros(mesh.n_vertices)
        f[ring] = np.linalg.solve(stiffness[np.ix_(ring, ring)], masses[ring])
        lowest.append(f[samples.cells == j].min())
    assert (np.array(lowest) <= 0).sum() == 1
    assert (poisson_basis(mesh, 60).functions[samples.vertices, range(60)] > 0).all()


@pytest.mark.parametrize(("make", "size"), CASES)
def test_a_basis_is_a_partition_of_unity_with_local_functions(make: Callable[[], Mesh], size: int) -> None:
    mesh = make()
    basis = poisson_basis(mesh, size)
    functions = basis.functions.toarray()
    assert functions.shape == (mesh.n_vertices, size)
    assert (functions >= 0).all()
    np.testing.assert_allclose(functions.sum(axis=1), 1, atol=4e-16)
    assert (functions[np.arange(mesh.n_vertices), basis.cells] > 0).all()
    np.testing.assert_array_equal(basis.cells[basis.samples], np.arange(size))
    touching = np.eye(size, dtype=bool)
    one, other = basis.cells[mesh.edges].T
    touching[one, other] = touching[other, one] = True
    assert not functions[~touching[basis.cells]].any()


def test_the_cutoff_joins_smoothly() -> None:
    from solver.basis import _cut

    m, c = 0.3, 0.2
    cut = lambda f: _cut(np.atleast_1d(f), m, c)  # noqa: E731
    np.testing.assert_array_equal(cut([0.0, c * m, -1.0]), 0)
    np.testing.assert_array_equal(cut([m, 0.5]), [m, 0.5])
    t = 0.5  # by hand: m/4 ((2 + c) − (1 + c)/2)
    assert cut(c * m + t * (1 - c) * m)[0] == pytest.approx(m / 4 * (2.2 - 0.6), rel=1e-14)
    step = 1e-7
    for f, slope in ((c * m, 0.0), (m, 1.0)):
        below, above = (cut(f) - cut(f - step)) / step, (cut(f + step) - cut(f)) / step
        np.testing.assert_allclose([below, above], slope, atol=1e-5)
    assert (np.diff(cut(np.linspace(c * m, 2 * m, 1000))) > 0).all()


@pytest.mark.parametrize(("make", "size"), CASES)
def test_tensors_are_the_integrals_they_are_called(make: Callable[[], Mesh], size: int) -> None:
    mesh = make()
    basis = poisson_basis(mesh, size)
    corner_values = basis.functions.toarray()[mesh.faces]  # (F, 3, n)
    areas = mesh.face_areas
    means = corner_values.mean(axis=1)
    integrals = areas @ means
    densities = means / integrals
    np.testing.assert_allclose(basis.integrals, integrals, rtol=1e-12)
    np.testing.assert_allclose(basis.face_means.toarray(), means, atol=1e-15)
    np.testing.assert_allclose(basis.densities.toarray(), densities, rtol=1e-12)
    np.testing.assert_allclose(
        basis.overlap.toarray(), np.einsum("f,fj,fk->jk", areas, densities, means), atol=1e-14
    )
    np.testing.assert_allclose(
        basis.density_products.toarray(), np.einsum("f,fj,fk->jk", areas, densities, densities), rtol=1e-11
    )


@pytest.mark.parametrize(("make", "size"), CASES)
def test_what_must_sum_to_one_does(make: Callable[[], Mesh], size: int) -> None:
    basis = poisson_basis(make(), size)
    assert basis.integrals.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(basis.face_means.sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(basis.overlap.sum(axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(basis.densities.T @ basis.mesh.face_areas, 1, atol=1e-12)
    np.testing.assert_allclose(
        basis.density_products @ basis.integrals, basis.mesh.face_areas @ basis.densities
    )


@given(seed=st.integers(0, 10**6), exponent=st.floats(-100, 100))
@settings(max_examples=15, deadline=None)
def test_a_basis_is_carried_along_by_motions_and_scalings(seed: int, exponent: float) -> None:
    mesh = shapes.torus()
    still = poisson_basis(mesh, 20)
    moved = poisson_basis(shapes.moved(mesh, np.random.default_rng(seed), 10.0**exponent), 20)
    np.testing.assert_array_equal(moved.samples, still.samples)
    assert abs(moved.functions - still.functions).max() < 1e-10
    assert abs(moved.overlap - still.overlap).max() < 1e-10


@given(seed=st.integers(0, 10**6))
@settings(max_examples=15, deadline=None)
def test_a_basis_is_carried_along_by_relabelling(seed: int) -> None:
    mesh = shapes.fibonacci_sphere(300)
    order = np.random.default_rng(seed).permutation(mesh.n_vertices)
    plain = poisson_basis(mesh, 20, first=7)
    other = poisson_basis(shapes.relabelled(mesh, order), 20, first=int(np.flatnonzero(order == 7)[0]))
    np.testing.assert_array_equal(order[other.samples], plain.samples)
    np.testing.assert_array_equal(other.cells, plain.cells[order])
    assert abs(other.functions - plain.functions[order]).max() < 1e-10


def test_the_same_question_has_the_same_bits() -> None:
    one, other = (poisson_basis(shapes.torus(), 40) for _ in range(2))
    assert one.functions.data.tobytes() == other.functions.data.tobytes()
    assert one.functions.indices.tobytes() == other.functions.indices.tobytes()


def test_one_function_is_constant() -> None:
    basis = poisson_basis(shapes.torus(), 1)
    np.testing.assert_array_equal(basis.functions.toarray(), 1)
    assert basis.overlap.toarray() == pytest.approx(1)
    basis.require_independent()


def test_every_vertex_can_have_a_function() -> None:
    mesh = shapes.icosphere(1)
    basis = poisson_basis(mesh, mesh.n_vertices)
    assert sorted(basis.samples) == list(range(mesh.n_vertices))
    basis.require_independent()


def test_two_functions_that_fill_a_component_share_it_equally_and_are_dependent() -> None:
    mesh = shapes.together(shapes.icosphere(1), shapes.icosphere(1))
    basis = poisson_basis(mesh, 4)
    assert set(basis.functions.data) == {0.5}
    with pytest.raises(InvalidBasis, match="4 functions of rank 2") as refusal:
        basis.require_independent()
    assert refusal.value.value == 2


@pytest.mark.parametrize(("make", "size"), CASES[:-1])
def test_independence_is_that_of_the_matrix(make: Callable[[], Mesh], size: int) -> None:
    basis = poisson_basis(make(), size)
    assert np.linalg.matrix_rank(basis.functions.toarray()) == size
    basis.require_independent()
    columns = basis.functions.tocsc()
    halves = sparse.hstack([columns[:, :-1], columns[:, [-1]] / 2, columns[:, [-1]] / 2])
    cells, samples = basis.cells, np.append(basis.samples, basis.samples[-1])
    with pytest.raises(InvalidBasis, match=f"{size + 1} functions of rank {size}"):
        Basis(basis.mesh, halves, samples, cells).require_independent()


def test_landmarks_can_be_samples() -> None:
    basis = poisson_basis(shapes.icosphere(2), 12, first=[50, 9])
    assert basis.samples[:2].tolist() == [50, 9]


def test_vertices_in_no_face_have_empty_rows() -> None:
    ball = shapes.icosphere(2)
    mesh = Mesh(np.vstack([[[9, 9, 9]], ball.vertices]), ball.faces + 1)
    with pytest.raises(InvalidBasis, match="first\\[0\\] is 0, no corner"):
        poisson_basis(mesh, 12)
    basis, plain = poisson_basis(mesh, 12, first=1), poisson_basis(ball, 12)
    assert basis.cells[0] == -1
    assert not basis.functions[[0]].toarray().any()
    assert abs(basis.functions[1:] - plain.functions).max() < 1e-12
    assert basis.integrals.sum() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("cutoff", [0, 1, -0.1, 1.5, np.nan, np.inf])
def test_the_cutoff_lies_between_zero_and_one(cutoff: float) -> None:
    with pytest.raises(InvalidBasis, match="cutoff must lie between 0 and 1"):
        poisson_basis(shapes.icosphere(1), 5, cutoff=cutoff)


def test_progress_rises_to_one_and_may_abort() -> None:
    seen: list[float] = []
    poisson_basis(shapes.icosphere(2), 12, progress=seen.append)
    assert len(seen) == 24
    assert seen == sorted(seen)
    assert seen[-1] == 1

    def abort(done: float) -> None:
        if done > 0.7:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        poisson_basis(shapes.icosphere(2), 12, progress=abort)


def stored() -> dict[str, object]:
    basis = poisson_basis(shapes.icosphere(1), 12)
    return {
        "mesh": basis.mesh,
        "functions": basis.functions.copy(),
        "samples": basis.samples.copy(),
        "cells": basis.cells.copy(),
    }


def changed(name: str, change: Callable[[np.ndarray], object]) -> dict[str, object]:
    parts = stored()
    given = parts[name]
    array = given.toarray() if sparse.issparse(given) else given
    parts[name] = change(array)
    return parts


def put(position: object, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array[position] = value
        return array

    return change


def test_a_basis_comes_back_from_its_arrays() -> None:
    basis = Basis(**stored())
    again = Basis(
        basis.mesh,
        sparse.csr_array(
            (basis.functions.data, basis.functions.indices, basis.functions.indptr),
            shape=basis.functions.shape,
        ),
        basis.samples,
        basis.cells,
    )
    assert abs(again.functions - basis.functions).max() == 0
    with pytest.raises(ValueError, match="read-only"):
        again.functions.data[0] = 1


@pytest.mark.parametrize(
    ("parts", "index", "words"),
    [
        (changed("functions", lambda b: b[:-1]), None, "one row for each of 42"),
        (changed("functions", lambda b: b[:, :0]), None, "one row for each"),
        (changed("functions", lambda b: b[:, 0]), None, "functions"),
        (changed("functions", put((5, 3), np.nan)), 3, "function 3 has the value nan"),
        (changed("functions", put((5, 3), -0.5)), 3, "function 3 has the value -0.5"),
        (changed("functions", lambda b: b * (1 + 1e-11)), 0, "the functions sum to 1.0"),
        (changed("functions", lambda b: np.column_stack([b, np.zeros(42)])), 12, "function 12 is zero"),
        (changed("samples", lambda s: s[:-1]), None, "samples must be 12 integers"),
        (changed("samples", put(4, 42)), 4, "samples\\[4\\] is 42"),
        (changed("cells", lambda c: c.astype(float)), None, "cells must be 42 integers"),
        (changed("cells", put(7, 12)), 7, "cells\\[7\\] is 12"),
        (changed("cells", put(7, -1)), 7, "cells\\[7\\] is -1"),
    ],
)
def test_broken_arrays_are_refused(parts: dict[str, object], index: int | None, words: str) -> None:
    with pytest.raises(InvalidBasis, match=words) as refusal:
        Basis(**parts)
    assert refusal.value.index == index


def test_broken_sparse_structure_is_refused() -> None:
    parts = stored()
    functions = parts["functions"]
    functions.indices[0] = 99
    with pytest.raises(InvalidBasis, match="no sparse matrix"):
        Basis(**parts)


FOLDERS = ["boundary", "closed", "components", "degenerate", "genus", "nonmanifold", "polygons", "tiny"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_every_real_mesh_has_a_basis_or_a_clear_refusal(folder: str, data: Path) -> None:
    refused = []
    paths = sorted((data / "robust" / folder).iterdir())
    for path in paths:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what the reader of files says is not our concern here
                mesh = shapes.load(path)
        except InvalidMesh as refusal:
            assert refusal.value is not None
            refused.append(path.name)
            continue
        size = max(min(20, int(mesh.referenced.sum())), mesh.n_components)
        first = int(np.flatnonzero(mesh.referenced)[0])
        basis = poisson_basis(mesh, size, first=first)
        np.testing.assert_allclose(
            basis.functions.sum(axis=1), mesh.referenced, atol=1e-14, err_msg=path.name
        )
        np.testing.assert_allclose(basis.overlap.sum(axis=1), 1, atol=1e-12, err_msg=path.name)
        assert mesh.euler_characteristic == mesh.referenced.sum() - len(mesh.edges) + mesh.n_faces
    assert set(refused) <= {"Spider_binary.stl", "tetris.obj"}, refused
    assert len(refused) < len(paths)
