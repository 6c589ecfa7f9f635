"""Shaded pictures of coloured triangles, headless: a small z-buffer rasteriser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Samples per pixel and direction; edges are smooth because they are averaged.
OVERSAMPLING = 2
#: Fragments rasterised at once: a few hundred megabytes at most, whatever the mesh.
FRAGMENTS = 1_000_000
#: Lights as seen by the camera: direction (right, up, towards), strength. The rest is ambient light.
LIGHTS = (((-0.45, 0.65, 0.62), 0.62), ((0.75, 0.10, 0.65), 0.22))
AMBIENT = 0.34


@dataclass(frozen=True)
class View:
    """Where the camera stands: degrees around the upward axis (0, 1 or 2) and above the horizon."""

    azimuth: float = 38.0
    elevation: float = 14.0
    up: int = 2

    def axes(self) -> Floats:
        """Rows: right, up and towards the camera, as vectors of the mesh's space."""
        a, e = np.radians(self.azimuth), np.radians(self.elevation)
        towards = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        # A cyclic shift of the axes keeps the handedness.
        axes: Floats = np.roll(np.stack([right, np.cross(towards, right), towards]), self.up - 2, axis=1)
        return axes


def render(
    vertices: Floats, faces: Ints, colours: Floats, view: View, size: tuple[int, int] = (620, 480)
) -> NDArray[np.uint8]:
    """Shaded picture of a coloured mesh, seen in parallel projection.

    Parameters
    ----------
    vertices : ndarray, (V, 3) float
        Positions.
    faces : ndarray, (F, 3) int
        Triangles.
    colours : ndarray, (F, 3) or (V, 3) float
        Red, green and blue in [0, 1] of faces (flat) or vertices (interpolated).
    view : View
        Camera.
    size : (int, int)
        Width and height in pixels.

    Returns
    -------
    ndarray, (height, width, 4) uint8
        Red, green, blue and opacity; the background is transparent.

    Raises
    ------
    ValueError
        If there is neither one colour per face nor one per vertex.
    """
    if len(colours) not in {len(faces), len(vertices)}:
        raise ValueError(f"{len(colours)} values fit neither {len(faces)} faces nor {len(vertices)} vertices")
    width, height = size[0] * OVERSAMPLING, size[1] * OVERSAMPLING
    seen = vertices @ view.axes().T
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    scale = 0.96 * min(width / max(high[0] - low[0], 1e-300), height / max(high[1] - low[1], 1e-300))
    middle = (low + high) / 2
    points = np.column_stack(
        [
            width / 2 + (seen[:, 0] - middle[0]) * scale,
            height / 2 - (seen[:, 1] - middle[1]) * scale,
            seen[:, 2] * scale,
        ]
    )
    hit, weights = _rasterise(points, faces, width, height)
    covered = np.flatnonzero(hit >= 0)
    face, weight = hit[covered], weights[covered]
    corners = faces[face]
    normals = np.einsum("pk,pkx->px", weight, vertex_normals(seen, faces)[corners])
    # Both sides are lit, since a mesh may be open or inside out; the face decides which side it is, for the
    # interpolated normal may point away at a silhouette.
    a, b, c = (seen[faces[:, k]] for k in range(3))
    away = np.cross(b - a, c - a)[:, 2] < 0.0
    normals[away[face]] *= -1.0
    flat = len(colours) == len(faces)
    colour = colours[face] if flat else np.einsum("pk,pkx->px", weight, colours[corners])
    # Eight bits a channel come out: single precision is plenty.
    picture = np.zeros((height * width, 4), dtype=np.float32)
    picture[covered, :3] = np.clip(colour * _light(normals)[:, None], 0.0, 1.0)
    picture[covered, 3] = 1.0
    picture = picture.reshape(size[1], OVERSAMPLING, size[0], OVERSAMPLING, 4).mean(axis=(1, 3))
    # The mean of covered and empty samples darkens an edge's colour; opacity alone must tell.
    picture[..., :3] /= np.maximum(picture[..., 3:], 1e-9)
    pixels: NDArray[np.uint8] = np.round(255.0 * picture).astype(np.uint8)
    return pixels


def _rasterise(points: Floats, faces: Ints, width: int, height: int) -> tuple[Ints, Floats]:
    """Frontmost face (−1: none) and barycentric weights at every pixel centre, row by row."""
    hit = np.full(width * height, -1, dtype=np.int64)
    weights = np.zeros((width * height, 3))
    depth = np.full(width * height, -np.inf)
    corners = points[faces]
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1) - 0.5), 0, (width, height)).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1) + 0.5), 0, (width, height)).astype(np.int64)
    columns, rows = np.maximum(high - low, 0).T
    # On a face the second and third weight and the depth are affine: a value at the first corner, two slopes.
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    counts = np.where(area == 0.0, 0, columns * rows)
    area = np.where(area == 0.0, 1.0, area)
    slope_b = np.stack([ac[:, 1], -ac[:, 0]], axis=1) / area[:, None]
    slope_c = np.stack([-ab[:, 1], ab[:, 0]], axis=1) / area[:, None]
    ends = np.cumsum(counts)
    start = 0
    while start < len(faces):
        before = ends[start] - counts[start]
        stop = max(start + 1, int(np.searchsorted(ends, before + FRAGMENTS, side="right")))
        face = np.repeat(np.arange(start, stop), counts[start:stop])
        within = np.arange(before, before + len(face)) - (ends - counts)[face]
        y, x = np.divmod(within, columns[face])
        x += low[face, 0]
        y += low[face, 1]
        dx, dy = x + 0.5 - a[face, 0], y + 0.5 - a[face, 1]
        wb = slope_b[face, 0] * dx + slope_b[face, 1] * dy
        wc = slope_c[face, 0] * dx + slope_c[face, 1] * dy
        inside = np.flatnonzero((wb >= 0.0) & (wc >= 0.0) & (wb + wc <= 1.0))
        face, wb, wc, pixel = face[inside], wb[inside], wc[inside], (y * width + x)[inside]
        z = a[face, 2] + wb * ab[face, 2] + wc * ac[face, 2]
        front = np.flatnonzero(z > depth[pixel])
        front = front[np.argsort(z[front], kind="stable")]
        # Where an index repeats, the last value assigned stays: the frontmost.
        depth[pixel[front]], hit[pixel[front]] = z[front], face[front]
        weights[pixel[front]] = np.column_stack([1.0 - wb - wc, wb, wc])[front]
        start = stop
    return hit, weights


def vertex_normals(vertices: Floats, faces: Ints) -> Floats:
    """Mean normals of the faces at each vertex, as long as those faces are large.

    Parameters
    ----------
    vertices : ndarray, (V, 3) float
        Positions.
    faces : ndarray, (F, 3) int
        Triangles.

    Returns
    -------
    ndarray, (V, 3) float

    Raises
    ------
    IndexError
        If a face names a vertex that does not exist.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], np.cross(b - a, c - a))
    return normals


def _light(normals: Floats) -> Floats:
    """Brightness at each normal."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    brightness: Floats = AMBIENT + 0.10 * unit[:, 1]
    for direction, strength in LIGHTS:
        towards = np.array(direction) / np.linalg.norm(direction)
        # Wrapped diffuse light: soft where the surface turns away.
        brightness += strength * np.maximum((unit @ towards + 0.25) / 1.25, 0.0)
    return brightness
