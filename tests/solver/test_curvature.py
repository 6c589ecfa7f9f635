"""Super-faces, the second derivative on them, its row blocks, and the Newton system made of both."""

from __future__ import annotations

import numpy as np
import pytest

from solver.basis import Basis
from solver.curvature import Curvature, curvature_model
from solver.energy import bijectivity, dirichlet
from solver.maxent import maxent_basis
from solver.mesh import FloatArray
from solver.newton import Step, newton_system
from solver.rowblocks import row_model
from solver.softmap import SoftMap
from solver.superfaces import super_faces
from tests.solver.dense import face_gradients
from tests.solver.shapes import fibonacci_sphere, torus

WEIGHT = 0.7
REGULARISATION = 1e-3


@pytest.fixture(scope="module")
def bases() -> tuple[Basis, Basis]:
    return maxent_basis(fibonacci_sphere(60), size=7), maxent_basis(torus(12, 6), size=11)


@pytest.fixture(scope="module")
def coefficients() -> FloatArray:
    return np.random.default_rng(3).dirichlet(np.full(11, 1.5), size=7)


def curvature(
    bases: tuple[Basis, Basis], coefficients: FloatArray, count: int, threads: int = 1
) -> Curvature:
    model = curvature_model(*bases, super_faces(bases[0], count), REGULARISATION, WEIGHT, threads)
    return model.at(np.ascontiguousarray(coefficients[:, model.order]))


def sumless(shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    """A random change whose rows sum to zero."""
    change = rng.normal(size=shape)
    return change - change.mean(axis=1, keepdims=True)


def dense(operator, shape: tuple[int, int]) -> FloatArray:  # type: ignore[no-untyped-def]
    """Matrix of a linear map of changes with rows that sum to zero."""
    columns = []
    for unit in np.eye(shape[0] * shape[1]):
        change = unit.reshape(shape)
        product = operator(change - change.mean(axis=1, keepdims=True))
        columns.append((product - product.mean(axis=1, keepdims=True)).ravel())
    return np.array(columns).T


def test_super_faces_keep_integrals_and_the_trace_of_slopes(bases: tuple[Basis, Basis]) -> None:
    source = bases[0]
    mesh = source.mesh
    squares = np.einsum("f,fnx->fn", mesh.face_areas, face_gradients(source) ** 2)
    for count in (4, 20, mesh.n_faces):
        faces = super_faces(source, count)
        assert faces.count <= count
        np.testing.assert_allclose(faces.means.sum(axis=1), 1, rtol=1e-12)
        traces = sum(float((slope.multiply(slope)).sum()) for slope in faces.slopes)
        assert traces == pytest.approx(squares.sum(), rel=1e-12)
    np.testing.assert_allclose(faces.means.toarray(), source.face_means.toarray(), rtol=1e-12)


def test_on_the_faces_themselves_curvature_is_the_second_derivative(
    bases: tuple[Basis, Basis], coefficients: FloatArray, rng: np.random.Generator
) -> None:
    found = curvature(bases, coefficients, bases[0].mesh.n_faces)
    order = found.model.order
    change = 1e-5 * sumless(coefficients.shape, rng)

    def gradient(c: FloatArray) -> FloatArray:
        softmap = SoftMap(*bases, c)
        smooth = dirichlet(softmap, REGULARISATION, gradient=True)
        assert smooth.gradient is not None
        return smooth.gradient + WEIGHT * bijectivity(softmap).gradient

    turned = (gradient(coefficients + change) - gradient(coefficients - change)) / 2
    product = np.empty_like(change)
    product[:, order] = found(np.ascontiguousarray(change[:, order]))
    turned -= turned.mean(axis=1, keepdims=True)
    product -= product.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(product, turned, atol=1e-6 * abs(turned).max())


@pytest.mark.parametrize("count", [5, 13])
def test_curvature_on_super_faces_is_symmetric_and_positive(
    bases: tuple[Basis, Basis], coefficients: FloatArray, count: int
) -> None:
    matrix = dense(curvature(bases, coefficients, count), coefficients.shape)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * abs(matrix).max())
    assert np.linalg.eigvalsh(matrix)[0] > -1e-12 * abs(matrix).max()
    threaded = curvature(bases, coefficients, count, threads=2)
    np.testing.assert_allclose(dense(threaded, coefficients.shape), matrix, atol=1e-13 * abs(matrix).max())


