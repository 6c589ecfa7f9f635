"""Artifacts as the solver's objects: what a task reads before it begins.

The solver is imported inside functions: whoever only plans tasks must not load it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from worker import specs
from worker.store import Manifest, Store, UnknownArtifact

if TYPE_CHECKING:
    import solver
    from solver.descriptors import Spectrum


class Reader:
    """Reads each artifact once; mixtures need maps that share their very bases.

    Parameters
    ----------
    store : Store

    Raises
    ------
    StoreError
        By every method, if the artifact or one behind it is not there or is damaged.
    SolverError
        By every method, if what is stored is none of that kind.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self._read: dict[str, Any] = {}

    def manifest(self, id_: str) -> Manifest:
        """Manifest of an artifact that must be there."""
        manifest = self.store.manifest(id_)
        if manifest is None:
            raise UnknownArtifact(id_, "is not there")
        return manifest

    def array(self, id_: str) -> npt.NDArray[Any]:
        """An uploaded array."""
        return self.store.array(id_, "array")

    def mesh(self, id_: str) -> solver.Mesh:
        """An uploaded mesh."""
        if id_ not in self._read:
            from solver import Mesh  # noqa: PLC0415  (see the module)

            manifest = self.manifest(id_)
            self._read[id_] = Mesh(
                self.store.array(manifest, "vertices"), self.store.array(manifest, "faces")
            )
        return self._read[id_]  # type: ignore[no-any-return]

    def basis(self, id_: str) -> solver.Basis:
        """A basis, on its mesh."""
        if id_ not in self._read:
            from scipy import sparse  # noqa: PLC0415  (see the module)

            from solver import Basis  # noqa: PLC0415

            manifest = self.manifest(id_)
            mesh = self.mesh(manifest.parents["mesh"])
            samples = self.store.array(manifest, "samples")
            data, indices, indptr = (
                self.store.array(manifest, f"functions_{part}") for part in ("data", "indices", "indptr")
            )
            shape = (mesh.n_vertices, len(samples))
            functions = sparse.csr_array((data, indices, indptr), shape=shape)
            self._read[id_] = Basis(mesh, functions, samples, self.store.array(manifest, "cells"))
        return self._read[id_]  # type: ignore[no-any-return]

    def softmap(self, id_: str) -> solver.SoftMap:
        """A soft map, between its bases."""
        if id_ not in self._read:
            from solver import SoftMap  # noqa: PLC0415  (see the module)

            manifest = self.manifest(id_)
            self._read[id_] = SoftMap(
                self.basis(manifest.parents["source"]),
                self.basis(manifest.parents["target"]),
                self.store.array(manifest, "coefficients"),
            )
        return self._read[id_]  # type: ignore[no-any-return]

    def spectrum(self, mesh: str, eigenpairs: int) -> Spectrum:
        """Eigenpairs of a mesh."""
        from solver.descriptors import Spectrum  # noqa: PLC0415  (see the module)

        manifest = self.manifest(specs.spec_id(specs.Spectrum(mesh=mesh, eigenpairs=eigenpairs)))
        return Spectrum(
            self.store.array(manifest, "eigenvalues"), self.store.array(manifest, "eigenfunctions")
        )

    def descriptor(self, id_: str) -> npt.NDArray[np.float64]:
        """A descriptor, or an uploaded array in its place."""
        name = "descriptor" if id_.startswith("descriptor-") else "array"
        return np.asarray(self.store.array(id_, name), dtype=np.float64)


def read_basis(store: Store, id_: str) -> solver.Basis:
    """Read a basis as the solver's; see `Reader`."""
    return Reader(store).basis(id_)


def read_softmap(store: Store, id_: str) -> solver.SoftMap:
    """Read a soft map as the solver's, bases and meshes included; see `Reader`."""
    return Reader(store).softmap(id_)
