"""Paths on the target that follow a path on the source (section 5.1, eq. 14): γ' = ∇Q(γ₀, γ)·γ₀'."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solver.basis import Basis
from solver.errors import SolverError
from solver.mesh import FloatArray, IntArray, Mesh
from solver.potential import potential
from solver.shortest import Pieces, SurfacePoints, shortest_path
from solver.softmap import SoftMap
from solver.tensor import face_gradients
from solver.walks import Layout, layout, walk

#: A step is halved until Euler's step and Heun's end nearer to each other than this share of its length on
#: the source, or until it has been halved this often.
TOLERANCE, HALVINGS = 0.02, 6
#: How far barycentric coordinates may be from summing to 1.
SUM_TOLERANCE = 1e-9


Barycentric = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Path:
    """A path traced on the target, and where the source path was meanwhile.

    Attributes
    ----------
    faces : ndarray of int64, shape (k,)
        Target face of each point, the start first.
    barycentric : ndarray of float64, shape (k, 3)
        Weights of its corners.
    points : ndarray of float64, shape (k, 3)
        Positions in the units of the target as given.
    source_faces : ndarray of int64, shape (k,)
        Source face that each point corresponds to.
    source_barycentric : ndarray of float64, shape (k, 3)
    source_points : ndarray of float64, shape (k, 3)
        Positions in the units of the source as given.
    length : float
        Length of the traced path in the units of the target as given.
    stopped : str
        "end" if the source path was followed to its end. Else the traced path ran into a "boundary", into a
        "branch" where more than two faces meet, or was "stuck" in triangles without end.
    """

    faces: IntArray
    barycentric: FloatArray
    points: FloatArray
    source_faces: IntArray
    source_barycentric: FloatArray
    source_points: FloatArray
    length: float
    stopped: str


def trace(
    softmap: SoftMap,
    source_path: npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike],
    start: int | tuple[int, npt.ArrayLike],
    step: float = 0.01,
    regularisation: float = 1e-5,
    progress: Callable[[float], None] | None = None,
) -> Path:
    """Path γ' = ∇Q(γ₀, γ)·γ₀' on the target from a start that corresponds to the beginning of γ₀ (eq. 14).

    Parameters
    ----------
    softmap : SoftMap
    source_path : (m,) array_like of int, or a tuple of (m,) int and (m, 3) float
        Vertices of the source, or faces and barycentric coordinates in them. γ₀ is the shortest path from
        each to the next: straight in a face, along an edge, else locally shortest over the triangles.
    start : int, or a tuple of int and (3,) float
        Vertex of the target, or a face and barycentric coordinates in it.
    step : float
        Longest step along γ₀, in √area of the source. Steps are shorter where the velocity changes quickly.
    regularisation : float
        ε of the blend (1−ε)ρ + ε, strictly between 0 and 1.
    progress : callable, optional
        Called with the fraction of the path done, from 0 to 1; may raise to abort.

    Returns
    -------
    Path

    Raises
    ------
    SolverError
        A path or start that is not on its surface, points that are not connected, a step that is not
        positive, a regularisation out of range; names the index.
    SingularSystem
        If a face's system has no trustworthy solution; names the face.

    Notes
    -----
    Only faces that γ₀ crosses are solved. Where the paper takes Euler steps, these are Heun's; the difference
    from Euler's chooses their length. ∇Q, which is constant on each face, is averaged to the vertices and
    interpolated: that follows known images better (docs/decisions/trace.md).
    """
    if not 0 < step < math.inf:
        raise SolverError(f"step must be positive, not {step}", value=float(step))
    source, target = softmap.source.mesh, softmap.target.mesh
    points = _on_surface(source, source_path, "the source path")
    begin = _on_surface(target, _alone(start), "the start")
    pieces = shortest_path(layout(source), points)
    moves = _positions(source.unit_vertices, source, pieces.faces, pieces.end - pieces.start)
    lengths = np.linalg.norm(moves, axis=1)
    distinct, place = np.unique(pieces.faces, return_inverse=True)
    q, frames = potential(softmap, regularisation, distinct)
    a, b, c = begin.barycentric[0].tolist()
    trail = _Trail(layout(target), _Velocity(softmap.target), int(begin.faces[0]), (a, b, c))
    for k, (move, length) in enumerate(zip(moves, lengths, strict=True)):
        trail.follow(k, (frames[place[k]] @ move) @ q[place[k]], float(length), step)
        if trail.stopped:
            break
        if progress is not None:
            progress(float(lengths[: k + 1].sum() / lengths.sum()))
    return _path(trail, pieces, points, source, target)


class _Velocity:
    """The field that a point of the target moves with while the source path is in one face."""

    def __init__(self, basis: Basis) -> None:
        gradients, mesh = face_gradients(basis), basis.mesh
        self._start, self._functions, self._vectors = gradients.start, gradients.functions, gradients.vectors
        self._faces, self._areas, self._frames = mesh.faces, mesh.face_areas, mesh.frames
        self._around = np.argsort(mesh.faces, axis=None, kind="stable") // 3
        self._begin = np.searchsorted(np.sort(mesh.faces, axis=None), np.arange(mesh.n_vertices + 1))
        self.use(np.zeros(basis.size))

    def use(self, potential: FloatArray) -> None:
        """Take the gradient of another potential (n,) from now on."""
        self._potential = potential
        self._known: dict[int, FloatArray] = {}

    def __call__(self, face: int, barycentric: Barycentric) -> complex:
        """Velocity at a point, in the frame of its face."""
        vector = np.zeros(3)
        for vertex, weight in zip(self._faces[face].tolist(), barycentric, strict=True):
            if weight > 0:
                vector += weight * self._at_vertex(vertex)
        along, across = self._frames[face] @ vector
        return complex(along, across)

    def _at_vertex(self, vertex: int) -> FloatArray:
        """Mean of the gradients on the faces of a vertex, by their areas."""
        if vertex not in self._known:
            faces = self._around[self._begin[vertex] : self._begin[vertex + 1]]
            vectors = np.array([self._on_face(face) for face in faces])
            self._known[vertex] = self._areas[faces] @ vectors / self._areas[faces].sum()
        return self._known[vertex]

    def _on_face(self, face: int) -> FloatArray:
        here = slice(self._start[face], self._start[face + 1])
        vector: FloatArray = self._potential[self._functions[here]] @ self._vectors[here]
        return vector


class _Trail:
    """The points of a traced path so far."""

    def __init__(self, on: Layout, velocity: _Velocity, face: int, barycentric: Barycentric) -> None:
        self._on, self._velocity = on, velocity
        self.faces, self.barycentric = [face], [barycentric]
        self.marks = [(0, 0.0)]  # piece of the source path, and how much of it was gone
        self.length, self.stopped = 0.0, ""

    def follow(self, piece: int, potential: FloatArray, length: float, step: float) -> None:
        """Follow one piece of the source path, of a given length, to its end or until stopped."""
        self._velocity.use(potential)
        most = share = 1 / math.ceil(length / step)
        done = 0.0
        while done < 1 and not self.stopped:
            share = min(share, 1 - done)
            vector, error = self._heun(share)
            allowed = TOLERANCE * share * length
            if error > allowed and share > most / 2**HALVINGS:
                share /= 2
                continue
            found = walk(self._on, self.faces[-1], self.barycentric[-1], vector)
            self.faces.append(found.face)
            self.barycentric.append(found.barycentric)
            self.length += found.gone * abs(vector)
            self.stopped = found.stopped
            done = 1.0 if share == 1 - done else done + share
            self.marks.append((piece, done))
            if error < allowed / 4:
                share = min(2 * share, most)

    def _heun(self, share: float) -> tuple[complex, float]:
        """Step with the mean of the velocities at both ends of an Euler step, and how far they part."""
        face, barycentric = self.faces[-1], self.barycentric[-1]
        euler = share * self._velocity(face, barycentric)
        end = walk(self._on, face, barycentric, euler)
        if end.stopped:
            return euler, 0.0
        there = share * self._velocity(end.face, end.barycentric) / end.turn
        heun = (euler + (there.conjugate() if end.mirrored else there)) / 2
        return heun, abs(heun - euler)


def _path(trail: _Trail, pieces: Pieces, points: SurfacePoints, source: Mesh, target: Mesh) -> Path:
    """All points of a trail in the units of both meshes as given."""
    faces, barycentric = np.array(trail.faces), np.array(trail.barycentric)
    source_faces, source_barycentric = points.faces[:1], points.barycentric[:1]
    if len(pieces.faces):
        piece, share = np.array([k for k, _ in trail.marks]), np.array([share for _, share in trail.marks])
        source_faces = pieces.faces[piece]
        source_barycentric = pieces.start[piece] + share[:, None] * (pieces.end - pieces.start)[piece]
    return Path(
        faces=faces,
        barycentric=barycentric,
        points=_positions(target.vertices, target, faces, barycentric),
        source_faces=source_faces,
        source_barycentric=source_barycentric,
        source_points=_positions(source.vertices, source, source_faces, source_barycentric),
        length=trail.length * target.length_scale,
        stopped=trail.stopped or "end",
    )


def _alone(start: int | tuple[int, npt.ArrayLike]) -> npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike]:
    """One point as a list of one."""
    return ([start[0]], np.asarray(start[1])[None]) if isinstance(start, tuple) else [start]


def _positions(vertices: FloatArray, mesh: Mesh, faces: IntArray, barycentric: FloatArray) -> FloatArray:
    """Barycentric combinations of the vertices of some faces, (k, 3)."""
    positions: FloatArray = np.einsum("kc,kcx->kx", barycentric, vertices[mesh.faces[faces]])
    return positions


def _on_surface(
    mesh: Mesh, given: npt.ArrayLike | tuple[npt.ArrayLike, npt.ArrayLike], what: str
) -> SurfacePoints:
    """Vertices, or faces with barycentric coordinates, as checked points of a mesh."""
    if isinstance(given, tuple) and len(given) == 2 and np.ndim(given[1]) > 0:
        faces, weights = np.atleast_1d(np.asarray(given[0])), np.asarray(given[1])
        _check_indices(faces, mesh.n_faces, "face", what)
        if weights.shape != (len(faces), 3) or weights.dtype.kind not in "iuf":
            message = f"{what} needs three barycentric coordinates for each of {len(faces)} faces"
            raise SolverError(message, value=str(weights.shape))
        weights = weights.astype(np.float64)
        sums = np.abs(weights.sum(axis=1) - 1)
        bad = np.flatnonzero(~((weights >= 0).all(axis=1) & (sums <= SUM_TOLERANCE)))
        if bad.size:
            message = f"{what} has barycentric coordinates that are negative or do not sum to 1"
            raise SolverError(message, index=int(bad[0]), value=str(weights[bad[0]].tolist()))
        return SurfacePoints(faces.astype(np.int64), weights)
    vertices = np.asarray(given)
    _check_indices(vertices, mesh.n_vertices, "vertex", what)
    loose = np.flatnonzero(~mesh.referenced[vertices])
    if loose.size:
        vertex = int(vertices[loose[0]])
        raise SolverError(
            f"{what} names vertex {vertex}, which is in no face", index=int(loose[0]), value=vertex
        )
    corners = np.argsort(mesh.faces, axis=None, kind="stable")
    corner = corners[np.searchsorted(mesh.faces.ravel()[corners], vertices)]
    return SurfacePoints(corner // 3, np.eye(3)[corner % 3])


def _check_indices(indices: npt.NDArray[np.integer], count: int, of: str, what: str) -> None:
    """Refuse anything but a list of at least one existing vertex or face."""
    if indices.ndim != 1 or indices.size == 0 or not np.issubdtype(indices.dtype, np.integer):
        message = (
            f"{what} must name at least one {of} by an integer, not {indices.dtype} of shape {indices.shape}"
        )
        raise SolverError(message, value=str(indices.shape))
    outside = np.flatnonzero((indices < 0) | (indices >= count))
    if outside.size:
        index = int(outside[0])
        message = f"{what} names {of} {indices[index]}, which is not one of 0 … {count - 1}"
        raise SolverError(message, index=index, value=int(indices[index]))
