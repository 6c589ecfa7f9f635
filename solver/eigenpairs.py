"""Smallest eigenpairs K φ = λ M φ of a Laplacian: block Lanczos on its shifted inverse, or all at once.

Lanczos runs on M^½ (K + sM)⁻¹ M^½, whose largest eigenvalues 1 / (λ + s) belong to the smallest λ, without
restarts: hundreds of pairs need a basis about three times as long. Its vectors come in blocks as wide as a
register, which one sweep over the factor serves, and products with the basis run on threads.
"""

from __future__ import annotations

import math
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
from scipy import sparse

from solver.errors import InvalidDescriptor
from solver.factored import Factored, factored
from solver.mesh import FloatArray

#: Vectors of a block, and of the blocks to try where eigenvalues were left out: those repeated more often.
WIDTHS = (8, 32, 128)
#: Up to this many rows, or this many for each pair wanted, a dense eigensolver is quicker.
DENSE_ROWS, DENSE_ROWS_PER_PAIR = 600, 4
#: The shift as a share of the largest wanted eigenvalue, which Weyl's law puts near 4πk on a unit area: small
#: enough for small λ to stand out, large enough for constants not to drown the others in rounding.
SHIFT_SHARE = 1 / 16
#: Residual, relative to its eigenvalue, of a pair that has converged. Its λ is off by the square of that.
CONVERGED = 1e-11
#: Length of the basis at the first look, and how much longer it becomes for each pair that has not converged.
FIRST_LOOK, EACH_MISSING = 2.25, 2.2
#: Longest basis, in vectors for each pair wanted and in blocks.
LONGEST, LONGEST_BLOCKS = 8, 64
#: Columns that the basis grows by, and rows of it that one thread multiplies at a time.
PANEL, PIECE = 128, 8192
#: Gap, relative to the last eigenvalue, in which counting eigenvalues by a factorisation is well conditioned.
APART = 1e-4


def smallest_eigenpairs(
    stiffness: sparse.sparray, weights: FloatArray, count: int, threads: int | None = None
) -> tuple[FloatArray, FloatArray]:
    """Smallest eigenpairs K φ = λ M φ, counted (Sylvester's law of inertia) so that none is left out.

    Parameters
    ----------
    stiffness : sparse array, shape (n, n)
        K, symmetric and positive semi-definite.
    weights : ndarray of float64, shape (n,)
        Diagonal of M, positive, summing to about 1.
    count : int
        How many, k ≤ n.
    threads : int, optional
        Threads that share products with the basis, one by default. The result does not depend on it.

    Returns
    -------
    values : ndarray of float64, shape (k,)
        Ascending.
    functions : ndarray of float64, shape (n, k)
        Orthonormal for M.

    Raises
    ------
    InvalidDescriptor
        If they were not found: the matrix is too badly conditioned.
    """
    n = weights.size
    with ThreadPoolExecutor(threads or 1) as pool:
        for width in WIDTHS:
            if n <= max(DENSE_ROWS, DENSE_ROWS_PER_PAIR * count, LONGEST_BLOCKS * width):
                return _dense_eigenpairs(stiffness, weights, count)
            try:
                values, functions = _lanczos(stiffness, weights, count, width, pool)
                if not values.size:
                    continue
                limit, found = _separated(values)
                if (
                    found == 0
                    or found == factored(stiffness - sparse.diags_array(limit * weights)).n_negative
                ):
                    return values, functions
            except RuntimeError as error:
                raise InvalidDescriptor(f"the Laplacian cannot be factored: {error}") from error
    raise InvalidDescriptor(f"the eigensolver did not find the {count} smallest eigenvalues", value=count)


def _separated(values: FloatArray) -> tuple[float, int]:
    """A number in the last gap between eigenvalues, and how many are below it; 0 if all are the same."""
    gaps = np.flatnonzero(np.diff(values) > APART * (values[-1] + 4 * math.pi))
    if not gaps.size:
        return 0.0, 0
    last = int(gaps[-1])
    return float(values[last] + values[last + 1]) / 2, last + 1


