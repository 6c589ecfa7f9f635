"""The transportation potential Q (§4.4–4.5): one sparse positive definite system for each source face.

A_f q_fs = b_fs with u_f · q_fs = 0 (eqs. 10, 12). A_f is singular exactly on the constants: each face is
grounded at its own heaviest function, which is exact since 1ᵀb = 0, and then shifted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from solver.assembly import systems
from solver.chunks import solved_chunks
from solver.errors import SolverError
from solver.mesh import FloatArray, IntArray
from solver.softmap import SoftMap

#: Source faces of one block: a shard of a solve, whose sums are added in order. Bits depend on it.
FACE_BLOCK = 4096


@dataclass(frozen=True, eq=False)
class Potential:
    """Transportation potential of a soft map on some source faces (eq. 9); unpacks as ``q, frames``.

    Attributes
    ----------
    potential : ndarray of float64, shape (k, 2, n)
        Coefficients q_fs of Q(f, V_f^s, ·) in the target basis, per unit length on the source.
    frames : ndarray of float64, shape (k, 2, 3)
        Orthonormal tangents V_f^s of those faces.
    residual : float
        Largest ‖Aq−b‖∞ / (‖A‖∞‖q‖∞ + ‖b‖∞) over faces and directions.
    """

    potential: FloatArray
    frames: FloatArray
    residual: float

    def __iter__(self) -> Iterator[FloatArray]:
        """Yield the potential, then the frames."""
        return iter((self.potential, self.frames))


def potential(
    softmap: SoftMap,
    regularisation: float = 1e-5,
    faces: npt.ArrayLike | None = None,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Potential:
    """Transportation potential q_f^s of a soft map: A_f q_fs = b_fs, u_f · q_fs = 0 (eqs. 9, 10, 12).

    Parameters
    ----------
    softmap : SoftMap
    regularisation : float
        ε of the blend (1−ε)ρ + ε, strictly between 0 and 1.
    faces : (k,) int, optional
        Source faces to solve for, all by default.
    threads : int, optional
        Threads that share the work, one by default. The result does not depend on it.
    progress : callable, optional
        Called with the fraction done, by this thread; may raise to abort.

    Returns
    -------
    Potential
        For all faces this holds F₀ · 2 · n numbers: use `potential_block` where that is too much.

    Raises
    ------
    SolverError
        If the regularisation is out of range or a face does not exist.
    SingularSystem
        If a face's system has no trustworthy solution; names the face.
    """
    mesh = softmap.source.mesh
    chosen = np.arange(mesh.n_faces) if faces is None else _checked_faces(faces, mesh.n_faces)
    found = np.empty((chosen.size, 2, softmap.target.size))
    residual, done = 0.0, 0
    for chunk in solved_chunks(systems(softmap, regularisation), chosen, potential=True, threads=threads):
        found[done : done + chunk.faces.size] = chunk.potential
        done += chunk.faces.size
        residual = max(residual, chunk.residual)
        if progress is not None:
            progress(done / chosen.size)
    return Potential(found, mesh.frames[chosen], residual)


def potential_block(
    softmap: SoftMap,
    start: int,
    stop: int,
    regularisation: float = 1e-5,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Potential:
    """Transportation potential on source faces [start, stop), for streaming.

    Parameters
    ----------
    softmap : SoftMap
    start, stop : int
        First face, and the one after the last.
    regularisation, threads, progress
        As in `potential`.

    Returns
    -------
    Potential

    Raises
    ------
    SolverError, SingularSystem
        As in `potential`.
    """
    return potential(softmap, regularisation, np.arange(start, stop), threads, progress)


def _checked_faces(faces: npt.ArrayLike, n_faces: int) -> IntArray:
    chosen = np.asarray(faces)
    if chosen.ndim != 1 or (chosen.size and not np.issubdtype(chosen.dtype, np.integer)):
        raise SolverError(f"faces must be a list of integers, not {chosen.dtype} of shape {chosen.shape}")
    outside = np.flatnonzero((chosen < 0) | (chosen >= n_faces))
    if outside.size:
        face = int(chosen[outside[0]])
        raise SolverError(f"face {face} is not one of 0 … {n_faces - 1}", index=int(outside[0]), value=face)
    return chosen.astype(np.int64)
