"""Marks on meshes as meshes of their own: balls at points, tubes along paths, arrows.

Drawn together with the surface, they hide and are hidden as they should.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Colour = tuple[float, float, float]

#: Corners of the polygon around a tube, and circles of latitude on a ball.
AROUND, LATITUDES = 8, 6
#: Radii of an arrow's shaft and head, and length of the head, as shares of the arrow's width.
SHAFT, HEAD, HEAD_LENGTH = 0.5, 1.4, 3.2


@dataclass(frozen=True, eq=False)
class Mark:
    """Triangles of one colour.

    Attributes
    ----------
    vertices : ndarray, (V, 3) float
    faces : ndarray, (F, 3) int
    colour : (float, float, float)
        Red, green and blue in [0, 1].
    """

    vertices: Floats
    faces: Ints
    colour: Colour


def balls(points: Floats, radius: float, colour: Colour) -> Mark:
    """Balls at points.

    Parameters
    ----------
    points : ndarray, (k, 3) float
        Their centres.
    radius : float
        Of each.
    colour : (float, float, float)
        Of all.

    Returns
    -------
    Mark

    Raises
    ------
    ValueError
        If the points are not (k, 3).
    """
    heights = np.linspace(-np.pi / 2, np.pi / 2, LATITUDES + 1)
    centres = np.column_stack([np.zeros((len(heights), 2)), radius * np.sin(heights)])
    one = _turned(centres, radius * np.cos(heights), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    faces = _strip_faces(len(heights))
    return _repeated([point + one for point in points], faces, colour)


def tube(points: Floats, radius: float, colour: Colour) -> Mark:
    """Round tube along a path.

    Parameters
    ----------
    points : ndarray, (k, 3) float
        The path.
    radius : float
        Of the tube.
    colour : (float, float, float)
        Of the tube.

    Returns
    -------
    Mark
        Nothing, if the path has no length.

    Raises
    ------
    ValueError
        If the points are not (k, 3).
    """
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    # Points nearer than a fraction of the radius would bend the tube into itself.
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    _, kept = np.unique(np.floor(along / (0.5 * radius)), return_index=True)
    path = points[kept]
    if len(path) < 2:
        return Mark(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), colour)
    directions = np.gradient(path, axis=0)
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-300)
    # One direction to the side is carried along, so that the tube does not twist.
    side = _across(directions[0])
    sides = np.empty_like(path)
    for k, direction in enumerate(directions):
        side = side - (side @ direction) * direction
        side /= np.linalg.norm(side)
        sides[k] = side
    ends = path[[0]] - 0.5 * radius * directions[0], path[[-1]] + 0.5 * radius * directions[-1]
    centres = np.concatenate([ends[0], path, ends[1]])
    radii = np.concatenate([[0.0], np.full(len(path), radius), [0.0]])
    sides = sides[[0, *range(len(path)), -1]]
    directions = directions[[0, *range(len(path)), -1]]
    return Mark(
        _turned(centres, radii, sides, np.cross(directions, sides)), _strip_faces(len(centres)), colour
    )


def arrows(points: Floats, vectors: Floats, width: float, colour: Colour) -> Mark:
    """Arrows from points along vectors.

    Parameters
    ----------
    points, vectors : ndarray, (k, 3) float
        Tails, and where the heads lie from there.
    width : float
        Twice the radius of a long arrow's shaft; short arrows are as thin as they are short.
    colour : (float, float, float)
        Of all.

    Returns
    -------
    Mark

    Raises
    ------
    ValueError
        If the shapes do not match.
    """
    shapes = []
    for point, vector in zip(points, vectors, strict=True):
        length = float(np.linalg.norm(vector))
        if length == 0.0:
            continue
        direction, side = vector / length, _across(vector / length)
        thick = min(width, 0.5 * length / HEAD_LENGTH)
        stops = np.array([0.0, 0.0, length - HEAD_LENGTH * thick, length - HEAD_LENGTH * thick, length])
        radii = thick * np.array([0.0, SHAFT, SHAFT, HEAD, 0.0])
        shapes.append(_turned(point + stops[:, None] * direction, radii, side, np.cross(direction, side)))
    return _repeated(shapes, _strip_faces(5), colour)


def _across(direction: Floats) -> Floats:
    """Return a unit vector at right angles to another."""
    across = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    unit: Floats = across / np.linalg.norm(across)
    return unit


def _turned(centres: Floats, radii: Floats, sides: Floats, ups: Floats) -> Floats:
    """Polygons of given radii around centres, (len(centres) · AROUND, 3)."""
    angles = 2 * np.pi * np.arange(AROUND) / AROUND
    sides, ups = np.broadcast_to(sides, centres.shape), np.broadcast_to(ups, centres.shape)
    rings = np.cos(angles)[:, None] * sides[:, None] + np.sin(angles)[:, None] * ups[:, None]
    points: Floats = (centres[:, None] + radii[:, None, None] * rings).reshape(-1, 3)
    return points


def _strip_faces(rings: int) -> Ints:
    """Triangles between successive polygons."""
    ring, corner = np.meshgrid(np.arange(rings - 1), np.arange(AROUND), indexing="ij")
    a = (ring * AROUND + corner).ravel()
    b = (ring * AROUND + (corner + 1) % AROUND).ravel()
    return np.concatenate([np.column_stack([a, b, b + AROUND]), np.column_stack([a, b + AROUND, a + AROUND])])


def _repeated(shapes: list[Floats], faces: Ints, colour: Colour) -> Mark:
    """Shapes with the same faces as one mark."""
    if not shapes:
        return Mark(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), colour)
    offsets = len(shapes[0]) * np.arange(len(shapes))
    return Mark(np.concatenate(shapes), (faces + offsets[:, None, None]).reshape(-1, 3), colour)
