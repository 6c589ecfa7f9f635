"""Tracing: known images are followed, symmetric ones apart, and every stop has its reason."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from solver.basis import Basis
from solver.errors import SolverError
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from solver.potential import Potential, potential
from solver.softmap import SoftMap
from solver.trace import Path, trace
from tests.solver import shapes


@pytest.fixture(scope="module")
def sphere() -> Basis:
    return maxent_basis(shapes.icosphere(4), 300)


@pytest.fixture(scope="module")
def identity(sphere: Basis) -> SoftMap:
    return SoftMap.from_points(sphere, sphere, np.arange(sphere.mesh.n_vertices))


@pytest.fixture(scope="module")
def plane() -> Basis:
    return maxent_basis(shapes.grid(16, 16), 100)


@pytest.fixture(scope="module")
def plane_identity(plane: Basis) -> SoftMap:
    return SoftMap.from_points(plane, plane, np.arange(plane.mesh.n_vertices))


def nearest(mesh: Mesh, *point: float) -> int:
    """Vertex in a direction of the sphere, or at a place of the plane."""
    return int(np.linalg.norm(mesh.vertices - point, axis=1).argmin())


def arc(mesh: Mesh) -> list[int]:
    """A path that winds round a third of the sphere."""
    t = np.linspace(0, 2, 9)
    tilt = np.pi / 2 + 0.5 * np.sin(2 * t)
    points = np.column_stack([np.sin(tilt) * np.cos(t), np.sin(tilt) * np.sin(t), np.cos(tilt)])
    return [nearest(mesh, *point) for point in points]


def deviation(path: Path, image: np.ndarray, mesh: Mesh) -> float:
    """Largest distance from the image of the source path, in √area."""
    return float(np.linalg.norm(path.points - image, axis=1).max() / mesh.length_scale)


def test_under_the_identity_a_path_is_its_own_image(identity: SoftMap) -> None:
    mesh = identity.source.mesh
    stops = arc(mesh)
    found = trace(identity, stops, stops[0])
    assert found.stopped == "end"
    assert deviation(found, found.source_points, mesh) < 0.03
    np.testing.assert_allclose(found.source_points[-1], mesh.vertices[stops[-1]], atol=1e-12)
    assert found.length == pytest.approx(
        np.linalg.norm(np.diff(found.source_points, axis=0), axis=1).sum(), rel=0.05
    )


def test_a_rotation_rotates_the_path(sphere: Basis) -> None:
    mesh = sphere.mesh
    # The icosphere is turned into itself by thirds about the axis (1, 1, 1) and by halves about z.
    turn = np.array([[-1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    image = np.array([nearest(mesh, *point) for point in mesh.vertices @ turn.T])
    np.testing.assert_allclose(mesh.vertices[image], mesh.vertices @ turn.T, atol=1e-6)
    stops = arc(mesh)
    found = trace(SoftMap.from_points(sphere, sphere, image), stops, int(image[stops[0]]))
    assert deviation(found, found.source_points @ turn.T, mesh) < 0.03


def test_starts_choose_between_symmetric_images(sphere: Basis, identity: SoftMap) -> None:
    mesh = sphere.mesh
    mirror = np.diag([1.0, 1, -1])
    image = np.array([nearest(mesh, *point) for point in mesh.vertices @ mirror])
    reflected = SoftMap.from_points(sphere, sphere, image)
    both = SoftMap.mixture([identity, reflected], [0.5, 0.5])
    stops = [nearest(mesh, np.cos(t), np.sin(t), 1.0) for t in (0.0, 0.5, 1.0)]
    above, below = trace(both, stops, stops[0]), trace(both, stops, int(image[stops[0]]))
    assert deviation(above, above.source_points, mesh) < 0.03
    assert deviation(below, below.source_points @ mirror, mesh) < 0.03


def test_shorter_steps_converge(identity: SoftMap) -> None:
    stops = arc(identity.source.mesh)
    coarse, fine, finest = (
        trace(identity, stops, stops[0], step).points[-1] for step in (0.05, 0.01, 0.0025)
    )
    assert np.linalg.norm(fine - finest) < 0.003
    assert np.linalg.norm(fine - finest) <= np.linalg.norm(coarse - finest) + 1e-3


def test_a_map_that_says_nothing_leads_nowhere(sphere: Basis) -> None:
    found = trace(SoftMap.uniform(sphere, sphere), [0, 900], 40)
    assert found.stopped == "end"
    assert found.length < 1e-9
    np.testing.assert_allclose(
        found.points, np.tile(sphere.mesh.vertices[40], (len(found.points), 1)), atol=1e-9
    )


def test_a_path_of_one_point_stays(identity: SoftMap) -> None:
    found = trace(identity, [7], 9)
    assert (found.stopped, found.length) == ("end", 0.0)
    np.testing.assert_allclose(found.points, identity.target.mesh.vertices[[9]])
    np.testing.assert_allclose(found.source_points, identity.source.mesh.vertices[[7]])


def test_points_are_where_their_faces_say(identity: SoftMap) -> None:
    found = trace(identity, arc(identity.source.mesh)[:3], 5)
    target = identity.target.mesh
    positions = np.einsum("kc,kcx->kx", found.barycentric, target.vertices[target.faces[found.faces]])
    np.testing.assert_allclose(found.points, positions, atol=1e-12)
    assert (found.barycentric >= 0).all()
    np.testing.assert_allclose(found.barycentric.sum(axis=1), 1)
    assert len(found.faces) == len(found.source_faces) == len(found.source_points)


def test_surface_points_are_as_good_as_vertices(identity: SoftMap) -> None:
    mesh = identity.source.mesh
    stops = arc(mesh)[:3]
    places = [np.argwhere(mesh.faces == v)[0] for v in stops]
    faces, barycentric = [int(f) for f, _ in places], [np.eye(3)[k].tolist() for _, k in places]
    by_vertex = trace(identity, stops, stops[0])
    by_face = trace(identity, (faces, barycentric), (faces[0], barycentric[0]))
    np.testing.assert_allclose(by_face.points, by_vertex.points, atol=1e-12)


def test_a_path_that_runs_ahead_ends_at_the_boundary(plane: Basis, plane_identity: SoftMap) -> None:
    mesh = plane.mesh
    path = [nearest(mesh, 0.5, 0.5, 0), nearest(mesh, 1, 0.5, 0)]
    found = trace(plane_identity, path, nearest(mesh, 0.75, 0.5, 0))
    assert found.stopped == "boundary"
    assert found.points[-1, 0] == pytest.approx(1)
    assert 0.5 < found.source_points[-1, 0] < 1


def test_lengths_are_in_the_units_of_each_mesh(plane_identity: SoftMap) -> None:
    source, target = plane_identity.source, plane_identity.target
    small = Mesh(0.01 * source.mesh.vertices, source.mesh.faces)
    large = Mesh(100 * target.mesh.vertices + 7, target.mesh.faces)
    scaled = SoftMap(
        Basis(small, source.functions, source.samples, source.cells),
        Basis(large, target.functions, target.samples, target.cells),
        plane_identity.coefficients,
    )
    path = [nearest(source.mesh, 0.25, 0.5, 0), nearest(source.mesh, 0.75, 0.625, 0)]
    one, other = trace(plane_identity, path, path[0]), trace(scaled, path, path[0])
    np.testing.assert_allclose(other.points, 100 * one.points + 7, atol=1e-6)
    np.testing.assert_allclose(other.source_points, 0.01 * one.source_points, atol=1e-9)
    assert other.length == pytest.approx(100 * one.length)
    assert deviation(one, one.source_points, source.mesh) < 0.05


def test_only_the_faces_that_are_crossed_are_solved(
    identity: SoftMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved: list[np.ndarray] = []

    def watched(softmap: SoftMap, regularisation: float, faces: np.ndarray) -> Potential:
        solved.append(faces)
        return potential(softmap, regularisation, faces)

    # The package's attribute of that name is the function.
    monkeypatch.setattr(importlib.import_module("solver.trace"), "potential", watched)
    found = trace(identity, arc(identity.source.mesh)[:4], 5)
    (faces,) = solved
    assert set(found.source_faces) <= set(faces.tolist())
    assert len(faces) < 0.02 * identity.source.mesh.n_faces


def test_progress_ends_at_one_and_may_abort(identity: SoftMap) -> None:
    fractions: list[float] = []
    trace(identity, [0, 900], 0, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1)

    def abort(_: float) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        trace(identity, [0, 900], 0, progress=abort)


@pytest.mark.parametrize(
    ("source_path", "start", "step", "match"),
    [
        ([], 0, 0.01, "the source path must name at least one vertex"),
        ([[1, 2]], 0, 0.01, "the source path must name"),
        ([0.5, 1.5], 0, 0.01, "by an integer"),
        ([0, -1], 0, 0.01, "the source path names vertex -1"),
        ([0, 10**7], 0, 0.01, "not one of 0"),
        (([0, 10**7], [[1, 0, 0], [1, 0, 0]]), 0, 0.01, "the source path names face"),
        (([0, 1], [[1, 0, 0]]), 0, 0.01, "three barycentric coordinates"),
        (([0, 1], [[1, 0, 0], [0.5, 0.6, 0]]), 0, 0.01, "sum to 1"),
        (([0, 1], [[1, 0, 0], [1.5, -0.5, 0]]), 0, 0.01, "negative"),
        (([0, 1], [[1, 0, 0], [np.nan, 1, 0]]), 0, 0.01, "negative or do not"),
        ([0, 1], -5, 0.01, "the start names vertex -5"),
        ([0, 1], (0, [1, 0]), 0.01, "three barycentric"),
        ([0, 1], 0, 0.0, "step"),
        ([0, 1], 0, np.nan, "step"),
    ],
)
def test_what_makes_no_sense_is_refused(
    identity: SoftMap, source_path: object, start: object, step: float, match: str
) -> None:
    with pytest.raises(SolverError, match=match):
        trace(identity, source_path, start, step)  # type: ignore[arg-type]
