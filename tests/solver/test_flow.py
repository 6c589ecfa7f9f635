"""Velocity and momentum: mass is conserved, a turning sphere turns its peaks, nothing depends on units."""

from __future__ import annotations

import numpy as np
import pytest

from solver.basis import Basis
from solver.errors import SolverError
from solver.fem import mass
from solver.flow import mass_density, momentum, velocity
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from solver.potential import potential
from solver.softmap import SoftMap
from tests.solver import dense, shapes

#: Roundings of sums over some thousand faces.
ROUNDING = 1e-10


@pytest.fixture(scope="module")
def sphere() -> Basis:
    return maxent_basis(shapes.fibonacci_sphere(1200), 150)


@pytest.fixture(scope="module")
def peaked(sphere: Basis) -> SoftMap:
    """ρ(x, y) ∝ exp(20⟨x, y⟩), which turns with the sphere."""
    points = sphere.mesh.vertices
    density = np.exp(20 * (points[sphere.samples] @ points.T - 1)) * mass(sphere.mesh)
    received = np.asarray(density @ sphere.functions)
    return SoftMap(sphere, sphere, received / received.sum(axis=1, keepdims=True))


def with_meshes(softmap: SoftMap, source: Mesh, target: Mesh) -> SoftMap:
    """The same soft map on meshes that were moved or scaled, with its bases carried along."""

    def carried(basis: Basis, mesh: Mesh) -> Basis:
        return Basis(mesh, basis.functions, basis.samples, basis.cells)

    return SoftMap(carried(softmap.source, source), carried(softmap.target, target), softmap.coefficients)


def test_momentum_carries_mass_as_fast_as_the_soft_map_asks(peaked: SoftMap) -> None:
    face, epsilon = 1234, 1e-3
    source, target = peaked.source.mesh, peaked.target.mesh
    direction = np.array([0.3, -1.2, 0.7])
    moved = momentum(peaked, face, direction, epsilon) / target.length_scale
    arriving = np.einsum("f,fx,fjx->j", target.face_areas, moved, dense.face_gradients(peaked.target))
    # How much of each function the blended density gains, by its derivative on the source face.
    gains = np.einsum("jx,x->j", dense.face_gradients(peaked.source)[face], direction / source.length_scale)
    growth = (1 - epsilon) * gains @ peaked.coefficients @ peaked.target.overlap
    np.testing.assert_allclose(arriving, growth, atol=ROUNDING * abs(growth).max())
    assert abs(growth).max() > 1e-3


def test_velocity_is_the_gradient_of_the_potential(peaked: SoftMap) -> None:
    face, direction = 77, np.array([1.0, 2.0, -0.5])
    q, frames = potential(peaked, faces=[face])
    gradients = dense.face_gradients(peaked.target)
    expected = np.einsum("s,sj,fjx->fx", frames[0] @ direction, q[0], gradients)
    np.testing.assert_allclose(velocity(peaked, face, direction), expected, atol=ROUNDING)


def test_momentum_is_density_times_velocity(peaked: SoftMap) -> None:
    face, direction, epsilon = 5, np.array([1.0, 0.2, 0.1]), 0.25
    weights = peaked.source.face_means[[face]].toarray()[0] @ peaked.coefficients
    density = 0.75 * (peaked.target.densities @ weights) + 0.25
    expected = density[:, None] * velocity(peaked, face, direction, epsilon)
    np.testing.assert_allclose(momentum(peaked, face, direction, epsilon), expected, atol=ROUNDING)
    np.testing.assert_allclose(mass_density(peaked, [face], epsilon), [density], atol=ROUNDING)
    assert peaked.target.mesh.face_areas @ mass_density(peaked, face, epsilon) == pytest.approx(1, rel=1e-12)
    with pytest.raises(SolverError, match="face 10000 is not one of"):
        mass_density(peaked, [0, 10_000])


def test_both_are_linear_in_the_direction(peaked: SoftMap) -> None:
    one, other = np.array([1.0, 0.4, 0.2]), np.array([-0.3, 0.1, 2.0])
    for field in (velocity, momentum):
        both = field(peaked, [9, 9, 9], [one, other, 2 * one - 3 * other])
        np.testing.assert_allclose(both[2], 2 * both[0] - 3 * both[1], atol=ROUNDING)


