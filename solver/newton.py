"""One linear system of the interior-point method: (H + Z/X) dx + AᵀY = r with rows of dx that sum to zero.

Solved by conjugate gradients that never leave A dx = 0: the preconditioner is the row blocks, projected.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from solver.curvature import Curvature
from solver.mesh import FloatArray, IntArray
from solver.rowblocks import RowBlocks, RowModel

#: Conjugate gradients stop when the residual, in the norm of the preconditioner, has fallen this far …
ACCURACY = 0.1
#: … or after so many iterations.
LONGEST = 40
#: Share of the largest eigenvalue below which constraints depend on one another.
DEPENDENT = 1e-12
#: Least curvature along a step, relative to the model's, that still corrects it.
LEAST_CURVATURE = 1e-3


@dataclass(frozen=True, eq=False)
class Step:
    """A step that was taken, and how the gradient turned; float64 (m, n) each, in elimination order."""

    taken: FloatArray
    turned: FloatArray


@dataclass(frozen=True, eq=False)
class Correction:
    """One update B ← B + y yᵀ / yᵀs − (Bs)(Bs)ᵀ / sᵀBs of BFGS."""

    turned: FloatArray
    turned_scale: float
    modelled: FloatArray
    modelled_scale: float

    def __call__(self, change: FloatArray) -> FloatArray:
        """Add to the product with a change."""
        added: FloatArray = self.turned * (self.turned_scale * float((self.turned * change).sum()))
        added -= self.modelled * (self.modelled_scale * float((self.modelled * change).sum()))
        return added


@dataclass(frozen=True, eq=False)
class Projection:
    """Keeps A dx = off: y ↦ y − M⁻¹Aᵀ(AM⁻¹Aᵀ)⁺(Ay − off) on the rows that constraints touch.

    Attributes
    ----------
    touched : ndarray of int64, shape (T,)
        Places of those rows among the free ones.
    weights : ndarray of float64, shape (L, T)
    inverses : ndarray of float64, shape (T, n, n)
        M⁻¹ of those rows.
    schur : ndarray of float64, shape (L n, L n)
        (AM⁻¹Aᵀ)⁺.
    """

    touched: IntArray
    weights: FloatArray
    inverses: FloatArray
    schur: FloatArray

    def multipliers(self, change: FloatArray, off: FloatArray | float = 0.0) -> FloatArray:
        """Y = (AM⁻¹Aᵀ)⁺ (A y − off), float64 (L, n)."""
        excess = self.weights @ change[self.touched] - off
        return (self.schur @ excess.ravel()).reshape(excess.shape)

    def __call__(self, change: FloatArray, off: FloatArray | float = 0.0) -> FloatArray:
        """Change with A dx = off."""
        multipliers = self.multipliers(change, off)
        pulled = np.einsum("tjk,tk->tj", self.inverses, self.weights.T @ multipliers)
        projected = change.copy()
        projected[self.touched] -= pulled
        return projected


@dataclass(frozen=True, eq=False)
class NewtonSystem:
    """The system at one soft map.

    Attributes
    ----------
    curvature : Curvature
    rows : ndarray of int64, shape (m,)
        Free rows.
    barrier : ndarray of float64, shape (m, n)
        Z/X, zero on held entries.
    corrections : list of Correction
    blocks : RowBlocks
    projection : Projection or None
        None where there are no linear constraints.
    """

    curvature: Curvature
    rows: IntArray
    barrier: FloatArray
    corrections: list[Correction]
    blocks: RowBlocks
    projection: Projection | None

    def solve(self, right: FloatArray, off: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve for a step.

        Parameters
        ----------
        right : (m, n) float64
            r, zero on held entries; columns in elimination order.
        off : (L, n) float64
            What rounding has left of the linear constraints, for the step to make up.

        Returns
        -------
        change : ndarray of float64, shape (m, n)
        multipliers : ndarray of float64, shape (L, n)
            Y, of the linear constraints.

        Raises
        ------
        MemoryError
            If there is no room.
        """
        change = np.zeros_like(right)
        residual = right.copy()
        direction = conditioned = self._condition(residual)
        length = first = float((residual * conditioned).sum())
        for _ in range(LONGEST):
            if not length > ACCURACY**2 * first:
                break
            product = self._product(direction)
            step = length / float((direction * product).sum())
            change += step * direction
            residual -= step * product
            conditioned = self._condition(residual)
            previous, length = length, float((residual * conditioned).sum())
            direction = conditioned + (length / previous) * direction
        if self.projection is None:
            return change, np.zeros((0, right.shape[1]))
        # What is left of the residual is AᵀY, up to the accuracy of the solve.
        return self.projection(change, off), self.projection.multipliers(self.blocks(residual))

    def _condition(self, residual: FloatArray) -> FloatArray:
        conditioned = self.blocks(residual)
        return conditioned if self.projection is None else self.projection(conditioned)

    def _product(self, change: FloatArray) -> FloatArray:
        product = _curved(self.curvature, self.rows, self.corrections, change)
        product += self.barrier * change
        return product


