"""Faces solved chunk by chunk on a pool of plain threads, and handed on in order."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue

import numpy as np

from solver.assembly import Systems
from solver.batches import Bench, Gradient, bench, solve_faces
from solver.errors import SingularSystem
from solver.mesh import FloatArray, IntArray

#: Faces of one chunk: what a thread does at a time, and whose sums are added in order. Bits depend on it.
CHUNK = 128
#: Residual above which a solution is not trusted. Systems of real maps stay below 1e-15.
RESIDUAL_TOLERANCE = 1e-10
#: Chunks that may be finished or under way for each thread, so that a slow one does not pile up the others'
#: results.
AHEAD = 4


@dataclass(frozen=True, eq=False)
class Chunk:
    """Some faces, solved.

    Attributes
    ----------
    faces : ndarray of int64, shape (k,)
    density : ndarray of float64, shape (k,)
        e(f).
    residual : float
        Largest residual.
    potential : ndarray of float64, shape (k, 2, n), of size 0 if not asked for
        q_fs.
    functions : ndarray of int64, shape (m,)
        Source functions that live on these faces; none if the gradient was not asked for.
    slopes, forms : ndarray of float64, shape (m, n)
        Their rows of Σ_fs area₀ g_fs q_fsᵀ and of Σ_f area₀ mean_f(β₀) (Σ_s q_fsᵀ Wⱼ q_fs)ⱼ.
    """

    faces: IntArray
    density: FloatArray
    residual: float
    potential: FloatArray
    functions: IntArray
    slopes: FloatArray
    forms: FloatArray


def solved_chunks(
    systems: Systems,
    faces: IntArray,
    *,
    potential: bool = False,
    gradient: bool = False,
    threads: int | None = None,
) -> Iterator[Chunk]:
    """Solve the systems of some faces, at most a few chunks ahead of whoever takes them.

    Parameters
    ----------
    systems : Systems
    faces : (k,) int64
    potential, gradient : bool
        Whether chunks hold the potential, and the sums that the gradient is made of.
    threads : int, optional
        Threads that share the work, one by default. Chunks come in order and do not depend on it.

    Yields
    ------
    Chunk

    Raises
    ------
    SingularSystem
        If a face's system has no trustworthy solution; names the first such face.
    """
    count = max(1, threads or 1)
    benches: SimpleQueue[Bench] = SimpleQueue()
    for _ in range(count):
        benches.put(bench(systems))

    def solved(first: int) -> Chunk:
        room = benches.get()
        try:
            return _solved(
                systems, faces[first : first + CHUNK], room, potential=potential, gradient=gradient
            )
        finally:
            benches.put(room)

    firsts = range(0, faces.size, CHUNK)
    if count == 1:
        yield from map(solved, firsts)
        return
    pool = ThreadPoolExecutor(count)
    waiting: deque[Future[Chunk]] = deque()
    try:
        for first in firsts:
            if len(waiting) >= AHEAD * count:
                yield waiting.popleft().result()
            waiting.append(pool.submit(solved, first))
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def _solved(systems: Systems, faces: IntArray, room: Bench, *, potential: bool, gradient: bool) -> Chunk:
    order = systems.plan.symbolic.order
    results = np.zeros((faces.size, 4))
    found = np.zeros((faces.size if potential else 0, 2, order.size))
    functions, sums = _sums(systems, faces if gradient else faces[:0])
    # One function spans the constants alone: A is 0, and so is q.
    if order.size > 1:
        epsilon = systems.regularisation
        solve_faces(systems.plan.target, systems.source, room, faces, epsilon, results, order, found, sums)
        _refuse_untrustworthy(systems, faces, results)
    by_function = np.argsort(order)
    return Chunk(
        faces=faces,
        density=results[:, 0],
        residual=float(results[:, 1].max(initial=0.0)),
        potential=found,
        functions=functions,
        slopes=sums.slopes[:, by_function],
        forms=sums.forms[:, by_function],
    )


def _sums(systems: Systems, faces: IntArray) -> tuple[IntArray, Gradient]:
    """Functions that live on some faces, and zeros to add their rows of the gradient to."""
    source = systems.softmap.source
    vertices = np.unique(source.mesh.faces[faces])
    functions = np.unique(source.functions[vertices].indices).astype(np.int64)
    line = np.zeros(source.size if faces.size else 0, dtype=np.int64)
    line[functions] = np.arange(functions.size)
    areas = source.mesh.face_areas[faces][None, :].copy()
    slopes, forms = np.zeros((2, functions.size, systems.softmap.target.size))
    return functions, Gradient(line, areas, slopes, forms)


def _refuse_untrustworthy(systems: Systems, faces: IntArray, results: FloatArray) -> None:
    """Raise for the first face with a dependent column or a residual that is large or not a number."""
    dependent = results[:, 2] >= 0
    bad = np.flatnonzero(dependent | ~(results[:, 1] <= RESIDUAL_TOLERANCE))
    if not bad.size:
        return
    face = int(faces[bad[0]])
    _, residual, column, pivot = (float(value) for value in results[bad[0]])
    if dependent[bad[0]]:
        function = systems.plan.symbolic.order[int(column)]
        raise SingularSystem(
            f"the system of face {face} is singular: function {function} of the target basis depends "
            f"linearly on others (relative pivot {pivot:.1e})",
            index=face,
            value=pivot,
        )
    message = f"the system of face {face} has no trustworthy solution (residual {residual:.1e})"
    raise SingularSystem(message, index=face, value=residual)
