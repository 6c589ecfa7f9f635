"""Straight walks over triangles: a face is left across an edge as if both lay in one plane (section 5.1)."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from solver.errors import SolverError
from solver.fem import hat_gradients
from solver.mesh import FloatArray, IntArray, Mesh
from solver.tangents import ComplexArray, corner_angles, twins

#: Barycentric weight below which a point that leaves its face is at the vertex and not beside it.
AT_VERTEX = 1e-12
#: A line whose angle with an edge is about this, in radians, is parallel to it.
PARALLEL = 1e-13
#: Share of a walk that is too small to matter.
ARRIVED = 1e-13
#: Slack of polar angles that lie at the very edge of a corner.
ANGLE_SLACK = 1e-9
#: Faces that one walk may cross: far more than any mesh has along a line.
CROSSINGS = 100_000


@dataclass(frozen=True, eq=False)
class Layout:
    """Every face of a unit mesh laid into the complex plane by its frame, and what lies across its edges.

    Attributes
    ----------
    mesh : Mesh
    corners : ndarray of complex128, shape (F, 3)
        Positions, the first at 0 and the second on the real axis.
    gradients : ndarray of complex128, shape (F, 3)
        ∇λ of each corner's hat function.
    twins : ndarray of int64, shape (3F,)
        As `solver.tangents.twins`.
    angles : ndarray of float64, shape (F, 3, 2)
        As `solver.tangents.corner_angles`.
    """

    mesh: Mesh
    corners: ComplexArray
    gradients: ComplexArray
    twins: IntArray
    angles: FloatArray


@dataclass(frozen=True, eq=False)
class Walk:
    """Where a walk led.

    Attributes
    ----------
    face : int
    barycentric : tuple of three float
        Non-negative, summing to 1.
    turn : complex
        What a vector that was carried along, in the frame of the first face, is multiplied by to stand in
        the frame of the last one.
    mirrored : bool
        Whether it is conjugated first: the two faces are oriented differently.
    gone : float
        Share of the way gone, 1 unless it was stopped.
    stopped : str
        "" if the walk went all its way, else "boundary", "branch" (more than two faces meet at the edge) or
        "stuck" (it crossed ``CROSSINGS`` faces).
    """

    face: int
    barycentric: tuple[float, float, float]
    turn: complex
    mirrored: bool
    gone: float
    stopped: str


def layout(mesh: Mesh) -> Layout:
    """Lay out a mesh for walking.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.

    Returns
    -------
    Layout

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    edges, frames = mesh.opposite_edges, mesh.frames
    flat = np.einsum("fsx,fkx->fks", frames, np.stack([0 * edges[:, 2], edges[:, 2], -edges[:, 1]], axis=1))
    slopes = np.einsum("fsx,fkx->fks", frames, hat_gradients(mesh))
    return Layout(
        mesh=mesh,
        corners=flat @ [1, 1j],
        gradients=slopes @ [1, 1j],
        twins=twins(mesh),
        angles=corner_angles(mesh),
    )


def walk(on: Layout, face: int, barycentric: FloatArray | tuple[float, ...], vector: complex) -> Walk:
    """Walk straight on from a point: across edges by unfolding, through vertices with equal angles beside.

    Parameters
    ----------
    on : Layout
    face : int
        Face to start in.
    barycentric : (3,) float
        Point to start from, non-negative and summing to 1.
    vector : complex
        How far to go, in the frame of that face, in √area.

    Returns
    -------
    Walk

    Raises
    ------
    SolverError
        If the vector is not finite.
    """
    if not cmath.isfinite(vector):
        raise SolverError("a walk needs a finite direction", value=str(vector))
    b = [max(float(x), 0.0) for x in barycentric]
    ahead, left, turn, mirrored = complex(vector), 1.0, 1 + 0j, False
    closed: tuple[
        int, ...
    ] = ()  # corners whose opposite edge cannot be crossed: the walk has just come from it
    if ahead == 0:
        return Walk(face, _normalised(b), turn, mirrored, 1.0, "")
    for _ in range(CROSSINGS):
        rates = [(gradient.conjugate() * ahead).real for gradient in on.gradients[face].tolist()]
        least = PARALLEL * max(map(abs, rates))
        share, out = left, -1
        for k in range(3):
            if k not in closed and rates[k] < -least and b[k] < -rates[k] * share:
                share, out = b[k] / -rates[k], k
        b = [max(b[k] + share * rates[k], 0.0) for k in range(3)]
        left -= share
        if out < 0 or left <= ARRIVED:
            return Walk(face, _normalised(b), turn, mirrored, 1.0, "")
        b[out] = 0.0
        corner = max(range(3), key=b.__getitem__)
        if b[corner] >= (1 - AT_VERTEX) * sum(b):
            step = _through_vertex(on, face, corner, ahead, arriving=share > 0)
            if step is None:
                return Walk(face, _normalised(b), turn, mirrored, 1 - left, "boundary")
            face, corner, factor, flip = step
            b = [float(k == corner) for k in range(3)]
            closed = ((corner + 1) % 3, (corner + 2) % 3)
        else:
            other = int(on.twins[3 * face + (out + 1) % 3])
            if other < 0:
                return Walk(face, _normalised(b), turn, mirrored, 1 - left, _why_not(on.mesh, face, out))
            face, b, factor, flip = _through_edge(on, face, out, b, other)
            closed = ((other % 3 + 2) % 3,)
        ahead = (ahead.conjugate() if flip else ahead) * factor
        turn = (turn.conjugate() if flip else turn) * factor
        mirrored ^= flip
    return Walk(face, _normalised(b), turn, mirrored, 1 - left, "stuck")


