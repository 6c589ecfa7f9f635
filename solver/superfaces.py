"""A source gathered into a few super-faces: what is left of eqs. 10–13 when nearby faces are taken as one.

Faces in one small patch see nearly the same mixing weights c_f, so their systems A_f are nearly one. Gathered
over a patch κ, only the second moment Σ_f area₀ Σ_s g_fs g_fsᵀ of the slopes matters, and two directions of
it are kept. Curvature of the energy then costs what a source of a few hundred faces would.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from solver.basis import Basis
from solver.geodesics import farthest_point_samples
from solver.mesh import FloatArray, IntArray
from solver.tensor import face_gradients


@dataclass(frozen=True, eq=False)
class SuperFaces:
    """Patches of source faces, each with the mean of the functions on it and two slopes.

    Attributes
    ----------
    means : csr_array of float64, shape (K, n₀)
        Area-weighted mean m_κ of each function on each patch; rows sum to 1.
    slopes : tuple of two csr_array of float64, shape (K, n₀)
        √area₀ g_κs: the two leading directions of the patch's second moment, scaled to keep its trace.
    """

    means: sparse.csr_array
    slopes: tuple[sparse.csr_array, sparse.csr_array]

    @property
    def count(self) -> int:
        """Number of patches K."""
        return int(self.means.shape[0])


def super_faces(basis: Basis, count: int) -> SuperFaces:
    """Gather the faces of a mesh into patches: farthest-point cells, of about equal diameter.

    Parameters
    ----------
    basis : Basis
        Of the source.
    count : int
        Patches wanted; where there are no more faces than that, each stays alone and nothing is lost.

    Returns
    -------
    SuperFaces
        A few less than asked for where a cell is the first corner's of no face.

    Raises
    ------
    InvalidBasis
        Never here: the basis was checked when it was made.
    """
    mesh = basis.mesh
    gradients = face_gradients(basis)
    counts = np.diff(gradients.start)
    along = np.einsum("esx,ex->es", np.repeat(mesh.frames, counts, axis=0), gradients.vectors)
    along *= np.sqrt(np.repeat(mesh.face_areas, counts))[:, None]

    def aligned(values: FloatArray) -> sparse.csr_array:
        shape = (mesh.n_faces, basis.size)
        return sparse.csr_array((values.copy(), gradients.functions, gradients.start), shape=shape)

    patch = np.arange(mesh.n_faces) if count >= mesh.n_faces else _patches(basis, count)
    gather = sparse.csr_array((mesh.face_areas, (patch, np.arange(mesh.n_faces))))
    means = sparse.diags_array(1 / gather.sum(axis=1)) @ (gather @ aligned(gradients.means))
    weighted = [aligned(along[:, s]) for s in range(2)]
    by_patch = np.argsort(patch, kind="stable")
    members = np.split(by_patch, np.searchsorted(patch[by_patch], np.arange(1, gather.shape[0])))
    patches, functions, slopes = [], [], []
    for k, faces in enumerate(members):
        rows = sparse.csc_array(sparse.vstack([slope[faces] for slope in weighted]))
        here = np.flatnonzero(np.diff(rows.indptr))
        slopes.append(_two_directions(rows[:, here].toarray()))
        patches.append(np.full(here.size, k))
        functions.append(here)
    where = (np.concatenate(patches), np.concatenate(functions))
    two = np.concatenate(slopes)
    first, second = (sparse.csr_array((two[:, s], where), shape=means.shape) for s in range(2))
    return SuperFaces(sparse.csr_array(means), (first, second))


def _patches(basis: Basis, count: int) -> IntArray:
    """Patch of each face: the farthest-point cell of its first corner, counted without gaps."""
    mesh = basis.mesh
    count = min(count, int(mesh.referenced.sum()))
    cells = farthest_point_samples(mesh, count, basis.samples[:count]).cells
    patch: IntArray = np.unique(cells[mesh.faces[:, 0]], return_inverse=True)[1]
    return patch


def _two_directions(slopes: FloatArray) -> FloatArray:
    """Two leading right singular vectors times singular values, scaled to the trace of all, (k, 2)."""
    squares, vectors = np.linalg.eigh(slopes.T @ slopes)
    squares = np.maximum(squares, 0.0)
    leading = squares[-2:]
    two = np.zeros((slopes.shape[1], 2))
    if leading.sum() > 0:
        two[:, : leading.size] = vectors[:, -2:] * np.sqrt(leading * (squares.sum() / leading.sum()))
    return two
