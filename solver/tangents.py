"""Tangent planes of vertices, transport between them, and logarithmic maps (for `solver.maxent`).

The plane of an interior vertex is its faces flattened: their angles, scaled to 2π, are polar angles. Where a
point p lies in such a plane, log_x p, is found by letting mass and moment flow from p for a short time, as in
the vector heat method (Sharp, Soliman and Crane 2019; Soliman and Sharp 2025).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np
import numpy.typing as npt

from solver.fem import mass
from solver.geodesics import discs
from solver.mesh import BoolArray, FloatArray, IntArray, Mesh

ComplexArray = npt.NDArray[np.complex128]

#: Cotangent weights below this are raised to it (those of an equilateral mesh are 0.58): the flow then never
#: runs uphill, and reaches every vertex. Any positive weights give the same logarithms in the plane.
LEAST_WEIGHT = 0.02

#: Times that the flow passes over a disc, outwards and inwards in turn. After 16 the error of a basis is that
#: of the exact solution.
SWEEPS = 16

#: The flow goes as far as an edge is long on average, but at least this fraction of the disc's radius:
#: farther out than 700 times its reach nothing of it can be represented.
LEAST_REACH = 1 / 300


def twins(mesh: Mesh) -> IntArray:
    """Half-edge on the other side of each half-edge.

    Parameters
    ----------
    mesh : Mesh
        Any mesh. Half-edge 3f + k runs from corner k to corner k + 1 of face f.

    Returns
    -------
    ndarray of int64, shape (3F,)
        −1 at boundaries and where more than two faces meet.

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    start, end = mesh.faces.ravel(), mesh.faces[:, [1, 2, 0]].ravel()
    keys = np.minimum(start, end) * mesh.n_vertices + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    _, first, counts = np.unique(keys[order], return_index=True, return_counts=True)
    one, other = order[first[counts == 2]], order[first[counts == 2] + 1]
    found = np.full(keys.size, -1, dtype=np.int64)
    found[one], found[other] = other, one
    return found


def corner_angles(mesh: Mesh) -> FloatArray:
    """Polar angles of the two edges of each corner in the plane of its vertex.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.

    Returns
    -------
    ndarray of float64, shape (F, 3, 2)
        Angle of the edge to the next corner of the face, then of that to the previous one. Around an interior
        vertex they are scaled so that all faces fill 2π; at a boundary they are as they are. Where surfaces
        only touch, one begins where the other ends.

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    edges = mesh.opposite_edges
    dots = -np.einsum("fkx,fkx->fk", edges[:, [1, 2, 0]], edges[:, [2, 0, 1]])
    inner = np.arctan2(2 * mesh.face_areas[:, None], dots)
    corners = np.argsort(mesh.faces, axis=None, kind="stable")
    counts = np.bincount(mesh.faces.ravel(), minlength=mesh.n_vertices)
    starts = np.concatenate([[0], np.cumsum(counts)])
    # Side 0 of a corner is its edge to the next corner, side 1 that to the previous one.
    corner = np.arange(mesh.faces.size)
    sides = np.stack([corner, np.where(corner % 3 == 0, corner + 2, corner - 1)], axis=1)
    twin = twins(mesh)[sides]
    here = mesh.faces.ravel()[:, None]
    outgoing = mesh.faces.ravel()[twin] == here
    following = np.where(twin % 3 == 2, twin - 2, twin + 1)
    across = np.where(twin < 0, -1, np.where(outgoing, 2 * twin, 2 * following + 1))
    angles = np.zeros((corner.size, 2))
    _flatten(starts, corners, np.ascontiguousarray(across).ravel(), inner.ravel(), angles)
    return angles.reshape(-1, 3, 2)


@dataclass(frozen=True, eq=False)
class Connection:
    """How each vertex sees its neighbours: entries ``starts[x]`` to ``starts[x + 1]`` belong to vertex x.

    Attributes
    ----------
    starts : ndarray of int64, shape (V + 1,)
    neighbours : ndarray of int64, shape (E,)
        The other end y of each edge.
    weights : ndarray of float64, shape (E,)
        Cotangent weight of the edge, at least ``LEAST_WEIGHT``.
    steps : ndarray of complex128, shape (E,)
        Where y lies in the plane of x, in √area.
    turns : ndarray of complex128, shape (E,)
        What a vector in the plane of y is multiplied by to be one in the plane of x.
    mirrored : ndarray of bool, shape (E,)
        Whether it is conjugated first: the planes are oriented differently.
    """

    starts: IntArray
    neighbours: IntArray
    weights: FloatArray
    steps: ComplexArray
    turns: ComplexArray
    mirrored: BoolArray


def connection(mesh: Mesh) -> Connection:
    """Edges of a mesh, each seen from both its ends.

    Parameters
    ----------
    mesh : Mesh
        Any mesh. Where more than two faces meet, the edge is seen once through each of them.

    Returns
    -------
    Connection

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    angles = corner_angles(mesh)
    signs = np.sign(angles[..., 1] - angles[..., 0])
    edges = mesh.opposite_edges
    cotangents = -np.einsum("fkx,fkx->fk", edges[:, [1, 2, 0]], edges[:, [2, 0, 1]])
    cotangents /= 4 * mesh.face_areas[:, None]
    # Half-edges of corner k → k + 1, seen from k, then from k + 1; the corner opposite is k + 2.
    after = [1, 2, 0]
    x = np.concatenate([mesh.faces, mesh.faces[:, after]]).ravel()
    y = np.concatenate([mesh.faces[:, after], mesh.faces]).ravel()
    ahead = np.concatenate([angles[:, :, 0], angles[:, after, 1]]).ravel()
    back = np.concatenate([angles[:, after, 1], angles[:, :, 0]]).ravel()
    mirrored = np.tile((signs * signs[:, after]).ravel() < 0, 2)
    lengths = np.tile(np.linalg.norm(edges, axis=2)[:, [2, 0, 1]].ravel(), 2)
    _, first, pair, counts = np.unique(
        x * mesh.n_vertices + y, return_index=True, return_inverse=True, return_counts=True
    )
    weights = np.bincount(pair, weights=np.tile(cotangents[:, [2, 0, 1]].ravel(), 2))
    weights = np.maximum(weights, LEAST_WEIGHT)
    crowd = np.where(counts > 2, counts, 1)
    # The two faces of an ordinary edge agree on it.
    kept = np.flatnonzero((first[pair] == np.arange(pair.size)) | (counts[pair] > 2))
    kept = kept[np.argsort(x[kept], kind="stable")]
    turned = ahead + np.pi + np.where(mirrored, back, -back)
    return Connection(
        starts=np.searchsorted(x[kept], np.arange(mesh.n_vertices + 1)).astype(np.int64),
        neighbours=y[kept],
        weights=(weights / crowd)[pair[kept]],
        steps=(lengths * np.exp(1j * ahead))[kept],
        turns=np.exp(1j * turned[kept]),
        mirrored=mirrored[kept],
    )


