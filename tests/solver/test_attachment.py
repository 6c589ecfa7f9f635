"""Costs that descriptors make: equal to their double integral, and least where they agree."""

from __future__ import annotations

import numpy as np
import pytest

from solver.attachment import descriptor_cost, landmark_distances
from solver.errors import InvalidDescriptor, InvalidMesh
from solver.fem import mass
from solver.geodesics import distances_from
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from solver.optimal import optimal_softmap
from solver.pointmap import pointmap
from solver.quality import map_quality
from solver.softmap import SoftMap
from tests.solver.shapes import fibonacci_sphere, grid, tetrahedron, together, torus


def test_the_cost_is_the_double_integral(rng: np.random.Generator) -> None:
    source, target = maxent_basis(fibonacci_sphere(60), size=6), maxent_basis(torus(10, 6), size=7)
    f0, f = rng.normal(size=(60, 3)) + 5, rng.normal(size=(60, 3)) + 5
    cost = descriptor_cost(source, target, f0, f)
    softmap = SoftMap(source, target, rng.dirichlet(np.ones(7), size=6))
    density = source.functions @ softmap.coefficients @ (target.functions.toarray() / target.integrals).T
    squares = ((f0[:, None] - f) ** 2).sum(axis=2)
    expected = mass(source.mesh) @ (density * squares) @ mass(target.mesh)
    assert (cost * softmap.coefficients).sum() == pytest.approx(expected, rel=1e-12)
    assert (cost >= 0).all()


def test_distances_to_landmarks_sharpen_an_optimal_map() -> None:
    """On the sphere, from three landmarks: nearer to the identity, with a certificate as before."""
    mesh = fibonacci_sphere(400)
    basis = maxent_basis(mesh, size=40)
    pairs = [(int(basis.samples[k]), int(basis.samples[k])) for k in range(3)]
    distances = landmark_distances(mesh, [v for v, _ in pairs])
    here, some = np.arange(400), np.arange(0, 400, 9)
    means = []
    for weight in (0.0, 100.0):
        cost = weight * descriptor_cost(basis, basis, distances, distances)
        found = optimal_softmap(basis, basis, pairs, tolerance=5e-3, cost=cost)
        assert found.converged
        means.append(map_quality(mesh, mesh, pointmap(found.softmap).targets, here, sources=some).mean)
    assert means[1] < 0.5 * means[0]


def test_distances_are_geodesic_and_must_be_finite() -> None:
    mesh = grid(4, 4)
    np.testing.assert_array_equal(landmark_distances(mesh, [3, 9])[:, 1], distances_from(mesh, 9))
    lonely = Mesh(np.concatenate([mesh.vertices, [[9.0, 9.0, 9.0]]]), mesh.faces)
    np.testing.assert_array_equal(landmark_distances(lonely, [3])[25], 0)
    with pytest.raises(InvalidMesh, match="landmark 1 is vertex 25") as refused:
        landmark_distances(mesh, [0, 25])
    assert refused.value.index == 1
    with pytest.raises(InvalidMesh, match="vertex 4 is not connected") as refused:
        landmark_distances(together(tetrahedron(), tetrahedron()), [0])
    assert refused.value.index == 4


def test_descriptors_that_do_not_fit_are_refused() -> None:
    basis = maxent_basis(grid(4, 4), size=4)
    good, bad = np.zeros((25, 2)), np.zeros((25, 2))
    bad[7] = np.nan
    with pytest.raises(InvalidDescriptor, match="target descriptor of vertex 7") as refused:
        descriptor_cost(basis, basis, good, bad)
    assert refused.value.index == 7
    for other in (np.zeros((24, 2)), np.zeros(25), np.zeros((25, 3))):
        with pytest.raises(InvalidDescriptor):
            descriptor_cost(basis, basis, good, other)
