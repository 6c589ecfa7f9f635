"""Energies: against a dense twin, against differences, and for every exact statement of the mathematics."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from solver.basis import Basis, poisson_basis
from solver.energy import bijectivity, dirichlet, dirichlet_block, gather_dirichlet
from solver.errors import SingularSystem, SolverError
from solver.mesh import Mesh
from solver.potential import FACE_BLOCK
from solver.softmap import SoftMap
from tests.solver.dense import dense_dirichlet, tensors
from tests.solver.shapes import fibonacci_sphere, grid, icosphere, moved, relabelled, tetrahedron, torus

#: Two solutions of systems with a condition of about 1e3 (scaled) differ by a thousand rounding errors, not
#: more.
AGREEMENT = 1e-11
#: Central differences with step 1e-5: truncation 1e-10, rounding 1e-16 / 1e-5, both relative.
DIFFERENCES = 1e-7
STEP = 1e-5


def random_map(source: Basis, target: Basis, rng: np.random.Generator, peakedness: float = 0.3) -> SoftMap:
    """A map whose rows are spread over few functions if `peakedness` is small."""
    rows = rng.dirichlet(np.full(target.size, peakedness), size=source.size)
    return SoftMap(source, target, rows)


def feasible_direction(softmap: SoftMap, rng: np.random.Generator) -> np.ndarray:
    """X with zero row sums along which C stays feasible both ways."""
    direction = softmap.coefficients * rng.normal(size=softmap.coefficients.shape)
    return np.asarray(direction - softmap.coefficients * direction.sum(axis=1, keepdims=True))


def along(softmap: SoftMap, direction: np.ndarray, step: float) -> SoftMap:
    return SoftMap(softmap.source, softmap.target, softmap.coefficients + step * direction)


@pytest.fixture(scope="module", params=["closed", "boundary", "genus"])
def softmap(request: pytest.FixtureRequest) -> SoftMap:
    closed = poisson_basis(icosphere(2), size=24)
    rng = np.random.default_rng(7)
    if request.param == "closed":
        return random_map(poisson_basis(fibonacci_sphere(100), size=17), closed, rng)
    if request.param == "boundary":
        return random_map(closed, poisson_basis(grid(9, 7), size=19), rng)
    return random_map(poisson_basis(grid(5, 6), size=11), poisson_basis(torus(20, 10), size=37), rng)


def test_energy_density_and_gradient_agree_with_the_dense_twin(softmap: SoftMap) -> None:
    found, expected = dirichlet(softmap, gradient=True), dense_dirichlet(softmap)
    assert found.energy == pytest.approx(expected.energy, rel=AGREEMENT)
    np.testing.assert_allclose(found.density, expected.density, atol=AGREEMENT * expected.density.max())
    np.testing.assert_allclose(
        found.gradient, expected.gradient, atol=AGREEMENT * abs(expected.gradient).max()
    )
    assert found.residual < 1e-14


@pytest.mark.parametrize("target", [fibonacci_sphere(100), torus(20, 10)], ids=["sphere", "torus"])
def test_faces_whose_rows_agree_are_solved_as_well_as_others(target: Mesh) -> None:
    """There b is a rounding error along u, which must not be mistaken for a charge."""
    source, target_basis = poisson_basis(torus(20, 10), size=10), poisson_basis(target, size=10)
    coefficients = SoftMap.uniform(source, target_basis).coefficients.copy()
    coefficients[0] = np.eye(10)[0]
    found = dirichlet(SoftMap(source, target_basis, coefficients))
    assert found.residual < 1e-14
    assert found.density.min() < 1e-20


@pytest.mark.parametrize("regularisation", [1e-9, 1e-5, 0.1, 0.9])
def test_any_regularisation_agrees_with_the_dense_twin(softmap: SoftMap, regularisation: float) -> None:
    found = dirichlet(softmap, regularisation, gradient=True)
    expected = dense_dirichlet(softmap, regularisation)
    np.testing.assert_allclose(found.density, expected.density, atol=1e-9 * expected.density.max())
    np.testing.assert_allclose(found.gradient, expected.gradient, atol=1e-9 * abs(expected.gradient).max())


def test_a_map_to_single_functions_agrees_with_the_dense_twin(rng: np.random.Generator) -> None:
    source, target = poisson_basis(icosphere(2), size=20), poisson_basis(torus(20, 10), size=40)
    rows = np.zeros((source.size, target.size))
    rows[np.arange(source.size), rng.integers(0, target.size, source.size)] = 1.0
    peaked = SoftMap(source, target, rows)
    found, expected = dirichlet(peaked, gradient=True), dense_dirichlet(peaked)
    np.testing.assert_allclose(found.density, expected.density, atol=1e-9 * expected.density.max())
    np.testing.assert_allclose(found.gradient, expected.gradient, atol=1e-9 * abs(expected.gradient).max())
    assert found.residual < 1e-14


def test_the_gradient_is_that_of_the_energy(softmap: SoftMap, rng: np.random.Generator) -> None:
    gradient = dirichlet(softmap, gradient=True).gradient
    assert gradient is not None
    for _ in range(3):
        direction = feasible_direction(softmap, rng)
        ahead, behind = (dirichlet(along(softmap, direction, step)).energy for step in (STEP, -STEP))
        difference = (ahead - behind) / (2 * STEP)
        assert (gradient * direction).sum() == pytest.approx(difference, rel=DIFFERENCES, abs=1e-9)


def test_the_map_times_the_gradient_is_the_energy_and_its_ridge(softmap: SoftMap) -> None:
    found = dirichlet(softmap, gradient=True)
    ridge = dense_dirichlet(softmap).regularisation_energy
    assert found.gradient is not None
    assert (softmap.coefficients * found.gradient).sum() == pytest.approx(found.energy + ridge, rel=1e-12)


def test_a_constant_map_has_no_energy(softmap: SoftMap, rng: np.random.Generator) -> None:
    row = rng.dirichlet(np.ones(softmap.target.size))
    constant = SoftMap(softmap.source, softmap.target, np.tile(row, (softmap.source.size, 1)))
    found = dirichlet(constant, gradient=True)
    assert abs(found.energy) < 1e-24
    assert found.gradient is not None
    assert abs(found.gradient).max() < 1e-11


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), weight=st.floats(0.01, 0.99), peakedness=st.sampled_from([0.02, 0.3, 5.0])
)
def test_the_energy_is_convex(seed: int, weight: float, peakedness: float) -> None:
    rng = np.random.default_rng(seed)
    one, other = (random_map(*convexity_bases(), rng, peakedness) for _ in range(2))
    mixed = SoftMap.mixture([one, other], [weight, 1 - weight])
    bound = weight * dirichlet(one).energy + (1 - weight) * dirichlet(other).energy
    assert dirichlet(mixed).energy <= bound * (1 + 1e-12)
    bound = weight * bijectivity(one).energy + (1 - weight) * bijectivity(other).energy
    assert bijectivity(mixed).energy <= bound * (1 + 1e-12)


_BASES: list[Basis] = []


def convexity_bases() -> tuple[Basis, Basis]:
    if not _BASES:
        _BASES.extend([poisson_basis(icosphere(1), size=9), poisson_basis(torus(12, 8), size=13)])
    return _BASES[0], _BASES[1]


def carried(basis: Basis, mesh: Mesh, order: np.ndarray | None = None) -> Basis:
    """The same functions on a mesh that is the same surface."""
    if order is None:
        return Basis(mesh, basis.functions, basis.samples, basis.cells)
    place = np.argsort(order)
    return Basis(mesh, sparse.csr_array(basis.functions[order]), place[basis.samples], basis.cells[order])


def reordered_faces(mesh: Mesh, rng: np.random.Generator) -> tuple[Mesh, np.ndarray]:
    """Faces in another order, each starting at another corner."""
    order = rng.permutation(mesh.n_faces)
    starts = rng.integers(0, 3, mesh.n_faces)
    corners = (starts[:, None] + np.arange(3)) % 3
    return Mesh(mesh.vertices, np.take_along_axis(mesh.faces[order], corners, axis=1)), order


def test_neither_motion_scale_nor_labels_matter(softmap: SoftMap, rng: np.random.Generator) -> None:
    expected = dirichlet(softmap, gradient=True)
    source, target = softmap.source, softmap.target
    order, target_order = (rng.permutation(basis.mesh.n_vertices) for basis in (source, target))
    changed = SoftMap(
        carried(source, relabelled(moved(source.mesh, rng, 7.0), order), order),
        carried(target, relabelled(moved(target.mesh, rng, 1e-3), target_order), target_order),
        softmap.coefficients,
    )
    found = dirichlet(changed, gradient=True)
    np.testing.assert_allclose(found.density, expected.density, atol=1e-10 * expected.density.max())
    assert expected.gradient is not None
    np.testing.assert_allclose(found.gradient, expected.gradient, atol=1e-10 * abs(expected.gradient).max())
    assert bijectivity(changed).energy == pytest.approx(bijectivity(softmap).energy, rel=1e-12)


def test_the_order_of_corners_and_faces_does_not_matter(softmap: SoftMap, rng: np.random.Generator) -> None:
    source, order = reordered_faces(softmap.source.mesh, rng)
    target, _ = reordered_faces(softmap.target.mesh, rng)
    changed = SoftMap(carried(softmap.source, source), carried(softmap.target, target), softmap.coefficients)
    expected = dirichlet(softmap)
    found = dirichlet(changed)
    np.testing.assert_allclose(found.density, expected.density[order], atol=1e-10 * expected.density.max())
    assert found.energy == pytest.approx(expected.energy, rel=1e-12)


def test_threads_change_no_bit(softmap: SoftMap) -> None:
    one, three = dirichlet(softmap, gradient=True), dirichlet(softmap, gradient=True, threads=3)
    assert one.energy == three.energy
    assert one.residual == three.residual
    np.testing.assert_array_equal(one.density, three.density)
    np.testing.assert_array_equal(one.gradient, three.gradient)


def test_company_changes_no_bit(softmap: SoftMap) -> None:
    """A face's density is the same to the bit whichever faces share its batch."""
    together = dirichlet(softmap).density
    for start, stop in [(0, 1), (5, 6), (3, 14), (17, softmap.source.mesh.n_faces)]:
        np.testing.assert_array_equal(dirichlet_block(softmap, start, stop).density, together[start:stop])