def test_the_normal_part_of_a_direction_is_ignored(peaked: SoftMap) -> None:
    face = 400
    along, normal = peaked.source.mesh.frames[face, 0], peaked.source.mesh.normals[face]
    np.testing.assert_allclose(
        velocity(peaked, face, along + 7 * normal), velocity(peaked, face, along), atol=ROUNDING
    )


def test_the_peak_moves_as_the_sphere_turns(peaked: SoftMap, rng: np.random.Generator) -> None:
    centres = peaked.source.mesh.vertices[peaked.source.mesh.faces].mean(axis=1)
    for face in rng.integers(0, len(centres), 10):
        axis = np.cross(centres[face], rng.normal(size=3))
        axis -= axis @ centres[face] * centres[face]
        axis /= np.linalg.norm(axis)
        moves = velocity(peaked, face, np.cross(axis, centres[face]))
        # The mean angular velocity of the mass, ∫ρ y × v over that of a rigid turn.
        weights = peaked.source.face_means[[face]].toarray()[0] @ peaked.coefficients
        density = peaked.target.mesh.face_areas * (peaked.target.densities @ weights)
        turned = density @ np.cross(centres, moves)
        rigid = density @ np.cross(centres, np.cross(axis, centres))
        assert np.linalg.norm(turned - rigid) < 0.05 * np.linalg.norm(rigid)
        # And at the peak itself.
        np.testing.assert_allclose(moves[face], np.cross(axis, centres[face]), atol=0.1)


def test_a_soft_map_that_says_nothing_moves_nothing(sphere: Basis, rng: np.random.Generator) -> None:
    constant = SoftMap(sphere, sphere, np.tile(rng.dirichlet(np.ones(sphere.size)), (sphere.size, 1)))
    for softmap in (SoftMap.uniform(sphere, sphere), constant):
        assert abs(momentum(softmap, [0, 999], np.eye(3)[:2])).max() < ROUNDING


def test_fields_turn_and_scale_with_their_meshes(peaked: SoftMap, rng: np.random.Generator) -> None:
    face, direction = 321, np.array([0.2, 0.9, -0.4])
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    source = Mesh(5 * peaked.source.mesh.vertices @ turn.T + [1, 2, 3], peaked.source.mesh.faces)
    target = Mesh(0.01 * peaked.target.mesh.vertices @ turn.T - 4, peaked.target.mesh.faces)
    moved = with_meshes(peaked, source, target)
    for field in (velocity, momentum):
        expected = 0.01 / 5 * field(peaked, face, direction) @ turn.T
        np.testing.assert_allclose(
            field(moved, face, turn @ direction), expected, atol=1e-8 * abs(expected).max()
        )


def test_several_faces_at_once_are_each_of_them(peaked: SoftMap) -> None:
    faces, directions = [8, 3, 8], np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    together = momentum(peaked, faces, directions)
    assert together.shape == (3, peaked.target.mesh.n_faces, 3)
    for one, face, direction in zip(together, faces, directions, strict=True):
        np.testing.assert_allclose(one, momentum(peaked, face, direction), atol=ROUNDING)


@pytest.mark.parametrize(
    ("face", "direction", "match"),
    [
        (-1, [1, 0, 0], "face -1"),
        (10**6, [1, 0, 0], "not one of"),
        (0.5, [1, 0, 0], "integer"),
        (0, [1, 0], "shape"),
        ([0, 1], [1, 0, 0], "shape"),
        ([[0]], [[[1, 0, 0]]], "shape"),
        (0, [1, 0, np.nan], "finite"),
        (0, [0, 0, 0], "no part along"),
        (0, ["a", "b", "c"], "numbers"),
    ],
)
def test_what_makes_no_sense_is_refused(peaked: SoftMap, face: object, direction: object, match: str) -> None:
    for field in (velocity, momentum):
        with pytest.raises(SolverError, match=match):
            field(peaked, face, direction)  # type: ignore[arg-type]


def test_a_normal_direction_is_refused(peaked: SoftMap) -> None:
    with pytest.raises(SolverError, match="no part along face 17") as refusal:
        velocity(peaked, 17, peaked.source.mesh.normals[17])
    assert refusal.value.index == 0
