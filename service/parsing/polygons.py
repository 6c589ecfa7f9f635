"""Polygons as a file stores them, and their triangles: what every reader of this package returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: A triangle below this part of its polygon's squared extent has no direction to check.
FLAT = 1e-12
#: A polygon that leaves its plane by less than this part of its extent is flat; files round to seven digits.
BENT = 1e-5
#: Clipping takes n³ steps; a larger polygon that no fan fits is a drawing, not a face.
MAX_CLIPPED_CORNERS = 500


class InvalidFile(Exception):
    """A file that is not a mesh of its format; the message says where, and what to do."""


class TooLarge(Exception):
    """A file with more vertices or faces than this service takes."""


@dataclass(frozen=True)
class Limits:
    """The most vertices and triangles a mesh may have."""

    vertices: int
    faces: int

    def check(self, n_vertices: int, n_faces: int) -> None:
        """Refuse counts above the limits, before anything of that size is built.

        Raises
        ------
        TooLarge
            Naming the count and its limit.
        """
        for count, limit, what in ((n_vertices, self.vertices, "vertices"), (n_faces, self.faces, "faces")):
            if count > limit:
                raise TooLarge(f"the mesh has {count:,} {what}; this service takes at most {limit:,}")


@dataclass(frozen=True, eq=False)
class Polygons:
    """Vertices and polygons in the order of a file.

    Attributes
    ----------
    vertices : ndarray (V, 3) float64
        Coordinates in the file's units.
    sizes : ndarray (P,) int64
        Corners of each polygon.
    corners : ndarray (sum(sizes),) int64
        Vertex of each corner, polygon after polygon.
    notes : tuple of str
        What the reader left out or changed, for the user.
    """

    vertices: Floats
    sizes: Ints
    corners: Ints
    notes: tuple[str, ...] = ()

    @classmethod
    def from_triangles(cls, vertices: Floats, faces: Ints, notes: tuple[str, ...] = ()) -> Polygons:
        """Triangles as polygons."""
        return cls(vertices, np.full(len(faces), 3, dtype=np.int64), faces.ravel(), notes)

    def check(self, limits: Limits) -> None:
        """Refuse what cannot be split: no vertices or faces, too few corners, indices out of range.

        Raises
        ------
        InvalidFile
            Naming the first face at fault, counted from 0.
        TooLarge
            If there are too many vertices or triangles.
        """
        if len(self.vertices) == 0:
            raise InvalidFile("the file has no vertices")
        if len(self.sizes) == 0:
            raise InvalidFile("the file has vertices but no faces: points and lines make no surface")
        small = np.flatnonzero(self.sizes < 3)
        if small.size:
            raise InvalidFile(f"face {small[0]} has {self.sizes[small[0]]} corners; a face needs three")
        limits.check(len(self.vertices), int((self.sizes - 2).sum()))
        outside = np.flatnonzero((self.corners < 0) | (self.corners >= len(self.vertices)))
        if outside.size:
            face = self.polygon_of(int(outside[0]))
            raise InvalidFile(
                f"face {face} names vertex {self.corners[outside[0]]}, counted from 0; "
                f"the file has {len(self.vertices)} vertices"
            )

    def polygon_of(self, corner: int) -> int:
        """Index of the polygon that a corner is part of."""
        return int(np.searchsorted(np.cumsum(self.sizes), corner, side="right"))

    def triangles(self) -> tuple[Ints, tuple[str, ...]]:
        """Triangles of all polygons, in their order, and a note if any had more than three corners.

        Convex polygons become fans around their first corner; others are clipped ear by ear, because a fan
        would cover area outside them. Where neither tiles a polygon, one that is bent becomes a fan, which is
        said in a note, and a flat one is refused.

        Returns
        -------
        faces : ndarray (sum(sizes) - 2 P, 3) int64
            Vertex indices.
        notes : tuple of str
            For the user.

        Raises
        ------
        InvalidFile
            Naming a flat polygon that crosses itself or has no area.
        """
        bent = 0
        n_split = int((self.sizes > 3).sum())
        if n_split == 0:
            return self.corners.reshape(-1, 3), ()
        starts = np.cumsum(self.sizes) - self.sizes
        firsts = np.cumsum(self.sizes - 2) - (self.sizes - 2)
        faces = np.empty((int((self.sizes - 2).sum()), 3), dtype=np.int64)
        for size in np.unique(self.sizes):
            chosen = np.flatnonzero(self.sizes == size)
            rings = self.corners[starts[chosen, None] + np.arange(size)]
            apexes = np.repeat(rings[:, :1], size - 2, axis=1)
            fans = np.stack([apexes, rings[:, 1:-1], rings[:, 2:]], axis=-1)
            if size > 3:
                for k in np.flatnonzero(~_fan_fits(self.vertices[rings])):
                    ears = _ears(self.vertices[rings[k]], rings[k], int(chosen[k]))
                    bent += ears is None
                    fans[k] = fans[k] if ears is None else rings[k][ears]
            faces[firsts[chosen, None] + np.arange(size - 2)] = fans
        notes = [f"polygons with more than three corners were split into triangles ({n_split} of them)"]
        if bent:
            notes.append(
                f"polygons too bent to be seen flat became fans around their first corner ({bent} of them)"
            )
        return faces, tuple(notes)


def _fan_fits(points: Floats) -> npt.NDArray[np.bool_]:
    """Whether each polygon (m, n, 3) is tiled by the fan around its first corner.

    It is if every triangle turns as the polygon's vector area Σ ½ pᵢ × pᵢ₊₁ does, and all together turn once.
    """
    with np.errstate(all="ignore"):  # infinite coordinates are refused by the mesh, which can name them
        arms = points[:, 1:] - points[:, :1]
        crosses = np.cross(arms[:, :-1], arms[:, 1:])
        area = crosses.sum(axis=1, keepdims=True)
        heights = (crosses * area).sum(axis=-1) / np.linalg.norm(area, axis=-1)
        inner = (arms[:, :-1] * arms[:, 1:]).sum(axis=-1)
        turn = np.arctan2(heights, inner).sum(axis=1)
        flat = FLAT * (arms**2).sum(axis=-1).max(axis=1)
        fits: npt.NDArray[np.bool_] = (heights > flat[:, None]).all(axis=1) & (turn < 2 * np.pi)
    return fits


def _ears(points: Floats, ring: Ints, polygon: int) -> Ints | None:
    """Triangles (n - 2, 3) of positions in ``ring`` that tile one polygon, cutting the best-shaped ear first.

    None if its projection crosses itself because the polygon is bent in space.
    """
    refusal = InvalidFile(
        f"face {polygon} with {len(ring)} corners crosses itself, covers itself or has no area: "
        "split it into triangles"
    )
    steps = np.stack([ring, np.roll(ring, -1)], axis=1)
    if len(np.unique(steps, axis=0)) < len(ring) or (steps[:, 0] == steps[:, 1]).any():
        raise refusal  # walks along one edge twice the same way
    if len(ring) > MAX_CLIPPED_CORNERS:
        raise InvalidFile(
            f"face {polygon} has {len(ring)} corners and is not convex: split it into triangles"
        )
    flattened = _flattened(points)
    if flattened is None:
        raise refusal
    plane, height = flattened
    left = np.arange(len(ring))
    triangles = []
    while len(left) >= 3:
        ears = np.stack([np.roll(left, 1), left, np.roll(left, -1)], axis=1)
        quality = _ear_quality(plane, ears, left, ring)
        best = int(quality.argmax())
        if not quality[best] > FLAT:
            if height < BENT:
                raise refusal
            return None
        triangles.append(np.sort(ears[best]))
        left = np.delete(left, best) if len(left) > 3 else left[:0]
    return np.array(triangles)


def _flattened(points: Floats) -> tuple[Floats, float] | None:
    """Coordinates (n, 2) in the plane of a polygon's vector area, and how far it leaves that plane.

    Both in units of the polygon's extent, and counterclockwise; None without area.
    """
    arms = points - points[0]
    extent = np.abs(arms).max()
    if not 0 < extent < np.inf:
        return None
    arms /= extent
    area = np.cross(arms[:-1], arms[1:]).sum(axis=0)
    size = np.linalg.norm(area)
    if size < FLAT:
        return None
    normal = area / size
    right = np.cross(np.eye(3)[np.abs(normal).argmin()], normal)
    right /= np.linalg.norm(right)
    return arms @ np.stack([right, np.cross(normal, right)], axis=1), float(np.ptp(arms @ normal))


def _ear_quality(points: Floats, ears: Ints, left: Ints, ring: Ints) -> Floats:
    """Area over squared edges of each ear (k, 3); negative if it turns inwards or holds another corner."""
    a, b, c = (points[ears[:, k]] for k in range(3))

    def turn(p: Floats, q: Floats, r: Floats) -> Floats:
        return (q[..., 0] - p[..., 0]) * (r[..., 1] - p[..., 1]) - (q[..., 1] - p[..., 1]) * (
            r[..., 0] - p[..., 0]
        )

    lengths = ((b - a) ** 2).sum(axis=1) + ((c - b) ** 2).sum(axis=1) + ((a - c) ** 2).sum(axis=1)
    quality = turn(a, b, c) / np.where(lengths > 0, lengths, 1.0)
    others = points[left][None]
    a, b, c = a[:, None], b[:, None], c[:, None]
    inside = (turn(a, b, others) >= 0) & (turn(b, c, others) >= 0) & (turn(c, a, others) >= 0)
    # A vertex that the polygon visits twice (a slit to a hole) does not stand in its own way.
    own = (ring[left][None, :, None] == ring[ears][:, None, :]).any(axis=-1)
    quality[(inside & ~own).any(axis=1)] = -1.0
    return quality
