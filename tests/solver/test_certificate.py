"""Lower bounds from tangent planes, on a convex quadratic whose optimum is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize

from solver.certificate import Certificate
from solver.feasible import Feasible


@pytest.fixture
def allowed(rng: np.random.Generator) -> Feasible:
    """Three rows of four: one held, two under one linear constraint."""
    pattern = np.ones((3, 4), dtype=bool)
    pattern[0] = [False, True, False, False]
    interior = np.where(pattern, rng.random((3, 4)), 0.0)
    interior /= interior.sum(axis=1, keepdims=True)
    weights = np.array([[0.0, 0.4, 0.6]])
    return Feasible(pattern, interior, weights, weights @ interior)


def random_feasible(allowed: Feasible, rng: np.random.Generator) -> np.ndarray:
    """A corner of the feasible set, by linear programming, mixed with its interior map."""
    system = np.concatenate([np.kron(np.eye(3), np.ones((1, 4))), np.kron(allowed.weights, np.eye(4))])
    aim = np.concatenate([np.ones(3), allowed.values.ravel()])
    bounds = [(0, 1 if free else 0) for free in allowed.allowed.ravel()]
    corner = optimize.linprog(rng.normal(size=12), A_eq=system, b_eq=aim, bounds=bounds).x.reshape(3, 4)
    share = rng.random()
    return share * corner + (1 - share) * allowed.interior


def test_no_multipliers_and_no_planes_raise_the_bound_above_the_optimum(
    allowed: Feasible, rng: np.random.Generator
) -> None:
    for _ in range(5):
        centre = random_feasible(allowed, rng)
        certificate, last = Certificate(allowed), -np.inf
        for _ in range(12):
            point = random_feasible(allowed, rng)
            energy, slope = ((point - centre) ** 2).sum(), 2 * (point - centre)
            own = certificate.add(point, energy, slope, rng.normal(size=(1, 4)))
            assert own >= energy - certificate.bound - 1e-14
            assert last <= certificate.bound <= 1e-14
            last = certificate.bound


def test_mixed_planes_prove_what_no_plane_does(rng: np.random.Generator) -> None:
    """|x − y| on a segment has its kink at the optimum: no tangent proves much, their mean all."""
    free = Feasible(np.ones((1, 2), dtype=bool), np.full((1, 2), 0.5), np.zeros((0, 1)), np.zeros((0, 2)))
    certificate = Certificate(free)
    slope = np.array([[1.0, -1.0]])
    assert certificate.add(np.array([[0.9, 0.1]]), 0.8, slope) == pytest.approx(1.8)
    assert certificate.add(np.array([[0.1, 0.9]]), 0.8, -slope) == pytest.approx(1.8)
    assert certificate.bound == pytest.approx(0.0, abs=5e-3)
    assert certificate.bound <= 0


def test_multipliers_prove_what_rows_alone_cannot(allowed: Feasible) -> None:
    """A linear energy that the constraint fixes: the bound is exact, but only with its multipliers."""
    multipliers = np.array([[1.0, -2.0, 0.5, 3.0]])
    slope = -allowed.weights.T @ multipliers
    value = float((slope * allowed.interior).sum())
    blind, seeing = Certificate(allowed), Certificate(allowed)
    assert blind.add(allowed.interior, value, slope) > 0.1
    assert seeing.add(allowed.interior, value, slope, multipliers) == pytest.approx(0.0, abs=1e-15)
