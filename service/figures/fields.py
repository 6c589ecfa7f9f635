"""Figures 1 and 2: functions of a basis, and how mass moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.figures.drawing import RED, SEVERAL, Sheet, moving_mass, plain, pointer, spots
from service.figures.shapes import Shelf
from service.marks import Floats
from solver import SoftMap, hks, maxent_basis, poisson_basis
from solver.geodesics import farthest_point_samples

#: Functions in the figure of bases, and in all others.
FEW, USUAL = 100, 300
#: Colours of the points.
NAMES = ("red", "yellow", "green")


def bases(shelf: Shelf) -> Sheet:
    """Samples and their distances; three functions of each basis (figure 1)."""
    shape = shelf.creatures.source
    samples = farthest_point_samples(shape.mesh, FEW, 0)
    chosen = [int(samples.cells[shape.vertex(place)]) for place in ("side", "knee", "ear")]
    others = np.setdiff1d(np.arange(FEW), chosen)
    marks = (
        spots(shape, samples.vertices[others], (0.95, 0.95, 0.95), 0.008),
        spots(shape, samples.vertices[chosen], RED, 0.012),
    )
    distances = samples.distances
    panels = [replace(plain(shape, "samples and distances", marks), values=distances)]
    for name, basis in (
        ("poisson", poisson_basis(shape.mesh, FEW)),
        ("maxent", maxent_basis(shape.mesh, FEW)),
    ):
        values = basis.functions[:, chosen].toarray()
        panels.append(replace(plain(shape, f"three {name} functions"), values=_tinted(values)))
    return Sheet((tuple(panels),), (3.6, 3.0), {"functions": FEW})


def _tinted(values: Floats) -> Floats:
    """Colour of each vertex from values of several functions."""
    colours = np.array([(0.88, 0.88, 0.89)]) * (1 - values.sum(axis=1, keepdims=True))
    tinted: Floats = np.clip(colours + values @ np.array(SEVERAL[: values.shape[1]]), 0.0, 1.0)
    return tinted


def momenta(shelf: Shelf) -> Sheet:
    """Momentum of three points that move, under a soft map of heat kernel signatures (figure 2)."""
    pair = shelf.ants
    source, target = pair.source, pair.target
    bases = maxent_basis(source.mesh, USUAL), maxent_basis(target.mesh, USUAL)
    softmap = SoftMap.from_descriptors(
        *bases, hks(source.mesh, partner=target.mesh), hks(target.mesh, partner=source.mesh)
    )
    ways = [[source.vertex(a), source.vertex(b)] for a, b in pair.ways]
    marks = tuple(mark for k, way in enumerate(ways) for mark in pointer(source, way, SEVERAL[k]))
    panels = [plain(source, "source", marks)]
    for k, way in enumerate(ways):
        panels.append(moving_mass(softmap, source, target, way, f"{NAMES[k]} point"))
    return Sheet(((panels[0], panels[1]), (panels[2], panels[3])), (4.2, 3.4), {"functions": USUAL})
