"""Figures 8 and 9: optimal soft maps with a few landmarks."""

from __future__ import annotations

import numpy as np

from service.figures.drawing import (
    BALL,
    RED,
    YELLOW,
    Sheet,
    density_at,
    line,
    mass,
    peak,
    plain,
    spots,
)
from service.figures.shapes import Shape, Shelf, sphere
from service.marks import Floats, Mark
from service.pictures import Panel
from service.rasteriser import View
from solver import OptimalMap, maxent_basis, optimal_softmap

#: Vertices and functions of the sphere, and functions on other shapes.
VERTICES, FUNCTIONS, MORE = 1500, 150, 150
#: Proven gap over energy at which the search may stop.
GAP = 1e-3
#: Landmarks of the sphere, and a curve from the first: its direction there, and points that are shown.
LANDMARKS = ((0.90, -0.10, 0.42), (0.40, 0.90, 0.15), (0.85, -0.30, -0.45))
TOWARDS, SHOWN = (-0.10, 1.0, -0.75), (0.38, 0.62, 0.86, 1.10)


def landmarks(_shelf: Shelf) -> Sheet:
    """Optimal maps of the sphere with one landmark and with three (figure 8)."""
    shape = Shape(sphere(VERTICES), View(22.0, 18.0))
    held = _nearest(shape, np.array(LANDMARKS))
    first, ahead = shape.mesh.vertices[held[0]], np.array(TOWARDS)
    ahead = ahead - (ahead @ first) * first
    ahead /= np.linalg.norm(ahead)
    shown = _nearest(shape, _circle(first, ahead, np.array(SHOWN)))
    curve = _circle(first, ahead, np.linspace(0.0, SHOWN[-1], 60))
    rows = []
    numbers: dict[str, float] = {}
    for count in (1, 3):
        found = _optimal(shape, shape, held[:count], held[:count], FUNCTIONS)
        marks = (
            spots(shape, held[:count], YELLOW, 1.4 * BALL),
            line(shape, curve, RED, 0.005),
            spots(shape, shown, RED),
        )
        title = f"{count} landmark" + "s" * (count > 1)
        darkest = max(peak(density_at(found.softmap, vertex)) for vertex in shown)
        rows.append(_images(found, shape, shown, shown, plain(shape, title, marks), darkest))
        numbers |= _numbers(found, f"{count} ")
    return Sheet(tuple(rows), (2.6, 2.7), numbers)


def _circle(start: Floats, ahead: Floats, angles: Floats) -> Floats:
    """Points of a great circle."""
    points: Floats = np.outer(np.cos(angles), start) + np.outer(np.sin(angles), ahead)
    return points


def _nearest(shape: Shape, directions: Floats) -> list[int]:
    """Vertices of a sphere in some directions."""
    return [int(k) for k in (shape.mesh.vertices @ directions.T).argmax(axis=0)]


def poses(shelf: Shelf) -> Sheet:
    """Optimal map between two poses with three landmarks (figure 9)."""
    pair = shelf.wolves
    held = [pair.source.vertex(place) for place in pair.landmarks]
    images = [int(pair.truth[vertex]) for vertex in held]
    found = _optimal(pair.source, pair.target, held, images, MORE)
    shown = [pair.source.vertex(place) for place in ("side", "knee", "shoulder")]
    marks = (spots(pair.source, held, YELLOW, 1.4 * BALL), spots(pair.source, shown, RED))
    first = plain(pair.source, "three landmarks", marks)
    true = [int(pair.truth[vertex]) for vertex in shown]
    return Sheet((_images(found, pair.target, shown, true, first, None),), (3.4, 3.2), _numbers(found, ""))


def _optimal(source: Shape, target: Shape, held: list[int], images: list[int], size: int) -> OptimalMap:
    bases = maxent_basis(source.mesh, size, first=held), maxent_basis(target.mesh, size, first=images)
    return optimal_softmap(*bases, list(zip(held, images, strict=True)), tolerance=GAP)


def _images(
    found: OptimalMap, target: Shape, shown: list[int], true: list[int], first: Panel, darkest: float | None
) -> tuple[Panel, ...]:
    """Source with what is shown, then the mass of each point beside its true image."""
    panels = [first]
    for vertex, image in zip(shown, true, strict=True):
        mark: tuple[Mark, ...] = (spots(target, [image], RED),)
        panels.append(mass(found.softmap, target, vertex, "", mark, darkest))
    return tuple(panels)


def _numbers(found: OptimalMap, name: str) -> dict[str, float]:
    return {
        f"{name}energy": found.energy,
        f"{name}dirichlet": found.dirichlet,
        f"{name}bijectivity": found.bijectivity,
        f"{name}gap": found.gap,
        f"{name}iterations": float(found.iterations),
    }
