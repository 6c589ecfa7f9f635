"""Rows of a soft map one by one: an approximate inverse of the curvature with a barrier.

Row i sees M_i = 2 s_i U A_i⁻¹ Uᵀ + Δ_i, with Δ_i = z/x the barrier's diagonal, s_i the sum of its squared
slopes and A_i the system at the mixing weights that it meets. With D = Δ⁻¹ its inverse is

    M_i⁻¹ = D − D U (A_i / 2s_i + Uᵀ D U)⁻¹ Uᵀ D

in which every matrix is sparse. A_i is singular on the constants, so A_i⁻¹ is infinite there and M_i⁻¹ v sums
to zero by itself: the simplex constraint needs no multiplier.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from solver.cholesky import Entries, Factor, solve_again, solve_lanes
from solver.curvature import Curvature, CurvatureModel, shared
from solver.lanes import LANES, empty_lanes
from solver.mesh import FloatArray, IntArray
from solver.symbolic import Symbolic, analyse


@dataclass(frozen=True, eq=False)
class RowModel:
    """What the row blocks of different soft maps share.

    Attributes
    ----------
    model : CurvatureModel
    symbolic : Symbolic
        Of the pattern of A + UᵀU.
    entries : Entries
    mixed : csr_array, shape (E, n)
        ``mixed @ c`` are the entries of Σⱼ cⱼ Wⱼ.
    squared : csr_array, shape (E, n)
        ``squared @ d`` are the entries of Uᵀ diag(d) U.
    diagonal : ndarray of int64, shape (n,)
        Where the diagonal stands among the entries.
    shares : csr_array, shape (n₀, K)
        Of each super-face in the squared slopes of each row.
    strengths : ndarray of float64, shape (n₀,)
        s_i.
    """

    model: CurvatureModel
    symbolic: Symbolic
    entries: Entries
    mixed: sparse.csr_array
    squared: sparse.csr_array
    diagonal: IntArray
    shares: sparse.csr_array
    strengths: FloatArray

    def at(self, curvature: Curvature, rows: IntArray, inverse_barrier: FloatArray) -> RowBlocks:
        """Row blocks at a soft map.

        Parameters
        ----------
        curvature : Curvature
        rows : (m,) int64
            Rows that are free.
        inverse_barrier : (m, n) float64
            D = x/z, zero where an entry is held; columns in elimination order.

        Returns
        -------
        RowBlocks

        Raises
        ------
        MemoryError
            If there is no room for a factor of each row.
        """
        spare = -rows.size % LANES
        padded = np.concatenate([np.arange(rows.size), np.zeros(spare, dtype=np.int64)])
        strengths = self.strengths[rows]
        weights = (self.shares[rows] @ curvature.weights) / (2 * strengths)[:, None]
        batches = padded.size // LANES
        factors: list[Factor] = [None] * batches  # type: ignore[list-item]
        n = self.diagonal.size

        def factor(some: IntArray) -> None:
            matrix, diagonal = empty_lanes(self.mixed.shape[0]), empty_lanes(n)
            nothing = np.zeros((2 * n, LANES))
            for k in some:
                here = padded[k * LANES : (k + 1) * LANES]
                matrix[:] = self.mixed @ weights[here].T + self.squared @ inverse_barrier[here].T
                diagonal[:] = matrix[self.diagonal]
                values = empty_lanes(int(self.symbolic.panels.start[-1]))
                factors[k] = Factor(values, empty_lanes(n), empty_lanes(2))
                panels = self.symbolic.panels
                solve_lanes(panels, self.entries, matrix, diagonal, factors[k], nothing)

        threads = self.model.threads
        shared(factor, np.array_split(np.arange(batches), threads), threads)
        return RowBlocks(self, padded, inverse_barrier, factors)


@dataclass(frozen=True, eq=False)
class RowBlocks:
    """Block-diagonal approximate inverse: takes a gradient to a change whose rows sum to zero.

    Attributes
    ----------
    rows : RowModel
    padded : ndarray of int64
        Row of each lane; spare lanes repeat the first.
    inverse_barrier : ndarray of float64, shape (m, n)
    factors : list of Factor
    """

    rows: RowModel
    padded: IntArray
    inverse_barrier: FloatArray
    factors: list[Factor]

    def __call__(self, gradient: FloatArray) -> FloatArray:
        """Product M⁻¹ v.

        Parameters
        ----------
        gradient : (m, n) float64
            v on the free rows, columns in elimination order.

        Returns
        -------
        ndarray of float64, shape (m, n)

        Raises
        ------
        MemoryError
            If there is no room.
        """
        overlap, order, panels = self.rows.model.overlap, self.rows.symbolic.order, self.rows.symbolic.panels
        m, n = gradient.shape
        batches = len(self.factors)
        scaled = self.inverse_barrier * gradient
        right = (overlap.T @ scaled.T)[order][:, self.padded]
        x = np.zeros((batches, n, 2, LANES))
        x[:, :, 0] = right.reshape(n, batches, LANES).transpose(1, 0, 2)
        lanes = x.reshape(batches, 2 * n, LANES)

        def solve(some: IntArray) -> None:
            for k in some:
                solve_again(panels, self.factors[k], lanes[k])

        threads = self.rows.model.threads
        shared(solve, np.array_split(np.arange(batches), threads), threads)
        solved = np.empty((n, m))
        solved[order] = x[:, :, 0].transpose(1, 0, 2).reshape(n, -1)[:, :m]
        change: FloatArray = scaled - self.inverse_barrier * (overlap @ solved).T
        # Rounding leaves a row sum of a few ulps of its terms, which would drift.
        change -= self.inverse_barrier * (change.sum(axis=1) / self.inverse_barrier.sum(axis=1))[:, None]
        return change


def row_model(model: CurvatureModel) -> RowModel:
    """Lay out what the row blocks of different soft maps share.

    Parameters
    ----------
    model : CurvatureModel

    Returns
    -------
    RowModel

    Raises
    ------
    InvalidBasis
        Never here: the basis was checked when the model was made.
    """
    n = model.order.size
    tensor = model.plan.target.tensor
    overlap = model.overlap
    first, second, products = _pairs(overlap)
    at_system = np.ones(tensor.row.size)
    system = sparse.csr_array((at_system, (tensor.row, tensor.column)), shape=(n, n))
    squares = sparse.csr_array((np.ones(first.size), (first, second)), shape=(n, n))
    lower = sparse.coo_array(system + squares)
    symbolic = analyse(sparse.csr_array(lower + lower.T))
    keys = lower.row.astype(np.int64) * n + lower.col
    sort = np.argsort(keys)

    def entry(row: IntArray, column: IntArray) -> IntArray:
        found: IntArray = sort[np.searchsorted(keys, row * n + column, sorter=sort)]
        return found

    mixing = sparse.csr_array((at_system, (entry(tensor.row, tensor.column), np.arange(tensor.row.size))))
    mixing.resize(keys.size, tensor.row.size)
    column_of = np.repeat(np.arange(n), _pair_counts(overlap))
    squared = sparse.csr_array((products, (entry(first, second), column_of)), shape=(keys.size, n))
    place = np.argsort(symbolic.order)
    a, b = place[lower.row], place[lower.col]
    rows, columns = np.maximum(a, b), np.minimum(a, b)
    cells = symbolic.cells(rows, columns)
    by_cell = np.argsort(cells)
    start = np.searchsorted(cells[by_cell], symbolic.panels.start)
    diagonal = np.empty(n, dtype=np.int64)
    on_diagonal = np.flatnonzero(rows == columns)
    diagonal[rows[on_diagonal]] = on_diagonal
    strengths, shares = _shares(model)
    return RowModel(
        model=model,
        symbolic=symbolic,
        entries=Entries(start.astype(np.int64), by_cell.astype(np.int64), cells[by_cell].astype(np.int64)),
        mixed=sparse.csr_array(mixing @ model.entries),
        squared=squared,
        diagonal=diagonal,
        shares=shares,
        strengths=strengths,
    )


def _shares(model: CurvatureModel) -> tuple[FloatArray, sparse.csr_array]:
    """Strengths s_i, and shares (n₀, K) of the super-faces in them."""
    one, other = model.faces.slopes
    squares = sparse.csr_array((one.multiply(one) + other.multiply(other)).T)
    strengths: FloatArray = squares.sum(axis=1)
    # A source function that is constant has no slope; its row is then held by the barrier alone.
    floor = np.finfo(np.float64).eps * max(float(strengths.max()), 1.0)
    strengths = np.maximum(strengths, floor)
    return strengths, sparse.csr_array(sparse.diags_array(1 / strengths) @ squares)


def _pair_counts(overlap: sparse.csr_array) -> IntArray:
    counts = np.diff(overlap.indptr).astype(np.int64)
    pairs: IntArray = counts * (counts + 1) // 2
    return pairs


def _pairs(overlap: sparse.csr_array) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs k ≥ l of columns in each row j of U, row by row, and U[j, k] U[j, l]."""
    first, second, products = [], [], []
    for j in range(overlap.shape[0]):
        here = slice(overlap.indptr[j], overlap.indptr[j + 1])
        columns, values = overlap.indices[here].astype(np.int64), overlap.data[here]
        above, below = np.tril_indices(columns.size)
        first.append(np.maximum(columns[above], columns[below]))
        second.append(np.minimum(columns[above], columns[below]))
        products.append(values[above] * values[below])
    return np.concatenate(first), np.concatenate(second), np.concatenate(products)
