"""Optimal soft maps: known optima, independent solvers, and certificates that hold."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import linalg, optimize

from solver.basis import Basis, poisson_basis
from solver.errors import InvalidMesh, InvalidSoftMap, SolverError
from solver.feasible import Feasible, LinearConstraint, feasible
from solver.maxent import maxent_basis
from solver.optimal import optimal_softmap
from solver.search import Iteration, Problem, Search
from solver.softmap import SoftMap
from tests.solver.dense import dense_dirichlet
from tests.solver.shapes import fibonacci_sphere, grid, icosphere, tetrahedron, together, torus

#: Central differences with step 1e-5: truncation 1e-10, rounding 1e-16 / 1e-5, both relative.
DIFFERENCES = 1e-7
STEP = 1e-5


@pytest.fixture(scope="module")
def bases() -> tuple[Basis, Basis]:
    return maxent_basis(fibonacci_sphere(150), size=16), maxent_basis(torus(16, 8), size=14)


@pytest.fixture(scope="module")
def landmarks(bases: tuple[Basis, Basis]) -> list[tuple[int, int]]:
    source, target = bases
    return [(int(source.samples[k]), int(target.samples[k])) for k in (0, 1, 2)]


@pytest.fixture(scope="module")
def tiny() -> tuple[Basis, Basis]:
    """Eight by eight functions: what a general solver can do."""
    return maxent_basis(icosphere(1), size=8), maxent_basis(grid(4, 5), size=8)


def dense_energy(source: Basis, target: Basis, coefficients: np.ndarray) -> tuple[float, np.ndarray]:
    """E_D + E_b and its gradient, without anything of the solver's."""
    smooth = dense_dirichlet(SoftMap(source, target, coefficients))
    areas, means = target.mesh.face_areas, target.functions.toarray()[target.mesh.faces].mean(axis=1)
    densities = means / (areas @ means)
    received = densities @ (source.integrals @ coefficients)
    even = areas @ received**2
    slope = 2 * np.outer(source.integrals, densities.T @ (areas * received))
    return smooth.energy + even, smooth.gradient + slope


def least_energy(source: Basis, target: Basis, allowed: Feasible) -> tuple[float, float]:
    """Bounds on the optimum by a logarithmic barrier and BFGS on the dense energy, in the free directions.

    At the minimum of E − μ Σ log x over m entries, E is at most μm above the optimum.
    """
    n0, n = source.size, target.size
    sums = np.kron(np.eye(n0), np.ones((1, n)))
    mixes = [np.kron(line, np.eye(n)) for line in allowed.weights]
    free = np.flatnonzero(allowed.allowed.ravel())
    directions = linalg.null_space(np.concatenate([sums, *mixes])[:, free])

    def energy(y: np.ndarray, barrier: float) -> tuple[float, np.ndarray]:
        c = allowed.interior.ravel().copy()
        c[free] += directions @ y
        if c[free].min() <= 0:
            return np.inf, np.zeros_like(y)
        value, slope = dense_energy(source, target, c.reshape(n0, n))
        slope = slope.ravel()[free] - barrier / c[free]
        return value - barrier * np.log(c[free]).sum(), directions.T @ slope

    y, barriers = np.zeros(directions.shape[1]), (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
    for barrier in barriers:
        y = optimize.minimize(energy, y, (barrier,), jac=True, method="BFGS", options={"gtol": 1e-6}).x
    reached = energy(y, 0.0)[0]
    return reached - 1.1 * barriers[-1] * free.size, reached


@pytest.mark.parametrize(
    ("maker", "held", "expected", "tolerance"),
    [
        # Known with other choices among tied samples. Other first samples than vertex 0, which move the
        # landmarks, change the optima by 2 %, 2 % and 11 %.
        (poisson_basis, [0], 1.044284, 0.012),
        (poisson_basis, [0, 20, 41], 1.146623, 0.015),
        (maxent_basis, [0, 20, 41], 1.6868, 0.03),
    ],
)
def test_optima_of_the_sphere(maker, held: list[int], expected: float, tolerance: float) -> None:  # type: ignore[no-untyped-def]
    basis = maker(icosphere(3), size=60)
    landmarks = [(int(basis.samples[k]), int(basis.samples[k])) for k in held]
    found = optimal_softmap(basis, basis, landmarks, threads=2)
    assert found.energy == pytest.approx(expected, rel=tolerance)
    assert found.converged
    assert found.gap <= 1e-3 * found.energy
    assert found.history[-1].evaluations < 25


def test_two_starts_and_two_methods_end_at_one_optimum(
    bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]], rng: np.random.Generator
) -> None:
    source, target = bases
    start = SoftMap(source, target, rng.dirichlet(np.full(target.size, 0.2), size=source.size))
    first = optimal_softmap(source, target, landmarks, tolerance=1e-7)
    second = optimal_softmap(source, target, landmarks, tolerance=1e-7, start=start)
    paper = optimal_softmap(source, target, landmarks, tolerance=1e-4, max_iterations=900, method="softmax")
    assert first.converged
    assert second.converged
    assert paper.converged
    assert second.energy == pytest.approx(first.energy, rel=2e-7)
    # The paper's method is at the optimum long before its gradient proves it.
    assert paper.energy == pytest.approx(first.energy, rel=1e-6)
    assert first.energy >= max(each.energy - each.gap for each in (second, paper))


