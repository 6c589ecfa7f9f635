"""Soft maps carried from one pair of bases to another."""

from __future__ import annotations

import numpy as np
import pytest

from solver.errors import InvalidSoftMap
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from solver.prolongation import prolong
from solver.softmap import SoftMap
from tests.solver.shapes import fibonacci_sphere, torus


def test_what_is_carried_stays_a_soft_map_and_uniform_stays_uniform(rng: np.random.Generator) -> None:
    meshes = fibonacci_sphere(150), torus(16, 8)
    coarse, fine = ([maxent_basis(mesh, size=size) for mesh in meshes] for size in (8, 20))
    carried = prolong(SoftMap(*coarse, rng.dirichlet(np.ones(8), size=8)), *fine)
    assert carried.source is fine[0]
    assert carried.target is fine[1]
    np.testing.assert_allclose(carried.coefficients.sum(axis=1), 1, rtol=1e-14)
    even = prolong(SoftMap.uniform(*coarse), *fine)
    np.testing.assert_allclose(even.coefficients, SoftMap.uniform(*fine).coefficients, rtol=1e-12)


def test_densities_are_carried_with_little_change(rng: np.random.Generator) -> None:
    """A smooth map by descriptors, on 30 functions and carried to 60, is what 60 make of it, smoothed."""
    mesh = fibonacci_sphere(400)
    coarse, fine = (maxent_basis(mesh, size=size) for size in (30, 60))
    points = mesh.unit_vertices
    carried = prolong(SoftMap.from_descriptors(coarse, coarse, points, points, sigma=0.7), fine, fine)
    expected = SoftMap.from_descriptors(fine, fine, points, points, sigma=0.7).coefficients
    even = SoftMap.uniform(fine, fine).coefficients
    assert abs(carried.coefficients - expected).sum() < 0.35 * abs(even - expected).sum()


def test_bases_of_equal_meshes_will_do_and_others_are_refused() -> None:
    mesh = fibonacci_sphere(100)
    same = Mesh(mesh.vertices, mesh.faces)
    one, two = maxent_basis(mesh, size=5), maxent_basis(same, size=9)
    assert prolong(SoftMap.uniform(one, one), two, two).target is two
    other = maxent_basis(fibonacci_sphere(101), size=5)
    with pytest.raises(InvalidSoftMap, match="the source differs"):
        prolong(SoftMap.uniform(one, one), other, one)
    with pytest.raises(InvalidSoftMap, match="the target differs"):
        prolong(SoftMap.uniform(one, one), one, other)
