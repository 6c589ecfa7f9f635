"""What a soft map costs beyond its energy: a linear term that draws mass to where descriptors agree.

An optimal map of landmarks alone spreads wherever they are far. ⟨K, C⟩ keeps the problem convex, so that its
certificate stays, and sharpens the map (docs/decisions/optimal.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from solver.basis import Basis
from solver.errors import InvalidDescriptor, InvalidMesh
from solver.fem import mass
from solver.geodesics import distances_from
from solver.mesh import FloatArray, Mesh


def descriptor_cost(
    source: Basis, target: Basis, source_descriptor: npt.ArrayLike, target_descriptor: npt.ArrayLike
) -> FloatArray:
    """Mean squared difference of descriptors under a soft map: ⟨K, C⟩ = ∫∫ ρ(x, y) ‖f₀(x) − f(y)‖² dy dx.

    Parameters
    ----------
    source, target : Basis
    source_descriptor : (V₀, d) array_like of float
    target_descriptor : (V, d) array_like of float

    Returns
    -------
    ndarray of float64, shape (n₀, n)
        K_ij = ∫β₀ᵢ(x) ∫βⱼ(y) ‖f₀(x) − f(y)‖² dy dx / ∫βⱼ, with lumped masses.

    Raises
    ------
    InvalidDescriptor
        If shapes do not match or a value is not finite.
    """
    pair = []
    for what, basis, given in (
        ("source", source, source_descriptor),
        ("target", target, target_descriptor),
    ):
        values = np.asarray(given, dtype=np.float64)
        if values.ndim != 2 or len(values) != basis.mesh.n_vertices:
            message = (
                f"the {what} descriptor must have shape ({basis.mesh.n_vertices}, d), not {values.shape}"
            )
            raise InvalidDescriptor(message, value=str(values.shape))
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if bad.size:
            message = f"the {what} descriptor of vertex {bad[0]} is not finite"
            raise InvalidDescriptor(message, index=int(bad[0]))
        pair.append(values)
    f0, f = pair
    if f0.shape[1] != f.shape[1]:
        message = f"descriptors must be equally long, not {f0.shape[1]} and {f.shape[1]}"
        raise InvalidDescriptor(message, value=f.shape[1])
    # Centred, so that the squares lose no digits to a common offset.
    centre = f.mean(axis=0)
    zeroth, first, second = _moments(source, f0 - centre)
    total, mean, square = _moments(target, f - centre)
    cost: FloatArray = second[:, None] - 2 * first @ (mean / total[:, None]).T
    cost += np.outer(zeroth, square / total)
    return np.maximum(cost, 0.0)


def landmark_distances(mesh: Mesh, landmarks: Sequence[int]) -> FloatArray:
    """Geodesic distances to landmarks as a descriptor: near-isometric surfaces share them.

    Parameters
    ----------
    mesh : Mesh
    landmarks : sequence of int
        Vertices, 0-based.

    Returns
    -------
    ndarray of float64, shape (V, L)
        In √area.

    Raises
    ------
    InvalidMesh
        If a vertex does not exist, or the mesh is not connected; names the vertex.
    """
    distances = np.empty((mesh.n_vertices, len(landmarks)))
    for k, vertex in enumerate(landmarks):
        if not 0 <= vertex < mesh.n_vertices:
            message = f"landmark {k} is vertex {vertex}, not one of 0 … {mesh.n_vertices - 1}"
            raise InvalidMesh(message, index=k, value=int(vertex))
        distances[:, k] = distances_from(mesh, int(vertex))
    # Vertices in no face carry no mass: any number will do for them.
    distances[~mesh.referenced] = 0.0
    unreached = np.flatnonzero(~np.isfinite(distances).all(axis=1))
    if unreached.size:
        message = f"vertex {unreached[0]} is not connected with every landmark"
        raise InvalidMesh(message, index=int(unreached[0]))
    return distances


def _moments(basis: Basis, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """∫β, ∫βf and ∫β‖f‖² of each function, (n,), (n, d) and (n,)."""
    areas = mass(basis.mesh)
    weighted = basis.functions.T * areas
    return weighted @ np.ones(areas.size), weighted @ values, weighted @ (values**2).sum(axis=1)
