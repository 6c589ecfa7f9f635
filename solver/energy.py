"""Dirichlet and bijectivity energies of a soft map (§4.5, §4.6): value, density and gradient side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from solver.assembly import Systems, systems
from solver.chunks import solved_chunks
from solver.errors import SolverError
from solver.mesh import FloatArray, IntArray
from solver.potential import FACE_BLOCK
from solver.softmap import SoftMap


@dataclass(frozen=True, eq=False)
class Dirichlet:
    """Dirichlet energy of a soft map over some source faces.

    Attributes
    ----------
    energy : float
        Σ_f area₀(f) e(f).
    density : ndarray of float64, shape (k,)
        e(f), per unit source area.
    gradient : ndarray of float64, shape (n₀, n), or None
        Exact derivative of the energy by the coefficients, if asked for; unique up to row constants.
    residual : float
        Largest relative residual of the systems solved.
    """

    energy: float
    density: FloatArray
    gradient: FloatArray | None
    residual: float


@dataclass(frozen=True, eq=False)
class Bijectivity:
    """Bijectivity energy of a soft map.

    Attributes
    ----------
    energy : float
        Σ_t area(t) b(t)².
    density : ndarray of float64, shape (F,)
        b(t), mass received per unit target area.
    gradient : ndarray of float64, shape (n₀, n)
        Derivative of the energy by the coefficients.
    """

    energy: float
    density: FloatArray
    gradient: FloatArray


def dirichlet(
    softmap: SoftMap,
    regularisation: float = 1e-5,
    gradient: bool = False,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Dirichlet:
    """Dirichlet energy E_D = Σ_f area₀(f) e(f), density e(f) = Σ_s b_fs · q_fs, gradient (eq. 13, prop. 7).

    Parameters
    ----------
    softmap : SoftMap
    regularisation : float
        ε of the blend (1−ε)ρ + ε, strictly between 0 and 1. The gradient is that of the blended energy.
    gradient : bool
        Whether to return the gradient too.
    threads : int, optional
        Threads that share the work, one by default. The result does not depend on it.
    progress : callable, optional
        Called with the fraction done; may raise to abort.

    Returns
    -------
    Dirichlet

    Raises
    ------
    SolverError
        If the regularisation is out of range.
    SingularSystem
        If a face's system has no trustworthy solution; names the face.
    """
    n_faces = softmap.source.mesh.n_faces
    solved = systems(softmap, regularisation)

    def part(start: int) -> Dirichlet:
        stop = min(start + FACE_BLOCK, n_faces)
        done = None if progress is None else lambda x: progress((start + x * (stop - start)) / n_faces)
        return _block(solved, np.arange(start, stop), gradient, threads, done)

    return gather_dirichlet(part(start) for start in range(0, n_faces, FACE_BLOCK))


def dirichlet_block(
    softmap: SoftMap,
    start: int,
    stop: int,
    regularisation: float = 1e-5,
    gradient: bool = False,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Dirichlet:
    """Dirichlet energy of source faces [start, stop): their share of the sum, density and gradient.

    Parameters
    ----------
    softmap : SoftMap
    start, stop : int
        First face, and the one after the last.
    regularisation, gradient, threads, progress
        As in `dirichlet`.

    Returns
    -------
    Dirichlet

    Raises
    ------
    SolverError
        If the regularisation or the faces are out of range.
    SingularSystem
        If a face's system has no trustworthy solution; names the face.
    """
    n_faces = softmap.source.mesh.n_faces
    if not 0 <= start < stop <= n_faces:
        raise SolverError(f"[{start}, {stop}) is no block of the faces 0 … {n_faces - 1}")
    return _block(systems(softmap, regularisation), np.arange(start, stop), gradient, threads, progress)


def _block(
    solved: Systems,
    faces: IntArray,
    gradient: bool,
    threads: int | None,
    progress: Callable[[float], None] | None,
) -> Dirichlet:
    softmap, regularisation = solved.softmap, solved.regularisation
    density = np.empty(faces.size)
    slopes, forms = np.zeros((2, softmap.source.size if gradient else 0, softmap.target.size))
    residual, done = 0.0, 0
    for chunk in solved_chunks(solved, faces, gradient=gradient, threads=threads):
        density[done : done + chunk.faces.size] = chunk.density
        done += chunk.faces.size
        residual = max(residual, chunk.residual)
        slopes[chunk.functions] += chunk.slopes
        forms[chunk.functions] += chunk.forms
        if progress is not None:
            progress(done / density.size)
    energy = math.fsum(softmap.source.mesh.face_areas[faces] * density)
    # Prop. 7: D = (1−ε) [ 2 Σ_fs area₀ g_fs (U q_fs)ᵀ − Σ_f area₀ mean_f(β₀) (Σ_s q_fsᵀ Wⱼ q_fs)ⱼ ].
    descent = (1 - regularisation) * (2 * (softmap.target.overlap @ slopes.T).T - forms) if gradient else None
    return Dirichlet(energy, density, descent, residual)


def gather_dirichlet(blocks: Iterable[Dirichlet]) -> Dirichlet:
    """Dirichlet energy of consecutive blocks of faces, added in order.

    Parameters
    ----------
    blocks : iterable of Dirichlet
        Consumed one by one. All with a gradient, or all without.

    Returns
    -------
    Dirichlet

    Raises
    ------
    SolverError
        If there is no block.
    """
    energy, residual, densities = 0.0, 0.0, []
    total: FloatArray | None = None
    for block in blocks:
        energy += block.energy
        residual = max(residual, block.residual)
        densities.append(block.density)
        if block.gradient is not None:
            total = block.gradient if total is None else total + block.gradient
    if not densities:
        raise SolverError("there is no block to gather")
    return Dirichlet(energy, np.concatenate(densities), total, residual)


def bijectivity(softmap: SoftMap) -> Bijectivity:
    """Bijectivity energy E_b = Σ_t area(t) b(t)², density b(t) = Σ_ij B₀ᵢ C_ij μⱼ(t), gradient (eq. 7, §4.6).

    Parameters
    ----------
    softmap : SoftMap

    Returns
    -------
    Bijectivity
        Not blended. The uniform map has energy 1, the least possible.

    Raises
    ------
    SolverError
        Never here: the soft map was checked when it was made.
    """
    received = softmap.source.integrals @ softmap.coefficients
    density = softmap.target.densities @ received
    gradient = 2 * np.outer(softmap.source.integrals, softmap.target.density_products @ received)
    return Bijectivity(math.fsum(softmap.target.mesh.face_areas * density**2), density, gradient)
