"""How good a point map or a soft map is against a known one: geodesic errors, coverage, bijectivity.

Errors follow the Princeton protocol (Kim, Lipman, Funkhouser 2011): geodesic distance on the target between
where a vertex goes and where it should go, in units of √area, as a curve of the share of vertices below each
threshold. Where the truth has a symmetric twin, the nearer of the two counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solver.errors import InvalidSoftMap
from solver.fem import mass
from solver.geodesics import distances_from
from solver.mesh import FloatArray, IntArray, Mesh
from solver.softmap import SoftMap

#: Thresholds of the error curve, in √area.
THRESHOLDS = np.linspace(0.0, 0.25, 26)


@dataclass(frozen=True, eq=False)
class MapQuality:
    """How good a point map is.

    Attributes
    ----------
    errors : ndarray of float64, shape (k,)
        Geodesic error of each measured source vertex in √area; NaN where the truth is unknown.
    mean : float
        Mean error over those whose truth is known.
    thresholds, curve : ndarray of float64
        Share of them with an error of at most each threshold.
    coverage : float
        Share of the target's area whose vertices are hit, 0 to 1.
    bijectivity : float
        ∫b² of the mass that target vertices receive, at least 1 where all of the source has a target.
    """

    errors: FloatArray
    mean: float
    thresholds: FloatArray
    curve: FloatArray
    coverage: float
    bijectivity: float


def map_quality(
    source: Mesh,
    target: Mesh,
    targets: npt.ArrayLike,
    truth: npt.ArrayLike,
    twin: npt.ArrayLike | None = None,
    sources: npt.ArrayLike | None = None,
    progress: Callable[[float], None] | None = None,
) -> MapQuality:
    """Measure a point map against a known one, or against the nearer of it and its symmetric twin.

    Parameters
    ----------
    source, target : Mesh
    targets : (V₀,) array_like of int
        Target vertex of each source vertex; −1 where there is none, which counts as no error and no coverage.
    truth, twin : (V₀,) array_like of int
        Known maps; −1 where unknown.
    sources : (k,) array_like of int, optional
        Source vertices whose errors are measured, all by default; each costs a distance field for each known
        target. Coverage and bijectivity are of the whole map.
    progress : callable, optional
        Called with the fraction done, from 0 to 1; may raise to abort.

    Returns
    -------
    MapQuality

    Raises
    ------
    InvalidSoftMap
        If a length does not match, or a vertex does not exist; names the index.
    """
    images = _checked(source, target, targets, "targets")
    known = [_checked(source, target, each, "the truth") for each in (truth, twin) if each is not None]
    chosen = _chosen(source, sources)
    errors = _errors(target, images[chosen], [each[chosen] for each in known], progress)
    counted = errors[np.isfinite(errors)]
    sent = images >= 0
    received = np.bincount(images[sent], weights=mass(source)[sent], minlength=target.n_vertices)
    masses = mass(target)
    hit = received > 0
    return MapQuality(
        errors=errors,
        mean=float(counted.mean()) if counted.size else float("nan"),
        thresholds=THRESHOLDS,
        curve=np.array([(counted <= t).mean() if counted.size else np.nan for t in THRESHOLDS]),
        coverage=float(masses[hit].sum()),
        bijectivity=float((received[hit] ** 2 / masses[hit]).sum()),
    )


def mass_within(
    softmap: SoftMap, truth: npt.ArrayLike, radius: float, sources: npt.ArrayLike | None = None
) -> FloatArray:
    """Probability mass of source vertices within a geodesic radius of where they should go.

    Parameters
    ----------
    softmap : SoftMap
    truth : (V₀,) array_like of int
        Known target vertex of each source vertex, −1 where unknown.
    radius : float
        In √area of the target.
    sources : (k,) array_like of int, optional
        Source vertices to measure, all by default; each costs one distance field.

    Returns
    -------
    ndarray of float64, shape (k,)
        ∫_{d(y, truth) ≤ radius} ρ(x, y) dy; NaN where the truth is unknown.

    Raises
    ------
    InvalidSoftMap
        If a length does not match, or a vertex does not exist; names the index.
    """
    source, target = softmap.source, softmap.target
    known = _checked(source.mesh, target.mesh, truth, "the truth")
    vertices = _chosen(source.mesh, sources)
    weighted = target.functions.T * (mass(target.mesh))
    found = np.full(vertices.size, np.nan)
    for k, vertex in enumerate(vertices):
        if known[vertex] >= 0:
            near = distances_from(target.mesh, int(known[vertex])) <= radius
            inside = (weighted @ near.astype(np.float64)) / target.integrals
            found[k] = (source.functions[[vertex]] @ softmap.coefficients)[0] @ inside
    return found


def _errors(
    target: Mesh, images: IntArray, known: list[IntArray], progress: Callable[[float], None] | None
) -> FloatArray:
    """Distance of each image to the nearer known one: one distance field for each known target."""
    errors = np.full(images.size, np.nan)
    total, done = sum(each.size for each in known), 0
    for each in known:
        order = np.argsort(each, kind="stable")
        for members in np.split(order, np.flatnonzero(np.diff(each[order])) + 1):
            done += members.size
            sent = members[images[members] >= 0]
            if sent.size and each[sent[0]] >= 0:
                distances = distances_from(target, int(each[sent[0]]))
                errors[sent] = np.fmin(errors[sent], distances[images[sent]])
            if progress is not None:
                progress(done / total)
    return errors


def _chosen(source: Mesh, sources: npt.ArrayLike | None) -> IntArray:
    if sources is None:
        return np.arange(source.n_vertices)
    chosen = np.asarray(sources)
    if chosen.ndim != 1 or not np.issubdtype(chosen.dtype, np.integer):
        raise InvalidSoftMap("sources must be a list of source vertices", value=str(chosen.shape))
    outside = np.flatnonzero((chosen < 0) | (chosen >= source.n_vertices))
    if outside.size:
        index = int(outside[0])
        message = f"sources[{index}] is {chosen[index]}, not a source vertex 0 … {source.n_vertices - 1}"
        raise InvalidSoftMap(message, index=index, value=int(chosen[index]))
    return chosen.astype(np.int64)


def _checked(source: Mesh, target: Mesh, given: npt.ArrayLike, what: str) -> IntArray:
    vertices = np.asarray(given)
    if vertices.shape != (source.n_vertices,) or not np.issubdtype(vertices.dtype, np.integer):
        message = f"{what} must hold an integer for each of the {source.n_vertices} source vertices"
        raise InvalidSoftMap(message, value=str(vertices.shape))
    outside = np.flatnonzero((vertices < -1) | (vertices >= target.n_vertices))
    if outside.size:
        index = int(outside[0])
        message = f"{what}[{index}] is {vertices[index]}, not a target vertex 0 … {target.n_vertices - 1}"
        raise InvalidSoftMap(message, index=index, value=int(vertices[index]))
    return vertices.astype(np.int64)
