"""Tangent planes and logarithms: exact in the plane, near the truth on the sphere, defined on everything."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from solver import tangents
from solver.fem import mass
from solver.geodesics import discs, distances_from
from solver.mesh import Mesh
from solver.tangents import connection, corner_angles, log_maps, twins
from tests.solver import shapes

#: A few hundred roundings of numbers near 1.
ROUNDING = 1e-12

ANY_MESH: list[Callable[[], Mesh]] = [
    shapes.triangle,
    shapes.tetrahedron,
    shapes.icosphere,
    shapes.grid,
    shapes.torus,
    shapes.moebius,
    shapes.hourglass,
    shapes.book,
    lambda: shapes.together(shapes.icosphere(1), shapes.grid(3, 3)),
]


def crumpled(rng: np.random.Generator) -> Mesh:
    """A flat rectangle whose inner vertices are moved about within it."""
    mesh = shapes.grid(9, 11, width=1.3)
    points = mesh.vertices.copy()
    inner = (points[:, 0] > 0) & (points[:, 0] < 1.3) & (points[:, 1] > 0) & (points[:, 1] < 1)
    points[inner, :2] += rng.uniform(-0.03, 0.03, (inner.sum(), 2))
    return Mesh(points, mesh.faces)


def rolled(mesh: Mesh, columns: int) -> Mesh:
    """A flat grid bent along its columns: an isometry, since every face stays as it is."""
    x, y, _ = mesh.vertices.T
    width = x.max() / columns
    turn = 2 * np.pi / 3 / columns
    radius = width / (2 * np.sin(turn / 2))
    return Mesh(
        np.column_stack([radius * np.cos(turn * x / width), radius * np.sin(turn * x / width), y]), mesh.faces
    )


def with_flips(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The same surface, with about half of its faces listed the other way round."""
    flipped = rng.random(mesh.n_faces) < 0.5
    return Mesh(mesh.vertices, np.where(flipped[:, None], mesh.faces[:, ::-1], mesh.faces))


def pairs(found: tangents.LogMaps) -> tuple[np.ndarray, np.ndarray]:
    """Vertex of each logarithm, and the logarithm of the first point that its vertex sees."""
    vertices = np.repeat(np.arange(len(found.starts) - 1), np.diff(found.starts))
    return vertices, found.vectors[found.starts[vertices]]


def assert_flat(mesh: Mesh, flat: Mesh, points: np.ndarray, radius: float) -> None:
    """All logarithms have the lengths, and the angles between them, of a plane."""
    found = log_maps(mesh, points, np.full(len(points), radius))
    vertices, one = pairs(found)
    plane = flat.unit_vertices[:, :2] @ [1, 1j]
    exact = plane[points[found.points]] - plane[vertices]
    exact_one = exact[found.starts[vertices]]
    # Polar angles begin anywhere and may run either way round: compare products that neither changes.
    product, exact_product = found.vectors * one.conj(), exact * exact_one.conj()
    np.testing.assert_allclose(product.real, exact_product.real, atol=ROUNDING)
    np.testing.assert_allclose(abs(product.imag), abs(exact_product.imag), atol=ROUNDING)