def test_blocks_gathered_are_the_whole_to_the_bit(rng: np.random.Generator) -> None:
    source, target = poisson_basis(fibonacci_sphere(2300), size=12), poisson_basis(torus(12, 8), size=13)
    softmap = random_map(source, target, rng)
    n_faces = source.mesh.n_faces
    assert n_faces > FACE_BLOCK
    heard: list[float] = []
    whole = dirichlet(softmap, gradient=True, progress=heard.append)
    gathered = gather_dirichlet(
        dirichlet_block(softmap, start, min(start + FACE_BLOCK, n_faces), gradient=True, threads=2)
        for start in range(0, n_faces, FACE_BLOCK)
    )
    assert whole.energy == gathered.energy
    np.testing.assert_array_equal(whole.density, gathered.density)
    np.testing.assert_array_equal(whole.gradient, gathered.gradient)
    assert heard == sorted(heard)
    assert heard[-1] == 1.0


def test_progress_may_abort(softmap: SoftMap) -> None:
    class Enough(Exception):
        pass

    def stop(_: float) -> None:
        raise Enough

    for threads in (1, 2):
        with pytest.raises(Enough):
            dirichlet(softmap, progress=stop, threads=threads)


def test_dependent_functions_are_a_singular_system_that_names_its_face(rng: np.random.Generator) -> None:
    target = poisson_basis(icosphere(2), size=20)
    halves = sparse.csr_array(
        sparse.hstack([target.functions[:, :1] / 2, target.functions[:, :1] / 2, target.functions[:, 1:]])
    )
    twins = Basis(target.mesh, halves, np.append(target.samples[0], target.samples), target.cells + 1)
    softmap = random_map(poisson_basis(grid(4, 4), size=6), twins, rng)
    with pytest.raises(SingularSystem, match=r"face 0 .* function [01] ") as caught:
        dirichlet(softmap)
    assert caught.value.index == 0
    assert isinstance(caught.value.value, float)
    assert abs(caught.value.value) < 1e-12