def test_an_independent_solver_finds_the_same_optimum_within_the_gap(tiny: tuple[Basis, Basis]) -> None:
    source, target = tiny
    landmarks = [(int(source.samples[0]), int(target.samples[0]))]
    below, above = least_energy(source, target, feasible(source, target, landmarks))
    for tolerance in (0.3, 1e-2, 1e-7):
        found = optimal_softmap(source, target, landmarks, tolerance=tolerance)
        assert found.converged
        assert found.energy - found.gap <= above
        assert found.energy >= below
    assert found.energy <= above
    expected = dense_energy(source, target, found.softmap.coefficients)[0]
    assert found.energy == pytest.approx(expected, rel=1e-11)


def test_an_independent_solver_agrees_under_linear_constraints(tiny: tuple[Basis, Basis]) -> None:
    source, target = tiny
    constraints = (
        LinearConstraint.on_region(source, target, [int(source.samples[1])], np.arange(20, 30)),
        LinearConstraint.on_region(source, target, np.arange(20), np.arange(10, 30)),
    )
    below, above = least_energy(source, target, feasible(source, target, [], constraints))
    for tolerance in (0.1, 1e-3, 1e-6):
        found = optimal_softmap(source, target, tolerance=tolerance, constraints=constraints)
        assert found.converged
        assert found.energy - found.gap <= above
        assert found.energy >= below
        for constraint in constraints:
            got = constraint.weights @ found.softmap.coefficients
            np.testing.assert_allclose(got, constraint.values, atol=1e-13)
    assert found.energy <= above


def test_the_gap_is_a_directional_derivative(bases: tuple[Basis, Basis], rng: np.random.Generator) -> None:
    """Σᵢ (Cᵢ·Dᵢ − minⱼ Dᵢⱼ) is minus the slope of E towards the best corner, by central differences."""
    source, target = bases
    allowed = feasible(source, target, [(int(source.samples[0]), int(target.samples[0]))])
    cost = rng.random((source.size, target.size))
    search = Search(Problem(source, target, allowed, cost, 0.7, 1e-3, 1, 1e-3, 1))
    coefficients = np.where(allowed.allowed, rng.dirichlet(np.full(target.size, 3.0), size=source.size), 0.0)
    coefficients /= coefficients.sum(axis=1, keepdims=True)
    evaluation = search.evaluate(coefficients)
    gradient = np.where(allowed.allowed, evaluation.gradient, np.inf)
    corner = np.eye(target.size)[gradient.argmin(axis=1)]
    ahead, behind = (search.evaluate(coefficients + t * (corner - coefficients)) for t in (STEP, -STEP))
    slope = (ahead.energy - behind.energy) / (2 * STEP)
    assert search.prove(evaluation) == pytest.approx(-slope, rel=DIFFERENCES)
    other = coefficients * rng.normal(size=coefficients.shape)
    other -= coefficients * other.sum(axis=1, keepdims=True)
    ahead, behind = (search.evaluate(coefficients + t * other) for t in (STEP, -STEP))
    slope = (ahead.energy - behind.energy) / (2 * STEP)
    assert (evaluation.gradient * other).sum() == pytest.approx(slope, rel=DIFFERENCES, abs=1e-9)


def test_history_tells_of_a_falling_energy_and_a_bound_that_rises(
    bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]]
) -> None:
    found = optimal_softmap(*bases, landmarks, tolerance=1e-5)
    energies = np.array([each.energy for each in found.history])
    bounds = np.array([each.energy - each.gap for each in found.history])
    assert (np.diff(energies) <= 0).all()
    assert (np.diff(bounds) >= -1e-15).all()
    assert (bounds <= found.energy).all()
    assert found.iterations == len(found.history) - 1
    assert found.energy == found.dirichlet + found.bijectivity
    assert found.attachment == 0
    assert found.relative_gap <= 1e-5 < found.strict_gap <= found.gap / (found.energy - 1) * 1.001
    assert all(each.evaluations >= k + 1 for k, each in enumerate(found.history))


def test_landmarks_hold_their_rows(bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]]) -> None:
    source, target = bases
    for method in ("interior", "softmax"):
        found = optimal_softmap(source, target, landmarks, max_iterations=5, method=method)  # type: ignore[arg-type]
        np.testing.assert_array_equal(found.softmap.coefficients[:3], np.eye(target.size)[:3])


def test_a_cost_that_outweighs_all_else_is_least_at_a_corner(
    bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]], rng: np.random.Generator
) -> None:
    source, target = bases
    cost = 1e4 * rng.random((source.size, target.size))
    found = optimal_softmap(source, target, landmarks, tolerance=1e-6, cost=cost)
    corner = np.eye(target.size)[cost.argmin(axis=1)]
    corner[:3] = np.eye(target.size)[:3]
    np.testing.assert_allclose(found.softmap.coefficients, corner, atol=0.02)
    assert found.converged
    assert found.energy == pytest.approx(found.dirichlet + found.bijectivity + found.attachment, rel=1e-14)
    assert found.attachment == pytest.approx((cost * found.softmap.coefficients).sum(), rel=1e-14)


