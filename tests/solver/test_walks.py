"""Straight walks: lines in the plane stay lines however the plane is cut, bent or listed."""

from __future__ import annotations

import cmath

import numpy as np
import pytest

from solver import walks
from solver.errors import SolverError
from solver.mesh import Mesh
from solver.walks import Layout, Walk, layout, walk
from tests.solver import shapes

#: A few hundred crossings, each rounded a few times.
ROUNDING = 1e-10


def position(on: Layout, face: int, barycentric: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """Where a point is, on the unit mesh."""
    return np.asarray(barycentric) @ on.mesh.unit_vertices[on.mesh.faces[face]]


def in_frame(on: Layout, face: int, vector: np.ndarray) -> complex:
    """A vector in space as one in the frame of a face."""
    return complex(*(on.mesh.frames[face] @ vector))


def back(on: Layout, there: Walk, vector: complex) -> Walk:
    """The walk back from where a vector led."""
    ahead = -(vector.conjugate() if there.mirrored else vector) * there.turn
    return walk(on, there.face, there.barycentric, ahead)


def random_point(on: Layout, rng: np.random.Generator) -> tuple[int, np.ndarray]:
    return int(rng.integers(on.mesh.n_faces)), rng.dirichlet(np.ones(3))


@pytest.fixture
def flat(rng: np.random.Generator) -> Layout:
    """A rectangle whose inner vertices are moved about within it, some faces listed the other way round."""
    mesh = shapes.grid(9, 11, width=1.3)
    points = mesh.vertices.copy()
    inner = (points[:, 0] > 0) & (points[:, 0] < 1.3) & (points[:, 1] > 0) & (points[:, 1] < 1)
    points[inner, :2] += rng.uniform(-0.03, 0.03, (inner.sum(), 2))
    flipped = rng.random(mesh.n_faces) < 0.5
    return layout(Mesh(points, np.where(flipped[:, None], mesh.faces[:, ::-1], mesh.faces)))


def test_faces_are_laid_out_as_they_are(flat: Layout) -> None:
    for a, b in ((0, 1), (1, 2), (2, 0)):
        edges = (
            flat.mesh.unit_vertices[flat.mesh.faces[:, b]] - flat.mesh.unit_vertices[flat.mesh.faces[:, a]]
        )
        np.testing.assert_allclose(
            abs(flat.corners[:, b] - flat.corners[:, a]), np.linalg.norm(edges, axis=1)
        )
    rises = (flat.gradients[:, 1].conj() * flat.corners[:, 1]).real
    np.testing.assert_allclose(rises, 1)


def test_walks_in_the_plane_are_straight(flat: Layout, rng: np.random.Generator) -> None:
    low, high = flat.mesh.unit_vertices.min(axis=0), flat.mesh.unit_vertices.max(axis=0)
    for _ in range(200):
        face, b = random_point(flat, rng)
        begin, end = position(flat, face, b), rng.uniform(low, high)
        found = walk(flat, face, b, in_frame(flat, face, end - begin))
        assert found.stopped == ""
        assert found.gone == 1
        np.testing.assert_allclose(position(flat, found.face, found.barycentric), end, atol=ROUNDING)


def test_what_is_carried_along_keeps_its_direction(flat: Layout, rng: np.random.Generator) -> None:
    vector = np.array([0.3, -0.2, 0.0])
    for _ in range(50):
        face, b = random_point(flat, rng)
        found = walk(flat, face, b, in_frame(flat, face, 0.2 * rng.normal(size=3) * [1, 1, 0]))
        carried = in_frame(flat, face, vector)
        carried = (carried.conjugate() if found.mirrored else carried) * found.turn
        assert abs(carried - in_frame(flat, found.face, vector)) < ROUNDING


def test_through_vertices_and_along_edges() -> None:
    on = layout(shapes.grid(6, 6))
    corner = on.mesh.unit_vertices[0]
    face = int(np.flatnonzero((on.mesh.faces == 0).any(axis=1))[0])
    at_corner = (on.mesh.faces[face] == 0).astype(float)
    for end in ([1, 1], [1, 0], [0, 1], [0.5, 1], [1, 0.5], [1 / 3, 5 / 6]):
        vector = np.array([*end, 0.0])
        found = walk(on, face, at_corner, in_frame(on, face, vector))
        assert found.stopped == ""
        np.testing.assert_allclose(
            position(on, found.face, found.barycentric), corner + vector, atol=ROUNDING
        )


def test_twice_an_edge_of_a_tetrahedron_leads_home(rng: np.random.Generator) -> None:
    """The plane of triangles covers the tetrahedron, and twice each of its edges is a period."""
    on = layout(shapes.tetrahedron())
    for face in range(4):
        for k in range(3):
            b = rng.dirichlet(np.ones(3))
            vector = 2 * complex(on.corners[face, k] - on.corners[face, k - 1])
            found = walk(on, face, b, vector)
            assert found.face == face
            np.testing.assert_allclose(found.barycentric, b, atol=ROUNDING)
            assert abs(found.turn - 1) < ROUNDING


@pytest.mark.parametrize("make", [shapes.icosphere, shapes.torus, shapes.moebius])
def test_the_way_back_leads_back(make, rng: np.random.Generator) -> None:  # type: ignore[no-untyped-def]
    on = layout(make())
    for _ in range(50):
        face, b = random_point(on, rng)
        vector = cmath.rect(0.6, rng.uniform(0, 2 * np.pi))
        there = walk(on, face, b, vector)
        if there.stopped:
            continue
        home = back(on, there, vector)
        np.testing.assert_allclose(
            position(on, home.face, home.barycentric), position(on, face, b), atol=ROUNDING
        )


def test_the_way_back_through_a_vertex_leads_back() -> None:
    on = layout(shapes.icosphere(1))
    for face in range(on.mesh.n_faces):
        middle = np.full(3, 1 / 3)
        for k in range(3):
            vector = 2.5 * complex(on.corners[face, k] - on.corners[face].mean())
            there = walk(on, face, middle, vector)
            home = back(on, there, vector)
            assert there.face != face
            assert home.face == face
            np.testing.assert_allclose(home.barycentric, middle, atol=ROUNDING)


def test_the_sphere_is_walked_round_in_great_circles() -> None:
    on = layout(shapes.icosphere(5))
    face, b = 1234, np.array([0.2, 0.5, 0.3])
    circumference = 2 * np.pi * np.sqrt(1 / (4 * np.pi))
    found = walk(on, face, b, cmath.rect(circumference, 0.7))
    assert np.linalg.norm(position(on, found.face, found.barycentric) - position(on, face, b)) < 0.005


def test_a_walk_ends_at_a_boundary(flat: Layout) -> None:
    face, b = 40, np.full(3, 1 / 3)
    begin = position(flat, face, b)
    right = flat.mesh.unit_vertices[:, 0].max()
    found = walk(flat, face, b, in_frame(flat, face, np.array([2.0, 0, 0])))
    assert found.stopped == "boundary"
    assert found.gone == pytest.approx((right - begin[0]) / 2)
    np.testing.assert_allclose(
        position(flat, found.face, found.barycentric), [right, begin[1], 0], atol=ROUNDING
    )


def test_a_walk_ends_at_a_corner_of_the_boundary() -> None:
    on = layout(shapes.grid(4, 4))
    found = walk(on, 0, (1.0, 0.0, 0.0), in_frame(on, 0, np.array([-1.0, -1.0, 0])))
    assert found.stopped == "boundary"
    assert found.gone == 0


def test_a_walk_ends_where_surfaces_branch() -> None:
    on = layout(shapes.book())
    found = walk(on, 0, np.full(3, 1 / 3), in_frame(on, 0, np.array([0, -5.0, 0])))
    assert found.stopped == "branch"
    assert position(on, found.face, found.barycentric)[1] == pytest.approx(on.mesh.unit_vertices[0, 1])


def test_a_walk_never_leaves_its_sheet_where_surfaces_touch() -> None:
    on = layout(shapes.hourglass())
    middle = on.corners[0].mean()
    found = walk(on, 0, np.full(3, 1 / 3), 3 * complex(on.corners[0, 0] - middle))
    assert found.stopped == "boundary"
    assert found.face == 0


def test_a_walk_without_end_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(walks, "CROSSINGS", 20)
    found = walk(layout(shapes.tetrahedron()), 0, np.full(3, 1 / 3), 100 + 3j)
    assert found.stopped == "stuck"
    assert 0 < found.gone < 1


def test_a_walk_of_no_length_stays() -> None:
    on = layout(shapes.tetrahedron())
    assert walk(on, 2, (0.2, 0.3, 0.5), 0j).barycentric == pytest.approx((0.2, 0.3, 0.5))


def test_a_direction_must_be_finite() -> None:
    with pytest.raises(SolverError, match="finite"):
        walk(layout(shapes.tetrahedron()), 0, np.full(3, 1 / 3), complex("nan"))