@dataclass(frozen=True, eq=False)
class LogMaps:
    """Where some points lie in the planes of the vertices around them.

    Attributes
    ----------
    starts : ndarray of int64, shape (V + 1,)
        Entries ``starts[x]`` to ``starts[x + 1]`` are those of vertex x.
    points : ndarray of int64, shape (m,)
        Position of the point p in the list asked for, ascending for each x.
    vectors : ndarray of complex128, shape (m,)
        log_x p in the plane of x, in √area.
    distances : ndarray of float64, shape (m,)
        Geodesic distance of x and p in √area.
    """

    starts: IntArray
    points: IntArray
    vectors: ComplexArray
    distances: FloatArray


def log_maps(
    mesh: Mesh, points: IntArray, radii: FloatArray, progress: Callable[[float], None] | None = None
) -> LogMaps:
    """Logarithms log_x p = z_x / s_x of mass s and moment z that flow from p for a short time t.

    With cotangent weights w, a step e_xy from x to y, and the turn R_xy from the plane of y to that of x:
    m_x s_x + t Σ_y w (s_x − s_y) = δ_xp and m_x z_x + t Σ_y w (z_x − R_xy z_y − s_y e_xy) = 0.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    points : ndarray of int64, shape (n,)
        Vertices p, corners of faces.
    radii : ndarray of float64, shape (n,)
        How far from each p its logarithms are wanted, in √area.
    progress : callable, optional
        Called with the fraction done, from 0 to 1; may raise to abort.

    Returns
    -------
    LogMaps

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.

    Notes
    -----
    In the plane z_x = s_x (p − x) exactly, after any number of sweeps. Elsewhere a logarithm is the mean over
    all short ways, each developed into a plane; t is the square of an average edge.
    """
    seen, masses, n_vertices = connection(mesh), mass(mesh), mesh.n_vertices
    entries = np.diff(seen.starts)
    edge_sums = np.bincount(np.repeat(np.arange(n_vertices), entries), abs(seen.steps), n_vertices)
    edge_means = edge_sums / np.maximum(entries, 1)
    place = np.full(n_vertices, -1, dtype=np.int64)
    found = []
    for k, (disc, distances) in enumerate(discs(mesh, points, radii)):
        reach = max(float(edge_means[disc].mean()), LEAST_REACH * float(distances[-1]))
        s, z = np.empty(len(disc)), np.empty(len(disc), dtype=np.complex128)
        _spread(
            disc, seen.starts, seen.neighbours, seen.weights, seen.steps, seen.turns, seen.mirrored,
            masses, reach**2, SWEEPS, place, s, z,
        )  # fmt: skip
        reached = s > 0
        z[0] = 0
        found.append((disc[reached], z[reached] / s[reached], distances[reached]))
        if progress is not None:
            progress((k + 1) / len(points))
    vertices, vectors, distances = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.argsort(vertices, kind="stable")
    return LogMaps(
        starts=np.searchsorted(vertices[order], np.arange(n_vertices + 1)).astype(np.int64),
        points=np.repeat(np.arange(len(points)), [len(part[0]) for part in found])[order],
        vectors=vectors[order],
        distances=distances[order],
    )