def test_without_landmarks_everything_goes_everywhere(bases: tuple[Basis, Basis]) -> None:
    found = optimal_softmap(*bases, bijectivity_weight=2.0)
    assert found.converged
    assert found.iterations == 0
    assert found.energy == pytest.approx(2.0, rel=1e-12)
    assert found.strict_gap == np.inf or found.strict_gap >= 0


def test_everything_held_leaves_nothing_to_do(tiny: tuple[Basis, Basis]) -> None:
    source, target = tiny
    pairs = [(int(v0), int(v)) for v0, v in zip(source.samples, target.samples, strict=True)]
    for method in ("interior", "softmax"):
        found = optimal_softmap(source, target, pairs, method=method)  # type: ignore[arg-type]
        np.testing.assert_array_equal(found.softmap.coefficients, np.eye(8))
        assert found.converged
        assert found.gap <= 1e-12


def test_a_run_that_was_cancelled_goes_on_from_its_last_report(
    bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]]
) -> None:
    reports: list[tuple[Iteration, SoftMap]] = []

    def stop(iteration: Iteration, softmap: SoftMap) -> None:
        reports.append((iteration, softmap))
        if len(reports) == 7:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        optimal_softmap(*bases, landmarks, tolerance=1e-5, report=stop)
    whole = optimal_softmap(*bases, landmarks, tolerance=1e-5)
    rest = optimal_softmap(*bases, landmarks, tolerance=1e-5, start=reports[-1][1])
    assert rest.converged
    assert rest.history[0].energy == pytest.approx(reports[-1][0].energy, rel=1e-14)
    assert rest.energy == pytest.approx(whole.energy, rel=1e-5)
    assert rest.iterations < whole.iterations


def test_progress_rises_to_one_and_may_cancel_within_an_iteration(
    bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]]
) -> None:
    seen: list[float] = []
    optimal_softmap(*bases, landmarks, progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    ticks = itertools.count()

    def cancel(_: float) -> None:
        if next(ticks) == 3:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        optimal_softmap(*bases, landmarks, progress=cancel)


def test_few_iterations_give_an_honest_answer(
    bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]]
) -> None:
    whole = optimal_softmap(*bases, landmarks, tolerance=1e-6)
    for iterations in (0, 1, 3):
        found = optimal_softmap(*bases, landmarks, tolerance=1e-6, max_iterations=iterations)
        assert found.iterations == iterations
        assert not found.converged
        assert found.energy - found.gap <= whole.energy <= found.energy


def test_threads_change_nothing_but_rounding(
    bases: tuple[Basis, Basis], landmarks: list[tuple[int, int]]
) -> None:
    one, two = (optimal_softmap(*bases, landmarks, max_iterations=6, threads=count) for count in (1, 2))
    assert two.energy == pytest.approx(one.energy, rel=1e-12)


def test_a_coarse_optimum_is_a_good_start() -> None:
    meshes = fibonacci_sphere(300), torus(20, 10)
    coarse, fine = ([maxent_basis(mesh, size=size) for mesh in meshes] for size in (12, 30))
    pairs = [(int(coarse[0].samples[k]), int(coarse[1].samples[k])) for k in range(3)]
    below = optimal_softmap(*coarse, pairs)
    cold, warm = (optimal_softmap(*fine, pairs, start=start) for start in (None, below.softmap))
    assert warm.history[1].gap < 0.6 * cold.history[1].gap
    assert warm.energy == pytest.approx(cold.energy, rel=1e-3)


def test_what_cannot_be_is_refused(tiny: tuple[Basis, Basis]) -> None:
    source, target = tiny
    for argument, value in (
        ("bijectivity_weight", -1.0),
        ("bijectivity_weight", np.nan),
        ("tolerance", 0.0),
        ("max_iterations", -1),
        ("method", "simplex"),
    ):
        with pytest.raises(SolverError, match=argument.split("_")[0]):
            optimal_softmap(source, target, **{argument: value})
    with pytest.raises(InvalidSoftMap, match=r"shape \(8, 8\), not \(8, 7\)"):
        optimal_softmap(source, target, cost=np.zeros((8, 7)))
    with pytest.raises(InvalidSoftMap, match="row 2 of the cost") as refused:
        optimal_softmap(source, target, cost=np.where(np.arange(8) == 2, np.nan, 0.0)[:, None] * np.ones(8))
    assert refused.value.index == 2
    with pytest.raises(SolverError, match="rows only"):
        at = LinearConstraint.at_point(source, target, 0, 0)
        optimal_softmap(source, target, constraints=[at], method="softmax")
    with pytest.raises(InvalidSoftMap, match="own meshes"):
        optimal_softmap(source, target, start=SoftMap.uniform(target, target))
    with pytest.raises(InvalidMesh, match="connected"):
        optimal_softmap(source, poisson_basis(together(tetrahedron(), tetrahedron()), size=4))
