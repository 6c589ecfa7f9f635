"""Meshes and maps as the client takes them, turned into specs: uploaded where they must be."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from service.answers import Upload
from service.asking import BasisOptions, map_kind, named_map, softmap
from service.session import MeshLike, Session

_MESH_ID = re.compile(r"mesh-[0-9a-f]{32}")


class Preparation(Session):
    """A connection that knows meshes and maps in every form that people have them in."""

    def softmap(
        self,
        source: MeshLike,
        target: MeshLike,
        map: str | ArrayLike = "wks",
        *,
        size: int = 300,
        method: str | None = None,
        cutoff: float | None = None,
        sharpness: float | None = None,
        sigma: float | None = None,
    ) -> dict[str, Any]:
        """Spec of a soft map between two meshes, which are uploaded, for `momentum`, `path` and `submit`.

        Parameters
        ----------
        source, target : path, bytes, (vertices, faces) or mesh id
            The two meshes.
        map : {"wks", "hks", "uniform"} or array_like
            Descriptors to compare, or V₀ integers (targets, from 0 on), or an n₀×n matrix of coefficients.
        size : int
            Functions of each basis.
        method : {"poisson", "maxent"}, optional
            How bases are made; as the service does unless given.
        cutoff, sharpness : float, optional
            Of poisson and of maxent bases.
        sigma : float, optional
            Of the descriptors.

        Returns
        -------
        dict
            With both bases inline.

        Raises
        ------
        ClientError
            If the meshes or the map cannot be uploaded.
        Unusable
            If the map fits neither the vertices nor a matrix.
        """
        m0, m = self.mesh(source), self.mesh(target)
        options = BasisOptions(size, method, cutoff, sharpness)
        return softmap(options.spec(m0.id), options.spec(m.id), self.map_spec(map, m0, m, sigma))

    def map_spec(
        self, map: str | ArrayLike, source: Upload, target: Upload, sigma: float | None = None
    ) -> dict[str, Any]:
        """The `map` of a softmap spec, its numbers uploaded if it has any.

        Parameters
        ----------
        map : str or array_like
            As in `softmap`.
        source, target : Upload
            The meshes.
        sigma : float, optional
            Of descriptors.

        Returns
        -------
        dict
            Ready for a spec.

        Raises
        ------
        Unusable
            If it is no map between these meshes; says why.
        ClientError
            If the numbers cannot be uploaded.
        """
        if isinstance(map, str):
            return named_map(map, sigma)
        array = np.asarray(map)
        if map_kind(array, source.n_vertices, target.n_vertices) == "points":
            return {"type": "points", "targets": self.upload_array(array.ravel()).id}
        return {"type": "matrix", "coefficients": self.upload_array(array.astype(np.float64)).id}

    def mesh(self, mesh: MeshLike) -> Upload:
        """Upload a mesh, or look up one that was uploaded.

        Parameters
        ----------
        mesh : path, bytes, (vertices, faces) or mesh id
            As in `softmap`.

        Returns
        -------
        Upload
            Its id and facts.

        Raises
        ------
        ClientError
            As `upload_mesh`; `NotFound` for an unknown id.
        """
        if isinstance(mesh, str) and _MESH_ID.fullmatch(mesh):
            return Upload(mesh, self.artifact(mesh).values)
        return self.upload_mesh(mesh)
