"""Geodesic distances, farthest-point samples and their cells (section 4.2).

Fronts march over the mesh vertex by vertex. Across an edge whose two ends are reached, the front is that of
the one point in the plane of the face that lies at both distances, which is exact on flat pieces.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np

from solver.errors import InvalidBasis, InvalidMesh
from solver.mesh import FloatArray, IntArray, Mesh

#: Distances that agree to this relative difference are tied, and the lower index wins: far above rounding, so
#: that symmetric meshes give the same samples whichever way they are turned, and far below any geometry.
TIE = 1e-6

#: A front passes a vertex again when it has found a way shorter by this relative amount, 1.1 times as much
#: each time. Obtuse triangles need it a few times. Where triangles are too coarse for the surface, their
#: planes can contradict each other, and the front would go round them for ever: it ends after 194 times.
SHORTER, SHORTER_GROWTH = 1e-8, 1.1


@dataclass(frozen=True, eq=False)
class Samples:
    """Farthest-point samples of a mesh, and the cells of vertices nearest to each.

    Attributes
    ----------
    vertices : ndarray of int64, shape (n,)
        The samples, in order of choice.
    cells : ndarray of int64, shape (V,)
        Nearest sample of each vertex as a position in ``vertices``; −1 where no face is.
    distances : ndarray of float64, shape (V,)
        Distance to that sample in √area; inf where no face is.
    """

    vertices: IntArray
    cells: IntArray
    distances: FloatArray


def distances_from(mesh: Mesh, vertex: int) -> FloatArray:
    """Geodesic distance of every vertex from one vertex.

    Parameters
    ----------
    mesh : Mesh
        Any mesh, with or without boundary, manifold or not.
    vertex : int
        The source, a corner of some face.

    Returns
    -------
    ndarray of float64, shape (V,)
        In √area; inf on other components and at unreferenced vertices.

    Raises
    ------
    InvalidMesh
        The source is no vertex, or is in no face.
    """
    if not 0 <= vertex < mesh.n_vertices or not mesh.referenced[vertex]:
        raise InvalidMesh(f"vertex {vertex} is no corner of any face", index=vertex, value=vertex)
    surface, scratch = _surface(mesh), _scratch(mesh.n_vertices)
    _march(vertex, *surface, np.full(mesh.n_vertices, np.inf), *scratch)
    return scratch[0]


def discs(mesh: Mesh, centres: IntArray, radii: FloatArray) -> Iterator[tuple[IntArray, FloatArray]]:
    """Vertices within a radius of each of several vertices, nearest first, with their distances.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    centres : ndarray of int64, shape (k,)
        Corners of faces.
    radii : ndarray of float64, shape (k,)
        In √area.

    Yields
    ------
    vertices : ndarray of int64, shape (m,)
        The centre itself comes first.
    distances : ndarray of float64, shape (m,)
        In √area, ascending.
    """
    surface, scratch = _surface(mesh), _scratch(mesh.n_vertices)
    distance, touched, passed = scratch[:3]
    for centre, radius in zip(centres, radii, strict=True):
        n_touched = _march(centre, *surface, np.full(mesh.n_vertices, radius), *scratch)
        reached = np.sort(touched[:n_touched])
        distances = distance[reached]
        distance[reached], passed[reached] = np.inf, 0
        order = np.argsort(distances, kind="stable")
        order = order[: np.searchsorted(distances[order], radius, side="right")]
        yield reached[order], distances[order]


def farthest_point_samples(
    mesh: Mesh,
    size: int,
    first: int | list[int] | IntArray = 0,
    progress: Callable[[float], None] | None = None,
) -> Samples:
    """Farthest-point samples: after the given first ones, each is the vertex farthest from all before it.

    Parameters
    ----------
    mesh : Mesh
        Any mesh. Each of its components gets at least one sample.
    size : int
        Number of samples n.
    first : int or sequence of int
        Vertices to start with, distinct.
    progress : callable, optional
        Called with the fraction done, from 0 to 1; may raise to abort.

    Returns
    -------
    Samples
        Always the same for the same mesh; ties within ``TIE`` go to the lowest vertex.

    Raises
    ------
    InvalidBasis
        More samples than vertices, fewer than components, or first vertices that are no distinct corners.
    """
    chosen = _checked_first(mesh, size, first)
    surface, scratch = _surface(mesh), _scratch(mesh.n_vertices)
    distances = np.where(mesh.referenced, np.inf, -1.0)  # −1 is never the farthest
    cells = np.full(mesh.n_vertices, -1, dtype=np.int64)
    vertices = np.empty(size, dtype=np.int64)
    for k in range(size):
        vertices[k] = chosen[k] if k < len(chosen) else _farthest(distances)
        _claim(vertices[k], k, *surface, distances, cells, *scratch)
        if progress is not None:
            progress((k + 1) / size)
    distances[~mesh.referenced] = np.inf
    for array in (vertices, cells, distances):
        array.setflags(write=False)
    return Samples(vertices, cells, distances)


def _checked_first(mesh: Mesh, size: int, first: int | list[int] | IntArray) -> IntArray:
    """Return the first samples as an array, or refuse them and the size with the culprit."""
    raw = np.atleast_1d(np.asarray(first))
    if raw.ndim != 1 or raw.size == 0 or raw.dtype.kind not in "iu":
        raise InvalidBasis("first must be a vertex or a list of vertices", value=str(first)[:80])
    vertices = raw.astype(np.int64)
    n_candidates = int(mesh.referenced.sum())
    if not isinstance(size, int | np.integer) or not 1 <= size <= n_candidates:
        raise InvalidBasis(f"size must be between 1 and the {n_candidates} vertices of the mesh", value=size)
    for k, vertex in enumerate(vertices):
        if not 0 <= vertex < mesh.n_vertices or not mesh.referenced[vertex]:
            raise InvalidBasis(f"first[{k}] is {vertex}, no corner of any face", index=k, value=int(vertex))
    unique, index = np.unique(vertices, return_index=True)
    if unique.size < vertices.size:
        k = int(np.setdiff1d(np.arange(vertices.size), index)[0])
        raise InvalidBasis(f"first[{k}] is {vertices[k]} again", index=k, value=int(vertices[k]))
    needed = vertices.size + mesh.n_components - np.unique(mesh.components[vertices]).size
    if size < needed:
        message = (
            f"size {size} is too small: {mesh.n_components} components need a sample each, "
            f"and {vertices.size} are given as first, which makes {needed}"
        )
        raise InvalidBasis(message, value=size)
    return vertices


Surface = tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]
Scratch = tuple[FloatArray, IntArray, IntArray, IntArray, IntArray]


def _surface(mesh: Mesh) -> Surface:
    """Corners around each vertex (starts, corners), faces, lengths, doubled areas, reach of each vertex."""
    corners = np.argsort(mesh.faces, axis=None, kind="stable")
    counts = np.bincount(mesh.faces.ravel(), minlength=mesh.n_vertices)
    starts = np.concatenate([[0], np.cumsum(counts)])
    lengths = np.ascontiguousarray(np.linalg.norm(mesh.opposite_edges, axis=2))
    longest = np.zeros(mesh.n_vertices)
    np.maximum.at(longest, mesh.faces, np.maximum(lengths[:, [1, 2, 0]], lengths[:, [2, 0, 1]]))
    return starts, corners, mesh.faces.copy(), lengths, 2 * mesh.face_areas, 2 * longest


def _scratch(n_vertices: int) -> Scratch:
    """Distances of a moving front, vertices it touched, times it passed each, its heap and places in that."""
    touched, passed, heap = np.zeros((3, n_vertices), dtype=np.int64)
    return np.full(n_vertices, np.inf), touched, passed, heap, np.full(n_vertices, -1, dtype=np.int64)


_kernel = partial(numba.njit, cache=True, nogil=True)
_SURFACE = "int64[::1], int64[::1], int64[:, ::1], float64[:, ::1], float64[::1], float64[::1]"
_SCRATCH = "float64[::1], int64[::1], int64[::1], int64[::1], int64[::1]"


@_kernel("float64(float64, float64, float64, float64, float64, float64)")
def _across(d_a: float, d_b: float, ab: float, ac: float, bc: float, doubled_area: float) -> float:
    """Distance at C of the front with distances d_a at A and d_b at B, where it crosses AB; else inf.

    In the plane of the face, A = (0, 0), B = (ab, 0) and C above them, the front comes from the point below
    them at distances d_a and d_b. It grows with d_a and d_b, so lowering distances as far as they go ends in
    the same field in whatever order that is done.
    """
    source_x = 0.5 * ((d_a - d_b) * ((d_a + d_b) / ab) + ab)
    squared = (d_a - source_x) * (d_a + source_x)
    if not squared > 0.0:
        return math.inf
    depth = math.sqrt(squared)
    height = doubled_area / ab
    c_x = 0.5 * ((ac - bc) * ((ac + bc) / ab) + ab)
    crossing = source_x * height + c_x * depth
    if crossing <= 0.0 or crossing >= ab * (height + depth):
        return math.inf
    return math.hypot(c_x - source_x, height + depth)


@_kernel("void(int64, float64[::1], int64[::1], int64[::1], int64)")
def _rise(vertex: int, distance: FloatArray, heap: IntArray, place: IntArray, size: int) -> None:
    """Move a vertex whose distance fell (or a new one, at place size) up to where it belongs."""
    here = place[vertex]
    if here < 0:
        here = size
    while here > 0:
        above = (here - 1) // 2
        if distance[heap[above]] <= distance[vertex]:
            break
        heap[here] = heap[above]
        place[heap[here]] = here
        here = above
    heap[here] = vertex
    place[vertex] = here


@_kernel("int64(float64[::1], int64[::1], int64[::1], int64)")
def _pop(distance: FloatArray, heap: IntArray, place: IntArray, size: int) -> int:
    """Take the nearest vertex off a heap of the given size."""
    top: int = heap[0]
    place[top] = -1
    last = heap[size - 1]
    if last == top:
        return top
    here = 0
    while True:
        below = 2 * here + 1
        if below >= size - 1:
            break
        if below + 1 < size - 1 and distance[heap[below + 1]] < distance[heap[below]]:
            below += 1
        if distance[last] <= distance[heap[below]]:
            break
        heap[here] = heap[below]
        place[heap[here]] = here
        here = below
    heap[here] = last
    place[last] = here
    return top


@_kernel(f"int64(int64, {_SURFACE}, float64[::1], {_SCRATCH})")
def _march(
    source: int,
    starts: IntArray,
    corners: IntArray,
    faces: IntArray,
    lengths: FloatArray,
    doubled_areas: FloatArray,
    reach: FloatArray,
    bound: FloatArray,
    distance: FloatArray,
    touched: IntArray,
    passed: IntArray,
    heap: IntArray,
    place: IntArray,
) -> int:
    """Spread a front from a vertex where it is below the bound, and a little farther; count what it touched.

    A geodesic to a vertex below the bound crosses only edges whose two ends are below the bound plus twice
    the edge: with that reach, the distances below the bound are those of a front that was never stopped.
    """
    distance[source] = 0.0
    touched[0] = source
    n_touched = 1
    _rise(source, distance, heap, place, 0)
    size = 1
    while size > 0:
        v = _pop(distance, heap, place, size)
        size -= 1
        passed[v] += 1
        if distance[v] >= bound[v] + reach[v]:
            continue
        for slot in range(starts[v], starts[v + 1]):
            f, k = corners[slot] // 3, corners[slot] % 3
            for turn in range(2):
                i, j = (k + 1 + turn) % 3, (k + 2 - turn) % 3
                w, other = faces[f, i], faces[f, j]
                # Lengths are named by the opposite corner.
                vw, v_other, w_other = lengths[f, j], lengths[f, i], lengths[f, k]
                d_v, d_other = distance[v], distance[other]
                reached = d_v + vw
                if d_other < math.inf:
                    reached = min(reached, _across(d_v, d_other, v_other, vw, w_other, doubled_areas[f]))
                if reached < distance[w]:
                    new = place[w] < 0
                    shorter = SHORTER * SHORTER_GROWTH ** passed[w]
                    if new and passed[w] > 0 and reached > distance[w] * (1.0 - shorter):
                        continue
                    if distance[w] == math.inf:
                        touched[n_touched] = w
                        n_touched += 1
                    distance[w] = reached
                    _rise(w, distance, heap, place, size)
                    if new:
                        size += 1
    return n_touched


@_kernel(f"void(int64, int64, {_SURFACE}, float64[::1], int64[::1], {_SCRATCH})")
def _claim(
    source: int,
    label: int,
    starts: IntArray,
    corners: IntArray,
    faces: IntArray,
    lengths: FloatArray,
    doubled_areas: FloatArray,
    reach: FloatArray,
    nearest: FloatArray,
    cells: IntArray,
    distance: FloatArray,
    touched: IntArray,
    passed: IntArray,
    heap: IntArray,
    place: IntArray,
) -> None:
    """Give a new sample the vertices that are nearer to it than to any before it, and clear the front."""
    n_touched = _march(
        source,
        starts,
        corners,
        faces,
        lengths,
        doubled_areas,
        reach,
        nearest,
        distance,
        touched,
        passed,
        heap,
        place,
    )
    for v in touched[:n_touched]:
        if distance[v] < nearest[v]:
            if distance[v] < nearest[v] * (1.0 - TIE):
                cells[v] = label
            nearest[v] = distance[v]
        distance[v] = math.inf
        passed[v] = 0


@_kernel("int64(float64[::1])")
def _farthest(distances: FloatArray) -> int:
    """Return the lowest vertex whose distance ties with the largest."""
    largest = 0.0
    for d in distances:
        largest = max(largest, d)
    v = 0
    while distances[v] < largest * (1.0 - TIE):
        v += 1
    return v
