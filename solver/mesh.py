"""Triangle meshes, checked once and then trusted (section 4.1: surfaces are meshes scaled to unit area).

Whatever has area is accepted: boundaries, handles, several components, non-manifold edges. What cannot be
measured is refused with the culprit's index and value; what is merely odd is told in ``warnings``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse import csgraph

from solver.errors import InvalidMesh

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
AnyArray = TypeVar("AnyArray", bound=npt.NDArray[Any])

#: A face whose height over its longest edge is below this multiple of that edge has zero area: in double
#: precision its normal and cotangents have no correct digit, or its cotangents drown those of its neighbours.
FLATTEST = 8 * float(np.finfo(np.float64).eps)

#: A face below this share of the squared size of the mesh has zero area: products of its lengths underflow.
SMALLEST = 1e-200


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with everything the solver asks of it; inside, its total area is 1.

    Parameters
    ----------
    vertices : array_like of float, shape (V, 3)
        Positions, in any unit. Sizes from about 1e-150 to 1e150 work: the area must be positive and finite.
    faces : array_like of int, shape (F, 3)
        0-based corners of each triangle.

    Attributes
    ----------
    vertices : ndarray of float64, shape (V, 3)
        As given, read-only.
    faces : ndarray of int64, shape (F, 3)
        As given, read-only.

    Raises
    ------
    InvalidMesh
        Wrong shape, no vertex or face, a vertex that is not finite, an index that is no vertex, a face that
        repeats a vertex or has zero area (see ``FLATTEST``), a total area that is not positive and finite.

    Notes
    -----
    Needles are welcome: a face is refused only when its height is below 1.8e-15 of its longest edge (an angle
    of 1e-13 degrees), where rounding alone decides its shape.
    """

    vertices: FloatArray
    faces: IntArray

    def __post_init__(self) -> None:
        vertices = _checked_vertices(self.vertices)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", _checked_faces(self.faces, len(vertices)))
        _refuse_unmeasurable(self)

    @property
    def n_vertices(self) -> int:
        """Number of vertices V, unreferenced ones included."""
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        """Number of faces F."""
        return len(self.faces)

    @cached_property
    def referenced(self) -> BoolArray:
        """Whether each vertex is a corner of some face, bool (V,)."""
        referenced = np.zeros(self.n_vertices, dtype=bool)
        referenced[self.faces.ravel()] = True
        return _frozen(referenced)

    @cached_property
    def _exponent(self) -> int:
        """The power of two above the extent of the mesh: scaling by it is exact, and nothing overflows."""
        corners = 0.5 * self.vertices[self.referenced]
        extent = float((corners.max(axis=0) - corners.min(axis=0)).max())
        return math.frexp(extent)[1] + 1 if extent > 0 else 0

    @cached_property
    def _scaled(self) -> tuple[FloatArray, float]:
        """Area of each face, and of all, in units of 4^exponent."""
        areas = 0.5 * np.linalg.norm(_doubled_area_vectors(_opposite_edges(self, self._exponent)), axis=1)
        return areas, float(areas.sum())

    @cached_property
    def area(self) -> float:
        """Total area, in squared units of the vertices as given."""
        return math.ldexp(self._scaled[1], 2 * self._exponent)

    @property
    def length_scale(self) -> float:
        """√area: one unit of length of the unit mesh, in units of the vertices as given."""
        return math.sqrt(self.area)

    @cached_property
    def unit_vertices(self) -> FloatArray:
        """Positions scaled to total area 1, centroid at 0, float64 (V, 3); unreferenced ones lie at 0."""
        areas, area = self._scaled
        scaled = np.ldexp(self.vertices[self.referenced], -self._exponent)
        positions = np.zeros((self.n_vertices, 3))
        positions[self.referenced] = scaled - scaled[0]
        centroid = areas @ positions[self.faces].mean(axis=1) / area
        positions[self.referenced] = (positions[self.referenced] - centroid) / math.sqrt(area)
        return _frozen(positions)

    @property
    def opposite_edges(self) -> FloatArray:
        """Edge vector opposite each corner of the unit mesh, float64 (F, 3 corners, 3), counter-clockwise.

        Subtracted before scaling, so each is correct to rounding however small its face.
        """
        return _opposite_edges(self, self._exponent) / math.sqrt(self._scaled[1])

    @cached_property
    def face_areas(self) -> FloatArray:
        """Area of each face of the unit mesh, float64 (F,); they sum to 1."""
        areas, area = self._scaled
        return _frozen(areas / area)

    @cached_property
    def normals(self) -> FloatArray:
        """Unit normal of each face by its corners' order, float64 (F, 3)."""
        return _frozen(np.cross(self.frames[:, 0], self.frames[:, 1]))

    @cached_property
    def frames(self) -> FloatArray:
        """Orthonormal tangents V_f^s of each face, float64 (F, 2, 3): its first edge's, and normal × that."""
        edges = self.opposite_edges
        first = edges[:, 2] / np.linalg.norm(edges[:, 2], axis=1, keepdims=True)
        normal = _doubled_area_vectors(edges)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        # In a face that is nearly flat the cross product is not quite orthogonal to the edge.
        normal -= np.einsum("fx,fx->f", normal, first)[:, None] * first
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return _frozen(np.stack([first, np.cross(normal, first)], axis=1))

    @cached_property
    def components(self) -> IntArray:
        """Component of each vertex, int64 (V,), counted by lowest vertex; −1 where unreferenced."""
        a, b, c = self.faces.T
        labels = _linked(np.concatenate([a, b]), np.concatenate([b, c]), self.n_vertices)[self.referenced]
        components = np.full(self.n_vertices, -1, dtype=np.int64)
        components[self.referenced] = _by_appearance(labels)
        return _frozen(components)

    @cached_property
    def n_components(self) -> int:
        """Number of components joined through faces."""
        return int(self.components.max()) + 1

    @cached_property
    def _edge_table(self) -> tuple[IntArray, IntArray, IntArray]:
        """Unique edges (E, 2) with lower vertex first, edge of each half-edge (3F,), faces at each edge (E,).

        Half-edge 3f + k runs from corner k to corner k + 1 of face f.
        """
        start, end = self.faces.ravel(), self.faces[:, [1, 2, 0]].ravel()
        keys = np.minimum(start, end) * self.n_vertices + np.maximum(start, end)
        unique, edge_of, counts = np.unique(keys, return_inverse=True, return_counts=True)
        return np.stack(np.divmod(unique, self.n_vertices), axis=1), edge_of, counts

    @cached_property
    def edges(self) -> IntArray:
        """Undirected edges, int64 (E, 2), lower vertex first, in lexicographic order."""
        return _frozen(self._edge_table[0])

    @cached_property
    def _fans(self) -> IntArray:
        """Label of the fan of each corner, int (3F,): corners of a vertex whose faces share an edge at it."""
        _, edge_of, _ = self._edge_table
        order = np.argsort(edge_of, kind="stable")
        same = edge_of[order[:-1]] == edge_of[order[1:]]
        one, other = order[:-1][same], order[1:][same]
        one_next, other_next = _next_corner(one), _next_corner(other)
        corners = self.faces.ravel()
        parallel = corners[one] == corners[other]
        return _linked(
            np.concatenate([one, one_next]),
            np.concatenate([np.where(parallel, other, other_next), np.where(parallel, other_next, other)]),
            corners.size,
        )

    @cached_property
    def n_boundary_loops(self) -> int:
        """Number of closed curves of edges with a single face; those that only touch count apart."""
        _, edge_of, counts = self._edge_table
        boundary = np.flatnonzero(counts[edge_of] == 1)
        start, end = self._fans[boundary], self._fans[_next_corner(boundary)]
        used, ends = np.unique(np.concatenate([start, end]), return_inverse=True)
        return int(_linked(ends[: start.size], ends[start.size :], used.size).max(initial=-1)) + 1

    @cached_property
    def euler_characteristic(self) -> int:
        """V − E + F, over referenced vertices."""
        return int(self.referenced.sum()) - len(self.edges) + self.n_faces

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What is odd but accepted, one sentence each with its count and first index."""
        edges, edge_of, counts = self._edge_table
        corners = self.faces.ravel()
        a_corner_of_fan = np.zeros(self._fans.max() + 1, dtype=np.int64)
        a_corner_of_fan[self._fans] = corners
        several_fans = np.flatnonzero(np.bincount(a_corner_of_fan, minlength=self.n_vertices) > 1)
        forward = np.bincount(edge_of, weights=corners == edges[edge_of, 0], minlength=len(edges))
        disagreeing = np.flatnonzero((counts == 2) & (forward != 1))
        by_corners = np.lexsort(np.sort(self.faces, axis=1).T)
        alike = (np.diff(np.sort(self.faces[by_corners], axis=1), axis=0) == 0).all(axis=1)
        repeats = np.sort(by_corners[1:][alike])
        crowded = np.flatnonzero(counts > 2)
        loose = np.flatnonzero(~self.referenced)
        found = []
        if crowded.size:
            a, b = edges[crowded[0]]
            found.append(f"{_count(crowded, 'edge')} with more than two faces; the first joins {a} and {b}.")
        if several_fans.size:
            n = _count(several_fans, "vertex", "vertices")
            found.append(f"{n} where surfaces only touch; the first is {several_fans[0]}.")
        if disagreeing.size:
            a, b = edges[disagreeing[0]]
            n = _count(disagreeing, "edge")
            found.append(f"{n} whose two faces are oriented differently; the first joins {a} and {b}.")
        if repeats.size:
            n = _count(repeats, "face")
            found.append(f"{n} on the same corners as an earlier one; the first is {repeats[0]}.")
        if loose.size:
            found.append(f"{_count(loose, 'vertex', 'vertices')} in no face; the first is {loose[0]}.")
        return tuple(found)


def _checked_vertices(given: Any) -> FloatArray:
    try:
        raw = np.asarray(given)
    except ValueError as error:  # ragged rows
        raise InvalidMesh(f"vertices are no (V, 3) array of numbers: {error}") from error
    if raw.dtype.kind not in "iuf":
        raise InvalidMesh(f"vertices must be real numbers, not {raw.dtype}", value=str(raw.dtype))
    if raw.ndim != 2 or raw.shape[1] != 3:
        raise InvalidMesh(f"vertices must have shape (V, 3), not {raw.shape}", value=str(raw.shape))
    if len(raw) == 0:
        raise InvalidMesh("the mesh has no vertices", value=0)
    with np.errstate(over="ignore"):  # a long double beyond 1e308 becomes inf, and is refused as that
        vertices = np.array(raw, dtype=np.float64, order="C")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if bad.size:
        value = str(vertices[bad[0]].tolist())
        raise InvalidMesh(f"vertex {bad[0]} is not finite: {value}", index=int(bad[0]), value=value)
    return _frozen(vertices)


def _checked_faces(given: Any, n_vertices: int) -> IntArray:
    try:
        raw = np.asarray(given)
    except ValueError as error:
        raise InvalidMesh(f"faces are no (F, 3) array of integers: {error}") from error
    if raw.size == 0:
        raise InvalidMesh("the mesh has no faces", value=0)
    if raw.dtype.kind not in "iuf":
        raise InvalidMesh(f"faces must be integers, not {raw.dtype}", value=str(raw.dtype))
    if raw.ndim != 2 or raw.shape[1] != 3:
        raise InvalidMesh(f"faces must have shape (F, 3), not {raw.shape}", value=str(raw.shape))
    with np.errstate(invalid="ignore"):  # NaN compares false, and so is refused here too
        fit = (raw >= 0) & (raw < n_vertices) & (raw == np.floor(raw))
    bad = np.flatnonzero(~fit.all(axis=1))
    if bad.size:
        value = raw[bad[0]][~fit[bad[0]]][0].item()
        message = f"face {bad[0]} names vertex {value}, which is not one of 0 … {n_vertices - 1}"
        raise InvalidMesh(message, index=int(bad[0]), value=value)
    faces = np.array(raw, dtype=np.int64, order="C")
    a, b, c = faces.T
    twice = np.flatnonzero((a == b) | (b == c) | (c == a))
    if twice.size:
        value = str(faces[twice[0]].tolist())
        raise InvalidMesh(f"face {twice[0]} repeats a vertex: {value}", index=int(twice[0]), value=value)
    return _frozen(faces)


def _refuse_unmeasurable(mesh: Mesh) -> None:
    """Refuse faces of zero area and a total area that is no positive finite number."""
    edges = _opposite_edges(mesh, mesh._exponent)
    longest = np.einsum("fkx,fkx->fk", edges, edges).max(axis=1)
    areas, _ = mesh._scaled
    flat = np.flatnonzero(2 * areas <= np.maximum(FLATTEST * longest, SMALLEST))
    if flat.size:
        corners = str(mesh.vertices[mesh.faces[flat[0]]].tolist())
        message = f"face {flat[0]} has zero area; its corners are {corners}"
        raise InvalidMesh(message, index=int(flat[0]), value=corners)
    try:
        total = mesh.area
    except OverflowError:
        total = math.inf
    if not np.finfo(np.float64).tiny <= total < math.inf:
        size = float(np.abs(mesh.vertices[mesh.referenced]).max())
        message = f"the area is {total}: coordinates of size {size:.3g} are out of range, rescale the mesh"
        raise InvalidMesh(message, value=total)


def _opposite_edges(mesh: Mesh, exponent: int) -> FloatArray:
    with np.errstate(over="ignore"):  # only unreferenced vertices can overflow, and no face reads them
        corners = np.ldexp(mesh.vertices, -exponent)[mesh.faces]
    return corners[:, [2, 0, 1]] - corners[:, [1, 2, 0]]


def _doubled_area_vectors(edges: FloatArray) -> FloatArray:
    """Return normals as long as twice the area: crossing the two shorter edges rounds least."""
    longest = np.einsum("fkx,fkx->fk", edges, edges).argmax(axis=1)
    rows = np.arange(len(edges))
    return np.cross(edges[rows, (longest + 1) % 3], edges[rows, (longest + 2) % 3])


def _next_corner(corners: IntArray) -> IntArray:
    return np.where(corners % 3 == 2, corners - 2, corners + 1)


def _linked(one: IntArray, other: IntArray, size: int) -> IntArray:
    """Component label of each of ``size`` nodes under the given links."""
    if size == 0:
        return np.zeros(0, dtype=np.int64)
    links = sparse.coo_array((np.ones(one.size, dtype=bool), (one, other)), shape=(size, size))
    labels: IntArray = csgraph.connected_components(links, directed=False)[1].astype(np.int64)
    return labels


def _by_appearance(labels: IntArray) -> IntArray:
    """Rename labels 0, 1, … in order of their first appearance."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse].astype(np.int64)


def _count(found: IntArray, one: str, many: str | None = None) -> str:
    return f"1 {one}" if found.size == 1 else f"{found.size} {many or one + 's'}"


def _frozen(array: AnyArray) -> AnyArray:
    array.setflags(write=False)
    return array