def _normalised(b: list[float]) -> tuple[float, float, float]:
    total = sum(b)
    return b[0] / total, b[1] / total, b[2] / total


def _through_edge(
    on: Layout, face: int, out: int, b: list[float], other: int
) -> tuple[int, list[float], complex, bool]:
    """Next face across the edge opposite a corner, the point there, and how vectors turn."""
    one, two = (out + 1) % 3, (out + 2) % 3
    next_face, k = divmod(other, 3)
    flip = bool(on.mesh.faces[next_face, k] == on.mesh.faces[face, one])
    begin, end = (k, (k + 1) % 3) if flip else ((k + 1) % 3, k)
    here = complex(on.corners[face, two] - on.corners[face, one])
    there = complex(on.corners[next_face, end] - on.corners[next_face, begin])
    moved = [0.0, 0.0, 0.0]
    moved[begin], moved[end] = b[one], b[two]
    factor = there / (here.conjugate() if flip else here)
    return next_face, moved, factor / abs(factor), flip


def _through_vertex(
    on: Layout, face: int, corner: int, ahead: complex, arriving: bool
) -> tuple[int, int, complex, bool] | None:
    """Corner that a straight line through a vertex goes on in, and how vectors turn; None at boundaries."""
    edge, inner, (first, last) = _corner(on, face, corner)
    scale = (last - first) / inner
    behind = first + scale * cmath.phase((-ahead if arriving else ahead) / edge)
    angles = [behind + math.pi, behind - math.pi] if arriving else [behind]
    corners, closed = fan(on, face, corner)
    if closed:
        angles = [angles[0] + turns * 2 * math.pi for turns in (0, -1, 1)]
    for angle in angles:
        for next_face, next_corner in corners:
            next_edge, next_inner, (lo, hi) = _corner(on, next_face, next_corner)
            if min(lo, hi) - ANGLE_SLACK <= angle <= max(lo, hi) + ANGLE_SLACK:
                within = min(max((angle - lo) * next_inner / (hi - lo), 0.0), next_inner)
                flip = (hi > lo) != (last > first)
                factor = cmath.rect(1.0, within) * next_edge / (ahead.conjugate() if flip else ahead)
                return next_face, next_corner, factor / abs(factor), flip
    return None


def fan(on: Layout, face: int, corner: int) -> tuple[list[tuple[int, int]], bool]:
    """Corners at a vertex that are joined to a given one through edges, and whether they go all round it.

    Parameters
    ----------
    on : Layout
    face, corner : int

    Returns
    -------
    corners : list of (int, int)
        Face and corner of each, the given one first.
    closed : bool

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    faces = on.mesh.faces
    vertex, corners, closed = faces[face, corner], [(face, corner)], True
    known = set(corners)
    for one, k in corners:  # grows while it is read
        for half_edge in (3 * one + k, 3 * one + (k + 2) % 3):
            next_face, end = divmod(int(on.twins[half_edge]), 3)
            if next_face < 0:
                closed = False
                continue
            found = next_face, end if faces[next_face, end] == vertex else (end + 1) % 3
            if found not in known:
                known.add(found)
                corners.append(found)
    return corners, closed


def _corner(on: Layout, face: int, corner: int) -> tuple[complex, float, FloatArray]:
    """Edge to the next corner, inner angle, and polar angles of a corner."""
    at, after, before = (complex(on.corners[face, (corner + k) % 3]) for k in range(3))
    return after - at, cmath.phase((before - at) / (after - at)), on.angles[face, corner]


def _why_not(mesh: Mesh, face: int, out: int) -> str:
    ends = np.delete(mesh.faces[face], out)
    return "branch" if np.isin(mesh.faces, ends).sum(axis=1).tolist().count(2) > 2 else "boundary"
