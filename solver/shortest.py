"""Shortest paths between points of a surface, as straight pieces in triangles (section 5.1: source paths).

A strip of faces that joins the two points is laid flat, and a string pulled taut in it (the funnel of Lee and
Preparata 1984). Where the string bends about a vertex that it could pass on the other side, the strip is led
round there, until nothing gets shorter.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from solver.errors import SolverError
from solver.geodesics import distances_from
from solver.mesh import FloatArray, IntArray, Mesh
from solver.walks import Layout, fan

#: Barycentric weights below this are taken for zero: the point lies on the edge, or at the vertex.
ON_EDGE = 1e-12
#: How much less than π an angle must be for its side to be the shorter one.
BEND = 1e-9
#: How much a step of the first guess costs more for each part by which it leads away from the geodesic.
ASTRAY = 10.0
#: By how much less, relative to the whole, a path is taken to be shorter.
SHORTER = 1e-12


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points of a surface.

    Attributes
    ----------
    faces : ndarray of int64, shape (m,)
    barycentric : ndarray of float64, shape (m, 3)
        Weights of the corners of each face, non-negative, summing to 1.
    """

    faces: IntArray
    barycentric: FloatArray


@dataclass(frozen=True, eq=False)
class Pieces:
    """Straight pieces of a path, each in one face.

    Attributes
    ----------
    faces : ndarray of int64, shape (k,)
    start, end : ndarray of float64, shape (k, 3)
        Barycentric coordinates of both ends.
    """

    faces: IntArray
    start: FloatArray
    end: FloatArray


def shortest_path(on: Layout, points: SurfacePoints) -> Pieces:
    """Locally shortest path through points of a surface, in their order.

    Parameters
    ----------
    on : Layout
        Of the surface.
    points : SurfacePoints
        At least one.

    Returns
    -------
    Pieces
        None of length zero. A piece along an edge is shared between the two faces, half in each.

    Raises
    ------
    SolverError
        If two consecutive points are not connected through edges with two faces; ``index`` is the second one.

    Notes
    -----
    Points of one face are joined in it. The others are joined through the faces whose centres make the
    shortest chain, pulled taut and led round vertices while that is shorter: locally, no other path is.
    """
    weights = [_weights(on.mesh, f, b) for f, b in zip(points.faces, points.barycentric, strict=True)]
    pieces: list[tuple[int, FloatArray, FloatArray]] = []
    for k in range(1, len(weights)):
        one, other = weights[k - 1], weights[k]
        if one == other:
            continue
        both = _faces_at(on, points, k - 1) & _faces_at(on, points, k)
        if both:
            face = min(both)
            pieces.append((face, _within(on.mesh, face, one), _within(on.mesh, face, other)))
        else:
            pieces += _joined(on, points, k, one, other)
    halves = [half for piece in pieces for half in _halves(on, *piece)]
    faces = np.array([face for face, _, _ in halves], dtype=np.int64)
    start, end = (np.array([half[i] for half in halves]).reshape(-1, 3) for i in (1, 2))
    return Pieces(faces, start, end)


def _weights(mesh: Mesh, face: int, barycentric: FloatArray) -> dict[int, float]:
    """A point as weights of vertices, zeros left out."""
    corners = zip(mesh.faces[face].tolist(), barycentric.tolist(), strict=True)
    return {vertex: weight for vertex, weight in corners if weight > ON_EDGE}


def _within(mesh: Mesh, face: int, weights: dict[int, float]) -> FloatArray:
    """Barycentric coordinates of a point in a face that it touches."""
    found: FloatArray = np.array([weights.get(vertex, 0.0) for vertex in mesh.faces[face].tolist()])
    found /= found.sum()
    return found


