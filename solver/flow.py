"""How the mass of a soft map moves on the target as its source point moves (sections 3.7 and 5.1)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from solver.basis import Basis
from solver.errors import SolverError
from solver.mesh import FloatArray, IntArray, Mesh
from solver.potential import potential
from solver.softmap import SoftMap
from solver.tensor import face_gradients

#: A direction whose tangential part is below this share of it is normal to its face.
TANGENTIAL = 1e-9


def velocity(
    softmap: SoftMap,
    face: int | npt.ArrayLike,
    direction: npt.ArrayLike,
    regularisation: float = 1e-5,
) -> FloatArray:
    """Velocity v(t) = Σ_s ⟨V, V_f^s⟩ Σⱼ q_fsj ∇βⱼ|_t of mass on the target, as the source point moves with V.

    Parameters
    ----------
    softmap : SoftMap
    face : int, or (k,) array_like of int
        Source face f, or several.
    direction : (3,) or (k, 3) array_like of float
        V at each face, in the units of the source as given; its part normal to the face is ignored.
    regularisation : float
        ε of the blend (1−ε)ρ + ε, strictly between 0 and 1.

    Returns
    -------
    ndarray of float64, shape (F, 3) or (k, F, 3)
        A vector in each target face, in the units of the target as given.

    Raises
    ------
    SolverError
        Shapes that do not match, a face that does not exist, a direction that is not finite or has no part
        along its face, a regularisation out of range; names the index.
    SingularSystem
        If a face's system has no trustworthy solution; names the face.
    """
    faces, directions = _checked(softmap.source.mesh, face, direction)
    found = _velocities(softmap, faces, directions, regularisation)
    return found[0] if np.ndim(face) == 0 else found


def momentum(
    softmap: SoftMap,
    face: int | npt.ArrayLike,
    direction: npt.ArrayLike,
    regularisation: float = 1e-5,
) -> FloatArray:
    """Momentum m(t) = ((1−ε) ρ(f, t) + ε) v(t) of mass on the target; ∫⟨m, ∇βₖ⟩ is the growth of ∫ρβₖ.

    Parameters
    ----------
    softmap, face, direction, regularisation
        As in `velocity`.

    Returns
    -------
    ndarray of float64, shape (F, 3) or (k, F, 3)
        In the units of the target as given, times a density whose mean over the target is 1.

    Raises
    ------
    SolverError, SingularSystem
        As in `velocity`.
    """
    found = velocity(softmap, face, direction, regularisation)
    found *= mass_density(softmap, face, regularisation)[..., None]
    return found


def mass_density(softmap: SoftMap, face: int | npt.ArrayLike, regularisation: float = 1e-5) -> FloatArray:
    """Density (1−ε) ρ(f, t) + ε of the mass that a source face sends to each target face.

    Parameters
    ----------
    softmap, face, regularisation
        As in `velocity`.

    Returns
    -------
    ndarray of float64, shape (F,) or (k, F)
        Its mean over the target is 1.

    Raises
    ------
    SolverError
        A face that does not exist; names the index.
    """
    faces = _checked_faces(softmap.source.mesh, face)
    weights = softmap.source.face_means[faces] @ softmap.coefficients
    density = (softmap.target.densities @ weights.T).T
    found = np.asarray((1 - regularisation) * density + regularisation)
    return found[0] if np.ndim(face) == 0 else found


def gradient_matrix(basis: Basis) -> sparse.csr_array:
    """Gradients of all functions on all faces: ``(gradient_matrix(basis) @ q).reshape(-1, 3)`` is ∇Q.

    Parameters
    ----------
    basis : Basis

    Returns
    -------
    csr_array of float64, shape (3F, n)
        In 1 / √area.

    Raises
    ------
    InvalidBasis
        Never here: the basis was checked when it was made.
    """
    gradients = face_gradients(basis)
    counts = np.diff(gradients.start)
    rows = 3 * np.repeat(np.arange(basis.mesh.n_faces), counts)[:, None] + np.arange(3)
    columns = np.repeat(gradients.functions, 3)
    shape = (3 * basis.mesh.n_faces, basis.size)
    return sparse.csr_array((gradients.vectors.ravel(), (rows.ravel(), columns)), shape=shape)


def _velocities(
    softmap: SoftMap, faces: IntArray, directions: FloatArray, regularisation: float
) -> FloatArray:
    """Return (k, F, 3) velocities; each distinct face is solved once."""
    distinct, place = np.unique(faces, return_inverse=True)
    q, frames = potential(softmap, regularisation, distinct)
    along = np.einsum("ksx,kx->ks", frames[place], directions)
    coefficients = np.einsum("ks,ksj->kj", along, q[place])
    scale = softmap.target.mesh.length_scale / softmap.source.mesh.length_scale
    vectors = gradient_matrix(softmap.target) @ coefficients.T
    return scale * np.ascontiguousarray(vectors.T).reshape(len(faces), -1, 3)


def _checked(
    source: Mesh, face: int | npt.ArrayLike, direction: npt.ArrayLike
) -> tuple[IntArray, FloatArray]:
    """Faces (k,) and tangential directions (k, 3), or refuse them with the culprit."""
    directions = np.asarray(direction)
    if directions.dtype.kind not in "iuf":
        raise SolverError("a direction is three numbers", value=str(directions.dtype))
    if directions.shape != (*np.shape(face), 3) or np.ndim(face) > 1:
        message = (
            f"{np.shape(face)} faces need directions of shape {(*np.shape(face), 3)}, not {directions.shape}"
        )
        raise SolverError(message, value=str(directions.shape))
    faces = _checked_faces(source, face)
    directions = directions.reshape(-1, 3).astype(np.float64)
    for k, (one, vector) in enumerate(zip(faces, directions, strict=True)):
        if not np.isfinite(vector).all():
            raise SolverError(f"direction {k} is not finite", index=k, value=str(vector.tolist()))
        if not np.linalg.norm(source.frames[one] @ vector) > TANGENTIAL * np.linalg.norm(vector):
            message = f"direction {k} has no part along face {one}"
            raise SolverError(message, index=k, value=str(vector.tolist()))
    return faces, directions


def _checked_faces(source: Mesh, face: int | npt.ArrayLike) -> IntArray:
    """Faces (k,), or refuse them with the culprit."""
    faces = np.atleast_1d(np.asarray(face))
    if faces.ndim > 1 or not np.issubdtype(faces.dtype, np.integer):
        message = f"a face is an integer, counted from 0, not {faces.dtype} of shape {faces.shape}"
        raise SolverError(message, value=str(faces.dtype))
    stray = np.flatnonzero((faces < 0) | (faces >= source.n_faces))
    if stray.size:
        k = int(stray[0])
        raise SolverError(
            f"face {faces[k]} is not one of 0 … {source.n_faces - 1}", index=k, value=int(faces[k])
        )
    return faces.astype(np.int64)
