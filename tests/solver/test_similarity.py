"""Soft maps of descriptors, tile by tile, equal the formula written down whole."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from solver.basis import Basis, poisson_basis
from solver.fem import mass
from solver.mesh import Mesh
from solver.similarity import DROPPED, compressed, received_by
from tests.solver.shapes import icosphere, torus


def whole(source: Basis, target: Basis, f0: np.ndarray, f: np.ndarray) -> np.ndarray:
    """∫β₀ᵢ ∫ρ_fine βⱼ from the matrix ρ_fine of all pairs of vertices."""
    exponent = -((f0[:, None, :] - f[None, :, :]) ** 2).sum(axis=2)
    exponent[:, ~target.mesh.referenced] = -np.inf
    exponent -= exponent.max(axis=1, keepdims=True)
    density = np.exp(exponent) * mass(target.mesh)
    density /= density.sum(axis=1, keepdims=True)
    return source.functions.T @ (mass(source.mesh)[:, None] * (density @ target.functions.toarray()))


@pytest.fixture(scope="module")
def pair() -> tuple[Basis, Basis]:
    ball = icosphere(2)
    loose = Mesh(np.vstack([[[9.0, 9.0, 9.0]], torus(12, 8).vertices]), torus(12, 8).faces + 1)
    return poisson_basis(ball, 20), poisson_basis(loose, 15, first=1)


@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.sampled_from([7, 64, 500]),
    columns=st.sampled_from([5, 33, 500]),
    scale=st.sampled_from([0.1, 3.0, 60.0]),  # at 60, all but the nearest exponentials vanish
)
@settings(max_examples=30, deadline=None)
def test_tiles_of_any_size_equal_the_whole_formula(
    pair: tuple[Basis, Basis], seed: int, rows: int, columns: int, scale: float
) -> None:
    source, target = pair
    random = np.random.default_rng(seed)
    f0 = scale * random.standard_normal((source.mesh.n_vertices, 6)) + 100
    f = scale * random.standard_normal((target.mesh.n_vertices, 6)) + 100
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("solver.similarity.ROWS", rows)
        patch.setattr("solver.similarity.COLUMNS", columns)
        found = received_by(source, target, f0, f)
    np.testing.assert_allclose(found, whole(source, target, f0, f), rtol=1e-9, atol=1e-14)


@given(seed=st.integers(0, 2**32 - 1), rank=st.integers(1, 6))
@settings(max_examples=30, deadline=None)
def test_compression_keeps_every_distance(seed: int, rank: int) -> None:
    random = np.random.default_rng(seed)
    directions = random.standard_normal((rank, 40))
    one, other = (random.standard_normal((k, rank)) @ directions for k in (30, 50))
    few, fewer = compressed(one, other)
    assert few.shape[1] == fewer.shape[1] <= rank

    def squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return ((a[:, None] - b[None]) ** 2).sum(axis=2)

    rounding = 1e-13 * squared(one, other).max()
    np.testing.assert_allclose(squared(few, fewer), squared(one, other), rtol=0, atol=DROPPED + rounding)