_kernel = partial(numba.njit, cache=True, nogil=True)


@_kernel("void(int64[::1], int64[::1], int64[::1], float64[::1], float64[:, ::1])")
def _flatten(
    starts: IntArray, corners: IntArray, across: IntArray, inner: FloatArray, angles: FloatArray
) -> None:
    """Lay the corners of each vertex one beside the other, in chains from a free side or round in circles."""
    done = np.zeros(len(corners), dtype=np.bool_)
    for v in range(len(starts) - 1):
        angle = 0.0
        for closed in range(2):
            for slot in range(starts[v], starts[v + 1]):
                for side in range(2):
                    first = 2 * corners[slot] + side
                    if done[corners[slot]] or (closed == 0 and across[first] >= 0):
                        continue
                    scale = 1.0
                    if closed == 1:
                        around, door = inner[first // 2], across[2 * (first // 2) + 1 - first % 2]
                        while door // 2 != first // 2:
                            around += inner[door // 2]
                            door = across[2 * (door // 2) + 1 - door % 2]
                        scale = 2 * np.pi / around
                    door = first
                    while door >= 0 and not done[door // 2]:
                        corner = door // 2
                        done[corner] = True
                        angles[corner, door % 2] = angle
                        angle += scale * inner[corner]
                        angles[corner, 1 - door % 2] = angle
                        door = across[2 * corner + 1 - door % 2]


@_kernel(
    "void(int64[::1], int64[::1], int64[::1], float64[::1], complex128[::1], complex128[::1], boolean[::1], "
    "float64[::1], float64, int64, int64[::1], float64[::1], complex128[::1])"
)
def _spread(
    disc: IntArray,
    starts: IntArray,
    neighbours: IntArray,
    weights: FloatArray,
    steps: ComplexArray,
    turns: ComplexArray,
    mirrored: BoolArray,
    masses: FloatArray,
    time: float,
    sweeps: int,
    place: IntArray,
    s: FloatArray,
    z: ComplexArray,
) -> None:
    """Gauss–Seidel sweeps of the flow of mass s and moment z from the first vertex of a disc, in order."""
    size = 0
    for k in range(len(disc)):
        place[disc[k]] = k
        size += starts[disc[k] + 1] - starts[disc[k]]
    # The disc's own copy of its edges, nearest first, is what makes the sweeps quick.
    begin, neighbour = np.empty(len(disc) + 1, np.int64), np.empty(size, np.int64)
    weight, step, turn = np.empty(size), np.empty(size, np.complex128), np.empty(size, np.complex128)
    flips, totals = np.empty(size, np.bool_), np.empty(len(disc))
    size = 0
    for k in range(len(disc)):
        x, begin[k] = disc[k], size
        totals[k] = masses[x] / time
        for e in range(starts[x], starts[x + 1]):
            totals[k] += weights[e]
            if place[neighbours[e]] >= 0:
                neighbour[size], flips[size], weight[size] = place[neighbours[e]], mirrored[e], weights[e]
                step[size], turn[size] = weights[e] * steps[e], weights[e] * turns[e]
                size += 1
        s[k] = 0.0
        z[k] = 0.0
    begin[len(disc)] = size
    for sweep in range(sweeps):
        for position in range(len(disc)):
            k = position if sweep % 2 == 0 else len(disc) - 1 - position
            mass_in = masses[disc[0]] / time if k == 0 else 0.0
            moment_in = 0j
            for e in range(begin[k], begin[k + 1]):
                y = neighbour[e]
                mass_in += weight[e] * s[y]
                moment_in += turn[e] * (z[y].conjugate() if flips[e] else z[y]) + step[e] * s[y]
            s[k] = mass_in / totals[k]
            z[k] = moment_in / totals[k]
    for x in disc:
        place[x] = -1