def _faces_at(on: Layout, points: SurfacePoints, k: int) -> set[int]:
    """Faces that a point touches, reached from its own one through edges."""
    face, b = int(points.faces[k]), points.barycentric[k]
    inside = np.flatnonzero(b > ON_EDGE)
    if inside.size == 1:
        return {one for one, _ in fan(on, face, int(inside[0]))[0]}
    if inside.size == 2:
        out = 3 - int(inside.sum())
        return {face} | {int(t) // 3 for t in on.twins[[3 * face + (out + 1) % 3]] if t >= 0}
    return {face}


def _joined(
    on: Layout, points: SurfacePoints, k: int, one: dict[int, float], other: dict[int, float]
) -> list[tuple[int, FloatArray, FloatArray]]:
    """Pieces of the shortest path between points k − 1 and k, which share no face."""
    begin, goal = _faces_at(on, points, k - 1), _faces_at(on, points, k)
    strip = _trimmed(_chain(on, begin, goal, k, (one, other)), begin, goal)
    taut = _Taut(on, strip, one, other)
    while True:
        for detour in taut.detours():
            found = _Taut(on, _trimmed(detour, begin, goal), one, other)
            if found.length < taut.length * (1 - SHORTER):
                taut = found
                break
        else:
            return taut.pieces()


def _trimmed(strip: list[int], begin: set[int], goal: set[int]) -> list[int]:
    """A strip without its loops, from the last face at the beginning to the first one at the goal."""
    short: list[int] = []
    for face in strip:
        if face in short:
            del short[short.index(face) :]
        short.append(face)
    first = max(i for i, face in enumerate(short) if face in begin)
    last = min(i for i, face in enumerate(short) if face in goal and i >= first)
    return short[first : last + 1]


def _chain(
    on: Layout, begin: set[int], goal: set[int], k: int, ends: tuple[dict[int, float], dict[int, float]]
) -> list[int]:
    """Faces of a short chain of centres from one set of faces to another, along the geodesic."""
    half_edges = np.flatnonzero(on.twins >= 0)
    here, there = half_edges // 3, on.twins[half_edges] // 3
    vertices, faces = on.mesh.unit_vertices, on.mesh.faces
    centres = vertices[faces].mean(axis=1)
    middles = (vertices[faces.ravel()] + vertices[faces[:, [1, 2, 0]].ravel()])[half_edges] / 2
    lengths = np.linalg.norm(centres[here] - middles, axis=1) + np.linalg.norm(
        middles - centres[there], axis=1
    )
    # Off the geodesic, the distances from both points have a larger sum.
    sums = np.sum([distances_from(on.mesh, max(point, key=lambda v: point[v])) for point in ends], axis=0)
    astray = sums[faces].mean(axis=1)
    reached = np.isfinite(astray)
    astray[reached] /= astray.min(where=reached, initial=np.inf)
    costly = reached[here] & reached[there]
    lengths[costly] *= 1 + ASTRAY * (astray[here] + astray[there] - 2)[costly]
    graph = sparse.csr_array((lengths, (here, there)), shape=(len(faces), len(faces)))
    costs, before, _ = csgraph.dijkstra(graph, indices=sorted(begin), return_predecessors=True, min_only=True)
    face = min(goal, key=lambda one: (costs[one], one))
    if not math.isfinite(costs[face]):
        raise SolverError(f"points {k - 1} and {k} of the path are not connected", index=k, value=k)
    strip = [face]
    while strip[-1] not in begin:
        strip.append(int(before[strip[-1]]))
    return strip[::-1]


def _halves(
    on: Layout, face: int, start: FloatArray, end: FloatArray
) -> list[tuple[int, FloatArray, FloatArray]]:
    """A piece, or two halves of it in both faces if it lies along their edge."""
    if abs(start - end).max() <= ON_EDGE:
        return []
    out = np.flatnonzero(np.maximum(start, end) <= ON_EDGE)
    if out.size == 0:
        return [(face, start, end)]
    twin = int(on.twins[3 * face + (int(out[0]) + 1) % 3])
    if twin < 0:
        return [(face, start, end)]
    middle = (start + end) / 2
    other, mesh = twin // 3, on.mesh
    return [
        (face, start, middle),
        (
            other,
            _within(mesh, other, _weights(mesh, face, middle)),
            _within(mesh, other, _weights(mesh, face, end)),
        ),
    ]


class _Taut:
    """The shortest string between two points in a strip of faces that is laid flat.

    Portals are the edges between consecutive faces of the strip; the string crosses portal i at ``_share[i]``
    of the way from its right end to its left end, as seen going along.
    """

    def __init__(self, on: Layout, strip: list[int], one: dict[int, float], other: dict[int, float]) -> None:
        self._on, self._strip, self._one, self._other = on, strip, one, other
        self._ends: list[tuple[int, int]] = []  # vertices at the left and right end of each portal
        places: list[tuple[complex, complex]] = []
        first = self._flat(strip[0])
        start = self._at(first, one)
        flat = first
        for face, following in pairwise(strip):
            shared = [v for v in self._flat(following) if v in flat]
            if len(shared) == 3:  # two faces on the same corners
                shared = self._shared(face, following)
            if not places:
                opposite = next(v for v in flat if v not in shared)
                a, b = shared
                ahead = ((flat[b] - flat[a]).conjugate() * (flat[opposite] - flat[a])).imag
                left, right = (a, b) if ahead < 0 else (b, a)
            else:
                left, right = self._ends[-1]
                (new,) = set(shared) - {left, right} or {left}
                left, right = (left, new) if left in shared else (new, right)
            self._ends.append((left, right))
            places.append((flat[left], flat[right]))
            flat = self._unfolded(following, left, right, *places[-1])
        self._start, self._end, self._places = start, self._at(flat, other), places
        self._corners = _funnel(start, self._end, places)
        self._share = self._shares()
        stops = [start, *(place for _, place in self._corners), self._end]
        self.length = sum(abs(b - a) for a, b in pairwise(stops))

    def _flat(self, face: int) -> dict[int, complex]:
        corners = zip(self._on.mesh.faces[face].tolist(), self._on.corners[face].tolist(), strict=True)
        return dict(corners)

    def _shared(self, face: int, following: int) -> list[int]:
        twins = self._on.twins[3 * face : 3 * face + 3] // 3
        k = int(np.flatnonzero(twins == following)[0])
        return [int(self._on.mesh.faces[face, k]), int(self._on.mesh.faces[face, (k + 1) % 3])]

    def _at(self, flat: dict[int, complex], weights: dict[int, float]) -> complex:
        return sum(weight * flat[v] for v, weight in weights.items()) / sum(weights.values())

    def _unfolded(
        self, face: int, left: int, right: int, left_at: complex, right_at: complex
    ) -> dict[int, complex]:
        """The face laid beyond the portal that it is entered through."""
        flat = self._flat(face)
        (new,) = set(flat) - {left, right}
        relative = (flat[new] - flat[right]) / (flat[left] - flat[right])
        if relative.imag > 0:  # it lies beyond if it is to the right of the way from right to left
            relative = relative.conjugate()
        return {left: left_at, right: right_at, new: right_at + (left_at - right_at) * relative}

    def _shares(self) -> list[float]:
        """Where the string crosses each portal."""
        share = []
        stops = [(-1, self._start), *self._corners, (len(self._places), self._end)]
        at = 0
        for i, (left, right) in enumerate(self._places):
            while stops[at + 1][0] < i:
                at += 1
            (_, begin), (_, end) = stops[at], stops[at + 1]
            along, across = end - begin, left - right
            area = (along.conjugate() * across).imag
            if area > 0:
                t = ((right - begin).conjugate() * along).imag / area
            else:  # the string lies along the portal, or is a point
                t = float(abs(end - left) < abs(end - right))
            share.append(min(max(t, 0.0), 1.0))
        return share

    def pieces(self) -> list[tuple[int, FloatArray, FloatArray]]:
        """The string in each face of the strip."""
        mesh, crossings = self._on.mesh, [self._one]
        for (left, right), share in zip(self._ends, self._share, strict=True):
            crossings.append({v: w for v, w in ((left, share), (right, 1 - share)) if w > ON_EDGE})
        crossings.append(self._other)
        return [
            (face, _within(mesh, face, a), _within(mesh, face, b))
            for face, a, b in zip(self._strip, crossings, crossings[1:], strict=False)
            if a != b
        ]

    def detours(self) -> Iterator[list[int]]:
        """Strips led round the other side of vertices: of all where that is shorter, then of each alone."""
        stops = [(-1, self._start), *self._corners, (len(self._places), self._end)]
        ways = []
        for k, (index, at) in enumerate(self._corners, start=1):
            before = next(place for _, place in stops[k - 1 :: -1] if place != at)
            beyond = next(place for _, place in stops[k + 1 :] if place != at)
            vertex = self._ends[index][0 if at == self._places[index][0] else 1]
            first, last = self._run(vertex, index)
            bend = abs(cmath.phase((before - at) / (beyond - at)))
            way = self._other_side(vertex, first, last, bend)
            if way is not None:
                ways.append((first, last + 2, way))
        strip, free = [], 0
        for first, end, way in ways:
            if first >= free:  # detours that overlap are for later
                strip += [*self._strip[free:first], *way]
                free = end
        yield [*strip, *self._strip[free:]]
        for first, end, way in ways:
            yield [*self._strip[:first], *way, *self._strip[end:]]

    def _run(self, vertex: int, index: int) -> tuple[int, int]:
        """First and last of the portals around a given one that end at a vertex."""
        first = last = index
        while first > 0 and vertex in self._ends[first - 1]:
            first -= 1
        while last + 1 < len(self._ends) and vertex in self._ends[last + 1]:
            last += 1
        return first, last

    def _other_side(self, vertex: int, first: int, last: int, bend: float) -> list[int] | None:
        """Faces round a vertex the other way, if the string bends by less than π there in all."""
        on = self._on
        begin, end = self._strip[first], self._strip[last + 1]
        corners, closed = fan(on, begin, int(np.flatnonzero(on.mesh.faces[begin] == vertex)[0]))
        around = sum(self._angle(face, corner) for face, corner in corners)
        # In the strip there are 2π − bend between the two ends of the string.
        if not closed or around - (2 * math.pi - bend) >= math.pi - BEND:
            return None
        corner_in = dict(corners)
        way, came = [begin], self._strip[first + 1]
        while way[-1] != end:
            face, corner = way[-1], corner_in[way[-1]]
            sides = [int(on.twins[3 * face + k]) // 3 for k in (corner, (corner + 2) % 3)]
            came, onward = face, sides[1] if sides[0] == came else sides[0]
            way.append(onward)
        return way

    def _angle(self, face: int, corner: int) -> float:
        """Angle of a corner of a face."""
        at, after, before = (complex(self._on.corners[face, (corner + k) % 3]) for k in range(3))
        return cmath.phase((before - at) / (after - at))


def _funnel(
    start: complex, end: complex, portals: list[tuple[complex, complex]]
) -> list[tuple[int, complex]]:
    """Corners of the shortest path through portals (left, right), each with the index of its portal."""
    gates = [*portals, (end, end)]
    corners: list[tuple[int, complex]] = []
    apex, at = start, -1
    left = right = start
    left_at = right_at = -1
    i = 0
    while i < len(gates):
        new_left, new_right = gates[i]
        if _turn(apex, right, new_right) >= 0:
            if apex in (left, new_right) or _turn(apex, left, new_right) < 0:
                right, right_at = new_right, i
            else:
                corners.append((left_at, left))
                apex, at = left, left_at
                left = right = apex
                left_at = right_at = at
                i = at + 1
                continue
        if _turn(apex, left, new_left) <= 0:
            if apex in (right, new_left) or _turn(apex, right, new_left) > 0:
                left, left_at = new_left, i
            else:
                corners.append((right_at, right))
                apex, at = right, right_at
                left = right = apex
                left_at = right_at = at
                i = at + 1
                continue
        i += 1
    # Drawn to the end, both sides of the funnel meet there.
    return [(index, place) for index, place in corners if index < len(portals)]


def _turn(a: complex, b: complex, c: complex) -> float:
    """Positive if c lies to the left of the way from a to b."""
    return ((b - a).conjugate() * (c - a)).imag
