"""Soft map → point map: where the mass of each source vertex peaks, or where on the surface it balances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import sparse

from solver.errors import SolverError
from solver.geodesics import distances_from
from solver.mesh import FloatArray, IntArray
from solver.softmap import SoftMap

Method = Literal["peak", "barycentre"]
#: Entries of a source × target table held at once (16 MB): memory is a block of rows, never V₀ · V.
BLOCK_ENTRIES = 2**21


@dataclass(frozen=True, eq=False)
class PointMap:
    """A point map read off a soft map.

    Attributes
    ----------
    targets : ndarray of int64, shape (V₀,)
        Target vertex of each source vertex, 0-based; −1 at source vertices in no face.
    confidence : ndarray of float64, shape (V₀,)
        Share of the mass of a vertex that is in functions which do not vanish at its target: 1 where the soft
        map is a point map, small where mass is spread; 0 where the target is −1.
    """

    targets: IntArray
    confidence: FloatArray


def pointmap(
    softmap: SoftMap, method: Method = "peak", progress: Callable[[float], None] | None = None
) -> PointMap:
    """Point map of a soft map: argmax_y ρ(x, y), or the barycentre argmin_y ∫ρ(x, y′) d(y, y′)² dy′.

    Parameters
    ----------
    softmap : SoftMap
    method : {"peak", "barycentre"}
        The vertex of largest density, or the one with the least mean squared geodesic distance to the mass,
        which stays on the surface and moves smoothly with x, but shrinks what is spread out.
    progress : callable, optional
        Called with the fraction done, from 0 to 1; may raise to abort.

    Returns
    -------
    PointMap
        Ties go to the lowest vertex.

    Raises
    ------
    SolverError
        If the method is unknown.
    """
    if method not in ("peak", "barycentre"):
        raise SolverError(f"method must be 'peak' or 'barycentre', not {method!r}", value=str(method)[:80])
    half = None if progress is None else lambda done: progress(0.5 * done)
    source, target = softmap.source, softmap.target
    candidates = np.flatnonzero(target.mesh.referenced)
    scores = (_densities(softmap) if method == "peak" else _centralities(softmap, half))[candidates]
    targets = np.full(source.mesh.n_vertices, -1, dtype=np.int64)
    confidence = np.zeros(source.mesh.n_vertices)
    present = (target.functions > 0).astype(np.float64)
    kept = np.flatnonzero(source.mesh.referenced)
    step = max(1, BLOCK_ENTRIES // target.mesh.n_vertices)
    for start in range(0, kept.size, step):
        vertices = kept[start : start + step]
        mass = source.functions[vertices] @ softmap.coefficients
        targets[vertices] = candidates[np.asarray(scores @ mass.T).argmax(axis=0)]
        confidence[vertices] = np.minimum((present[targets[vertices]].toarray() * mass).sum(axis=1), 1.0)
        if progress is not None:
            progress(0.5 + 0.5 * min(start + step, kept.size) / kept.size)
    return PointMap(targets, confidence)


def _densities(softmap: SoftMap) -> sparse.csr_array:
    """βⱼ(v) / ∫βⱼ, csr (V, n): density at each target vertex of a unit of mass in each function."""
    target = softmap.target
    return sparse.csr_array(target.functions @ sparse.diags_array(1 / target.integrals))


def _centralities(softmap: SoftMap, progress: Callable[[float], None] | None) -> FloatArray:
    """−d(v, pⱼ)², float64 (V, n): the spread of μⱼ about its sample adds about the same for every v."""
    target = softmap.target
    squares = np.empty((target.mesh.n_vertices, target.size))
    for j, sample in enumerate(target.samples):
        squares[:, j] = distances_from(target.mesh, int(sample)) ** 2
        if progress is not None:
            progress((j + 1) / target.size)
    return -squares
