"""A certificate for a convex problem: how far an energy can be from the least one, proven by tangent planes.

The energy is convex, so E(C′) ≥ E(C) + ⟨D, C′ − C⟩ for every soft map C′; a minimum of the right side over
all feasible C′ bounds the optimum from below. Any mixture of tangent planes is such a bound too, and one of
the last few planes is much tighter than the last alone: where the gradient still wavers, its mean does not.
"""

from __future__ import annotations

import numpy as np

from solver.feasible import Feasible
from solver.mesh import FloatArray

#: Planes that are mixed: those of the last iterations.
PLANES = 8
#: Golden-section steps for each mixing weight: it is then known to 0.3 %.
SECTIONS = 12
_GOLDEN = (5**0.5 - 1) / 2


class Certificate:
    """Best lower bound so far on the energy of all feasible soft maps.

    Parameters
    ----------
    feasible : Feasible

    Attributes
    ----------
    bound : float
        Lower bound; −inf before the first plane.
    """

    def __init__(self, feasible: Feasible) -> None:
        self.bound = -np.inf
        self._feasible = feasible
        self._planes: list[tuple[float, FloatArray]] = []
        self._best: tuple[float, FloatArray] | None = None

    def add(
        self,
        coefficients: FloatArray,
        energy: float,
        gradient: FloatArray,
        multipliers: FloatArray | None = None,
    ) -> float:
        """Add the tangent plane at a soft map.

        Parameters
        ----------
        coefficients : (n₀, n) float64
            Where the plane touches.
        energy : float
        gradient : (n₀, n) float64
            D.
        multipliers : (L, n) float64, optional
            Y, of the linear constraints: ⟨D, C⟩ = ⟨D + AᵀY, C⟩ − ⟨Y, t⟩ on all feasible maps, and any Y is
            valid. Zero by default.

        Returns
        -------
        float
            The gap that this plane alone proves.

        Raises
        ------
        ValueError
            If shapes do not match.
        """
        value = energy - float((coefficients * gradient).sum())
        plane = gradient
        if multipliers is not None:
            plane = gradient + self._feasible.weights.T @ multipliers
            value -= float((multipliers * self._feasible.values).sum())
        own = self._feasible.bound(value, plane)
        self._planes = [*self._planes[1 - PLANES :], (value, plane)]
        if own > self.bound or self._best is None:
            self.bound, self._best = own, (value, plane)
        for other in reversed(self._planes):
            self._mix(other)
        return energy - own

    def _mix(self, other: tuple[float, FloatArray]) -> None:
        """Move the best plane towards another as long as the bound rises: it is concave in the weight."""
        assert self._best is not None
        value, plane = self._best

        def mixed(t: float) -> tuple[float, FloatArray]:
            return (1 - t) * value + t * other[0], (1 - t) * plane + t * other[1]

        low, high = 0.0, 1.0
        inner, outer = 1 - _GOLDEN, _GOLDEN
        at_inner, at_outer = (self._feasible.bound(*mixed(t)) for t in (inner, outer))
        for _ in range(SECTIONS):
            if at_inner > at_outer:
                high, outer, at_outer = outer, inner, at_inner
                inner = high - _GOLDEN * (high - low)
                at_inner = self._feasible.bound(*mixed(inner))
            else:
                low, inner, at_inner = inner, outer, at_outer
                outer = low + _GOLDEN * (high - low)
                at_outer = self._feasible.bound(*mixed(outer))
        best, t = max((at_inner, inner), (at_outer, outer))
        if best > self.bound:
            self.bound, self._best = best, mixed(t)
