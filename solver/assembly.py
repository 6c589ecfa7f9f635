"""What the systems A_f q = b_f are made of (eqs. 10–12): the tensor W of a target, gradients of a source.

With c̃_f = (1−ε) c_f + ε ∫β the blend costs nothing: Σⱼ ∫βⱼ μⱼ = 1, so A_f = Σⱼ c̃_fj Wⱼ and u_f = Uᵀ c̃_f.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from solver.basis import Basis
from solver.errors import InvalidBasis, InvalidSoftMap, SolverError
from solver.fem import hat_gradients
from solver.mesh import FloatArray, IntArray
from solver.softmap import SoftMap

#: Faces of a target whose products of gradients are held at once (a few MB).
_TENSOR_FACES = 16384


@dataclass(frozen=True, eq=False)
class FaceGradients:
    """Gradients ∇βⱼ|_f of the functions that do not vanish on a face, aligned with `Basis.face_means`.

    Attributes
    ----------
    indptr : ndarray of int64, shape (F + 1,)
        Where each face's functions start.
    functions : ndarray of int64, shape (nnz,)
        Which functions live on a face, ascending.
    means : ndarray of float64, shape (nnz,)
        Mean of the function on the face.
    vectors : ndarray of float64, shape (nnz, 3)
        Its gradient on the unit mesh, in 1 / √area.
    """

    indptr: IntArray
    functions: IntArray
    means: FloatArray
    vectors: FloatArray


@dataclass(frozen=True, eq=False)
class TargetTensor:
    """W as a sparse matrix: row e holds (Wⱼ[rows[e], columns[e]])ⱼ, for each entry e of the lower pattern.

    Attributes
    ----------
    rows, columns : ndarray of int64, shape (E,)
        Entries on and below the diagonal, in lexicographic order.
    values : csr_array of float64, shape (E, n)
        So that ``values @ c`` are the entries of Σⱼ cⱼ Wⱼ.
    """

    rows: IntArray
    columns: IntArray
    values: sparse.csr_array


_tensors: weakref.WeakKeyDictionary[Basis, TargetTensor] = weakref.WeakKeyDictionary()


def face_gradients(basis: Basis) -> FaceGradients:
    """Gradient ∇βⱼ|_f = Σ_corners βⱼ(corner) ∇λ_corner of each function on each face of its support.

    Parameters
    ----------
    basis : Basis

    Returns
    -------
    FaceGradients

    Raises
    ------
    InvalidBasis
        Never here: the basis was checked when it was made.
    """
    means = sparse.csr_array(basis.face_means, copy=True)
    means.sort_indices()
    faces_of = np.repeat(np.arange(means.shape[0], dtype=np.int64), np.diff(means.indptr))
    keys = faces_of * means.shape[1] + means.indices
    hats = hat_gradients(basis.mesh)
    vectors = np.zeros((means.nnz, 3))
    for corner in range(3):
        values = sparse.coo_array(basis.functions[basis.mesh.faces[:, corner]])
        place = np.searchsorted(keys, values.row.astype(np.int64) * means.shape[1] + values.col)
        vectors[place] += values.data[:, None] * hats[values.row, corner]
    return FaceGradients(means.indptr.astype(np.int64), means.indices.astype(np.int64), means.data, vectors)


def target_tensor(basis: Basis) -> TargetTensor:
    """Tensor Wⱼ[j', k] = ∫ μⱼ ⟨∇βⱼ', ∇βₖ⟩ of a target basis (eq. 11), computed once for each basis.

    Parameters
    ----------
    basis : Basis

    Returns
    -------
    TargetTensor

    Raises
    ------
    InvalidBasis
        If a function has no support on any face.
    """
    tensor = _tensors.get(basis)
    if tensor is None:
        tensor = _tensors[basis] = _target_tensor(basis)
    return tensor


def _target_tensor(basis: Basis) -> TargetTensor:
    gradients = face_gradients(basis)
    n = basis.size
    counts = np.diff(gradients.indptr)
    keys = [np.unique(_pairs(gradients, counts, chunk, n)[1]) for chunk in _chunks(counts)]
    entries = np.unique(np.concatenate(keys))
    rows, columns = np.divmod(entries, n)
    absent = np.setdiff1d(np.arange(n), rows[rows == columns])
    if absent.size:
        raise InvalidBasis(f"function {absent[0]} vanishes on every face", index=int(absent[0]))
    densities = sparse.csr_array(basis.densities)
    values = sparse.csr_array((entries.size, n))
    for chunk in _chunks(counts):
        face, key, product = _pairs(gradients, counts, chunk, n)
        product *= basis.mesh.face_areas[chunk][face]
        products = sparse.csr_array(
            (product, (np.searchsorted(entries, key), face)), shape=(entries.size, chunk.size)
        )
        values = values + products @ densities[chunk]
    values.sort_indices()
    return TargetTensor(rows, columns, values)


def _chunks(counts: IntArray) -> list[IntArray]:
    """Runs of faces with the same number of functions."""
    chunks = []
    for count in np.unique(counts):
        same = np.flatnonzero(counts == count)
        chunks += [same[start : start + _TENSOR_FACES] for start in range(0, same.size, _TENSOR_FACES)]
    return chunks


def _pairs(
    gradients: FaceGradients, counts: IntArray, chunk: IntArray, n: int
) -> tuple[IntArray, IntArray, FloatArray]:
    """Pairs of functions on each face of a chunk: place in the chunk, key j'·n + k with j' ≥ k, ⟨∇βⱼ', ∇βₖ⟩."""
    count = int(counts[chunk[0]])
    here = gradients.indptr[chunk][:, None] + np.arange(count)
    functions, vectors = gradients.functions[here], gradients.vectors[here]
    above, below = np.tril_indices(count)
    key = functions[:, above] * n + functions[:, below]
    product = np.einsum("fpx,fpx->fp", vectors[:, above], vectors[:, below])
    face = np.repeat(np.arange(chunk.size, dtype=np.int64), above.size)
    return face, key.ravel(), product.ravel()


@dataclass(frozen=True, eq=False)
class FaceSystems:
    """Everything the systems of a soft map's faces are computed from, a few rows at a time.

    Attributes
    ----------
    softmap : SoftMap
    regularisation : float
        ε of the blend (1−ε)ρ + ε.
    tensor : TargetTensor
        W of the target.
    means : csr_array of float64, shape (F₀, n₀)
        mean_f(β₀ᵢ).
    slopes : tuple of two csr_array of float64, shape (F₀, n₀)
        g_fs[i] = ⟨∇₀β₀ᵢ|_f, V_f^s⟩ for s = 1, 2.
    received : ndarray of float64, shape (n₀, n)
        C U: what u and b are mixed from.
    """

    softmap: SoftMap
    regularisation: float
    tensor: TargetTensor
    means: sparse.csr_array
    slopes: tuple[sparse.csr_array, sparse.csr_array]
    received: FloatArray

    def weights(self, faces: IntArray | slice) -> FloatArray:
        """Mixing weights c_f = Cᵀ mean_f(β₀), float64 (len(faces), n); rows sum to 1."""
        return np.asarray(self.means[faces] @ self.softmap.coefficients)

    def blended(self, weights: FloatArray) -> FloatArray:
        """Blend c̃_f = (1−ε) c_f + ε ∫β, float64 (len(faces), n)."""
        return (1 - self.regularisation) * weights + self.regularisation * self.softmap.target.integrals

    def right_sides(self, faces: IntArray | slice) -> FloatArray:
        """Right-hand sides b_fs = (1−ε) Uᵀ Cᵀ g_fs, float64 (len(faces), 2, n)."""
        sides = [np.asarray(slope[faces] @ self.received) for slope in self.slopes]
        right_sides: FloatArray = (1 - self.regularisation) * np.stack(sides, axis=1)
        return right_sides


def face_systems(softmap: SoftMap, regularisation: float) -> FaceSystems:
    """Gather what the systems of a soft map are computed from (eqs. 10–12).

    Parameters
    ----------
    softmap : SoftMap
    regularisation : float
        ε, strictly between 0 and 1.

    Returns
    -------
    FaceSystems

    Raises
    ------
    SolverError
        If the regularisation is not strictly between 0 and 1.
    InvalidSoftMap
        If the target's mesh is not connected.
    """
    if not 0 < regularisation < 1:
        raise SolverError(
            f"the regularisation must be strictly between 0 and 1, not {regularisation}",
            value=float(regularisation),
        )
    target = softmap.target
    if target.mesh.n_components != 1:
        raise InvalidSoftMap(
            f"the target of a soft map must be connected; this one has {target.mesh.n_components} components",
            value=target.mesh.n_components,
        )
    gradients = face_gradients(softmap.source)
    frames = softmap.source.mesh.frames
    shape = (softmap.source.mesh.n_faces, softmap.source.size)
    faces_of = np.repeat(np.arange(shape[0]), np.diff(gradients.indptr))
    along = np.einsum("ex,esx->es", gradients.vectors, frames[faces_of])

    def aligned(entries: FloatArray) -> sparse.csr_array:
        return sparse.csr_array(
            (np.ascontiguousarray(entries), gradients.functions, gradients.indptr), shape=shape
        )

    return FaceSystems(
        softmap=softmap,
        regularisation=float(regularisation),
        tensor=target_tensor(target),
        means=aligned(gradients.means),
        slopes=(aligned(along[:, 0]), aligned(along[:, 1])),
        received=np.asarray(softmap.coefficients @ target.overlap),
    )
