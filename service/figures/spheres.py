"""Figures 4 (a) and 5: a superposition of two maps of the sphere, and four maps with their energies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from service.figures.drawing import Sheet, moving_mass, plain, pointer
from service.figures.shapes import Shape, Shelf, sphere
from service.marks import Floats, Ints
from service.rasteriser import View
from solver import Mesh, SoftMap, bijectivity, dirichlet, maxent_basis

VERTICES, FUNCTIONS = 3000, 300
#: Vertices of the spheres that textures are drawn on.
FINE = 120_000
VIEW = View(25.0, 22.0)
#: Width of the edges in a texture, in radii.
EDGE = 0.012


def located(mesh: Mesh, directions: Floats) -> tuple[Ints, Floats]:
    """Where rays from the origin meet a sphere.

    Parameters
    ----------
    mesh : Mesh
        A sphere around the origin.
    directions : ndarray, (k, 3) float
        Of the rays.

    Returns
    -------
    faces : ndarray, (k,) int64
    barycentric : ndarray, (k, 3) float64
        Non-negative weights of their corners, summing to 1.

    Raises
    ------
    LinAlgError
        If the mesh has faces that contain the origin.
    """
    corners = mesh.vertices[mesh.faces]
    _, near = cKDTree(corners.mean(axis=1)).query(directions, 20)
    weights = np.linalg.solve(corners[near].swapaxes(2, 3), directions[:, None, :, None])[..., 0]
    weights /= weights.sum(axis=2, keepdims=True)
    best = weights.min(axis=2).argmax(axis=1)
    chosen = np.arange(len(directions)), best
    barycentric = np.clip(weights[chosen], 0.0, 1.0)
    return near[chosen], barycentric / barycentric.sum(axis=1, keepdims=True)


def superposed(_shelf: Shelf) -> Sheet:
    """Momentum of the identity and a reflection of the sphere in equal parts (figure 4 a)."""
    shape = Shape(sphere(VERTICES), View(25.0, 4.0), {"point": (1.0, 0.35, 0.55), "towards": (0.3, 0.8, 0.5)})
    basis = maxent_basis(shape.mesh, FUNCTIONS)
    points = shape.mesh.vertices
    maps = [
        SoftMap.from_points(basis, basis, *located(shape.mesh, points * mirror))
        for mirror in ((1.0, 1.0, 1.0), (1.0, 1.0, -1.0))
    ]
    both = SoftMap.mixture(maps, [0.5, 0.5])
    way = [shape.vertex("point"), shape.vertex("towards")]
    panels = (
        plain(shape, "source point and direction", pointer(shape, way)),
        moving_mass(maps[0], shape, shape, way, "identity"),
        moving_mass(both, shape, shape, way, "identity and reflection"),
    )
    energies = {
        name: dirichlet(one).energy for name, one in zip(("identity", "reflection"), maps, strict=True)
    }
    return Sheet((panels,), (3.0, 3.0), energies | {"both": dirichlet(both).energy})


def _conformal(points: Floats, factor: float) -> Floats:
    """Möbius map: the stereographic plane is scaled."""
    height = points[:, 2]
    plane = factor * points[:, :2] / (1 + 1e-12 + height)[:, None]
    squared = (plane**2).sum(axis=1)
    image: Floats = np.column_stack([2 * plane, 1 - squared]) / (1 + squared)[:, None]
    return image


def _stretched(points: Floats, factor: float) -> Floats:
    """One axis is drawn out, and the points pushed back to the sphere."""
    image = points * (1.0, factor, 1.0)
    stretched: Floats = image / np.linalg.norm(image, axis=1, keepdims=True)
    return stretched


TURN = Rotation.from_rotvec([0.5, 0.9, -0.4]).as_matrix()
#: Each map with its inverse, which textures are carried by.
MAPS: dict[str, tuple[Callable[[Floats], Floats], Callable[[Floats], Floats]]] = {
    "identity": (lambda points: points, lambda points: points),
    "rotation": (lambda points: points @ TURN.T, lambda points: points @ TURN),
    "conformal": (lambda points: _conformal(points, 1.7), lambda points: _conformal(points, 1 / 1.7)),
    "stretched": (lambda points: _stretched(points, 3.0), lambda points: _stretched(points, 1 / 3.0)),
}


def spheres(_shelf: Shelf) -> Sheet:
    """Four maps of the sphere as textures, with the energies of their soft maps (figure 5)."""
    mesh, fine = sphere(VERTICES), Shape(sphere(FINE), VIEW)
    basis = maxent_basis(mesh, FUNCTIONS)
    panels = []
    numbers: dict[str, float] = {}
    for name, (forwards, backwards) in MAPS.items():
        softmap = SoftMap.from_points(basis, basis, *located(mesh, forwards(mesh.vertices)))
        stretch, evenness = dirichlet(softmap).energy, bijectivity(softmap).energy
        title = f"{name}: $E_D$ = {stretch:.2f}, $E_b$ = {evenness:.2f}"
        values = _texture(backwards(fine.mesh.vertices))
        panels.append(replace(plain(fine, title), values=values))
        numbers |= {f"{name} dirichlet": stretch, f"{name} bijectivity": evenness}
    return Sheet((tuple(panels),), (3.0, 3.1), numbers)


def _texture(points: Floats) -> Floats:
    """Colours of a globe: squares of longitude and latitude, each hemisphere in its own."""
    longitude, latitude = np.arctan2(points[:, 1], points[:, 0]), np.arcsin(np.clip(points[:, 2], -1, 1))
    # The edges of squares are as soft as vertices are apart, or they would be ragged.
    waves = np.sin(9 * longitude) * np.sin(9 * latitude) * np.maximum(np.cos(latitude), 0.05)
    even = np.clip(0.5 + waves / (9 * EDGE), 0.0, 1.0)[:, None]
    share = ((points[:, 2] + 1) / 2)[:, None]
    dark = share * np.array([0.80, 0.22, 0.16]) + (1 - share) * np.array([0.10, 0.32, 0.66])
    light = share * np.array([0.99, 0.86, 0.60]) + (1 - share) * np.array([0.74, 0.88, 0.97])
    colours: Floats = even * dark + (1 - even) * light
    return colours
