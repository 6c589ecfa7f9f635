"""Maximum-entropy functions: exact on linear functions, sparse, smooth, and there on every mesh."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy import optimize

from solver.basis import Basis, poisson_basis
from solver.energy import dirichlet
from solver.errors import InvalidBasis
from solver.fem import mass
from solver.geodesics import farthest_point_samples
from solver.maxent import DROPPED, KEPT, RIDGE, WALL, maxent_basis
from solver.mesh import Mesh
from solver.softmap import SoftMap
from solver.tangents import log_maps
from tests.solver import shapes

#: One division and a few additions.
ROW_SUM = 1e-12

#: E_D of ρ(x, y) ∝ exp(5⟨x, y⟩) on the sphere, a one-dimensional boundary-value problem.
EXACT_ENERGY = 1.560212

ANY_MESH: list[Callable[[], Mesh]] = [
    shapes.triangle,
    shapes.tetrahedron,
    lambda: shapes.icosphere(2),
    shapes.grid,
    shapes.torus,
    shapes.moebius,
    shapes.hourglass,
    shapes.book,
    lambda: shapes.together(shapes.icosphere(1), shapes.grid(3, 3)),
    lambda: Mesh(np.vstack([shapes.grid().vertices, [9, 9, 9]]), shapes.grid().faces),
]


def rotation_invariant(basis: Basis, kappa: float) -> SoftMap:
    """The soft map ρ(x, y) ∝ exp(κ⟨x, y⟩) of the unit sphere, each row its value at a sample."""
    points = basis.mesh.vertices
    density = np.exp(kappa * (points[basis.samples] @ points.T - 1)) * mass(basis.mesh)
    received = np.asarray(density @ basis.functions)
    return SoftMap(basis, basis, received / received.sum(axis=1, keepdims=True))


def spread(basis: Basis) -> tuple[float, float]:
    """Energy, and the standard deviation over the surface of a density that ought to be constant."""
    found, areas = dirichlet(rotation_invariant(basis, 5.0), threads=2), basis.mesh.face_areas
    return found.energy, float(np.sqrt(areas @ (found.density - found.energy) ** 2))


@pytest.mark.parametrize("make", ANY_MESH)
@pytest.mark.parametrize("size", [1, 2, 3, 7, 40])
def test_a_partition_of_unity_on_every_mesh(make: Callable[[], Mesh], size: int) -> None:
    mesh = make()
    size = min(max(size, mesh.n_components), int(mesh.referenced.sum()))
    basis = maxent_basis(mesh, size)
    assert (basis.functions.data > 0).all()
    np.testing.assert_allclose(basis.functions.sum(axis=1), mesh.referenced, atol=ROW_SUM)
    np.testing.assert_array_equal(basis.samples, farthest_point_samples(mesh, size).vertices)
    own = basis.functions[basis.samples, np.arange(size)]
    assert (own >= 0.2).all()
    values = basis.functions.tocoo()
    assert (mesh.components[basis.samples[values.col]] == mesh.components[values.row]).all()


@pytest.mark.parametrize("file", ["narrow_triangles.obj", "moebius.obj", "lego.ply"])
def test_bad_triangles_are_no_obstacle(data: Path, file: str) -> None:
    found = list((data / "robust").rglob(file))
    loaded = trimesh.load(found[0], process=False, maintain_order=True, skip_materials=True)
    mesh = Mesh(loaded.vertices, loaded.faces)
    basis = maxent_basis(mesh, min(100, mesh.n_vertices // 4))
    np.testing.assert_allclose(basis.functions.sum(axis=1), mesh.referenced, atol=ROW_SUM)
    assert basis.functions.nnz < 12 * mesh.n_vertices


def test_weights_are_what_a_general_minimiser_finds() -> None:
    mesh, size, sharpness = shapes.fibonacci_sphere(150), 30, 2.0
    basis = maxent_basis(mesh, size, sharpness)
    h = np.sqrt(1 / size)
    samples = farthest_point_samples(mesh, size)
    logs = log_maps(mesh, samples.vertices, np.full(size, max(2.4, np.sqrt(17 / sharpness)) * h))
    ridge, wall = RIDGE * 3 / sharpness, WALL * (3 / sharpness) ** 3

    def weights(prior: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        def tilted(multiplier: np.ndarray) -> np.ndarray:
            return prior * np.exp(vectors @ multiplier)

        def objective(multiplier: np.ndarray) -> float:
            squared = float(multiplier @ multiplier)
            return float(np.log(tilted(multiplier).sum())) + ridge * squared / 2 + wall * squared**2 / 4

        best = optimize.minimize(objective, np.zeros(2), method="BFGS", options={"gtol": 1e-9})
        return tilted(best.x) / tilted(best.x).sum()

    for x in range(0, mesh.n_vertices, 10):
        mine = slice(logs.starts[x], logs.starts[x + 1])
        vectors = np.column_stack([logs.vectors[mine].real, logs.vectors[mine].imag]) / h
        full = weights(np.exp(-sharpness * (logs.distances[mine] / h) ** 2), vectors)
        t = np.clip((full - DROPPED) / (KEPT - DROPPED), 0, 1)
        expected = np.zeros(size)
        expected[logs.points[mine]] = weights(full * t**2 * (3 - 2 * t), vectors)
        np.testing.assert_allclose(basis.functions[[x]].toarray()[0], expected, atol=1e-6)


def test_linear_functions_are_reproduced_in_the_plane() -> None:
    mesh, size = shapes.grid(24, 24), 60
    points = mesh.unit_vertices[:, :2]
    edge = 0.5 - abs(points).max(axis=1)
    h = np.sqrt(1 / size)

    def error(basis: Basis) -> np.ndarray:
        return np.linalg.norm(basis.functions @ points[basis.samples] - points, axis=1) / h

    errors = error(maxent_basis(mesh, size))
    assert errors[edge > 1e-9].max() < 0.05
    assert np.median(errors) < 0.003
    assert np.median(error(poisson_basis(mesh, size))) > 0.02


def test_the_density_of_a_rotation_invariant_map_is_constant() -> None:
    mesh = shapes.fibonacci_sphere(1500)
    energy, deviation = spread(maxent_basis(mesh, 150))
    assert deviation < 0.025
    assert abs(energy - EXACT_ENERGY) < 0.1
    assert spread(poisson_basis(mesh, 150))[1] > 0.2


@pytest.mark.slow
def test_the_density_converges() -> None:
    mesh = shapes.fibonacci_sphere(3000)
    coarse, coarse_deviation = spread(maxent_basis(mesh, 300))
    fine, fine_deviation = spread(maxent_basis(mesh, 600))
    assert coarse_deviation < 0.01
    assert fine_deviation < 0.006
    assert (coarse - EXACT_ENERGY) / (fine - EXACT_ENERGY) > 1.7


def test_sharper_functions_meet_less() -> None:
    mesh = shapes.fibonacci_sphere(1000)
    entries = [maxent_basis(mesh, 100, sharpness).functions.nnz for sharpness in (0.5, 1.8, 3.0, 6.0, 50.0)]
    assert entries == sorted(entries, reverse=True)
    assert entries[-1] < 3.2 * mesh.n_vertices  # nearly the hat functions of a triangulation
    assert entries[2] < poisson_basis(mesh, 100).functions.nnz


def test_motion_scale_and_order_of_corners_change_nothing(rng: np.random.Generator) -> None:
    mesh = shapes.fibonacci_sphere(500)
    functions = maxent_basis(mesh, 40).functions
    moved = maxent_basis(shapes.moved(mesh, rng, scale=1e-3), 40).functions
    turned = maxent_basis(Mesh(mesh.vertices, mesh.faces[:, [1, 2, 0]]), 40).functions
    mirrored = maxent_basis(Mesh(mesh.vertices, mesh.faces[:, ::-1]), 40).functions
    for other in (moved, turned, mirrored):
        np.testing.assert_allclose(other.toarray(), functions.toarray(), atol=1e-9)


def test_functions_are_independent() -> None:
    maxent_basis(shapes.icosphere(3), 100).require_independent()
    maxent_basis(shapes.grid(), 20).require_independent()


def test_landmarks_are_samples_and_own_their_functions() -> None:
    basis = maxent_basis(shapes.icosphere(3), 60, first=[17, 333, 5])
    np.testing.assert_array_equal(basis.samples[:3], [17, 333, 5])
    assert (basis.functions[[17, 333, 5]].toarray().argmax(axis=1) == [0, 1, 2]).all()


@pytest.mark.parametrize("sharpness", [0.0, -3.0, 0.4, 51.0, np.inf, np.nan])
def test_a_sharpness_out_of_range_is_refused(sharpness: float) -> None:
    with pytest.raises(InvalidBasis, match="sharpness") as refusal:
        maxent_basis(shapes.icosphere(1), 10, sharpness)
    assert refusal.value.value == pytest.approx(sharpness, nan_ok=True)


def test_progress_rises_to_one_and_may_abort() -> None:
    fractions: list[float] = []
    maxent_basis(shapes.icosphere(2), 20, progress=fractions.append)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0

    def abort(done: float) -> None:
        if done > 0.5:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        maxent_basis(shapes.icosphere(2), 20, progress=abort)
