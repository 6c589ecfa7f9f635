"""A soft map carried from one pair of bases to another on the same meshes: coarse to fine (section 5.3)."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from solver.basis import Basis
from solver.errors import InvalidSoftMap
from solver.mesh import FloatArray, Mesh
from solver.softmap import SoftMap


def prolong(softmap: SoftMap, source: Basis, target: Basis) -> SoftMap:
    """Carry a soft map to other bases of its meshes: C′ = β₀(p′) C ∫μ β′, taken at the samples p′.

    Parameters
    ----------
    softmap : SoftMap
    source, target : Basis
        Other bases of the same two meshes.

    Returns
    -------
    SoftMap
        Row i is the old density at the sample of the new function i, projected as maps from data are (§5.2).

    Raises
    ------
    InvalidSoftMap
        If a basis belongs to another mesh.
    """
    for what, old, new in (("source", softmap.source, source), ("target", softmap.target, target)):
        if not _same(old.mesh, new.mesh):
            raise InvalidSoftMap(
                f"a soft map can only be carried to bases of its own meshes: the {what} differs"
            )
    at_samples = softmap.source.functions[source.samples] @ softmap.coefficients
    areas = sparse.diags_array(target.mesh.face_areas)
    received = sparse.csr_array(softmap.target.densities.T @ (areas @ target.face_means))
    carried: FloatArray = (received.T @ at_samples.T).T
    return SoftMap(source, target, carried / carried.sum(axis=1, keepdims=True))


def _same(one: Mesh, other: Mesh) -> bool:
    return one is other or (
        np.array_equal(one.vertices, other.vertices) and np.array_equal(one.faces, other.faces)
    )
