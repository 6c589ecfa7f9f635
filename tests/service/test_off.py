"""OFF files keep every digit and the order of vertices."""

from __future__ import annotations

import numpy as np
import pytest

from service.creature import creature
from service.off import off


def test_off_reads_back_to_the_same_numbers() -> None:
    vertices, faces = creature("trotting")
    lines = off(vertices, faces).decode("ascii").splitlines()
    assert lines[0] == "OFF"
    assert lines[1].split() == [str(len(vertices)), str(len(faces)), "0"]
    assert np.array_equal(
        np.array([line.split() for line in lines[2 : 2 + len(vertices)]], dtype=float), vertices
    )
    triangles = np.array([line.split() for line in lines[2 + len(vertices) :]], dtype=int)
    assert np.array_equal(triangles, np.column_stack([np.full(len(faces), 3), faces]))


def test_off_refuses_other_shapes() -> None:
    vertices, faces = creature()
    with pytest.raises(ValueError, match=r"not \(4450, 2\)"):
        off(vertices[:, :2], faces)


def test_off_refuses_fractional_faces() -> None:
    vertices, faces = creature()
    with pytest.raises(ValueError, match="must be integers, not float64"):
        off(vertices, faces.astype(float))