def test_row_blocks_invert_rows_of_the_curvature_with_a_barrier(
    bases: tuple[Basis, Basis], coefficients: FloatArray, rng: np.random.Generator
) -> None:
    """M⁻¹ = (2 sᵢ U Aᵢ⁺ Uᵀ + Δ)⁻¹ on changes that sum to zero, held entries left alone."""
    found = curvature(bases, coefficients, 12)
    order, target = found.model.order, bases[1]
    blocks = row_model(found.model)
    rows = np.array([0, 2, 3, 4, 6])
    inverse_barrier = 10.0 ** rng.uniform(-3, 1, size=(5, 11))
    inverse_barrier[1, :6] = 0.0
    right = sumless((5, 11), rng)
    right[inverse_barrier == 0] = 0.0
    change = blocks.at(found, rows, inverse_barrier)(right)
    tensor = np.einsum(
        "f,fj,fax,fbx->jab",
        target.mesh.face_areas,
        target.densities.toarray(),
        *(2 * [face_gradients(target)]),
        optimize=True,
    )[order][:, order][:, :, order]
    overlap = target.overlap.toarray()[order][:, order]
    for k, row in enumerate(rows):
        weights = (blocks.shares[[row]] @ found.weights)[0]
        system = np.tensordot(weights, tensor, axes=1) / (2 * blocks.strengths[row])
        free = inverse_barrier[k] > 0
        matrix = (overlap @ np.linalg.pinv(system, rcond=1e-12) @ overlap.T)[free][:, free]
        matrix += np.diag(1 / inverse_barrier[k][free])
        count = int(free.sum())
        bordered = np.block([[matrix, np.ones((count, 1))], [np.ones((1, count)), np.zeros((1, 1))]])
        expected = np.linalg.solve(bordered, np.append(right[k][free], 0.0))[:-1]
        np.testing.assert_allclose(change[k][free], expected, atol=1e-9 * abs(expected).max())
        assert (change[k][~free] == 0).all()


@pytest.mark.parametrize("constrained", [False, True])
def test_the_newton_system_is_solved_within_its_constraints(
    bases: tuple[Basis, Basis], coefficients: FloatArray, rng: np.random.Generator, constrained: bool
) -> None:
    """The step leaves less of the energy of the model than a tenth of the preconditioned residual allows."""
    found = curvature(bases, coefficients, 12)
    rows = np.array([0, 1, 2, 4, 5, 6])
    weights = np.zeros((int(constrained), 7))
    weights[:, [1, 2, 4]] = [0.2, 0.5, 0.3]
    inverse_barrier = 10.0 ** rng.uniform(-4, 2, size=(6, 11))
    steps = [Step(sumless((6, 11), rng), sumless((6, 11), rng)) for _ in range(4)]
    steps = [Step(step.taken, step.turned + 40 * step.taken) for step in steps]
    system = newton_system(found, row_model(found.model), rows, weights, inverse_barrier, steps)
    right, off = rng.normal(size=(6, 11)), 1e-3 * sumless((int(constrained), 11), rng)
    change, multipliers = system.solve(right, off)
    np.testing.assert_allclose(change.sum(axis=1), 0, atol=1e-11 * abs(change).max())
    np.testing.assert_allclose(weights[:, rows] @ change, off, atol=1e-11)
    # The last correction makes the model turn as its step did.
    turned = system._product(steps[-1].taken) - steps[-1].taken / inverse_barrier
    np.testing.assert_allclose(
        turned - turned.mean(axis=1, keepdims=True), steps[-1].turned, atol=1e-9 * abs(steps[-1].turned).max()
    )
    matrix = dense(system._product, (6, 11))
    sums = np.concatenate([np.kron(np.eye(6), np.ones((1, 11))), np.kron(weights[:, rows], np.eye(11))])
    aim = np.concatenate([np.zeros(6), off.ravel()])
    kkt = np.block([[matrix, sums.T], [sums, np.zeros((len(sums),) * 2)]])
    solved = np.linalg.lstsq(kkt, np.concatenate([right.ravel(), aim]))[0]
    expected = solved[: right.size].reshape(right.shape)
    error = change - expected
    assert (error * system._product(error)).sum() < 0.05 * (expected * system._product(expected)).sum()
    if constrained:
        exact = solved[right.size + 6 :]
        exact, multipliers = exact - exact.mean(), multipliers.ravel() - multipliers.mean()
        assert np.linalg.norm(multipliers - exact) < 0.2 * np.linalg.norm(exact)
