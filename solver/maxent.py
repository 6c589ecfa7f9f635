"""A partition of unity that reproduces linear functions: local maximum entropy (Arroyo and Ortiz 2006).

Of all weights w that put the samples' mean at x, Σ wᵢ log_x pᵢ = 0, it takes those nearest to a Gaussian.
Densities of soft maps on such a basis converge, which with `solver.basis.poisson_basis` they do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numba
import numpy as np
from scipy import sparse

from solver.basis import Basis
from solver.errors import InvalidBasis
from solver.geodesics import Samples, farthest_point_samples
from solver.mesh import FloatArray, IntArray, Mesh
from solver.tangents import LogMaps, log_maps

#: Sharpness γ that is accepted: below, most functions meet at every vertex; above, hardly any overlap.
SHARPEST, BLUNTEST = 50.0, 0.5

#: How far from its sample a function is looked for: h times the first, or where the Gaussian has fallen to
#: exp(−the second) if that is farther. On limbs thinner than h the next sample may be 2.2 h away.
REACH, FALLEN = 2.4, 17.0

#: Weights below the first are dropped, those above the second kept, and between them a smooth step leads from
#: one to the other; then λ is found again, so that nothing is lost but a third of the functions at a vertex.
DROPPED, KEPT = 0.003, 0.006

#: Penalties ½ a |λ|² + ¼ b |λ|⁴ on λ, at γ = 3 and in units of h. Well inside the hull of its samples a
#: vertex has |λ| < 3 and feels neither; outside, where no λ is enough, they keep it from growing for ever.
RIDGE, WALL = 1e-3, 1e-3

#: Newton's decrement at which λ is exact to rounding, and a number of steps that is never needed.
DECREMENT, STEPS = 1e-24, 200

#: Shares of choosing samples and of logarithms in the progress.
SAMPLING_SHARE, LOGARITHM_SHARE = 0.1, 0.85


def maxent_basis(
    mesh: Mesh,
    size: int = 300,
    sharpness: float = 3.0,
    first: int | list[int] | IntArray = 0,
    progress: Callable[[float], None] | None = None,
) -> Basis:
    """Partition of unity wᵢ(x) ∝ exp(−γ d(x, pᵢ)²/h² + λ(x)·log_x pᵢ), with λ such that Σ wᵢ log_x pᵢ ≈ 0.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    size : int
        Number of functions n, from the number of components to that of vertices.
    sharpness : float
        γ, from 0.5 to 50: larger values give narrower functions, fewer of them at a vertex, less smooth.
    first : int or sequence of int
        The first samples, distinct.
    progress : callable, optional
        Called with the fraction done, from 0 to 1; may raise to abort.

    Returns
    -------
    Basis
        Always the same for the same arguments.

    Raises
    ------
    InvalidBasis
        A size, sharpness or first sample out of range.

    Notes
    -----
    h² is the area of a component over the number of its samples. λ minimises log Σ exp(…) + ½ a h²|λ|² +
    ¼ b h⁴|λ|⁴; weights below 0.3 to 0.6 % are then taken out, and λ is found again for those that stay.
    """
    if not BLUNTEST <= sharpness <= SHARPEST:
        message = f"sharpness must lie between {BLUNTEST} and {SHARPEST}, not {sharpness}"
        raise InvalidBasis(message, value=float(sharpness))

    def report(start: float, end: float) -> Callable[[float], None] | None:
        return None if progress is None else lambda done: progress(start + (end - start) * done)

    samples = farthest_point_samples(mesh, size, first, report(0.0, SAMPLING_SHARE))
    spacings = _spacings(mesh, samples)
    reach = max(REACH, math.sqrt(FALLEN / sharpness))
    radii = np.maximum(reach * spacings, _cell_radii(samples))
    logs = log_maps(mesh, samples.vertices, radii, report(SAMPLING_SHARE, LOGARITHM_SHARE))
    weights = _weights(logs, spacings, sharpness)
    functions = sparse.csr_array((weights, logs.points, logs.starts), shape=(mesh.n_vertices, size))
    functions = functions + _forgotten(mesh, samples, logs)
    functions.eliminate_zeros()
    sums = np.where(mesh.referenced, functions.sum(axis=1), 1.0)
    basis = Basis(mesh, sparse.diags_array(1 / sums) @ functions, samples.vertices, samples.cells)
    if progress is not None:
        progress(1.0)
    return basis


def _spacings(mesh: Mesh, samples: Samples) -> FloatArray:
    """Spacing h of each sample: the root of its component's area over the number of samples there."""
    areas = np.bincount(mesh.components[mesh.faces[:, 0]], weights=mesh.face_areas)
    component = mesh.components[samples.vertices]
    spacings: FloatArray = np.sqrt(areas / np.bincount(component, minlength=areas.size))[component]
    return spacings


