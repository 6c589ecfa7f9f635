"""Soft maps of descriptors, ρ_fine(x, y) ∝ exp(−‖f₀(x) − f(y)‖²), integrated without ever being held (§5.2).

V₀ · V numbers are visited, tile by tile, each within a processor's cache: one product of matrices makes the
exponents, another integrates their exponentials against the few functions that live on the tile. Before that,
descriptors are turned so that few columns say all, and target vertices ordered so that neighbours are near.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from solver.basis import Basis
from solver.fem import mass
from solver.mesh import FloatArray, IntArray

#: Source and target vertices of a tile: 2 MB of exponents.
ROWS, COLUMNS = 256, 1024
#: How much leaving out directions in which descriptors hardly vary may change an exponent.
DROPPED = 1e-13
#: Row blocks that may be finished or under way for each thread.
AHEAD = 4


class Tile(NamedTuple):
    """Some target vertices.

    Attributes
    ----------
    exponent : ndarray of float64, shape (d + 1, k)
        2 f(y) and below it −‖f(y)‖², so that [f₀, 1] times it is −‖f₀ − f‖² + ‖f₀‖².
    functions : ndarray of int64, shape (m,)
        Functions that live there.
    weights : ndarray of float64, shape (k, m)
        Their values, times the vertices' masses.
    """

    exponent: FloatArray
    functions: IntArray
    weights: FloatArray


def received_by(
    source: Basis,
    target: Basis,
    source_descriptor: FloatArray,
    target_descriptor: FloatArray,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> FloatArray:
    """Integrals ∫β₀ᵢ(x) ∫ρ_fine(x, y) βⱼ(y) dy dx for ρ_fine(x, y) = exp(−‖f₀(x) − f(y)‖²) / Z(x).

    Parameters
    ----------
    source, target : Basis
    source_descriptor : (V₀, d) float64
        f₀, in units of the width of the kernel.
    target_descriptor : (V, d) float64
    threads : int, optional
        Threads that share the rows, one by default. The result does not depend on it.
    progress : callable, optional
        Called with the fraction done.

    Returns
    -------
    (n₀, n) float64

    Raises
    ------
    MemoryError
        If there is no room: O(V₀ d + V d + n₀ n) numbers are held.
    """
    rows, columns = compressed(source_descriptor, target_descriptor)
    rows = np.column_stack([rows, np.ones(len(rows))])
    tiles = _tiles(target, columns)
    weighted = (source.functions.T * mass(source.mesh)).tocsc()
    total = np.zeros((source.size, target.size))

    def received(start: int) -> FloatArray:
        return _received(rows[start : start + ROWS], tiles, target.size)

    starts = range(0, len(rows), ROWS)
    for start, block in zip(starts, _in_order(received, starts, threads or 1), strict=True):
        # In order, and one product a block, so that threads cannot change a bit.
        total += weighted[:, start : start + ROWS] @ block
        if progress is not None:
            progress(min(1.0, (start + ROWS) / len(rows)))
    return total


def compressed(one: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows of both turned by the same rotation, without columns that change no squared distance between them.

    Parameters
    ----------
    one, other : (·, d) float64

    Returns
    -------
    (·, r) float64, (·, r) float64
        Squared distances differ by ``DROPPED`` at most, beside rounding. Signatures have r ≈ 30.

    Raises
    ------
    MemoryError
        If there is no room.
    """
    # Centred, so that ‖a‖² + ‖b‖² − 2ab loses no digits to a common offset.
    centre = other.mean(axis=0)
    one, other = one - centre, other - centre
    triangles = [np.linalg.qr(each, mode="r") for each in (one, other)]
    directions = np.linalg.svd(np.vstack(triangles), full_matrices=True)[2].T
    turned = one @ directions, other @ directions
    # ‖a − b‖² of the last columns is at most (|a| + |b|)².
    tails = [np.sqrt(np.cumsum(each[:, ::-1] ** 2, axis=1).max(axis=0)) for each in turned]
    kept = max(1, turned[0].shape[1] - int(((tails[0] + tails[1]) ** 2 <= DROPPED).sum()))
    return np.ascontiguousarray(turned[0][:, :kept]), np.ascontiguousarray(turned[1][:, :kept])


def _tiles(target: Basis, descriptor: FloatArray) -> list[Tile]:
    """Target vertices in tiles of neighbouring cells."""
    near = csgraph.reverse_cuthill_mckee(sparse.csr_matrix(target.overlap), symmetric_mode=True)
    place = np.empty(target.size, dtype=np.int64)
    place[near] = np.arange(target.size)
    vertices = np.flatnonzero(target.mesh.referenced)
    vertices = vertices[np.argsort(place[target.cells[vertices]], kind="stable")]
    masses = mass(target.mesh)
    tiles = []
    for start in range(0, vertices.size, COLUMNS):
        some = vertices[start : start + COLUMNS]
        values = target.functions[some]
        functions = np.unique(values.indices).astype(np.int64)
        exponent = np.vstack([2 * descriptor[some].T, -(descriptor[some] ** 2).sum(axis=1)])
        weights = values[:, functions].toarray() * masses[some, None]
        tiles.append(Tile(exponent, functions, weights))
    return tiles


def _received(rows: FloatArray, tiles: list[Tile], size: int) -> FloatArray:
    """∫ρ_fine(x, y) βⱼ(y) dy for some source vertices x."""
    found = np.zeros((len(rows), size))
    # ‖f₀‖² is common to a row: taking the largest exponent so far away removes it and keeps exp within range.
    largest = np.full((len(rows), 1), -np.inf)
    room = np.empty(len(rows) * COLUMNS)
    for tile in tiles:
        exponent = room[: len(rows) * tile.exponent.shape[1]].reshape(len(rows), -1)
        np.matmul(rows, tile.exponent, out=exponent)
        top = exponent.max(axis=1, keepdims=True)
        if (top > largest).any():
            np.maximum(top, largest, out=top)
            found *= np.exp(largest - top)
            largest = top
        exponent -= largest
        found[:, tile.functions] += np.exp(exponent, out=exponent) @ tile.weights
    found /= found.sum(axis=1, keepdims=True)
    return found


def _in_order(make: Callable[[int], FloatArray], starts: range, threads: int) -> Iterator[FloatArray]:
    """Results in order, made on threads, a few ahead of whoever takes them."""
    waiting: deque[Future[FloatArray]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for start in starts:
            if len(waiting) >= AHEAD * threads:
                yield waiting.popleft().result()
            waiting.append(pool.submit(make, start))
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