def _dense_eigenpairs(
    stiffness: sparse.sparray, weights: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    root = np.sqrt(weights)
    symmetric = stiffness.toarray() / np.outer(root, root)
    values, functions = scipy.linalg.eigh(symmetric, subset_by_index=(0, count - 1))
    return values, functions / root[:, None]


def _lanczos(
    stiffness: sparse.sparray, weights: FloatArray, count: int, width: int, pool: Executor
) -> tuple[FloatArray, FloatArray]:
    """Eigenpairs, or none; of an eigenvalue repeated more than `width` times, copies may be missing."""
    n = weights.size
    root = np.sqrt(weights)[:, None]
    shift = SHIFT_SHARE * 4 * math.pi * count
    inverse: Factored = factored(stiffness + sparse.diags_array(shift * weights))
    longest = min(n, LONGEST * count + LONGEST_BLOCKS * width)
    basis = _Panels(n, pool)
    # Block tridiagonal: the inverse in the basis.
    projected = np.zeros((longest + width, longest + width))
    # A fixed start makes the answer repeatable, and a random one has a part in every eigenspace.
    block, corner = _orthonormal(np.random.default_rng(0).standard_normal((n, width)))
    previous = np.zeros_like(block)
    look = FIRST_LOOK * count
    while basis.length + width <= longest:
        own = slice(basis.length, basis.length + width)
        basis.append(block)
        image = root * inverse.solve(root * block)
        # First what the recurrence says, so that what is left of the whole basis is rounding.
        image -= previous @ corner.T
        inner = block.T @ image
        image -= block @ inner
        rest = basis.overlap(image)
        basis.subtract(rest, image)
        inner += rest[own]
        projected[own, own] = (inner + inner.T) / 2
        previous = block
        block, corner = _orthonormal(image)
        if basis.length >= look:
            size = basis.length
            inverted, mix = scipy.linalg.eigh(
                projected[:size, :size], subset_by_index=(size - count, size - 1), check_finite=False
            )
            residuals = np.linalg.norm(corner @ mix[own], axis=0) / inverted
            missing = int((~(residuals <= CONVERGED)).sum())
            if not missing:
                functions = basis.combined(mix[:, ::-1]) / root
                return 1.0 / inverted[::-1] - shift, functions
            look = size + max(width, EACH_MISSING * missing, size / 16)
        after = slice(own.stop, own.stop + width)
        projected[after, own], projected[own, after] = corner, corner.T
    return np.empty(0), np.empty((n, 0))


def _orthonormal(block: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Q and R of a block of vectors."""
    q, r = scipy.linalg.qr(block, mode="economic", check_finite=False)
    return np.ascontiguousarray(q), r


@dataclass(eq=False)
class _Panels:
    """Columns of a growing basis B, a panel of them after another; products by pieces of rows, on threads.

    Threads cannot change a bit: pieces are always the same, and sums of them are added in order.
    """

    n_rows: int
    pool: Executor
    length: int = 0
    panels: list[FloatArray] = field(default_factory=list)

    def append(self, block: FloatArray) -> None:
        """Add columns; every block is as wide as the first."""
        start = self.length % PANEL
        if start == 0:
            self.panels.append(np.empty((self.n_rows, PANEL)))
        self.panels[-1][:, start : start + block.shape[1]] = block
        self.length += block.shape[1]

    def overlap(self, block: FloatArray) -> FloatArray:
        """Bᵀ X."""

        def of(rows: slice) -> FloatArray:
            return np.concatenate([panel[rows].T @ block[rows] for panel in self._filled()])

        total: FloatArray = sum(self.pool.map(of, self._pieces()), np.zeros((self.length, block.shape[1])))
        return total

    def subtract(self, factors: FloatArray, block: FloatArray) -> None:
        """X −= B H, in place."""

        def at(rows: slice) -> None:
            for k, panel in enumerate(self._filled()):
                block[rows] -= panel[rows] @ factors[k * PANEL : (k + 1) * PANEL]

        list(self.pool.map(at, self._pieces()))

    def combined(self, factors: FloatArray) -> FloatArray:
        """B H."""
        found = np.zeros((self.n_rows, factors.shape[1]))
        self.subtract(-factors, found)
        return found

    def _filled(self) -> list[FloatArray]:
        return [*self.panels[:-1], self.panels[-1][:, : (self.length - 1) % PANEL + 1]]

    def _pieces(self) -> list[slice]:
        return [slice(start, start + PIECE) for start in range(0, self.n_rows, PIECE)]
