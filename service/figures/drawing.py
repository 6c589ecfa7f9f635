"""What the figures share: mass and vectors on a surface, paths and points as marks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from service.figures.shapes import Shape
from service.marks import Colour, Floats, Ints, Mark, arrows, balls, tube
from service.pictures import Panel
from service.rasteriser import vertex_normals
from solver import Mesh, SoftMap, momentum
from solver.geodesics import farthest_point_samples
from solver.shortest import SurfacePoints, shortest_path
from solver.walks import layout

PLAIN: Colour = (0.80, 0.80, 0.82)
RED: Colour = (0.84, 0.12, 0.10)
YELLOW: Colour = (1.0, 0.80, 0.10)
GREEN: Colour = (0.10, 0.62, 0.30)
BLACK: Colour = (0.12, 0.12, 0.14)
#: Colours of several points or paths, in their order.
SEVERAL: tuple[Colour, ...] = ((0.84, 0.12, 0.10), (1.0, 0.66, 0.05), (0.10, 0.62, 0.30), (0.50, 0.25, 0.70))
#: Sizes of marks in √area: a ball, half a path's width, an arrow's width.
BALL, PATH, ARROW = 0.016, 0.0065, 0.006
#: Arrows of a vector field, and the length of the longest in √area.
ARROWS, LONGEST = 420, 0.085
#: Arrows shorter than this share of the longest are left out.
SHORTEST = 0.04
#: Share of the vertices that is darker than the scale of a mass density can tell.
DARKEST = 99.7


@dataclass(frozen=True, eq=False)
class Sheet:
    """A figure before it is drawn.

    Attributes
    ----------
    rows : tuple of tuples of Panel
    inches : (float, float)
        Of each panel.
    numbers : dict
        What was computed, for a caption.
    """

    rows: tuple[tuple[Panel, ...], ...]
    inches: tuple[float, float]
    numbers: dict[str, float]


def plain(shape: Shape, title: str = "", marks: tuple[Mark, ...] = ()) -> Panel:
    """A shape of one colour, with marks.

    Returns
    -------
    Panel

    Raises
    ------
    ValueError
        Never.
    """
    values = np.tile(PLAIN, (shape.mesh.n_vertices, 1))
    return Panel(shape.mesh.vertices, shape.mesh.faces, values, title, marks=marks, view=shape.view)


def mass(
    softmap: SoftMap,
    shape: Shape,
    vertex: int,
    title: str = "",
    marks: tuple[Mark, ...] = (),
    darkest: float | None = None,
) -> Panel:
    """Mass density on the target of one source vertex, white to blue.

    Parameters
    ----------
    softmap : SoftMap
    shape : Shape
        The target.
    vertex : int
        Of the source.
    title : str
    marks : tuple of Mark
    darkest : float, optional
        Density that is drawn dark blue; nearly its largest value unless given.

    Returns
    -------
    Panel

    Raises
    ------
    IndexError
        If there is no such vertex.
    """
    density = density_at(softmap, vertex)
    values = blues(density / (darkest or peak(density)))
    return replace(plain(shape, title, marks), values=values)


def peak(density: Floats) -> float:
    """Nearly the largest value of a density."""
    return float(np.percentile(density, DARKEST))


def density_at(softmap: SoftMap, vertex: int) -> Floats:
    """ρ(x, ·) of a source vertex x at the vertices of the target, (V,)."""
    row = softmap.source.functions[[vertex]] @ softmap.coefficients
    density: Floats = softmap.target.functions @ (np.asarray(row)[0] / softmap.target.integrals)
    return density


def blues(share: Floats) -> Floats:
    """Colours from nearly white (0) to dark blue (1), (k, 3)."""
    share = np.clip(share, 0.0, 1.0)[:, None]
    light, middle, dark = np.array(PLAIN) + 0.08, np.array([0.45, 0.66, 0.90]), np.array([0.10, 0.30, 0.72])
    lower = light + (middle - light) * np.minimum(2 * share, 1.0)
    colours: Floats = np.where(share < 0.5, lower, middle + (dark - middle) * (2 * share - 1))
    return colours


def spots(shape: Shape, vertices: Ints | list[int], colour: Colour, size: float = BALL) -> Mark:
    """Balls at vertices of a shape."""
    return balls(shape.mesh.vertices[vertices], size * shape.mesh.length_scale, colour)


def line(shape: Shape, points: Floats, colour: Colour, width: float = PATH) -> Mark:
    """Tube along a path on a shape."""
    return tube(points, width * shape.mesh.length_scale, colour)


def field(shape: Shape, vectors: Floats, colour: Colour = RED) -> Mark:
    """Arrows of a vector field on the faces (F, 3), each the mean of a neighbourhood."""
    mesh = shape.mesh
    cells, samples = _neighbourhoods(mesh)
    face_cells = cells[mesh.faces[:, 0]]
    areas = np.bincount(face_cells, mesh.face_areas, len(samples))
    sums = [np.bincount(face_cells, mesh.face_areas * vectors[:, k], len(samples)) for k in range(3)]
    means = np.column_stack(sums) / np.maximum(areas, 1e-300)[:, None]
    normals = vertex_normals(mesh.vertices, mesh.faces)[samples]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    means -= np.einsum("kx,kx->k", means, normals)[:, None] * normals
    lengths = np.linalg.norm(means, axis=1)
    top = np.percentile(lengths, 99.0)
    shown = np.flatnonzero(lengths > SHORTEST * top)
    scale = LONGEST * mesh.length_scale / top
    drawn = means[shown] * (scale * np.minimum(1.0, top / lengths[shown]))[:, None]
    lifted = mesh.vertices[samples[shown]] + 1.2 * ARROW * mesh.length_scale * normals[shown]
    return arrows(lifted - drawn / 2, drawn, ARROW * mesh.length_scale, colour)


def way(shape: Shape, vertices: list[int]) -> tuple[int, Floats]:
    """First face of the shortest path through vertices, and its direction there."""
    pieces = shortest_path(layout(shape.mesh), _at(shape.mesh, vertices))
    corners = shape.mesh.vertices[shape.mesh.faces[pieces.faces[0]]]
    direction = (pieces.end[0] - pieces.start[0]) @ corners
    return int(pieces.faces[0]), direction / np.linalg.norm(direction)


def moving_mass(
    softmap: SoftMap, source: Shape, target: Shape, vertices: list[int], title: str = ""
) -> Panel:
    """Mass of the first vertex on the target, and its momentum as the vertex moves towards the others."""
    face, direction = way(source, vertices)
    found = momentum(softmap, face, direction)
    return mass(softmap, target, vertices[0], title, (field(target, found),))


def pointer(shape: Shape, vertices: list[int], colour: Colour = RED) -> tuple[Mark, ...]:
    """A source point, and the direction in which it moves."""
    face, direction = way(shape, vertices)
    scale = shape.mesh.length_scale
    lift = 0.014 * scale * shape.mesh.normals[face]
    tail = shape.mesh.vertices[vertices[0]][None] + lift
    return spots(shape, vertices[:1], colour), arrows(
        tail, 0.14 * scale * direction[None], 0.016 * scale, colour
    )


def _at(mesh: Mesh, vertices: list[int]) -> SurfacePoints:
    """Vertices as points of faces."""
    corners = np.array([np.argwhere(mesh.faces == vertex)[0] for vertex in vertices])
    return SurfacePoints(corners[:, 0], np.eye(3)[corners[:, 1]])


@cache
def _neighbourhoods(mesh: Mesh) -> tuple[Ints, Ints]:
    samples = farthest_point_samples(mesh, min(ARROWS, mesh.n_vertices // 2), 0)
    return samples.cells, samples.vertices
