"""Meshes as OFF files, the simplest format that keeps the order of vertices and every digit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def off(vertices: ArrayLike, faces: ArrayLike) -> bytes:
    """Mesh as an OFF file, with every digit that float64 has.

    Parameters
    ----------
    vertices : array_like, (V, 3) float
        Positions.
    faces : array_like, (F, 3) int
        Triangles, 0-based.

    Returns
    -------
    bytes
        ASCII text that reads back to the same numbers.

    Raises
    ------
    ValueError
        If an array has another shape, or faces are not integers.
    """
    positions, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    if positions.ndim != 2 or positions.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"arrays must be (V, 3) and (F, 3), not {positions.shape} and {triangles.shape}")
    if triangles.dtype.kind not in "iu":
        raise ValueError(f"faces must be integers, not {triangles.dtype}")
    lines = ["OFF", f"{len(positions)} {len(triangles)} 0"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in positions.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in triangles.tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")