def newton_system(
    curvature: Curvature,
    row_blocks: RowModel,
    rows: IntArray,
    weights: FloatArray,
    inverse_barrier: FloatArray,
    steps: Iterable[Step],
) -> NewtonSystem:
    """Lay out the system at one soft map.

    Parameters
    ----------
    curvature : Curvature
    row_blocks : RowModel
    rows : (m,) int64
        Free rows.
    weights : (L, n₀) float64
        A, of the linear constraints.
    inverse_barrier : (m, n) float64
        X/Z, zero on held entries; columns in elimination order.
    steps : iterable of Step
        Earlier steps, which correct the curvature.

    Returns
    -------
    NewtonSystem

    Raises
    ------
    MemoryError
        If there is no room.
    """
    corrections: list[Correction] = []
    for step in steps:
        modelled = _curved(curvature, rows, corrections, step.taken)
        bend, turn = float((step.taken * modelled).sum()), float((step.taken * step.turned).sum())
        if turn > LEAST_CURVATURE * bend > 0:
            corrections.append(Correction(step.turned, 1 / turn, modelled, 1 / bend))
    barrier = np.divide(1.0, inverse_barrier, out=np.zeros_like(inverse_barrier), where=inverse_barrier > 0)
    blocks = row_blocks.at(curvature, rows, inverse_barrier)
    projection = None
    if len(weights):
        projection = _projection(curvature, row_blocks, rows, weights[:, rows], inverse_barrier)
    return NewtonSystem(curvature, rows, barrier, corrections, blocks, projection)


def _curved(
    curvature: Curvature, rows: IntArray, corrections: list[Correction], change: FloatArray
) -> FloatArray:
    """Product of the corrected curvature with a change of the free rows."""
    whole = np.zeros((curvature.model.source.size, change.shape[1]))
    whole[rows] = change
    product: FloatArray = curvature(whole)[rows]
    for correction in corrections:
        product += correction(change)
    return product


def _projection(
    curvature: Curvature,
    row_blocks: RowModel,
    rows: IntArray,
    weights: FloatArray,
    inverse_barrier: FloatArray,
) -> Projection:
    touched = np.flatnonzero((weights != 0).any(axis=0))
    weights = weights[:, touched]
    n = inverse_barrier.shape[1]
    blocks = row_blocks.at(curvature, rows[touched], inverse_barrier[touched])
    inverses = np.empty((touched.size, n, n))
    for k in range(n):
        unit = np.zeros((touched.size, n))
        unit[:, k] = 1.0
        inverses[:, :, k] = blocks(unit)
    schur = np.einsum("at,bt,tjk->ajbk", weights, weights, inverses, optimize=True)
    size = len(weights) * n
    return Projection(touched, weights, inverses, _pseudoinverse(schur.reshape(size, size), n))


def _pseudoinverse(schur: FloatArray, n: int) -> FloatArray:
    """Pseudoinverse of AM⁻¹Aᵀ, whose entries span many orders of magnitude: scaled and grounded.

    M⁻¹ takes constants to zero, so that constants of each constraint are in the kernel.
    """
    scale = np.sqrt(np.diag(schur))
    inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    scaled = inverse[:, None] * schur * inverse
    constants = linalg.block_diag(*(part / np.linalg.norm(part) for part in scale.reshape(-1, n)))
    scaled += constants.T @ constants
    found: FloatArray = inverse[:, None] * linalg.pinvh(scaled, rtol=DEPENDENT) * inverse
    return found
