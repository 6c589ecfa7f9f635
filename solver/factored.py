"""One large sparse symmetric matrix, factored once as P K Pᵀ = L D Lᵀ, and solved for many right-hand sides.

SuperLU finds order and factor. Its own solve takes right-hand sides one after another; here `LANES` of them
lie side by side, so that an entry of L is read once for all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from solver.cholesky import FLOATS, INTEGERS, kernel, types
from solver.lanes import LANES, empty_lanes, load, multiply, splat, store, subtract_product
from solver.mesh import FloatArray, IntArray

_NUMBERS: Any = types.Array(types.float64, 1, "C")


@dataclass(frozen=True, eq=False)
class Factored:
    """A factored symmetric matrix of n rows.

    Attributes
    ----------
    order : ndarray of int64, shape (n,)
        Row k of the factor is row ``order[k]`` of the matrix.
    start, rows : ndarray of int64, shapes (n + 1,) and (nnz,)
        Rows below the diagonal in each column of L.
    values : ndarray of float64, shape (nnz,)
        L there; its diagonal is 1.
    pivots : ndarray of float64, shape (n,)
        D.
    """

    order: IntArray
    start: IntArray
    rows: IntArray
    values: FloatArray
    pivots: FloatArray

    @property
    def n_negative(self) -> int:
        """Number of negative eigenvalues of the matrix: that of negative pivots (Sylvester)."""
        return int((self.pivots < 0).sum())

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve K x = b for several right-hand sides.

        Parameters
        ----------
        right : ndarray of float64, shape (n, k)

        Returns
        -------
        ndarray of float64, shape (n, k)

        Raises
        ------
        MemoryError
            If there is no room.
        """
        found = np.empty(right.shape)
        inverse = 1.0 / self.pivots
        x = empty_lanes(self.order.size)
        for first in range(0, right.shape[1], LANES):
            some = right[:, first : first + LANES]
            x[:, : some.shape[1]] = some[self.order]
            x[:, some.shape[1] :] = 0.0
            _substitute(self.start, self.rows, self.values, inverse, x)
            found[self.order, first : first + LANES] = x[:, : some.shape[1]]
        return found


def factored(matrix: sparse.sparray) -> Factored:
    """Factor a symmetric matrix without exchanging rows for the sake of pivots.

    Parameters
    ----------
    matrix : sparse array, shape (n, n)
        Symmetric; positive definite, or indefinite with pivots that happen to be far from 0.

    Returns
    -------
    Factored

    Raises
    ------
    RuntimeError
        If a pivot is exactly 0.
    """
    factor = linalg.splu(
        sparse.csc_array(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    if not np.array_equal(factor.perm_r, factor.perm_c):
        raise RuntimeError("a pivot is 0")
    lower = sparse.csc_array(sparse.tril(factor.L, -1))
    return Factored(
        order=np.argsort(factor.perm_c),
        start=lower.indptr.astype(np.int64),
        rows=lower.indices.astype(np.int64),
        values=np.asarray(lower.data),
        pivots=factor.U.diagonal(),
    )


@kernel(types.void(INTEGERS, INTEGERS, _NUMBERS, _NUMBERS, FLOATS))
def _substitute(start, rows, values, inverse, x):  # type: ignore[no-untyped-def]
    """Solve L D Lᵀ x = b in every lane; `x` holds b and then the solution."""
    n = inverse.size
    for column in range(n):
        own = load(x, column)
        for k in range(start[column], start[column + 1]):
            row = rows[k]
            store(x, row, subtract_product(splat(values[k]), own, load(x, row)))
    for column in range(n - 1, -1, -1):
        own = multiply(load(x, column), splat(inverse[column]))
        for k in range(start[column], start[column + 1]):
            own = subtract_product(splat(values[k]), load(x, rows[k]), own)
        store(x, column, own)
