"""One factor, many right-hand sides: equal to a dense solution, and inertia counts eigenvalues."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from solver.factored import factored
from solver.fem import mass, stiffness
from tests.solver.shapes import torus

MESH = torus(20, 10)


@pytest.mark.parametrize("count", [1, 8, 19])
@pytest.mark.parametrize("shift", [-7.5, 3.0])
def test_solutions_equal_dense_ones(count: int, shift: float) -> None:
    matrix = stiffness(MESH) + sparse.diags_array(shift * mass(MESH))
    right = np.random.default_rng(1).standard_normal((MESH.n_vertices, count))
    found = factored(matrix).solve(right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix.toarray(), right), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("limit", [1.0, 100.0, 1000.0])
def test_negative_pivots_count_eigenvalues_below_a_shift(limit: float) -> None:
    shifted = stiffness(MESH) - sparse.diags_array(limit * mass(MESH))
    assert factored(shifted).n_negative == (np.linalg.eigvalsh(shifted.toarray()) < 0).sum()


def test_a_zero_pivot_is_refused() -> None:
    with pytest.raises(RuntimeError):
        factored(sparse.csr_array(np.zeros((2, 2))))
