"""A minimisation in progress: evaluations, the best map so far, the proven gap, and whoever watches."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from solver.basis import Basis
from solver.certificate import Certificate
from solver.energy import bijectivity, dirichlet
from solver.feasible import Feasible
from solver.mesh import FloatArray
from solver.softmap import SoftMap

#: Energies are of the order of 1 + λ; a gap below this share of that is nothing.
NOTHING = 1e-12


@dataclass(frozen=True)
class Iteration:
    """What was known after one iteration.

    Attributes
    ----------
    energy : float
        Least energy so far.
    gap : float
        How much less any feasible map can have.
    evaluations : int
        Evaluations of energy and gradient so far.
    seconds : float
        Since the start.
    """

    energy: float
    gap: float
    evaluations: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Evaluation:
    """E = E_D + λE_b + ⟨K, C⟩ at a soft map.

    Attributes
    ----------
    softmap : SoftMap
    energy, dirichlet, bijectivity, attachment : float
        E, E_D, E_b and ⟨K, C⟩.
    gradient : ndarray of float64, shape (n₀, n)
    """

    softmap: SoftMap
    energy: float
    dirichlet: float
    bijectivity: float
    attachment: float
    gradient: FloatArray


@dataclass(frozen=True, eq=False)
class Problem:
    """What is minimised, over what, and when to stop.

    Attributes
    ----------
    source, target : Basis
    feasible : Feasible
    cost : ndarray of float64, shape (n₀, n)
        K.
    bijectivity_weight : float
        λ.
    tolerance : float
        Gap over energy at which to stop.
    max_iterations : int
    regularisation : float
        ε.
    threads : int
    """

    source: Basis
    target: Basis
    feasible: Feasible
    cost: FloatArray
    bijectivity_weight: float
    tolerance: float
    max_iterations: int
    regularisation: float
    threads: int


class Search:
    """A minimisation in progress.

    Parameters
    ----------
    problem : Problem
    progress : callable, optional
        Called with the fraction done, 0 to 1, several times an evaluation; may raise to abort.
    report : callable, optional
        Called after each iteration with its `Iteration` and the best soft map so far; may raise to abort.

    Attributes
    ----------
    best : Evaluation
        The evaluation of least energy; there is one after the first.
    history : list of Iteration
    converged : bool
        Whether gap ≤ tolerance · energy.
    """

    best: Evaluation

    def __init__(
        self,
        problem: Problem,
        progress: Callable[[float], None] | None = None,
        report: Callable[[Iteration, SoftMap], None] | None = None,
    ) -> None:
        self.problem = problem
        self.history: list[Iteration] = []
        self.converged = False
        self._certificate = Certificate(problem.feasible)
        self._progress, self._report = progress, report
        self._evaluations = 0
        self._fraction = 0.0
        self._first_gap = math.inf
        self._began = time.perf_counter()

    @property
    def gap(self) -> float:
        """Least energy so far minus the best lower bound, never negative."""
        return max(self.best.energy - self._certificate.bound, 0.0)

    def evaluate(self, coefficients: FloatArray) -> Evaluation:
        """Energy and gradient at a soft map.

        Parameters
        ----------
        coefficients : (n₀, n) float64

        Returns
        -------
        Evaluation

        Raises
        ------
        InvalidSoftMap
            If the coefficients are no soft map.
        SingularSystem
            If a face's system has no trustworthy solution.
        """
        problem, watch = self.problem, self._progress
        softmap = SoftMap(problem.source, problem.target, coefficients)
        # The fraction rises after iterations only, but who cancels should not have to wait for one.
        tick = None if watch is None else lambda _: watch(self._fraction)
        smooth = dirichlet(softmap, problem.regularisation, True, problem.threads, tick)
        even = bijectivity(softmap)
        assert smooth.gradient is not None
        weight = problem.bijectivity_weight
        attachment = float((problem.cost * softmap.coefficients).sum())
        evaluation = Evaluation(
            softmap=softmap,
            energy=smooth.energy + weight * even.energy + attachment,
            dirichlet=smooth.energy,
            bijectivity=even.energy,
            attachment=attachment,
            gradient=smooth.gradient + weight * even.gradient + problem.cost,
        )
        self._evaluations += 1
        if self._evaluations == 1 or evaluation.energy < self.best.energy:
            self.best = evaluation
        return evaluation

    def prove(self, evaluation: Evaluation, multipliers: FloatArray | None = None) -> float:
        """Add the tangent plane at an evaluation to the certificate.

        Parameters
        ----------
        evaluation : Evaluation
        multipliers : (L, n) float64, optional
            Of the linear constraints.

        Returns
        -------
        float
            The gap that this plane alone proves.

        Raises
        ------
        ValueError
            If the multipliers do not match.
        """
        coefficients = evaluation.softmap.coefficients
        return self._certificate.add(coefficients, evaluation.energy, evaluation.gradient, multipliers)

    def finished(self) -> bool:
        """Write down an iteration, tell those who watch, and say whether it was the last.

        Returns
        -------
        bool
            Whether the gap is small enough, or there have been enough iterations.

        Raises
        ------
        Exception
            What those who watch raise.
        """
        energy, gap = self.best.energy, self.gap
        seconds = time.perf_counter() - self._began
        self.history.append(Iteration(energy, gap, self._evaluations, seconds))
        nothing = NOTHING * (1 + self.problem.bijectivity_weight)
        self.converged = gap <= max(self.problem.tolerance * energy, nothing)
        self._advance(gap, energy)
        if self._report is not None:
            self._report(self.history[-1], self.best.softmap)
        return self.converged or len(self.history) > self.problem.max_iterations

    def _advance(self, gap: float, energy: float) -> None:
        """Measure progress by how far the gap has fallen, in logarithms, or by iterations used up."""
        if self._progress is None:
            return
        self._first_gap = min(self._first_gap, gap) if math.isinf(self._first_gap) else self._first_gap
        used = (len(self.history) - 1) / max(self.problem.max_iterations, 1)
        aim = self.problem.tolerance * energy
        fallen = 1.0 if self.converged else 0.0
        if 0 < aim < gap < self._first_gap:
            fallen = math.log(self._first_gap / gap) / math.log(self._first_gap / aim)
        self._fraction = min(1.0, max(self._fraction, used, fallen))
        self._progress(self._fraction)