@pytest.mark.parametrize("make", ANY_MESH)
def test_twins_are_the_same_edge_from_two_faces(make: Callable[[], Mesh]) -> None:
    mesh = make()
    twin = twins(mesh)
    start, end = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    edges = np.sort(np.stack([start, end], axis=1), axis=1)
    _, edge_of, counts = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    paired = np.flatnonzero(twin >= 0)
    np.testing.assert_array_equal(twin >= 0, counts[edge_of] == 2)
    np.testing.assert_array_equal(twin[twin[paired]], paired)
    np.testing.assert_array_equal(edges[twin[paired]], edges[paired])
    assert (twin[paired] // 3 != paired // 3).all()


def test_the_plane_of_an_inner_vertex_is_filled_by_its_faces() -> None:
    mesh = shapes.icosphere(2)
    angles = corner_angles(mesh)
    widths = np.bincount(mesh.faces.ravel(), weights=abs(angles[..., 1] - angles[..., 0]).ravel())
    np.testing.assert_allclose(widths, 2 * np.pi, atol=ROUNDING)


def test_at_a_boundary_angles_are_as_they_are() -> None:
    mesh = shapes.grid(3, 3)
    angles = corner_angles(mesh)
    widths = np.bincount(mesh.faces.ravel(), weights=abs(angles[..., 1] - angles[..., 0]).ravel())
    corner, side, inner = np.pi / 2, np.pi, 2 * np.pi
    expected = [corner, side, side, corner, *[side, inner, inner, side] * 2, corner, side, side, corner]
    np.testing.assert_allclose(widths, expected, atol=ROUNDING)


@pytest.mark.parametrize("make", ANY_MESH)
def test_neighbours_agree_on_their_edge(make: Callable[[], Mesh]) -> None:
    mesh = make()
    seen = connection(mesh)
    here = np.repeat(np.arange(mesh.n_vertices), np.diff(seen.starts))
    lengths = np.linalg.norm(mesh.unit_vertices[here] - mesh.unit_vertices[seen.neighbours], axis=1)
    np.testing.assert_allclose(abs(seen.steps), lengths, atol=ROUNDING)
    assert (seen.weights >= tangents.LEAST_WEIGHT / 3).all()
    ends = {(x, y): e for e, (x, y) in enumerate(zip(here, seen.neighbours, strict=True))}
    crowded = len(ends) < len(here)
    assert crowded == (make is shapes.book)
    if not crowded:
        # What y sees of x, brought to x, leads back.
        other = np.array([ends[y, x] for x, y in ends])
        back = np.where(seen.mirrored, seen.steps[other].conj(), seen.steps[other])
        np.testing.assert_allclose(seen.turns * back, -seen.steps, atol=ROUNDING)
        np.testing.assert_allclose(seen.weights[other], seen.weights, atol=ROUNDING)


def test_logarithms_in_the_plane_are_differences(rng: np.random.Generator) -> None:
    flat = crumpled(rng)
    assert_flat(flat, flat, np.array([0, 17, 40, 64, 101]), 0.7)


def test_bending_without_stretching_changes_nothing() -> None:
    flat = shapes.grid(9, 12, width=1.3)
    assert_flat(rolled(flat, 12), flat, np.array([0, 17, 40, 64, 101]), 0.7)


def test_the_order_of_corners_changes_nothing(rng: np.random.Generator) -> None:
    flat = crumpled(rng)
    mixed = with_flips(flat, rng)
    assert connection(mixed).mirrored.any()
    assert_flat(mixed, flat, np.array([0, 17, 40, 64, 101]), 0.7)


def test_logarithms_on_the_sphere_are_great_circles() -> None:
    mesh = shapes.fibonacci_sphere(2000)
    points = np.array([3, 400, 1000, 1711])
    found = log_maps(mesh, points, np.full(4, 0.15))
    vertices, _ = pairs(found)
    radius = np.sqrt(1 / (4 * np.pi))
    arcs = radius * np.arccos(
        np.clip((mesh.vertices[vertices] * mesh.vertices[points[found.points]]).sum(axis=1), -1, 1)
    )
    errors = abs(found.vectors) - arcs
    assert np.sqrt((errors**2).mean()) < 0.01 * 0.15
    np.testing.assert_allclose(found.distances, arcs, atol=0.001)


def test_sweeps_end_in_the_solution_of_the_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, point = shapes.torus(12, 8), 5
    monkeypatch.setattr(tangents, "SWEEPS", 400)
    found = log_maps(mesh, np.array([point]), np.array([np.inf]))
    seen = connection(mesh)
    n, here = mesh.n_vertices, np.repeat(np.arange(mesh.n_vertices), np.diff(seen.starts))
    edge_means = np.bincount(here, abs(seen.steps)) / np.bincount(here)
    time = max(edge_means.mean(), tangents.LEAST_REACH * distances_from(mesh, point).max()) ** 2
    flow = np.diag(mass(mesh) / time).astype(complex)
    carried = np.zeros((n, n), dtype=complex)
    for x, y, w, step in zip(here, seen.neighbours, seen.weights, seen.steps, strict=True):
        flow[x, x] += w
        flow[x, y] -= w
        carried[x, y] += w * step
    source = np.zeros(n)
    source[point] = 1
    s = np.linalg.solve(flow, source)
    turning = flow.copy()
    turning[here, seen.neighbours] *= seen.turns
    expected = np.linalg.solve(turning, carried @ s) / s
    expected[point] = 0
    np.testing.assert_allclose(found.vectors, expected, atol=1e-10)


@pytest.mark.parametrize("make", ANY_MESH)
def test_every_vertex_is_reached_on_every_mesh(make: Callable[[], Mesh]) -> None:
    mesh = make()
    points = np.flatnonzero(
        np.isin(np.arange(mesh.n_vertices), np.unique(mesh.components, return_index=True)[1])
    )
    found = log_maps(mesh, points, np.full(len(points), np.inf))
    assert (np.diff(found.starts) == 1).all()
    assert np.isfinite(found.vectors).all()
    far = found.distances > 0
    assert (abs(found.vectors[far]) > 0).all()


def test_discs_are_what_distances_say() -> None:
    mesh = shapes.torus()
    centres, radii = np.array([4, 100, 4]), np.array([0.2, 0.45, np.inf])
    for centre, radius, (vertices, distances) in zip(
        centres, radii, discs(mesh, centres, radii), strict=True
    ):
        exact = distances_from(mesh, int(centre))
        assert set(vertices) == set(np.flatnonzero(exact <= radius))
        np.testing.assert_allclose(distances, exact[vertices], atol=1e-7)
        assert vertices[0] == centre
        assert (np.diff(distances) >= 0).all()


def test_progress_ends_at_one_and_may_abort() -> None:
    mesh = shapes.icosphere(1)
    fractions: list[float] = []
    log_maps(mesh, np.array([0, 5]), np.array([1.0, 1.0]), fractions.append)
    assert fractions == [0.5, 1.0]

    def abort(_: float) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        log_maps(mesh, np.array([0, 5]), np.array([1.0, 1.0]), abort)
