"""Lanczos finds what a dense eigensolver finds, with every copy of an eigenvalue."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg, sparse

from solver import eigenpairs
from solver.eigenpairs import smallest_eigenpairs
from solver.errors import InvalidDescriptor


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 40))
@settings(max_examples=8, deadline=None)
def test_pairs_of_a_random_chain_equal_dense_ones(seed: int, count: int) -> None:
    n = eigenpairs.DENSE_ROWS + 50
    random = np.random.default_rng(seed)
    springs = random.uniform(0.5, 2.0, n - 1) * n
    stiffness = sparse.diags_array(
        [np.append(springs, 0) + np.append(0, springs), -springs, -springs], offsets=[0, 1, -1]
    ).tocsr()
    weights = random.uniform(0.5, 1.5, n) / n
    values, functions = smallest_eigenpairs(stiffness, weights, count)
    exact = linalg.eigh(stiffness.toarray(), np.diag(weights), eigvals_only=True)[:count]
    np.testing.assert_allclose(values, exact, rtol=1e-9, atol=1e-9 * exact[-1])
    np.testing.assert_allclose(functions.T @ (weights[:, None] * functions), np.eye(count), atol=1e-10)


def test_a_laplacian_of_nothing_is_refused() -> None:
    n = eigenpairs.DENSE_ROWS + 1
    with pytest.raises(InvalidDescriptor, match="factored"):
        smallest_eigenpairs(sparse.csr_array((n, n)), np.zeros(n), 4)
