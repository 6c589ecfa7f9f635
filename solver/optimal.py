"""Optimal soft maps (section 5.3): least E_D + λE_b + ⟨K, C⟩ under landmarks, with a proof how good they are.

The problem is convex, so every answer carries a gap that bounds its distance from the true optimum. Two
methods share one search: the paper's softmax with L-BFGS, and an interior-point method that needs far fewer
evaluations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from solver.basis import Basis
from solver.errors import InvalidSoftMap, SolverError
from solver.feasible import Feasible, LinearConstraint, feasible
from solver.interior import interior_point
from solver.mesh import FloatArray
from solver.prolongation import prolong
from solver.search import Iteration, Problem, Search
from solver.softmap import SoftMap
from solver.softmax import softmax_descent

Method = Literal["interior", "softmax"]
_METHODS: dict[str, Callable[[Search, FloatArray], None]] = {
    "interior": interior_point,
    "softmax": softmax_descent,
}
#: How far a start may be from satisfying the linear constraints.
CONSTRAINT_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class OptimalMap:
    """A soft map of nearly least energy, and the proof of how nearly.

    Attributes
    ----------
    softmap : SoftMap
    energy : float
        E = E_D + λE_b + ⟨K, C⟩.
    dirichlet, bijectivity, attachment : float
        E_D, E_b and ⟨K, C⟩.
    gap : float
        No feasible soft map has less energy than ``energy − gap``.
    converged : bool
        Whether ``gap ≤ tolerance · energy``. If not, the map is the best found, and the gap still holds.
    iterations : int
    history : tuple of Iteration
        Energy, gap, evaluations and seconds after each iteration; the first entry is the start's.
    bijectivity_weight : float
        λ.
    """

    softmap: SoftMap
    energy: float
    dirichlet: float
    bijectivity: float
    attachment: float
    gap: float
    converged: bool
    iterations: int
    history: tuple[Iteration, ...]
    bijectivity_weight: float

    @property
    def relative_gap(self) -> float:
        """Gap over energy."""
        return self.gap / self.energy if self.energy > 0 else 0.0

    @property
    def strict_gap(self) -> float:
        """Gap over E − λ: E_b is at least 1, so that λ is no achievement; inf where nothing else is left."""
        rest = self.energy - self.bijectivity_weight
        return self.gap / rest if rest > 0 else math.inf


def optimal_softmap(
    source: Basis,
    target: Basis,
    landmarks: Sequence[tuple[int, int]] = (),
    bijectivity_weight: float = 1.0,
    tolerance: float = 1e-3,
    max_iterations: int = 500,
    method: Method = "interior",
    constraints: Sequence[LinearConstraint] = (),
    start: SoftMap | None = None,
    regularisation: float = 1e-5,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
    report: Callable[[Iteration, SoftMap], None] | None = None,
    cost: npt.ArrayLike = 0.0,
) -> OptimalMap:
    """Soft map of least energy E_D(C) + λE_b(C) + ⟨K, C⟩ over C ≥ 0, C1 = 1, landmarks held (section 5.3).

    This signature is stable: what is added comes after it, by keyword.

    Parameters
    ----------
    source, target : Basis
    landmarks : sequence of (int, int)
        Pairs of a source vertex v₀ and a target vertex v, 0-based: the row of the source function largest at
        v₀ is held at the target function largest at v. Make landmarks samples with ``first``.
    bijectivity_weight : float
        λ ≥ 0.
    tolerance : float
        Stop when the proven gap is this share of the energy, positive.
    max_iterations : int
        Stop after as many in any case.
    method : {"interior", "softmax"}
        Interior points, or the paper's softmax with L-BFGS. Both end at the same optimum.
    constraints : sequence of LinearConstraint
        What weighted sums of rows must be; for the interior method.
    start : SoftMap, optional
        Where to start, the uniform map by default: an earlier result, or one on coarser bases of the same
        meshes, which is prolonged. Landmark rows are held whatever it says there.
    regularisation : float
        ε of the blend (1−ε)ρ + ε.
    threads : int, optional
        Threads that share the work, one by default. The result does not depend on it beyond rounding.
    progress : callable, optional
        Called with the fraction done; may raise to abort.
    report : callable, optional
        Called after each iteration with its `Iteration` and the best soft map so far, which can be a later
        ``start``; may raise to abort.
    cost : (n₀, n) array_like of float, optional
        K, none by default: see `descriptor_cost`, which draws mass to where descriptors agree.

    Returns
    -------
    OptimalMap
        Not converging is an answer too: see its ``converged`` and ``gap``.

    Raises
    ------
    InvalidSoftMap
        If a landmark does not exist, landmarks contradict each other, no soft map satisfies the constraints,
        the start belongs to other meshes, or the cost does not fit or is not finite; names the culprit.
    InvalidMesh
        If the target's mesh is not connected.
    SolverError
        If a weight, tolerance, count or method is out of range.
    SingularSystem
        If a face's system has no trustworthy solution; names the face.
    """
    _check(bijectivity_weight, tolerance, max_iterations, method)
    allowed = feasible(source, target, landmarks, constraints)
    problem = Problem(
        source=source,
        target=target,
        feasible=allowed,
        cost=_checked_cost(cost, allowed.allowed.shape),
        bijectivity_weight=float(bijectivity_weight),
        tolerance=tolerance,
        max_iterations=max_iterations,
        regularisation=regularisation,
        threads=threads or 1,
    )
    search = Search(problem, progress, report)
    _METHODS[method](search, _feasible_start(source, target, allowed, start))
    best = search.best
    return OptimalMap(
        softmap=best.softmap,
        energy=best.energy,
        dirichlet=best.dirichlet,
        bijectivity=best.bijectivity,
        attachment=best.attachment,
        gap=search.gap,
        converged=search.converged,
        iterations=len(search.history) - 1,
        history=tuple(search.history),
        bijectivity_weight=float(bijectivity_weight),
    )


def _feasible_start(source: Basis, target: Basis, allowed: Feasible, start: SoftMap | None) -> FloatArray:
    """Feasible coefficients to start from: those given where they satisfy the constraints, held rows held."""
    if start is None:
        return allowed.interior
    if start.source is not source or start.target is not target:
        start = prolong(start, source, target)
    coefficients = np.where(allowed.allowed, start.coefficients, 0.0)
    sums = coefficients.sum(axis=1, keepdims=True)
    coefficients = np.where(sums > 0, coefficients / np.where(sums > 0, sums, 1.0), allowed.interior)
    off = np.abs(allowed.weights @ coefficients - allowed.values).max(initial=0.0)
    if off > CONSTRAINT_TOLERANCE:
        # Rows that a constraint mixes have to satisfy it together: start those from the interior.
        touched = (allowed.weights != 0).any(axis=0)
        coefficients[touched] = allowed.interior[touched]
    return coefficients


def _checked_cost(cost: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    given = np.asarray(cost, dtype=np.float64)
    if given.ndim and given.shape != shape:
        message = f"the cost must have shape {shape}, not {given.shape}"
        raise InvalidSoftMap(message, value=str(given.shape))
    whole = np.broadcast_to(given, shape)
    bad = np.flatnonzero(~np.isfinite(whole).all(axis=1))
    if bad.size:
        raise InvalidSoftMap(f"row {bad[0]} of the cost is not finite", index=int(bad[0]))
    return whole


def _check(weight: float, tolerance: float, max_iterations: int, method: str) -> None:
    if not 0 <= weight < math.inf:
        raise SolverError(
            f"the bijectivity weight must be finite and not negative, not {weight}", value=weight
        )
    if not 0 < tolerance < math.inf:
        raise SolverError(f"the tolerance must be positive and finite, not {tolerance}", value=tolerance)
    if max_iterations < 0:
        raise SolverError(
            f"max_iterations must not be negative, but is {max_iterations}", value=max_iterations
        )
    if method not in _METHODS:
        raise SolverError(f"method must be one of {sorted(_METHODS)}, not {method!r}", value=str(method)[:80])
