"""Marks: closed surfaces of the size and at the place that was asked for."""

from __future__ import annotations

import numpy as np
import pytest

from service.marks import Mark, arrows, balls, tube

RED = (1.0, 0.0, 0.0)


def volume(mark: Mark) -> float:
    """Volume inside, positive if the faces look outwards."""
    a, b, c = (mark.vertices[mark.faces[:, k]] for k in range(3))
    return float(np.einsum("fx,fx->", a, np.cross(b, c)) / 6)


def test_balls_are_round_and_where_they_should_be() -> None:
    centres = np.array([[1.0, 2, 3], [-4, 0, 1]])
    mark = balls(centres, 0.5, RED)
    assert volume(mark) == pytest.approx(2 * np.pi / 6, rel=0.25)
    nearest = np.linalg.norm(mark.vertices[:, None] - centres, axis=2).min(axis=1)
    np.testing.assert_allclose(nearest, 0.5)


def test_a_tube_follows_its_path() -> None:
    t = np.linspace(0, 3, 200)
    path = np.column_stack([np.cos(t), np.sin(t), 0.2 * t])
    mark = tube(path, 0.05, RED)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert volume(mark) == pytest.approx(np.pi * 0.05**2 * length, rel=0.15)
    distances = np.linalg.norm(mark.vertices[:, None] - path, axis=2).min(axis=1)
    assert distances.max() < 0.06


def test_a_path_that_goes_nowhere_has_no_tube() -> None:
    assert len(tube(np.zeros((5, 3)), 0.1, RED).faces) == 0


def test_arrows_point_where_their_vectors_do(rng: np.random.Generator) -> None:
    tails, vectors = rng.normal(size=(7, 3)), rng.normal(size=(7, 3))
    mark = arrows(tails, vectors, 0.01, RED)
    assert volume(mark) > 0
    shapes = mark.vertices.reshape(7, -1, 3)
    np.testing.assert_allclose(shapes[:, -1], tails + vectors)
    along = np.einsum("kvx,kx->kv", shapes - tails[:, None], vectors)
    assert (along <= np.einsum("kx,kx->k", vectors, vectors)[:, None] + 1e-12).all()


def test_no_arrow_has_no_triangles() -> None:
    assert len(arrows(np.zeros((2, 3)), np.zeros((2, 3)), 0.1, RED).faces) == 0
