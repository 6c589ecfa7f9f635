"""Figures 4 (b–e), 6 and 7: what the energies and their densities tell of a map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.figures.drawing import SEVERAL, Sheet, mass, moving_mass, plain, spots
from service.figures.fields import USUAL
from service.figures.shapes import Pair, Shape, Shelf
from service.pictures import Panel, bijectivity_panel, dirichlet_panel
from solver import SoftMap, bijectivity, dirichlet, maxent_basis, wks

#: Scale of the reciprocal bijectivity density, the same for all deformations.
EVEN = (0.4, 2.5)


def limb(shelf: Shelf) -> Sheet:
    """Four points along a limb, their images with momentum, and both densities (figure 4 b–e)."""
    pair = shelf.hands
    softmap = _of_wave_kernels(pair)
    stops = [pair.source.vertex(place) for place in pair.limb]
    marks = tuple(spots(pair.source, [stop], SEVERAL[k]) for k, stop in enumerate(stops))
    images = []
    for k, stop in enumerate(stops):
        way = [stop, stops[k + 1]] if k + 1 < len(stops) else [stop, stops[k - 1]]
        images.append(moving_mass(softmap, pair.source, pair.target, way, pair.limb[k]))
    stretch, evenness = dirichlet(softmap), bijectivity(softmap)
    true = SoftMap.from_points(softmap.source, softmap.target, pair.truth)
    best = dirichlet(true)
    densities = (
        _stretch(pair.source, stretch.density, stretch.energy, "WKS"),
        _evenness(pair.target, evenness.density, evenness.energy, "WKS"),
        _stretch(pair.source, best.density, best.energy, "true map"),
    )
    numbers = {"dirichlet": stretch.energy, "bijectivity": evenness.energy, "true dirichlet": best.energy}
    first = plain(pair.source, "four points", marks)
    return Sheet(((first, *images[:3]), (images[3], *densities)), (3.1, 3.0), numbers)


def deformations(shelf: Shelf) -> Sheet:
    """Reciprocal bijectivity density of four deformations whose correspondence is known (figure 6)."""
    rest, *deformed = shelf.series
    basis = maxent_basis(rest.mesh, USUAL)
    panels = [plain(rest, "source")]
    numbers: dict[str, float] = {}
    for k, shape in enumerate(deformed, 1):
        softmap = SoftMap.from_points(basis, maxent_basis(shape.mesh, USUAL), np.arange(rest.mesh.n_vertices))
        stretch, evenness = dirichlet(softmap).energy, bijectivity(softmap)
        panel = _evenness(shape, evenness.density, evenness.energy, "")
        title = f"$E_D$ = {stretch:.2f},  $E_b$ = {evenness.energy:.3f}"
        panels.append(replace(panel, title=title, logarithmic=True, limits=EVEN, colours="coolwarm"))
        numbers |= {f"dirichlet {k}": stretch, f"bijectivity {k}": evenness.energy}
    return Sheet((tuple(panels),), (2.9, 3.3), numbers)


def failure(shelf: Shelf) -> Sheet:
    """Where a soft map of wave kernel signatures tears an arm (figure 7)."""
    pair = shelf.arms
    softmap = _of_wave_kernels(pair)
    found = dirichlet(softmap)
    stops = [pair.source.vertex(place) for place in pair.limb[1:3]]
    marks = tuple(spots(pair.source, [stop], SEVERAL[k]) for k, stop in enumerate(stops))
    panels = [
        replace(_stretch(pair.source, found.density, found.energy, "WKS"), marks=marks),
        *(
            mass(softmap, pair.target, stop, f"image of {place}",
                 (spots(pair.target, [int(pair.truth[stop])], SEVERAL[k]),))
            for k, (stop, place) in enumerate(zip(stops, pair.limb[1:3], strict=True))
        ),
    ]  # fmt: skip
    return Sheet((tuple(panels),), (3.6, 3.2), {"dirichlet": found.energy})


def _of_wave_kernels(pair: Pair) -> SoftMap:
    source, target = pair.source.mesh, pair.target.mesh
    bases = maxent_basis(source, USUAL), maxent_basis(target, USUAL)
    return SoftMap.from_descriptors(*bases, wks(source, partner=target), wks(target, partner=source))


def _stretch(shape: Shape, density: np.ndarray, energy: float, name: str) -> Panel:
    panel = dirichlet_panel(shape.mesh.vertices, shape.mesh.faces, density, energy, name)
    return replace(panel, view=shape.view)


def _evenness(shape: Shape, density: np.ndarray, energy: float, name: str) -> Panel:
    panel = bijectivity_panel(shape.mesh.vertices, shape.mesh.faces, density, energy, name)
    return replace(panel, view=shape.view)
