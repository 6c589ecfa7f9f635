"""Piecewise-linear finite elements on a mesh of unit area (section 4.1): gradients, mass, stiffness."""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt
import robust_laplacian
from scipy import sparse

from solver.errors import InvalidMesh
from solver.mesh import FloatArray, IntArray, Mesh


def hat_gradients(mesh: Mesh) -> FloatArray:
    """Gradient ∇λᵢ = n × eᵢ / 2A of each corner's hat function, constant on its face.

    Parameters
    ----------
    mesh : Mesh
        Any mesh; the gradients are those of its unit mesh.

    Returns
    -------
    ndarray of float64, shape (F, 3 corners, 3)
        In 1 / √area. The three of a face sum to zero.

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    across = np.cross(mesh.normals[:, None, :], mesh.opposite_edges)
    gradients: FloatArray = across / (2 * mesh.face_areas)[:, None, None]
    return gradients


def mass(mesh: Mesh) -> FloatArray:
    """Lumped mass of each vertex, a third of the area of its faces.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.

    Returns
    -------
    ndarray of float64, shape (V,)
        In units of the total area: they sum to 1, and are 0 at unreferenced vertices.

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    thirds = np.repeat(mesh.face_areas / 3, 3)
    corners = mesh.faces.ravel()
    return np.bincount(corners, weights=thirds, minlength=mesh.n_vertices).astype(np.float64, copy=False)


def stiffness(mesh: Mesh) -> sparse.csr_array:
    """Cotangent stiffness K[v, w] = ∫ ⟨∇λ_v, ∇λ_w⟩, positive semi-definite.

    Parameters
    ----------
    mesh : Mesh
        Any mesh, with its natural condition at boundaries.

    Returns
    -------
    csr_array of float64, shape (V, V)
        Symmetric and without unit (energy is conformally invariant). Each diagonal entry is minus the sum of
        the rest of its row, so constants are in the kernel to rounding.

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    edges = mesh.opposite_edges
    after, before = [1, 2, 0], [2, 0, 1]
    # Corner k sees the edge between its two neighbours; eᵢ·eⱼ / 4A = −cot / 2 there.
    halves = np.einsum("fkx,fkx->fk", edges[:, after], edges[:, before]) / (4 * mesh.face_areas)[:, None]
    v, w = mesh.faces[:, after].ravel(), mesh.faces[:, before].ravel()
    return _with_zero_row_sums(v, w, halves.ravel(), mesh.n_vertices)


def intrinsic_delaunay_stiffness(mesh: Mesh) -> sparse.csr_array:
    """Stiffness on the intrinsic Delaunay triangulation: no positive entry off the diagonal.

    Parameters
    ----------
    mesh : Mesh
        Any mesh. Its tufted cover is used, two sheets joined at boundaries and non-manifold edges (Sharp and
        Crane 2020), so edges near a boundary may pass behind it.

    Returns
    -------
    csr_array of float64, shape (V, V)
        Like `stiffness`, but an M-matrix, for which the discrete maximum principle holds.

    Raises
    ------
    InvalidMesh
        The triangulation could not be made.
    """
    kept = np.flatnonzero(mesh.referenced)
    renumbered = np.cumsum(mesh.referenced) - 1
    try:
        laplacian, _ = robust_laplacian.mesh_laplacian(mesh.unit_vertices[kept], renumbered[mesh.faces])
    except RuntimeError as error:  # whatever the C++ library throws
        raise InvalidMesh(f"the mesh has no intrinsic Delaunay triangulation: {error}") from error
    upper = sparse.coo_array(sparse.triu(laplacian, k=1))
    # Rounding makes some entries of flat edges slightly positive; a Delaunay edge has none.
    entries = np.minimum(upper.data, 0.0)
    return _with_zero_row_sums(kept[upper.row], kept[upper.col], entries, mesh.n_vertices)


def face_mean(mesh: Mesh) -> sparse.csr_array:
    """Mean of a piecewise-linear function on each face, as a matrix of thirds.

    Parameters
    ----------
    mesh : Mesh
        Any mesh.

    Returns
    -------
    csr_array of float64, shape (F, V)
        ``face_mean(mesh) @ f`` is the per-face mean of ``f``.

    Raises
    ------
    InvalidMesh
        Never here: the mesh was checked when it was made.
    """
    thirds = np.full(3 * mesh.n_faces, 1 / 3)
    starts = np.arange(0, 3 * mesh.n_faces + 1, 3)
    return sparse.csr_array((thirds, mesh.faces.ravel(), starts), shape=(mesh.n_faces, mesh.n_vertices))


def _with_zero_row_sums(
    v: npt.NDArray[np.integer], w: IntArray, entries: FloatArray, size: int
) -> sparse.csr_array:
    """Symmetric matrix with the given entries at (v, w) and (w, v), summed, and rows that sum to zero."""
    rows, columns = np.concatenate([v, w]), np.concatenate([w, v])
    values = np.concatenate([entries, entries])
    off_diagonal = sparse.csr_array((values, (rows, columns)), shape=(size, size))
    return cast(sparse.csr_array, off_diagonal - sparse.diags_array(off_diagonal.sum(axis=1)).tocsr())
