"""Meshes: what is measured exactly, what is refused with its culprit, and what is only reported."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from solver.errors import InvalidMesh
from solver.mesh import Mesh
from tests.solver import shapes

SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
HALVES = [[0, 1, 2], [0, 2, 3]]

MAKERS: list[Callable[[], Mesh]] = [
    shapes.triangle,
    shapes.tetrahedron,
    shapes.icosphere,
    shapes.grid,
    shapes.torus,
    shapes.moebius,
    shapes.hourglass,
    shapes.book,
]


def test_a_triangle_is_measured_exactly() -> None:
    mesh = shapes.triangle()
    assert (mesh.n_vertices, mesh.n_faces, mesh.area, mesh.length_scale) == (3, 1, 1.0, 1.0)
    np.testing.assert_allclose(mesh.unit_vertices, mesh.vertices - np.array([2 / 3, 1 / 3, 0]), atol=1e-15)
    np.testing.assert_array_equal(mesh.face_areas, [1.0])
    np.testing.assert_allclose(mesh.frames, [[[1, 0, 0], [0, 1, 0]]], atol=1e-15)
    np.testing.assert_allclose(mesh.normals, [[0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(mesh.edges, [[0, 1], [0, 2], [1, 2]])


@pytest.mark.parametrize(
    ("make", "components", "loops", "euler"),
    [
        (shapes.triangle, 1, 1, 1),
        (shapes.tetrahedron, 1, 0, 2),
        (shapes.icosphere, 1, 0, 2),
        (shapes.grid, 1, 1, 1),
        (shapes.torus, 1, 0, 0),
        (shapes.moebius, 1, 1, 0),
        (shapes.hourglass, 1, 2, 1),
        (lambda: shapes.together(shapes.torus(), shapes.grid(), shapes.tetrahedron()), 3, 1, 3),
    ],
)
def test_topology_is_counted(make: Callable[[], Mesh], components: int, loops: int, euler: int) -> None:
    mesh = make()
    assert (mesh.n_components, mesh.n_boundary_loops, mesh.euler_characteristic) == (components, loops, euler)


def test_components_are_numbered_by_their_lowest_vertex() -> None:
    vertices = np.arange(27.0).reshape(9, 3) ** 1.5
    mesh = Mesh(vertices, [[8, 4, 6], [1, 7, 2]])
    assert mesh.components.tolist() == [-1, 0, 0, -1, 1, -1, 1, 0, 1]
    assert mesh.n_components == 2


@pytest.mark.parametrize(
    ("vertices", "faces", "index", "value", "words"),
    [
        ([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]], None, "(3, 2)", "shape"),
        (SQUARE, [[0, 1, 2, 3]], None, "(1, 4)", "shape"),
        (SQUARE, [0, 1, 2], None, "(3,)", "shape"),
        (np.zeros((0, 3)), HALVES, None, 0, "no vertices"),
        (SQUARE, np.zeros((0, 3), int), None, 0, "no faces"),
        (SQUARE, [], None, 0, "no faces"),
        ([["a", "b", "c"]] * 3, [[0, 1, 2]], None, "<U1", "real numbers"),
        (np.ones((3, 3), complex), [[0, 1, 2]], None, "complex128", "real numbers"),
        (SQUARE, [[True, False, True]], None, "bool", "integers"),
        ([*SQUARE[:2], [np.nan, 0, 0]], [[0, 1, 2]], 2, "[nan, 0.0, 0.0]", "vertex 2 is not finite"),
        ([*SQUARE, [0, -np.inf, 0]], HALVES, 4, "[0.0, -inf, 0.0]", "vertex 4 is not finite"),
        (SQUARE, [[0, 1, 2], [0, 2, 4]], 1, 4, "vertex 4"),
        (SQUARE, [[0, 1, 2], [0, 2, -1]], 1, -1, "vertex -1"),
        (SQUARE, [[0, 1, 2], [0.5, 2, 3]], 1, 0.5, "vertex 0.5"),
        (SQUARE, [[0, 1, 2], [0, 2, 1e300]], 1, 1e300, "vertex 1e\\+300"),
        (SQUARE, np.array([[0, 1, 2**63]], dtype=np.uint64), 0, 2**63, str(2**63)),
        (SQUARE, [[0, 1, 2], [3, 0, 3]], 1, "[3, 0, 3]", "repeats a vertex"),
        ([*SQUARE, [0.5, 0, 0]], [*HALVES, [0, 4, 1]], 2, None, "face 2 has zero area"),
        ([[1, 2, 3]] * 3, [[0, 1, 2]], 0, None, "face 0 has zero area"),
        ([[0, 0, 0], [0.1, 0.1, 0.1], [0.3, 0.3, 0.3]], [[0, 1, 2]], 0, None, "zero area"),
        (np.array(SQUARE) * 1e308, HALVES, None, np.inf, "out of range"),
        (np.array(SQUARE) * 1e155, HALVES, None, np.inf, "out of range"),
        (np.array(SQUARE) * 1e-165, HALVES, None, 0.0, "out of range"),
    ],
)
def test_what_cannot_be_measured_is_refused_with_its_culprit(
    vertices: object, faces: object, index: int | None, value: object, words: str
) -> None:
    with pytest.raises(InvalidMesh, match=words) as refusal:
        Mesh(vertices, faces)
    assert refusal.value.index == index
    assert refusal.value.value is not None
    if value is not None:
        assert refusal.value.value == value


def test_ragged_lists_are_refused() -> None:
    with pytest.raises(InvalidMesh, match="no \\(V, 3\\) array"):
        Mesh([[0, 0, 0], [1, 0]], [[0, 1, 2]])
    with pytest.raises(InvalidMesh, match="no \\(F, 3\\) array"):
        Mesh(SQUARE, [[0, 1, 2], [0, 1]])


@pytest.mark.parametrize("degrees", [1e-1, 1e-5, 1e-9, 1e-12])
def test_needles_have_area(degrees: float) -> None:
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [1, np.radians(degrees), 0]], [[0, 1, 2]])
    assert mesh.area == pytest.approx(np.radians(degrees) / 2, rel=1e-12)
    np.testing.assert_allclose(mesh.frames @ mesh.frames.transpose(0, 2, 1), [np.eye(2)], atol=1e-14)


@pytest.mark.parametrize("height", [1e-7, 1e-13])
def test_caps_have_right_frames_whatever_their_corners_order(height: float) -> None:
    corners = np.array([[0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5 + height]])
    for turn in range(3):
        frame = Mesh(corners, [np.roll([0, 1, 2], turn)]).frames[0]
        np.testing.assert_allclose(frame @ frame.T, np.eye(2), atol=1e-14)


@pytest.mark.parametrize(
    ("make", "warning"),
    [
        (shapes.book, "1 edge with more than two faces; the first joins 0 and 1."),
        (shapes.hourglass, "1 vertex where surfaces only touch; the first is 0."),
        (shapes.moebius, "4 edges whose two faces are oriented differently; the first joins 0 and 1."),
        (
            lambda: Mesh(SQUARE, [*HALVES, [2, 0, 1], [1, 2, 3]]),
            "1 face on the same corners as an earlier one; the first is 2.",
        ),
        (
            lambda: Mesh([*SQUARE[:3], *[[9, 9, 9]] * 2], [[0, 1, 2]]),
            "2 vertices in no face; the first is 3.",
        ),
    ],
)
def test_what_is_odd_is_reported_and_accepted(make: Callable[[], Mesh], warning: str) -> None:
    assert warning in make().warnings


@pytest.mark.parametrize("make", [shapes.triangle, shapes.icosphere, shapes.grid, shapes.torus])
def test_ordinary_meshes_have_no_warnings(make: Callable[[], Mesh]) -> None:
    assert make().warnings == ()


def test_arrays_are_copied_and_read_only() -> None:
    vertices = np.array(SQUARE, dtype=float)
    mesh = Mesh(vertices, np.array(HALVES))
    vertices[0] = 7
    assert mesh.vertices[0].tolist() == [0, 0, 0]
    for name in ("vertices", "faces", "unit_vertices", "face_areas", "frames", "components", "edges"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(mesh, name)[0] = 0


def test_whole_numbers_of_any_type_are_indices() -> None:
    for kind in (np.int8, np.uint32, np.float64):
        assert Mesh(np.array(SQUARE, np.float32), np.array(HALVES, kind)).faces.dtype == np.int64


def test_unreferenced_vertices_do_not_move_the_mesh() -> None:
    plain, loose = Mesh(SQUARE, HALVES), Mesh([*SQUARE, [1e308, -1e308, 5]], HALVES)
    np.testing.assert_array_equal(loose.unit_vertices, [*plain.unit_vertices, [0, 0, 0]])
    np.testing.assert_array_equal(loose.frames, plain.frames)
    assert loose.area == plain.area
    assert loose.components.tolist() == [0, 0, 0, 0, -1]
    assert loose.euler_characteristic == 1


@given(exponent=st.integers(-500, 500), seed=st.integers(0, 99))
def test_scaling_by_a_power_of_two_changes_no_bit(exponent: int, seed: int) -> None:
    mesh = shapes.moved(shapes.tetrahedron(), np.random.default_rng(seed))
    scaled = Mesh(np.ldexp(mesh.vertices, exponent), mesh.faces)
    assert scaled.area == np.ldexp(mesh.area, 2 * exponent)
    np.testing.assert_array_equal(scaled.unit_vertices, mesh.unit_vertices)
    np.testing.assert_array_equal(scaled.face_areas, mesh.face_areas)


@pytest.mark.parametrize("scale", [1e-150, 1e-9, 3.0, 1e9, 1e150])
@pytest.mark.parametrize("make", MAKERS)
def test_the_unit_mesh_forgets_position_and_scale(
    make: Callable[[], Mesh], scale: float, rng: np.random.Generator
) -> None:
    mesh = make()
    moved = shapes.moved(mesh, rng, scale)
    assert moved.area == pytest.approx(scale**2 * mesh.area, rel=1e-12)
    assert moved.face_areas.sum() == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(moved.face_areas, mesh.face_areas, rtol=1e-10)
    distances, unmoved = (
        np.linalg.norm(m.unit_vertices[:, None] - m.unit_vertices[None], axis=2) for m in (moved, mesh)
    )
    np.testing.assert_allclose(distances, unmoved, atol=1e-12)
    centroid = moved.face_areas @ moved.unit_vertices[moved.faces].mean(axis=1)
    np.testing.assert_allclose(centroid, 0, atol=1e-13)


@pytest.mark.parametrize("make", MAKERS)
def test_frames_are_orthonormal_and_right_handed(make: Callable[[], Mesh]) -> None:
    mesh = make()
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.normals, outward, atol=1e-12)
    np.testing.assert_allclose(np.cross(mesh.frames[:, 0], mesh.frames[:, 1]), outward, atol=1e-12)
    gram = np.einsum("fsx,ftx->fst", mesh.frames, mesh.frames)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(2), gram.shape), atol=1e-14)


def test_far_from_the_origin_small_faces_keep_their_shape() -> None:
    corner = np.array([2.0**20, -(2.0**20), 2.0**20])
    near, far = shapes.grid(4, 4), Mesh(shapes.grid(4, 4).vertices + corner, shapes.grid(4, 4).faces)
    np.testing.assert_array_equal(far.opposite_edges, near.opposite_edges)


def test_a_mesh_survives_pickling() -> None:
    mesh = pickle.loads(pickle.dumps(shapes.torus()))
    assert mesh.euler_characteristic == 0
