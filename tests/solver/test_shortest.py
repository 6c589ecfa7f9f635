"""Shortest paths over triangles: straight where they can be, taut about corners where they cannot."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse import csgraph

from solver.errors import SolverError
from solver.mesh import Mesh
from solver.shortest import Pieces, SurfacePoints, shortest_path
from solver.walks import layout
from tests.solver import shapes

#: Sums of a hundred pieces.
ROUNDING = 1e-10


def at_vertices(mesh: Mesh, vertices: list[int]) -> SurfacePoints:
    places = [np.argwhere(mesh.faces == v)[0] for v in vertices]
    return SurfacePoints(np.array([f for f, _ in places]), np.array([np.eye(3)[k] for _, k in places]))


def ends(mesh: Mesh, pieces: Pieces) -> tuple[np.ndarray, np.ndarray]:
    corners = mesh.unit_vertices[mesh.faces[pieces.faces]]
    return np.einsum("kc,kcx->kx", pieces.start, corners), np.einsum("kc,kcx->kx", pieces.end, corners)


def path(mesh: Mesh, points: SurfacePoints) -> tuple[Pieces, float]:
    """The path, checked to hang together, and its length."""
    pieces = shortest_path(layout(mesh), points)
    start, end = ends(mesh, pieces)
    np.testing.assert_allclose(start[1:], end[:-1], atol=ROUNDING)
    for barycentric in (pieces.start, pieces.end):
        assert (barycentric >= 0).all()
        np.testing.assert_allclose(barycentric.sum(axis=1), 1, atol=ROUNDING)
    steps = np.linalg.norm(end - start, axis=1)
    assert (steps > 0).all()
    return pieces, float(steps.sum())


def notched() -> Mesh:
    """A square of side 2 without its upper right quarter."""
    whole = shapes.grid(8, 8, width=2.0, height=2.0)
    centres = whole.vertices[whole.faces].mean(axis=1)
    kept = whole.faces[(centres[:, 0] < 1) | (centres[:, 1] < 1)]
    used = np.unique(kept)
    return Mesh(whole.vertices[used], np.searchsorted(used, kept))


def test_in_the_plane_paths_are_straight(rng: np.random.Generator) -> None:
    mesh = shapes.grid(9, 12, width=1.3)
    for _ in range(30):
        points = SurfacePoints(rng.integers(0, mesh.n_faces, 2), rng.dirichlet(np.ones(3), 2))
        corners = mesh.unit_vertices[mesh.faces[points.faces]]
        a, b = np.einsum("kc,kcx->kx", points.barycentric, corners)
        pieces, length = path(mesh, points)
        start, end = ends(mesh, pieces)
        np.testing.assert_allclose([start[0], end[-1]], [a, b], atol=ROUNDING)
        assert length == pytest.approx(np.linalg.norm(b - a), abs=ROUNDING)


def test_between_vertices_of_the_plane_too(rng: np.random.Generator) -> None:
    mesh = shapes.grid(9, 12, width=1.3)
    for _ in range(30):
        a, b = rng.choice(mesh.n_vertices, 2, replace=False).tolist()
        _, length = path(mesh, at_vertices(mesh, [a, b]))
        exact = np.linalg.norm(mesh.unit_vertices[a] - mesh.unit_vertices[b])
        assert length == pytest.approx(exact, abs=ROUNDING)


def test_about_a_corner_paths_are_taut() -> None:
    mesh = notched()

    def vertex(x: float, y: float) -> int:
        return int(np.linalg.norm(mesh.vertices - [x, y, 0], axis=1).argmin())

    _, length = path(mesh, at_vertices(mesh, [vertex(2, 1), vertex(1, 2)]))
    assert length * mesh.length_scale == pytest.approx(2)
    _, length = path(mesh, at_vertices(mesh, [vertex(2, 0.5), vertex(0.75, 2)]))
    exact = np.hypot(1, 0.5) + np.hypot(0.25, 1)
    assert length * mesh.length_scale == pytest.approx(exact)


@pytest.mark.parametrize("make", [shapes.icosphere, shapes.torus, lambda: shapes.fibonacci_sphere(700)])
def test_paths_are_shorter_than_along_edges(make, rng: np.random.Generator) -> None:  # type: ignore[no-untyped-def]
    mesh = make()
    lengths = np.linalg.norm(np.diff(mesh.unit_vertices[mesh.edges], axis=1)[:, 0], axis=1)
    graph = sparse.csr_array((lengths, tuple(mesh.edges.T)), shape=(mesh.n_vertices, mesh.n_vertices))
    for _ in range(10):
        a, b = rng.choice(mesh.n_vertices, 2, replace=False).tolist()
        _, length = path(mesh, at_vertices(mesh, [a, b]))
        along_edges = csgraph.dijkstra(graph, directed=False, indices=a)[b]
        assert np.linalg.norm(mesh.unit_vertices[a] - mesh.unit_vertices[b]) <= length + ROUNDING
        assert length <= along_edges + ROUNDING


def test_on_the_sphere_paths_are_great_circles(rng: np.random.Generator) -> None:
    mesh = shapes.icosphere(4)
    for _ in range(10):
        a, b = rng.choice(mesh.n_vertices, 2, replace=False).tolist()
        _, length = path(mesh, at_vertices(mesh, [a, b]))
        angle = np.arccos(np.clip(mesh.vertices[a] @ mesh.vertices[b], -1, 1))
        assert length == pytest.approx(angle * np.sqrt(1 / (4 * np.pi)), rel=0.005)


def test_an_edge_is_walked_half_in_each_of_its_faces() -> None:
    mesh = shapes.icosphere(1)
    a, b = mesh.edges[7].tolist()
    pieces, _ = path(mesh, at_vertices(mesh, [a, b]))
    beside = np.flatnonzero(((mesh.faces == a) | (mesh.faces == b)).sum(axis=1) == 2)
    assert sorted(pieces.faces.tolist()) == beside.tolist()
    start, end = ends(mesh, pieces)
    np.testing.assert_allclose(start[0], mesh.unit_vertices[a], atol=ROUNDING)
    np.testing.assert_allclose(end[0], mesh.unit_vertices[[a, b]].mean(axis=0), atol=ROUNDING)


def test_a_boundary_edge_has_one_face() -> None:
    mesh = shapes.grid(2, 2)
    pieces, _ = path(mesh, at_vertices(mesh, [0, 1]))
    assert len(pieces.faces) == 1


def test_in_one_face_a_path_is_one_piece() -> None:
    mesh = shapes.icosphere(2)
    points = SurfacePoints(np.array([9, 9]), np.array([[0.2, 0.3, 0.5], [0.6, 0.3, 0.1]]))
    pieces, _ = path(mesh, points)
    assert pieces.faces.tolist() == [9]
    np.testing.assert_allclose([pieces.start[0], pieces.end[0]], points.barycentric)


def test_a_path_goes_through_all_its_points() -> None:
    mesh = shapes.icosphere(3)
    stops = [0, 100, 33, 33, 500]
    pieces, _ = path(mesh, at_vertices(mesh, stops))
    start, _ = ends(mesh, pieces)
    for stop in stops[:-1]:
        assert np.linalg.norm(start - mesh.unit_vertices[stop], axis=1).min() < ROUNDING


def test_one_point_makes_no_pieces() -> None:
    pieces = shortest_path(layout(shapes.icosphere(1)), at_vertices(shapes.icosphere(1), [3]))
    assert pieces.faces.size == 0
    assert pieces.start.shape == (0, 3)


@pytest.mark.parametrize(
    ("mesh", "begin", "end"),
    [
        (shapes.together(shapes.icosphere(1), shapes.icosphere(1)), 2, 60),
        (shapes.hourglass(), 2, 4),
        (shapes.book(), 2, 4),
    ],
)
def test_points_that_no_edges_connect_are_refused(mesh: Mesh, begin: int, end: int) -> None:
    with pytest.raises(SolverError, match="points 1 and 2 of the path are not connected") as refusal:
        shortest_path(layout(mesh), at_vertices(mesh, [begin, begin, end]))
    assert refusal.value.index == 2


@pytest.mark.parametrize("make", [shapes.moebius, shapes.torus])
def test_paths_bend_nowhere_but_at_corners_they_cannot_pass(make, rng: np.random.Generator) -> None:  # type: ignore[no-untyped-def]
    """Any crossing moved along its edge makes the path longer."""
    mesh = make()
    a, b = rng.choice(mesh.n_vertices, 2, replace=False).tolist()
    pieces, _length = path(mesh, at_vertices(mesh, [a, b]))
    start, end = ends(mesh, pieces)
    for k in range(len(start) - 1):
        edge = [v for v in mesh.faces[pieces.faces[k]] if v in mesh.faces[pieces.faces[k + 1]]]
        if len(edge) != 2:
            continue
        along = mesh.unit_vertices[edge[1]] - mesh.unit_vertices[edge[0]]
        for nudge in (-1e-3, 1e-3):
            moved = end[k] + nudge * along
            share = (moved - mesh.unit_vertices[edge[0]]) @ along / (along @ along)
            if 0 <= share <= 1:
                before = np.linalg.norm(end[k] - start[k]) + np.linalg.norm(end[k + 1] - start[k + 1])
                after = np.linalg.norm(moved - start[k]) + np.linalg.norm(end[k + 1] - moved)
                assert after > before - ROUNDING
