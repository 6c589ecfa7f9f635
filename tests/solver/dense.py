"""The mathematics once more, dense, slow and independent of the solver: what kernels are compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.basis import Basis
from solver.softmap import SoftMap


@dataclass(frozen=True)
class DenseEnergy:
    """Potential, density, energy and gradient of a soft map."""

    potential: np.ndarray
    density: np.ndarray
    energy: float
    gradient: np.ndarray
    regularisation_energy: float


def face_gradients(basis: Basis) -> np.ndarray:
    """Gradient of every function on every face, (F, n, 3), from its differences along two edges."""
    values = basis.functions.toarray()
    p = basis.mesh.unit_vertices[basis.mesh.faces]
    edges = np.stack([p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]], axis=1)
    corner = values[basis.mesh.faces]
    rises = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=1)
    return np.einsum("fxe,fen->fnx", np.linalg.pinv(edges), rises)


def tensors(basis: Basis) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Face means (F, n), U (n, n), W (n, n, n) and K (n, n), as eq. 11 says."""
    areas = basis.mesh.face_areas
    means = basis.functions.toarray()[basis.mesh.faces].mean(axis=1)
    densities = means / (areas @ means)
    gradients = face_gradients(basis)
    overlap = np.einsum("f,fj,fk->jk", areas, densities, means)
    tensor, stiffness = np.zeros((basis.size,) * 3), np.zeros((basis.size,) * 2)
    for start in range(0, len(areas), 256):
        some = slice(start, start + 256)
        products = np.einsum("f,fax,fbx->fab", areas[some], gradients[some], gradients[some])
        tensor += np.tensordot(densities[some], products, axes=(0, 0))
        stiffness += products.sum(axis=0)
    return means, overlap, tensor, stiffness


def dense_dirichlet(
    softmap: SoftMap, regularisation: float = 1e-5, faces: np.ndarray | None = None
) -> DenseEnergy:
    """Solve faces (all by default) by a bordered dense system, u · q = 0 being a row of it."""
    source, c, eps = softmap.source, softmap.coefficients, regularisation
    means = source.functions.toarray()[source.mesh.faces].mean(axis=1)
    slopes = np.einsum("fnx,fsx->fsn", face_gradients(source), source.mesh.frames)
    target_means, overlap, tensor, stiffness = tensors(softmap.target)
    integrals = softmap.target.mesh.face_areas @ target_means
    n = softmap.target.size
    chosen = np.arange(source.mesh.n_faces) if faces is None else faces
    areas = source.mesh.face_areas[chosen]
    potential = np.zeros((len(areas), 2, n))
    density = np.zeros(len(areas))
    gradient = np.zeros_like(c)
    ridge = 0.0
    for k, (f, area) in enumerate(zip(chosen, areas, strict=True)):
        weights = c.T @ means[f]
        matrix = (1 - eps) * np.einsum("j,jab->ab", weights, tensor) + eps * stiffness
        mean = (1 - eps) * overlap.T @ weights + eps * integrals
        right = (1 - eps) * slopes[f] @ c @ overlap
        # Scaled to unit diagonal, so that the reference itself is accurate on peaked maps.
        scale = np.append(1 / np.sqrt(np.diag(matrix)), 1.0) if n > 1 else np.ones(2)
        bordered = np.block([[matrix, mean[:, None]], [mean[None, :], np.zeros((1, 1))]])
        full = np.vstack([right.T, np.zeros((1, 2))])
        solved = scale[:, None] * np.linalg.solve(scale[:, None] * bordered * scale, scale[:, None] * full)
        q = solved[:-1].T
        potential[k] = q
        density[k] = (right * q).sum()
        forms = np.einsum("sa,jab,sb->j", q, tensor, q)
        gradient += (1 - eps) * area * (2 * slopes[f].T @ (overlap @ q.T).T - np.outer(means[f], forms))
        ridge += eps * area * np.einsum("sa,ab,sb->", q, stiffness, q)
    return DenseEnergy(potential, density, float(areas @ density), gradient, ridge)