def test_functions_that_are_all_constant_are_a_singular_system() -> None:
    same = poisson_basis(tetrahedron(), size=4)
    with pytest.raises(SingularSystem):
        dirichlet(SoftMap.uniform(same, same))


def test_one_function_has_no_energy() -> None:
    sphere = poisson_basis(icosphere(1), size=8)
    alone = poisson_basis(icosphere(1), size=1)
    found = dirichlet(SoftMap.uniform(sphere, alone), gradient=True)
    assert found.energy == 0
    assert not found.density.any()


@pytest.mark.parametrize("regularisation", [0.0, 1.0, -1e-5, 2.0, float("nan"), float("inf")])
def test_regularisation_lies_between_0_and_1(softmap: SoftMap, regularisation: float) -> None:
    with pytest.raises(SolverError, match="regularisation"):
        dirichlet(softmap, regularisation)


@pytest.mark.parametrize(("start", "stop"), [(-1, 2), (2, 2), (0, 10**6)])
def test_a_block_that_is_none_is_refused(softmap: SoftMap, start: int, stop: int) -> None:
    with pytest.raises(SolverError, match="block"):
        dirichlet_block(softmap, start, stop)


def test_no_blocks_gather_to_nothing() -> None:
    with pytest.raises(SolverError, match="no block"):
        gather_dirichlet([])


# -- bijectivity
# ----------------------------------------------------------------------------------------------------


