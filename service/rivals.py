"""The systems of some faces, solved face by face with what everybody has: what the solver is compared with.

Each rival gets its matrices for nothing: they are assembled, grounded and laid out before the clock starts.
The solver is used for W, C and the densities to agree with, never for the solutions.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from solver import SoftMap

Floats = NDArray[np.float64]
#: Solves A x = b for all faces, one after another: (k, n, 2).
Rival = Callable[[], Floats]


@dataclass(frozen=True, eq=False)
class FaceSystems:
    """Systems A_f q_fs = b_fs of some faces, each grounded at its heaviest function.

    Attributes
    ----------
    faces : ndarray of int64, shape (k,)
    matrices : list of csc_array, shape (n − 1, n − 1)
        A_f without its heaviest row and column, k of them.
    right : ndarray of float64, shape (k, n − 1, 2)
        b_fs there.
    """

    faces: NDArray[np.int64]
    matrices: list[Any]
    right: Floats

    def densities(self, solutions: Floats) -> Floats:
        """Densities e(f) = Σ_s b_fs · q_fs, float64 (k,)."""
        found: Floats = (self.right * solutions).sum(axis=(1, 2))
        return found

    def residual(self, solutions: Floats) -> float:
        """Largest ‖Aq − b‖∞ / (‖A‖∞ ‖q‖∞ + ‖b‖∞)."""
        worst = 0.0
        for matrix, x, b in zip(self.matrices, solutions, self.right, strict=True):
            scale = abs(matrix).sum(axis=1).max() * np.abs(x).max() + np.abs(b).max()
            worst = max(worst, float(np.abs(matrix @ x - b).max() / scale))
        return worst


def face_systems(softmap: SoftMap, faces: NDArray[np.int64], regularisation: float = 1e-5) -> FaceSystems:
    """Assemble the systems of some faces (eqs. 10–12), the slow way.

    Parameters
    ----------
    softmap : SoftMap
    faces : ndarray of int64, shape (k,)
    regularisation : float
        ε of the blend (1−ε)ρ + ε.

    Returns
    -------
    FaceSystems

    Raises
    ------
    SolverError
        If a function of the target vanishes on every face.
    """
    from scipy import sparse  # noqa: PLC0415  (the command line starts without)

    from solver.fem import hat_gradients  # noqa: PLC0415
    from solver.tensor import target_tensor  # noqa: PLC0415

    source, target = softmap.source, softmap.target
    tensor, n = target_tensor(target), target.size
    weights = (source.face_means[faces] @ softmap.coefficients) * (1 - regularisation)
    weights += regularisation * target.integrals
    slopes = np.einsum("fcx,fsx->fsc", hat_gradients(source.mesh)[faces], source.mesh.frames[faces])
    received = (1 - regularisation) * (softmap.coefficients @ target.overlap)
    matrices, right = [], []
    for face, weight, slope in zip(faces, weights, slopes, strict=True):
        lower = tensor.values @ weight
        off = tensor.rows != tensor.columns
        rows = np.concatenate([tensor.rows, tensor.columns[off]])
        columns = np.concatenate([tensor.columns, tensor.rows[off]])
        whole = sparse.csc_array((np.concatenate([lower, lower[off]]), (rows, columns)), shape=(n, n))
        kept = np.delete(np.arange(n), int(np.argmax(weight)))
        matrices.append(whole[kept][:, kept])
        corners = source.functions[source.mesh.faces[face]] @ received
        right.append((slope @ corners)[:, kept].T)
    return FaceSystems(faces, matrices, np.ascontiguousarray(right))


def rivals(systems: FaceSystems) -> dict[str, Rival]:
    """Every rival that this machine has, by name, ready to be timed.

    Parameters
    ----------
    systems : FaceSystems

    Returns
    -------
    dict
        LAPACK (dense), SuperLU (sparse, as SciPy brings it), and CHOLMOD if CVXOPT is installed.

    Raises
    ------
    MemoryError
        If dense matrices of all faces do not fit.
    """
    found = {"LAPACK, dense": _lapack(systems), "SuperLU": _superlu(systems)}
    if importlib.util.find_spec("cvxopt") is not None:
        found["CHOLMOD"] = _cholmod(systems)
    return found


def timed(act: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds that something takes, and what it returns."""
    begun = time.perf_counter()
    made = act()
    return time.perf_counter() - begun, made


def _lapack(systems: FaceSystems) -> Rival:
    from scipy.linalg import lapack  # noqa: PLC0415

    matrices = [np.asfortranarray(matrix.toarray()) for matrix in systems.matrices]
    right = [np.asfortranarray(b) for b in systems.right]
    room = np.empty_like(matrices[0])

    def solve() -> Floats:
        solutions = []
        for matrix, b in zip(matrices, right, strict=True):
            room[:] = matrix  # the factor overwrites it
            factor, _ = lapack.dpotrf(room, lower=1, clean=0, overwrite_a=1)
            solutions.append(lapack.dpotrs(factor, b, lower=1)[0])
        return np.array(solutions)

    return solve


def _superlu(systems: FaceSystems) -> Rival:
    from scipy.sparse.linalg import splu  # noqa: PLC0415

    symmetric = {"SymmetricMode": True}

    def solve() -> Floats:
        return np.array(
            [
                splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric).solve(b)
                for matrix, b in zip(systems.matrices, systems.right, strict=True)
            ]
        )

    return solve


def _cholmod(systems: FaceSystems) -> Rival:
    """One symbolic analysis for all faces grounded alike, as the pattern allows."""
    from cvxopt import cholmod, matrix, spmatrix  # noqa: PLC0415
    from scipy import sparse  # noqa: PLC0415

    lower = [sparse.coo_array(sparse.tril(each)) for each in systems.matrices]
    given = [spmatrix(each.data, each.row.tolist(), each.col.tolist(), each.shape) for each in lower]
    right = [matrix(b) for b in systems.right]
    analysed: dict[bytes, Any] = {}
    plans = []
    for each, entries in zip(given, lower, strict=True):
        key = entries.row.tobytes() + entries.col.tobytes()
        plans.append(analysed.setdefault(key, cholmod.symbolic(each)))

    def solve() -> Floats:
        solutions = []
        for each, plan, b in zip(given, plans, right, strict=True):
            cholmod.numeric(each, plan)
            x = +b
            cholmod.solve(plan, x)
            solutions.append(np.array(x))
        return np.array(solutions)

    return solve