def _cell_radii(samples: Samples) -> FloatArray:
    """Largest distance of a vertex from its own sample, and a little more, of each cell."""
    radii = np.zeros(len(samples.vertices))
    inside = samples.cells >= 0
    np.maximum.at(radii, samples.cells[inside], samples.distances[inside])
    return radii * (1 + 1e-6)


def _weights(logs: LogMaps, spacings: FloatArray, sharpness: float) -> FloatArray:
    """Weight of each function at each vertex that it may reach, in the order of the logarithms."""
    h = spacings[logs.points]
    vectors = np.ascontiguousarray(np.stack([logs.vectors.real, logs.vectors.imag], axis=1) / h[:, None])
    weights = -sharpness * (logs.distances / h) ** 2
    # λ grows with γ, so these keep their size beside the variance of the weights, which is about h²/2γ.
    _solve(logs.starts, vectors, RIDGE * 3 / sharpness, WALL * (3 / sharpness) ** 3, weights)
    return weights


def _forgotten(mesh: Mesh, samples: Samples, logs: LogMaps) -> sparse.csr_array:
    """1 for the function of the own cell, at vertices that no logarithm reaches."""
    alone = np.flatnonzero((np.diff(logs.starts) == 0) & mesh.referenced)
    shape = (mesh.n_vertices, len(samples.vertices))
    return sparse.csr_array((np.ones(alone.size), (alone, samples.cells[alone])), shape=shape)


_kernel = partial(numba.njit, cache=True, nogil=True)


@_kernel("void(float64[:, ::1], float64[::1], float64, float64, float64[::1])")
def _minimise(vectors: FloatArray, prior: FloatArray, ridge: float, wall: float, w: FloatArray) -> None:
    """Damped Newton for λ minimising log Σ exp(prior + λ·v) + ½ ridge |λ|² + ¼ wall |λ|⁴; the weights w."""
    x = y = step_x = step_y = 0.0
    value, slope, share = math.inf, 0.0, 1.0
    for _ in range(STEPS):
        next_x, next_y = x + share * step_x, y + share * step_y
        for i in range(len(w)):
            w[i] = prior[i] + next_x * vectors[i, 0] + next_y * vectors[i, 1]
        top = np.max(w)
        total = mean_x = mean_y = 0.0
        for i in range(len(w)):
            w[i] = math.exp(w[i] - top)
            total += w[i]
            mean_x += w[i] * vectors[i, 0]
            mean_y += w[i] * vectors[i, 1]
        squared = next_x**2 + next_y**2
        found = top + math.log(total) + 0.5 * ridge * squared + 0.25 * wall * squared**2
        if found > value + 0.25 * share * slope + 1e-13 * (1.0 + abs(value)):
            share *= 0.5
            continue
        x, y, value, share = next_x, next_y, found, 1.0
        mean_x, mean_y = mean_x / total, mean_y / total
        penalty = ridge + wall * squared
        xx, xy, yy = penalty + 2 * wall * x * x, 2 * wall * x * y, penalty + 2 * wall * y * y
        for i in range(len(w)):
            w[i] /= total
            off_x, off_y = vectors[i, 0] - mean_x, vectors[i, 1] - mean_y
            xx += w[i] * off_x * off_x
            xy += w[i] * off_x * off_y
            yy += w[i] * off_y * off_y
        mean_x, mean_y = mean_x + penalty * x, mean_y + penalty * y
        determinant = xx * yy - xy * xy
        step_x = (xy * mean_y - yy * mean_x) / determinant
        step_y = (xy * mean_x - xx * mean_y) / determinant
        slope = mean_x * step_x + mean_y * step_y
        if -slope < DECREMENT:
            break


@_kernel("void(int64[::1], float64[:, ::1], float64, float64, float64[::1])")
def _solve(starts: IntArray, vectors: FloatArray, ridge: float, wall: float, weights: FloatArray) -> None:
    """Turn logarithms of the prior at each vertex into weights, small ones into zeros, in place."""
    scratch = np.empty((2, np.max(np.diff(starts))))
    for x in range(len(starts) - 1):
        begin, end = starts[x], starts[x + 1]
        if begin == end:
            continue
        prior, w = weights[begin:end], scratch[0, : end - begin]
        _minimise(vectors[begin:end], prior, ridge, wall, w)
        dropped = min(DROPPED, 0.25 * np.max(w))
        for i in range(end - begin):
            t = min(max((w[i] - dropped) / (KEPT - DROPPED), 0.0), 1.0)
            prior[i] = math.log(w[i] * t * t * (3 - 2 * t)) if t > 0.0 else -math.inf
        _minimise(vectors[begin:end], prior, ridge, wall, w)
        prior[:] = w
