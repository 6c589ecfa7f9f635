"""Factorisations side by side: against numpy on every kind of pattern, in company, and when they fail."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from solver.basis import poisson_basis
from solver.cholesky import Entries, Factor, solve_lanes
from solver.lanes import LANES, empty_lanes
from solver.symbolic import WIDEST, Symbolic, analyse
from solver.tensor import face_gradients, target_tensor
from tests.solver import dense
from tests.solver.shapes import grid, icosphere, torus


def lattice(rows: int, columns: int, reach: int) -> np.ndarray:
    """Pattern of unknowns on a square lattice, each tied to all within `reach`."""
    x, y = np.divmod(np.arange(rows * columns), columns)
    return (abs(x[:, None] - x) <= reach) & (abs(y[:, None] - y) <= reach)


def arrow(n: int) -> np.ndarray:
    """Pattern of a diagonal and one full row and column, which a bad order fills completely."""
    pattern = np.eye(n, dtype=bool)
    pattern[0] = pattern[:, 0] = True
    return pattern


def scattered(n: int, seed: int) -> np.ndarray:
    pattern = np.random.default_rng(seed).random((n, n)) < 3 / n
    return pattern | pattern.T | np.eye(n, dtype=bool)


PATTERNS = {
    "one": np.ones((1, 1), dtype=bool),
    "two": np.ones((2, 2), dtype=bool),
    "dense": np.ones((61, 61), dtype=bool),
    "diagonal": np.eye(9, dtype=bool),
    "two components": np.kron(np.eye(2, dtype=bool), np.ones((7, 7), dtype=bool)),
    "tridiagonal": np.eye(30, dtype=bool) | np.eye(30, k=1, dtype=bool) | np.eye(30, k=-1, dtype=bool),
    "arrow": arrow(40),
    "lattice": lattice(12, 13, 2),
    "wide lattice": lattice(6, 25, 3),
    "scattered": scattered(80, 1),
    "dense scattered": scattered(50, 2) | scattered(50, 3) | scattered(50, 4),
}


def matrices(pattern: np.ndarray, rng: np.random.Generator, count: int = LANES) -> np.ndarray:
    """Positive definite matrices of a pattern, with scales from 1e-6 to 1e6."""
    n = len(pattern)
    half = np.tril(rng.normal(size=(count, n, n)) * pattern, -1)
    symmetric = half + half.transpose(0, 2, 1)
    definite = symmetric + np.eye(n) * (abs(symmetric).sum(axis=2, keepdims=True) + 0.1)
    scale = 10 ** rng.uniform(-3, 3, size=(count, n))
    return np.asarray(scale[:, :, None] * definite * scale[:, None, :])


def solved(
    symbolic: Symbolic, given: np.ndarray, right: np.ndarray | None = None
) -> tuple[Factor, np.ndarray, np.ndarray]:
    """Factor a stack of matrices, one in each lane; beside it the reordered stack and its solutions."""
    reordered = given[:, symbolic.order][:, :, symbolic.order]
    rows, columns = np.nonzero(np.tril((given[:, symbolic.order][:, :, symbolic.order] != 0).any(axis=0)))
    cells = symbolic.cells(rows, columns)
    entry = np.argsort(cells)
    start = np.searchsorted(cells[entry], symbolic.panels.start)
    n = len(symbolic.order)
    matrix, diagonal = empty_lanes(len(rows)), empty_lanes(n)
    matrix[:] = reordered[:, rows, columns].T
    diagonal[:] = np.diagonal(reordered, axis1=1, axis2=2).T
    factor = Factor(empty_lanes(int(symbolic.panels.start[-1])), empty_lanes(n), empty_lanes(2))
    factor.values.fill(np.nan)
    right = np.ones((LANES, n, 2)) if right is None else right
    x = empty_lanes(2 * n)
    x[:] = right.reshape(LANES, -1).T
    solve_lanes(symbolic.panels, Entries(start, entry, cells[entry]), matrix, diagonal, factor, x)
    return factor, reordered, x.T.reshape(right.shape)


@pytest.mark.parametrize("name", PATTERNS)
def test_systems_of_any_pattern_are_solved(name: str, rng: np.random.Generator) -> None:
    pattern = PATTERNS[name]
    symbolic = analyse(sparse.csr_array(pattern.astype(float)))
    right = rng.normal(size=(LANES, len(pattern), 2))
    factor, given, found = solved(symbolic, matrices(pattern, rng), right)
    size = abs(given) @ abs(found) + abs(right)
    assert (abs(given @ found - right) / size).max() < 1e-14
    assert (factor.failed[0] == -1).all()


@pytest.mark.parametrize("name", ["lattice", "scattered", "dense"])
def test_the_panels_hold_the_factor(name: str, rng: np.random.Generator) -> None:
    pattern = PATTERNS[name]
    symbolic = analyse(sparse.csr_array(pattern.astype(float)))
    factor, given, _ = solved(symbolic, matrices(pattern, rng))
    expected = np.linalg.cholesky(given)
    rows, columns = np.nonzero(np.tril(abs(expected).max(axis=0)))
    found = factor.values[symbolic.cells(rows, columns)].T
    wanted = expected[:, rows, columns]
    scale = np.sqrt(np.diagonal(given, axis1=1, axis2=2))[:, rows]
    assert (abs(found - wanted) / scale).max() < 1e-13
    np.testing.assert_allclose(factor.inverse.T, 1 / np.diagonal(expected, axis1=1, axis2=2), rtol=1e-12)


@pytest.mark.parametrize("name", PATTERNS)
def test_the_order_is_a_permutation_and_panels_are_few_and_narrow(name: str) -> None:
    pattern = PATTERNS[name]
    symbolic = analyse(sparse.csr_array(pattern.astype(float)))
    n = len(pattern)
    np.testing.assert_array_equal(np.sort(symbolic.order), np.arange(n))
    panels = symbolic.panels
    assert panels.width.max() <= WIDEST
    assert panels.width.sum() == n
    np.testing.assert_array_equal(panels.first, np.cumsum(panels.width) - panels.width)


def test_an_arrow_does_not_fill_in() -> None:
    """The full row is eliminated last, whatever its number: 2n − 1 nonzeros, and little padding."""
    symbolic = analyse(sparse.csr_array(PATTERNS["arrow"].astype(float)))
    assert symbolic.panels.start[-1] < 3 * 40


def test_neighbours_change_no_bit(rng: np.random.Generator) -> None:
    """A matrix has the same factor in every lane and beside any others, even beside NaN."""
    pattern = PATTERNS["lattice"]
    symbolic = analyse(sparse.csr_array(pattern.astype(float)))
    given = matrices(pattern, rng)
    once = solved(symbolic, given)[0].values.copy()
    rolled = solved(symbolic, np.roll(given, 1, axis=0))[0].values
    np.testing.assert_array_equal(np.roll(once, 1, axis=1), rolled)
    given[1:, pattern] = np.nan
    alone = solved(symbolic, given)[0].values
    np.testing.assert_array_equal(alone[:, 0], once[:, 0])


@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan, 1e-14])
def test_a_pivot_that_is_not_positive_is_told_in_its_lane_alone(
    value: float, rng: np.random.Generator
) -> None:
    pattern = PATTERNS["lattice"]
    symbolic = analyse(sparse.csr_array(pattern.astype(float)))
    given = np.tile(np.eye(len(pattern)), (LANES, 1, 1)) + 1e-3 * pattern
    lane, column = 2, 31
    # Column and row of a block diag(1, value): eliminating the first leaves `value` at the second.
    given[lane] = np.eye(len(pattern))
    other = 5
    given[lane, column, other] = given[lane, other, column] = 1.0
    given[lane, column, column] = 1.0 + value
    factor, _, _ = solved(symbolic, given)
    last = max(np.flatnonzero(symbolic.order == column)[0], np.flatnonzero(symbolic.order == other)[0])
    assert factor.failed[0, lane] == last or np.isnan(value)
    assert factor.failed[0, lane] >= 0
    assert (np.delete(factor.failed[0], lane) == -1).all()


def test_the_tensor_of_a_target_is_that_of_the_paper() -> None:
    for mesh, size in [(icosphere(2), 21), (grid(8, 5), 12), (torus(14, 9), 30)]:
        basis = poisson_basis(mesh, size=size)
        found = target_tensor(basis)
        _, _, expected, stiffness = dense.tensors(basis)
        np.testing.assert_allclose(
            found.values.toarray(), expected[:, found.rows, found.columns].T, atol=1e-13 * abs(expected).max()
        )
        outside = np.ones((size, size), dtype=bool)
        outside[found.rows, found.columns] = outside[found.columns, found.rows] = False
        assert abs(expected[:, outside]).max(initial=0) == 0
        # The blend costs nothing: K is the combination of all Wⱼ with weights ∫βⱼ.
        np.testing.assert_allclose(
            found.values @ basis.integrals,
            stiffness[found.rows, found.columns],
            atol=1e-12 * abs(stiffness).max(),
        )


def test_gradients_on_faces_are_those_of_their_edges() -> None:
    basis = poisson_basis(torus(14, 9), size=30)
    found = face_gradients(basis)
    expected = dense.face_gradients(basis)
    faces = np.repeat(np.arange(basis.mesh.n_faces), np.diff(found.start))
    np.testing.assert_allclose(
        found.vectors, expected[faces, found.functions], atol=1e-12 * abs(expected).max()
    )
    assert abs(expected).sum() == pytest.approx(abs(found.vectors).sum(), rel=1e-12)
