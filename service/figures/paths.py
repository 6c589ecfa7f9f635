"""Figure 3: paths on the target that follow a path on the source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.figures.drawing import (
    BLACK,
    GREEN,
    RED,
    SEVERAL,
    YELLOW,
    Sheet,
    line,
    mass,
    plain,
    spots,
)
from service.figures.shapes import Pair, Shelf
from service.pictures import Panel
from solver import SoftMap, maxent_basis, trace, wks

#: Functions of each basis: two legs side by side need narrow ones.
FUNCTIONS = 500


def paths(shelf: Shelf) -> Sheet:
    """Paths traced under soft maps that cannot tell left from right, nor points on a ring (figure 3)."""
    rows: list[tuple[Panel, ...]] = []
    numbers: dict[str, float] = {}
    # The built-in creature has legs, and is all there is instead of arms.
    pairs = [shelf.wolves] if shelf.arms is shelf.creatures else [shelf.wolves, shelf.arms]
    for pair in pairs:
        row, found = _traced(pair)
        rows.append(row)
        numbers |= {f"{pair.name} {key}": value for key, value in found.items()}
    return Sheet(tuple(rows), (3.8, 3.3), numbers)


def _traced(pair: Pair) -> tuple[tuple[Panel, ...], dict[str, float]]:
    """Source path, mass of its beginning, traced paths and true images."""
    source, target = (replace(one, view=pair.ahead or one.view) for one in (pair.source, pair.target))
    bases = maxent_basis(source.mesh, FUNCTIONS), maxent_basis(target.mesh, FUNCTIONS)
    softmap = SoftMap.from_descriptors(
        *bases, wks(source.mesh, partner=target.mesh), wks(target.mesh, partner=source.mesh)
    )
    stops = [source.vertex(place) for place in pair.limb[:3]]
    starts = dict.fromkeys([int(pair.truth[stops[0]]), int(pair.twins[stops[0]])])
    traced = [trace(softmap, stops, start) for start in starts]
    beginning = (spots(source, stops[:1], YELLOW), line(source, traced[0].source_points, RED))
    marks = [spots(target, list(starts), YELLOW)]
    numbers = {}
    for k, (path, colour) in enumerate(zip(traced, (RED, SEVERAL[3]), strict=False)):
        marks.append(line(target, path.points, colour))
        # Where every vertex has its image, so has every point of a face.
        image = (pair.truth, pair.twins)[k]
        corners = target.mesh.vertices[image[source.mesh.faces[path.source_faces]]]
        true = np.einsum("kc,kcx->kx", path.source_barycentric, corners)
        marks.append(line(target, true, (GREEN, BLACK)[k], 0.003))
        gaps = np.linalg.norm(path.points - true, axis=1) / target.mesh.length_scale
        numbers[("deviation", "deviation of the twin")[k]] = float(gaps.mean())
    panels = (
        plain(source, "path on the source", beginning),
        mass(softmap, target, stops[0], "mass of its beginning", (marks[0],)),
        plain(target, "traced paths", tuple(marks)),
    )
    return panels, numbers
