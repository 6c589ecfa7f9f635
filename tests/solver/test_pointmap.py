"""Point maps read off soft maps: equal to their definition, and close to known maps."""

from __future__ import annotations

import numpy as np
import pytest

from solver.basis import Basis, poisson_basis
from solver.errors import SolverError
from solver.geodesics import distances_from
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from solver.pointmap import BLOCK_ENTRIES, pointmap
from solver.quality import map_quality
from solver.softmap import SoftMap
from tests.solver.shapes import fibonacci_sphere, grid, torus


@pytest.fixture(scope="module")
def bases() -> tuple[Basis, Basis]:
    return maxent_basis(fibonacci_sphere(150), size=14), maxent_basis(torus(16, 8), size=12)


def test_the_peak_is_the_vertex_of_largest_density(
    bases: tuple[Basis, Basis], rng: np.random.Generator
) -> None:
    source, target = bases
    softmap = SoftMap(source, target, rng.dirichlet(np.full(12, 0.5), size=14))
    found = pointmap(softmap)
    mass = source.functions.toarray() @ softmap.coefficients
    density = mass @ (target.functions.toarray() / target.integrals).T
    np.testing.assert_array_equal(found.targets, density.argmax(axis=1))
    share = (mass * (target.functions.toarray()[found.targets] > 0)).sum(axis=1)
    np.testing.assert_allclose(found.confidence, share, rtol=1e-12)


def test_the_barycentre_is_nearest_to_the_mass(bases: tuple[Basis, Basis], rng: np.random.Generator) -> None:
    source, target = bases
    softmap = SoftMap(source, target, rng.dirichlet(np.full(12, 0.5), size=14))
    squares = np.stack([distances_from(target.mesh, int(p)) ** 2 for p in target.samples])
    cost = source.functions.toarray() @ softmap.coefficients @ squares
    found = pointmap(softmap, "barycentre")
    np.testing.assert_allclose(cost[np.arange(150), found.targets], cost.min(axis=1), rtol=1e-12)


@pytest.mark.parametrize(("method", "share"), [("peak", 0.5), ("barycentre", 0.05)])
def test_a_known_map_comes_back_within_a_share_of_the_samples_spacing(method: str, share: float) -> None:
    mesh = fibonacci_sphere(400)
    basis = maxent_basis(mesh, size=60)
    turned = np.arange(400)[::-1]  # the spiral, run through backwards: nearly a half turn
    found = pointmap(SoftMap.from_points(basis, basis, turned), method)  # type: ignore[arg-type]
    errors = map_quality(mesh, mesh, found.targets, turned, sources=np.arange(0, 400, 7)).errors
    spacing = (1 / 60) ** 0.5
    assert errors.mean() < share * spacing
    assert errors.max() < 2 * share * spacing
    assert (found.confidence > 0.4).all()


def test_confidence_is_low_where_mass_is_spread(bases: tuple[Basis, Basis]) -> None:
    source, target = bases
    assert pointmap(SoftMap.uniform(source, target)).confidence.max() < 1
    one = np.zeros((14, 12))
    one[:, 3] = 1.0
    np.testing.assert_allclose(pointmap(SoftMap(source, target, one)).confidence, 1, rtol=1e-14)


def test_vertices_of_no_face_go_nowhere_and_are_nobody_s_image() -> None:
    mesh = grid(4, 4)
    lonely = Mesh(np.concatenate([[[9.0, 9.0, 9.0]], mesh.vertices]), mesh.faces + 1)
    basis = poisson_basis(lonely, size=5, first=1)
    for method in ("peak", "barycentre"):
        found = pointmap(SoftMap.uniform(basis, basis), method)  # type: ignore[arg-type]
        assert found.targets[0] == -1
        assert found.confidence[0] == 0
        assert (found.targets[1:] > 0).all()


def test_progress_rises_to_one_and_may_cancel(bases: tuple[Basis, Basis]) -> None:
    softmap = SoftMap.uniform(*bases)
    for method in ("peak", "barycentre"):
        seen: list[float] = []
        pointmap(softmap, method, progress=seen.append)  # type: ignore[arg-type]
        assert seen == sorted(seen)
        assert seen[-1] == 1.0

    def cancel(_: float) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        pointmap(softmap, progress=cancel)


def test_more_rows_than_a_block_holds(rng: np.random.Generator) -> None:
    basis = poisson_basis(fibonacci_sphere(1600), size=8)
    assert BLOCK_ENTRIES < 1600**2
    softmap = SoftMap(basis, basis, rng.dirichlet(np.full(8, 0.5), size=8))
    density = basis.functions @ softmap.coefficients @ (basis.functions.toarray() / basis.integrals).T
    np.testing.assert_array_equal(pointmap(softmap).targets, density.argmax(axis=1))


def test_an_unknown_method_is_refused(bases: tuple[Basis, Basis]) -> None:
    with pytest.raises(SolverError, match="'median'"):
        pointmap(SoftMap.uniform(*bases), "median")  # type: ignore[arg-type]