def test_bijectivity_is_what_the_paper_says(softmap: SoftMap) -> None:
    found = bijectivity(softmap)
    areas = softmap.target.mesh.face_areas
    means, _, _, _ = tensors(softmap.target)
    densities = means / (areas @ means)
    received = softmap.source.integrals @ softmap.coefficients
    np.testing.assert_allclose(found.density, densities @ received, rtol=1e-12)
    products = densities.T @ (areas[:, None] * densities)
    assert found.energy == pytest.approx(received @ products @ received, rel=1e-12)
    assert areas @ found.density == pytest.approx(1, rel=1e-12)


def test_the_uniform_map_is_a_minimum_of_bijectivity(softmap: SoftMap, rng: np.random.Generator) -> None:
    uniform = SoftMap.uniform(softmap.source, softmap.target)
    found = bijectivity(uniform)
    assert found.energy == pytest.approx(1, abs=1e-13)
    np.testing.assert_allclose(found.density, 1, rtol=1e-12)
    assert bijectivity(softmap).energy > 1
    # Any map with B₀ᵀC = ∫β is a minimum: move mass between two rows so that what arrives stays the same.
    weights = softmap.source.integrals
    change = 0.1 * weights.min() * softmap.target.integrals.min() * rng.uniform(-1, 1, softmap.target.size)
    change -= change.mean()
    rows = uniform.coefficients.copy()
    rows[0] += change / weights[0]
    rows[1] -= change / weights[1]
    assert bijectivity(SoftMap(softmap.source, softmap.target, rows)).energy == pytest.approx(1, abs=1e-13)


def test_the_gradient_of_bijectivity(softmap: SoftMap, rng: np.random.Generator) -> None:
    found = bijectivity(softmap)
    direction = feasible_direction(softmap, rng)
    ahead, behind = (bijectivity(along(softmap, direction, step)).energy for step in (1e-3, -1e-3))
    assert (found.gradient * direction).sum() == pytest.approx((ahead - behind) / 2e-3, rel=1e-9)
    assert (found.gradient * softmap.coefficients).sum() == pytest.approx(2 * found.energy, rel=1e-12)


# -- known values
# ---------------------------------------------------------------------------------------------------


def sphere_energy(kappa: float, cells: int = 4000) -> float:
    """E_D of ρ ∝ exp(κ⟨x, y⟩) on the unit-area sphere: (sinθ f h')'/sinθ − f h/sin²θ = f' by elements."""
    theta = np.linspace(0, np.pi, cells + 1)
    middle, step = (theta[1:] + theta[:-1]) / 2, np.pi / cells
    radius_squared = 1 / (4 * np.pi)
    f = np.exp(kappa * (np.cos(middle) - 1))
    f /= 2 * np.pi * radius_squared * (f * np.sin(middle)).sum() * step
    slope = -kappa * np.sin(middle) * f
    sine = np.sin(middle)
    # Weak form, h(0) = h(π) = 0: ∫ f (sinθ h'v' + h v / sinθ) = −∫ f' v sinθ, midpoint rule on each cell.
    stiff, massive = f * sine / step, f / sine * step / 4
    diagonal = (stiff + massive)[:-1] + (stiff + massive)[1:]
    off = (massive - stiff)[1:-1]
    load = -(slope * sine * step / 2)
    system = sparse.diags_array([off, diagonal, off], offsets=[-1, 0, 1]).tocsc()
    h = np.concatenate([[0], sparse.linalg.spsolve(system, load[:-1] + load[1:]), [0]])
    return float(-2 * np.pi * radius_squared * (slope * sine * (h[1:] + h[:-1]) / 2).sum() * step)


@pytest.mark.parametrize(
    ("kappa", "expected"),
    [(0.01, 3.33328e-5), (1, 0.289208), (5, 1.560212), (20, 1.898210), (100, 1.979932), (300, 1.993325)],
)
def test_the_boundary_value_problem_on_the_sphere(kappa: float, expected: float) -> None:
    assert sphere_energy(kappa) == pytest.approx(expected, rel=3e-5)


def test_a_smooth_map_on_the_sphere_is_near_the_exact_energy() -> None:
    """The poisson basis does not converge; at this size it is within a fifth."""
    basis = poisson_basis(fibonacci_sphere(1000), size=200)
    kappa = 5.0
    points = basis.mesh.unit_vertices / np.linalg.norm(basis.mesh.unit_vertices, axis=1, keepdims=True)
    kernel: Callable[[np.ndarray], np.ndarray] = lambda cosine: np.exp(kappa * (cosine - 1))  # noqa: E731
    masses = np.bincount(basis.mesh.faces.ravel(), np.repeat(basis.mesh.face_areas / 3, 3))
    rows = (basis.functions.T @ (kernel(points @ points[basis.samples].T) * masses[:, None])).T
    softmap = SoftMap(basis, basis, rows / rows.sum(axis=1, keepdims=True))
    assert dirichlet(softmap).energy == pytest.approx(1.560212, rel=0.2)
