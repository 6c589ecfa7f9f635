"""Distances, samples and cells: exact in the plane, convergent on the sphere, the same however found."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import potpourri3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import Delaunay

from solver.errors import InvalidBasis, InvalidMesh
from solver.geodesics import SHORTER, TIE, distances_from, farthest_point_samples
from solver.mesh import Mesh
from tests.solver import shapes

MAKERS: list[Callable[[], Mesh]] = [
    shapes.icosphere,
    shapes.grid,
    shapes.torus,
    shapes.moebius,
    shapes.hourglass,
    shapes.book,
    lambda: shapes.together(shapes.icosphere(1), shapes.grid(3, 3), shapes.triangle()),
]
SPHERE_RADIUS = 1 / np.sqrt(4 * np.pi)


def great_circles(sphere: Mesh, vertex: int) -> np.ndarray:
    return SPHERE_RADIUS * np.arccos(np.clip(sphere.vertices @ sphere.vertices[vertex], -1, 1))


def along_edges(mesh: Mesh, vertex: int) -> np.ndarray:
    a, b = mesh.edges.T
    lengths = np.linalg.norm(mesh.unit_vertices[a] - mesh.unit_vertices[b], axis=1)
    graph = sparse.coo_array((lengths, (a, b)), shape=(mesh.n_vertices, mesh.n_vertices)).tocsr()
    return csgraph.dijkstra(graph, directed=False, indices=vertex)


@pytest.mark.parametrize(("squash", "tolerance"), [(1.0, 1e-7), (0.1, 1e-6), (0.01, 1e-2)])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_in_a_convex_piece_of_the_plane_distances_are_exact(
    squash: float, tolerance: float, seed: int
) -> None:
    # Squashed 100 times, fronts that pass each vertex once err by 0.5; worst of 1500 seeds here: 1e-3.
    points = np.random.default_rng(seed).uniform(size=(40, 2))
    triangles = Delaunay(points).simplices
    flat = np.column_stack([points * [1, squash], np.zeros(len(points))])
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    thick = np.abs(np.cross(b - a, c - a)[:, 2]) > 1e-12
    mesh = Mesh(flat, triangles[thick])
    exact = np.linalg.norm(mesh.unit_vertices - mesh.unit_vertices[0], axis=1)
    np.testing.assert_allclose(distances_from(mesh, 0), exact, atol=tolerance)


def test_across_the_fold_of_a_book_pages_are_as_good_as_flat() -> None:
    mesh = shapes.book()
    distances = distances_from(mesh, 2) * mesh.length_scale
    np.testing.assert_allclose(distances, [1.25**0.5, 1.25**0.5, 0, 2, 2], rtol=1e-14)


@pytest.mark.parametrize("make", MAKERS)
def test_geodesics_are_no_shorter_than_chords_and_no_longer_than_edge_paths(make: Callable[[], Mesh]) -> None:
    mesh = make()
    distances = distances_from(mesh, 0)
    chords = np.linalg.norm(mesh.unit_vertices - mesh.unit_vertices[0], axis=1)
    reached = mesh.components == mesh.components[0]
    assert (distances[reached] <= along_edges(mesh, 0)[reached] * (1 + 1e-12)).all()
    assert (distances[reached] >= chords[reached] * (1 - 1e-12)).all()
    assert np.isinf(distances[~reached]).all()


def test_on_spheres_distances_converge() -> None:
    sizes = np.array([500, 2000, 8000])
    everywhere, nearby = [], []
    for size in sizes:
        sphere = shapes.fibonacci_sphere(size)
        exact = great_circles(sphere, 0)
        errors = distances_from(sphere, 0) - exact
        everywhere.append(np.sqrt(np.mean(errors**2)))
        nearby.append(np.abs(errors[exact < 0.1]).max())
    slope = np.polyfit(np.log(sizes**-0.5), np.log(everywhere), 1)[0]
    assert everywhere[-1] < 2e-3
    assert max(nearby) < 2e-4
    assert slope > 0.8


def test_fronts_end_even_among_triangles_that_contradict_each_other() -> None:
    # Sizes from 1e-8 to 1e8 in one tangle: without an end, fronts went round the tiny ones for ever.
    rng = np.random.default_rng(361)
    size = int(rng.integers(4, 60))
    vertices = rng.normal(size=(size, 3)) * 10.0 ** rng.uniform(-8, 8, size=(size, 1))
    faces = rng.integers(0, size, size=(2 * size, 3))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    longest = np.max([np.linalg.norm(e, axis=1) for e in (a - b, b - c, c - a)], axis=0)
    mesh = Mesh(vertices, faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-13 * longest**2])
    for vertex in np.flatnonzero(mesh.referenced):
        distances = distances_from(mesh, vertex)
        assert (distances <= along_edges(mesh, vertex) + 1e-12).all()


@pytest.mark.parametrize("make", [shapes.icosphere, shapes.torus, lambda: shapes.grid(20, 20)])
def test_the_heat_method_agrees(make: Callable[[], Mesh]) -> None:
    mesh = make()
    heat = potpourri3d.MeshHeatMethodDistanceSolver(mesh.unit_vertices, mesh.faces).compute_distance(0)
    assert np.sqrt(np.mean((distances_from(mesh, 0) - heat) ** 2)) < 0.03


@pytest.mark.parametrize("vertex", [-1, 3, 99])
def test_a_source_must_be_a_corner_of_a_face(vertex: int) -> None:
    mesh = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2]])
    with pytest.raises(InvalidMesh, match=f"vertex {vertex} is no corner") as refusal:
        distances_from(mesh, vertex)
    assert refusal.value.index == vertex


@pytest.mark.parametrize("make", [*MAKERS, lambda: shapes.fibonacci_sphere(400)])
def test_samples_and_cells_are_those_of_complete_fronts(make: Callable[[], Mesh]) -> None:
    mesh = make()
    size = min(25, mesh.n_vertices)
    samples = farthest_point_samples(mesh, size)
    nearest = np.full(mesh.n_vertices, np.inf)
    for k, vertex in enumerate(samples.vertices):
        if k > 0:
            ties = np.flatnonzero(nearest >= nearest.max() * (1 - TIE))
            assert vertex == ties[0]
        nearest = np.minimum(nearest, distances_from(mesh, vertex))
    np.testing.assert_allclose(samples.distances, nearest, rtol=10 * SHORTER)
    own = np.array([distances_from(mesh, vertex) for vertex in samples.vertices])
    at_cell = own[samples.cells, np.arange(mesh.n_vertices)]
    np.testing.assert_allclose(at_cell, nearest, rtol=3 * TIE, atol=1e-15)


@pytest.mark.parametrize("source", ["closed/spot_triangulated.obj", "degenerate/octagonal_pocket.ply"])
def test_on_real_meshes_stopped_fronts_lose_nothing(source: str, data: Path) -> None:
    mesh = shapes.load(data / "robust" / source)
    samples = farthest_point_samples(mesh, 60)
    nearest = np.min([distances_from(mesh, vertex) for vertex in samples.vertices], axis=0)
    np.testing.assert_allclose(samples.distances, nearest, rtol=10 * SHORTER)


def test_tied_corners_of_a_square_are_taken_in_order() -> None:
    mesh = shapes.grid(4, 4)
    assert farthest_point_samples(mesh, 5).vertices.tolist() == [0, 24, 4, 20, 12]


@given(seed=st.integers(0, 10**6), exponent=st.floats(-100, 100))
@settings(max_examples=20, deadline=None)
def test_even_symmetric_meshes_keep_their_samples_when_moved(seed: int, exponent: float) -> None:
    mesh = shapes.icosphere(2)
    moved = shapes.moved(mesh, np.random.default_rng(seed), 10.0**exponent)
    still, turned = farthest_point_samples(mesh, 30), farthest_point_samples(moved, 30)
    np.testing.assert_array_equal(turned.vertices, still.vertices)
    np.testing.assert_array_equal(turned.cells, still.cells)
    np.testing.assert_allclose(turned.distances, still.distances, rtol=1e-9, atol=1e-15)


def test_the_same_question_has_the_same_bits() -> None:
    mesh = shapes.fibonacci_sphere(500)
    one, other = farthest_point_samples(mesh, 50), farthest_point_samples(mesh, 50)
    for name in ("vertices", "cells", "distances"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_every_component_gets_a_sample_and_loose_vertices_none() -> None:
    pair = shapes.together(shapes.icosphere(1), shapes.grid(3, 3))
    mesh = Mesh([*pair.vertices, [0, 0, 9]], pair.faces)
    samples = farthest_point_samples(mesh, 2)
    assert samples.vertices.tolist() == [0, 42]
    assert samples.cells.tolist() == mesh.components.tolist()
    assert np.isinf(samples.distances[-1])
    assert np.isfinite(samples.distances[:-1]).all()


def test_every_vertex_can_be_a_sample() -> None:
    mesh = shapes.icosphere(1)
    samples = farthest_point_samples(mesh, mesh.n_vertices)
    assert sorted(samples.vertices) == list(range(mesh.n_vertices))
    np.testing.assert_array_equal(samples.vertices[samples.cells], np.arange(mesh.n_vertices))
    assert not samples.distances.any()


def test_the_given_samples_come_first_and_in_order() -> None:
    mesh = shapes.icosphere(2)
    assert farthest_point_samples(mesh, 8, [40, 3, 17]).vertices[:3].tolist() == [40, 3, 17]
    assert farthest_point_samples(mesh, 3, np.array([40, 3, 17])).vertices.tolist() == [40, 3, 17]


@pytest.mark.parametrize(
    ("size", "first", "index", "value", "words"),
    [
        (0, 0, None, 0, "between 1 and the 58 vertices"),
        (60, 0, None, 60, "between 1 and the 58 vertices"),
        (2.5, 0, None, 2.5, "between 1 and"),
        (1, 0, None, 1, "2 components need a sample each"),
        (3, [0, 1, 2], None, 3, "which makes 4"),
        (5, [0, 1, 60], 2, 60, "first\\[2\\] is 60, no corner"),
        (5, [0, -1], 1, -1, "first\\[1\\] is -1, no corner"),
        (5, 58, 0, 58, "first\\[0\\] is 58, no corner"),
        (5, [4, 7, 4], 2, 4, "first\\[2\\] is 4 again"),
        (5, [], None, "[]", "a vertex or a list"),
        (5, [0.5], None, "[0.5]", "a vertex or a list"),
    ],
)
def test_impossible_samples_are_refused(
    size: int, first: object, index: int | None, value: object, words: str
) -> None:
    pair = shapes.together(shapes.icosphere(1), shapes.grid(3, 3))
    mesh = Mesh([*pair.vertices, [0, 0, 9], [1, 2, 3]], pair.faces)
    assert mesh.referenced.sum() == 58
    with pytest.raises(InvalidBasis, match=words) as refusal:
        farthest_point_samples(mesh, size, first)
    assert refusal.value.index == index
    assert refusal.value.value == value


def test_progress_runs_to_one_and_may_abort() -> None:
    seen: list[float] = []
    farthest_point_samples(shapes.icosphere(1), 7, progress=seen.append)
    np.testing.assert_allclose(seen, np.arange(1, 8) / 7)

    def abort(done: float) -> None:
        if done > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        farthest_point_samples(shapes.icosphere(1), 7, progress=abort)
