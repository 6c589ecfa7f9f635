"""What the systems of the potential are made of (eq. 11): gradients on faces, the tensor W of a target."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from solver.basis import Basis
from solver.errors import InvalidBasis
from solver.fem import hat_gradients
from solver.mesh import FloatArray, IntArray

#: Faces of a target whose products of gradients are held at once (a few MB).
_TENSOR_FACES = 16384


@dataclass(frozen=True, eq=False)
class FaceGradients:
    """Gradients ∇βⱼ|_f of the functions that do not vanish on a face, aligned with `Basis.face_means`.

    Attributes
    ----------
    start : ndarray of int64, shape (F + 1,)
        Where each face's functions start.
    functions : ndarray of int64, shape (nnz,)
        Which functions live on a face, ascending.
    means : ndarray of float64, shape (nnz,)
        Mean of the function on the face.
    vectors : ndarray of float64, shape (nnz, 3)
        Its gradient on the unit mesh, in 1 / √area.
    """

    start: IntArray
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
    """Tensor Wⱼ[j', k] = ∫ μⱼ ⟨∇βⱼ', ∇βₖ⟩ of a target basis (eq. 11).

    Parameters
    ----------
    basis : Basis

    Returns
    -------
    TargetTensor

    Raises
    ------
    InvalidBasis
        If a function vanishes on every face.
    """
    gradients = face_gradients(basis)
    n = basis.size
    counts = np.diff(gradients.start)
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
    """Pairs of functions on each face of a chunk: place in the chunk, key j'·n + k (j' ≥ k), ⟨∇βⱼ', ∇βₖ⟩."""
    count = int(counts[chunk[0]])
    here = gradients.start[chunk][:, None] + np.arange(count)
    functions, vectors = gradients.functions[here], gradients.vectors[here]
    above, below = np.tril_indices(count)
    key = functions[:, above] * n + functions[:, below]
    product = np.einsum("fpx,fpx->fp", vectors[:, above], vectors[:, below])
    face = np.repeat(np.arange(chunk.size, dtype=np.int64), above.size)
    return face, key.ravel(), product.ravel()
