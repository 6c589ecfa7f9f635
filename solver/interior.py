"""An interior-point method for optimal soft maps, with the curvature of super-faces as its second derivative.

The free entries x of C stay positive, and so do their prices z = D − ν1 + AᵀY; x∘z = μ falls towards zero.
Each step solves (H + Z/X) dx = μ/x − D on rows that sum to zero, and ends in one evaluation of E. H need not
be exact: a step that does not descend is shortened. Entries that a row does not use keep a price that is
nearly right, which is what the gap measures; that is why so few evaluations prove so much.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from solver.curvature import curvature_model
from solver.mesh import BoolArray, FloatArray
from solver.newton import Step, newton_system
from solver.rowblocks import row_model
from solver.search import Evaluation, Search
from solver.superfaces import super_faces

#: Super-faces for each source function: more cost more and gain little (docs/decisions/optimal.md).
SUPER_FACES = 2
#: Steps that correct the curvature as BFGS does.
MEMORY = 5
#: μ aims at this share of what the gap is worth in it, but falls by no more than LEAST_CENTRING a step.
GAP_SHARE = 0.3
LEAST_CENTRING = 0.1
#: Sufficient decrease, how often a step may be shortened, and how near to the boundary it may go.
ARMIJO = 1e-4
SHORTENINGS = 8
BOUNDARY = 0.995
#: A start is mixed with this much of an interior map where it is not positive: an entry at zero cannot move.
LIFT = 0.05


def interior_point(search: Search, start: FloatArray) -> None:
    """Minimise by interior-point steps until the search is finished or no step descends.

    Parameters
    ----------
    search : Search
    start : (n₀, n) float64
        A feasible soft map.

    Raises
    ------
    SingularSystem
        If a face's system has no trustworthy solution.
    """
    problem = search.problem
    feasible = problem.feasible
    rows = feasible.rows
    current = search.evaluate(start)
    own = search.prove(current)
    if search.finished() or not rows.size:
        return
    faces = super_faces(problem.source, SUPER_FACES * problem.source.size)
    model = curvature_model(
        problem.source,
        problem.target,
        faces,
        problem.regularisation,
        problem.bijectivity_weight,
        problem.threads,
    )
    blocks = row_model(model)
    order = model.order
    unorder = np.argsort(order)
    free = feasible.allowed[rows][:, order]
    # Where constraints mix rows, entries must move in proportion; elsewhere each may bend to stay positive.
    mixed = (feasible.weights[:, rows] != 0).any(axis=0)
    current, own = _lifted(search, current, own)
    x = current.softmap.coefficients[rows][:, order]
    z = _over(own / free.sum(), x, free)
    steps: deque[Step] = deque(maxlen=MEMORY)
    failures = 0
    while True:
        worth = float((x * z).sum())
        centring = 1.0 if failures else float(np.clip(GAP_SHARE * search.gap / worth, LEAST_CENTRING, 1.0))
        barrier = centring * worth / free.sum()
        gradient = current.gradient[rows][:, order]
        pull = _over(barrier, x, free)
        curvature = model.at(np.ascontiguousarray(current.softmap.coefficients[:, order]))
        system = newton_system(curvature, blocks, rows, feasible.weights, _over(x, z, free), steps)
        off = (feasible.values - feasible.weights @ current.softmap.coefficients)[:, order]
        dx, multipliers = system.solve(np.where(free, pull - gradient, 0.0), off)
        slope = float(((gradient - pull) * dx).sum())
        merit = current.energy - barrier * _logarithms(x, free)
        length = min(1.0, BOUNDARY * _reach(x[mixed], dx[mixed]))
        for _ in range(SHORTENINGS):
            moved = _moved(x, dx, length, mixed)
            following = search.evaluate(_filled(current.softmap.coefficients, rows, moved[:, unorder]))
            reached = following.energy - barrier * _logarithms(moved, free)
            if reached <= merit + ARMIJO * length * slope:
                break
            # The parabola through both values and the slope has its minimum here.
            best = -slope * length**2 / (2 * (reached - merit - slope * length))
            length = min(max(best, 0.1 * length), 0.5 * length)
        else:
            failures += 1
            steps.clear()
            if failures > 1:
                return
            continue
        failures = 0
        search.prove(following, multipliers[:, unorder])
        turned = following.gradient[rows][:, order] - gradient
        steps.append(Step(moved - x, turned - turned.mean(axis=1, keepdims=True)))
        dz = np.where(free, pull - z - dx * _over(z, x, free), 0.0)
        current, x, z = following, moved, _bent(z, dz, 1.0)
        if search.finished():
            return


def _lifted(search: Search, current: Evaluation, own: float) -> tuple[Evaluation, float]:
    """Leave a start that is positive wherever that is allowed; mix any other with an interior map."""
    feasible = search.problem.feasible
    coefficients = current.softmap.coefficients
    if (coefficients[feasible.allowed] > 0).all():
        return current, own
    lifted = search.evaluate((1 - LIFT) * coefficients + LIFT * feasible.interior)
    return lifted, search.prove(lifted)


def _moved(x: FloatArray, dx: FloatArray, length: float, mixed: BoolArray) -> FloatArray:
    """Step on the simplices: x + dx where rows are mixed, else bent so as to stay positive."""
    moved = _bent(x, dx, length)
    moved[mixed] = x[mixed] + length * dx[mixed]
    moved /= moved.sum(axis=1, keepdims=True)
    return moved


def _bent(x: FloatArray, dx: FloatArray, length: float) -> FloatArray:
    """Return x + dx for what grows and x exp(dx / x) for what shrinks: they agree to first order."""
    rate = length * np.divide(np.minimum(dx, 0.0), x, out=np.zeros_like(x), where=x > 0)
    shrink = np.exp(np.maximum(rate, np.log(1 - BOUNDARY)))
    bent: FloatArray = np.where(dx > 0, x + length * dx, x * shrink)
    return bent


def _reach(x: FloatArray, dx: FloatArray) -> float:
    """How far along dx x stays non-negative."""
    falling = dx < 0
    return float((-x[falling] / dx[falling]).min(initial=np.inf))


def _over(a: FloatArray | float, b: FloatArray, free: BoolArray) -> FloatArray:
    """Quotient a / b on free entries, zero elsewhere."""
    return np.divide(a, b, out=np.zeros_like(b), where=free)


def _logarithms(x: FloatArray, free: BoolArray) -> float:
    return float(np.log(x, out=np.zeros_like(x), where=free).sum())


def _filled(coefficients: FloatArray, rows: np.ndarray, moved: FloatArray) -> FloatArray:
    filled = coefficients.copy()
    filled[rows] = moved
    return filled
