"""The paper's way to optimal soft maps (section 5.3): C = softmax(Θ), minimised over Θ by L-BFGS."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import optimize, special

from solver.errors import SolverError
from solver.mesh import FloatArray
from solver.search import Search

#: Corrections that L-BFGS remembers.
MEMORY = 30
#: Least entry of a start: the derivative by Θ is proportional to C, so that a zero would stay one.
LEAST = 1e-8


def softmax_descent(search: Search, start: FloatArray) -> None:
    """Minimise over Θ with Cᵢ = softmax(Θᵢ) by L-BFGS, until the search is finished or no step descends.

    Parameters
    ----------
    search : Search
    start : (n₀, n) float64
        A feasible soft map.

    Raises
    ------
    SolverError
        If there are linear constraints, which the softmax does not keep.
    SingularSystem
        If a face's system has no trustworthy solution.
    """
    feasible = search.problem.feasible
    if len(feasible.weights):
        raise SolverError("the softmax method holds rows only; linear constraints need the interior method")
    rows = feasible.rows
    search.prove(search.evaluate(start))
    if search.finished() or not rows.size:
        return
    coefficients = start.copy()

    def energy(theta: FloatArray) -> tuple[float, FloatArray]:
        c = special.softmax(theta.reshape(rows.size, -1), axis=1)
        coefficients[rows] = c
        evaluation = search.evaluate(coefficients)
        search.prove(evaluation)
        descent = evaluation.gradient[rows]
        # ∂E/∂Θ = C ∘ (D − ⟨C, D⟩), row by row.
        slope = c * (descent - (c * descent).sum(axis=1, keepdims=True))
        return evaluation.energy, slope.ravel()

    def iterated(_: Any) -> None:
        if search.finished():
            raise StopIteration

    optimize.minimize(
        energy,
        np.log(np.maximum(start[rows], LEAST)).ravel(),
        jac=True,
        method="L-BFGS-B",
        callback=iterated,
        options={"maxcor": MEMORY, "maxiter": 10**9, "maxfun": 10**9, "ftol": 0.0, "gtol": 0.0},
    )
