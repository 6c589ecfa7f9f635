"""Finite elements: one triangle by hand, exactness on linear functions, convergence on the sphere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from solver import fem
from solver.mesh import Mesh
from tests.solver import shapes

MAKERS: list[Callable[[], Mesh]] = [
    shapes.tetrahedron,
    shapes.icosphere,
    shapes.grid,
    shapes.torus,
    shapes.moebius,
    shapes.hourglass,
    shapes.book,
    lambda: shapes.together(shapes.icosphere(1), shapes.grid(3, 3)),
]


def test_one_triangle_by_hand() -> None:
    mesh = shapes.triangle()  # legs 2 and 1, area 1
    np.testing.assert_allclose(fem.hat_gradients(mesh), [[[-0.5, -1, 0], [0.5, 0, 0], [0, 1, 0]]], atol=1e-15)
    np.testing.assert_allclose(fem.mass(mesh), [1 / 3, 1 / 3, 1 / 3], rtol=1e-15)
    expected = [[1.25, -0.25, -1], [-0.25, 0.25, 0], [-1, 0, 1]]
    np.testing.assert_allclose(fem.stiffness(mesh).toarray(), expected, atol=1e-15)
    np.testing.assert_allclose(fem.intrinsic_delaunay_stiffness(mesh).toarray(), expected, atol=1e-12)
    np.testing.assert_allclose(fem.face_mean(mesh).toarray(), [[1 / 3, 1 / 3, 1 / 3]], rtol=1e-15)


@pytest.mark.parametrize("make", MAKERS)
def test_gradients_of_linear_functions_are_exact(make: Callable[[], Mesh]) -> None:
    mesh = make()
    values = mesh.unit_vertices[mesh.faces]  # (F, corner, coordinate)
    gradients = np.einsum("fcx,fcd->fdx", fem.hat_gradients(mesh), values)
    tangential = np.eye(3) - mesh.normals[:, :, None] * mesh.normals[:, None, :]
    np.testing.assert_allclose(gradients, tangential, atol=1e-12)


@pytest.mark.parametrize("make", MAKERS)
def test_stiffness_is_the_sum_over_faces_of_gradient_products(make: Callable[[], Mesh]) -> None:
    mesh = make()
    dense = np.zeros((mesh.n_vertices, mesh.n_vertices))
    for face, gradients, area in zip(mesh.faces, fem.hat_gradients(mesh), mesh.face_areas, strict=True):
        dense[np.ix_(face, face)] += area * gradients @ gradients.T
    stiffness = fem.stiffness(mesh).toarray()
    np.testing.assert_allclose(stiffness, dense, atol=1e-13 * np.abs(dense).max())
    np.testing.assert_array_equal(stiffness, stiffness.T)


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("laplacian", [fem.stiffness, fem.intrinsic_delaunay_stiffness])
def test_constants_and_nothing_else_are_in_the_kernel(
    make: Callable[[], Mesh], laplacian: Callable[[Mesh], object]
) -> None:
    mesh = make()
    values, vectors = np.linalg.eigh(laplacian(mesh).toarray())
    assert values[0] > -1e-12
    kernel = vectors[:, values < 1e-9]
    assert kernel.shape[1] == mesh.n_components
    indicators = mesh.components[:, None] == np.arange(mesh.n_components)
    np.testing.assert_allclose(kernel @ (kernel.T @ indicators), indicators, atol=1e-9)


@pytest.mark.parametrize("make", MAKERS)
def test_masses_and_face_means_keep_integrals(make: Callable[[], Mesh], rng: np.random.Generator) -> None:
    mesh = make()
    f = rng.normal(size=mesh.n_vertices)
    assert fem.mass(mesh).sum() == pytest.approx(1, abs=1e-14)
    assert mesh.face_areas @ (fem.face_mean(mesh) @ f) == pytest.approx(fem.mass(mesh) @ f, abs=1e-14)


def test_unreferenced_vertices_have_empty_rows() -> None:
    mesh = Mesh(np.insert(shapes.grid(3, 3).vertices, 5, 9, axis=0), _skipping(shapes.grid(3, 3).faces, 5))
    assert fem.mass(mesh)[5] == 0
    for matrix in (fem.stiffness(mesh), fem.intrinsic_delaunay_stiffness(mesh)):
        assert not matrix[[5]].toarray().any()
        assert not matrix[:, [5]].toarray().any()


def test_the_sphere_laplacian_converges_with_the_square_of_the_edge() -> None:
    # Coordinates are eigenfunctions; on the sphere of area 1 their eigenvalue is 2 / R² = 8π.
    errors = []
    for subdivisions in (2, 3, 4):
        mesh = shapes.icosphere(subdivisions)
        z = mesh.unit_vertices[:, 2]
        quotient = z @ (fem.stiffness(mesh) @ z) / (fem.mass(mesh) @ z**2)
        errors.append(abs(quotient / (8 * np.pi) - 1))
    slopes = -np.diff(np.log2(errors))
    assert errors[-1] < 2e-3
    assert ((slopes > 1.9) & (slopes < 2.1)).all(), slopes


def test_on_a_sheared_plane_delaunay_edges_have_no_positive_entries_and_keep_linear_functions() -> None:
    flat = shapes.grid(16, 16)
    sheared = Mesh(flat.vertices @ np.array([[1, 0, 0], [4, 1, 0], [0, 0, 1]]), flat.faces)
    cotangent, delaunay = (
        fem.stiffness(sheared).toarray(),
        fem.intrinsic_delaunay_stiffness(sheared).toarray(),
    )
    assert np.triu(cotangent, 1).max() > 1  # the triangles are obtuse
    assert np.triu(delaunay, 1).max() <= 0
    deep = (np.abs(flat.vertices[:, :2] - 0.5) < 0.2).all(axis=1)
    assert np.abs(cotangent - delaunay)[deep].max() > 1
    np.testing.assert_allclose((delaunay @ sheared.unit_vertices)[deep], 0, atol=1e-9)


def test_on_a_delaunay_mesh_both_laplacians_agree() -> None:
    mesh = shapes.fibonacci_sphere(300)
    cotangent, delaunay = fem.stiffness(mesh), fem.intrinsic_delaunay_stiffness(mesh)
    assert abs(cotangent - delaunay).max() < 1e-10


@pytest.mark.parametrize("scale", [1e-120, 1e120])
def test_elements_forget_the_unit_of_length(scale: float) -> None:
    mesh, scaled = shapes.torus(), Mesh(shapes.torus().vertices * scale, shapes.torus().faces)
    np.testing.assert_allclose(fem.hat_gradients(scaled), fem.hat_gradients(mesh), atol=1e-11)
    assert abs(fem.stiffness(scaled) - fem.stiffness(mesh)).max() < 1e-12
    np.testing.assert_allclose(fem.mass(scaled), fem.mass(mesh), rtol=1e-12)


def _skipping(faces: np.ndarray, vertex: int) -> np.ndarray:
    return faces + (faces >= vertex)
