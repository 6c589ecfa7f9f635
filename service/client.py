"""The Python client: `Client(url).energy(source, target)` goes from two meshes to energies and densities."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from service.answers import Artifact, Energies, Job, Motion, TracedPath, Upload
from service.asking import BasisOptions, map_kind, named_map, softmap
from service.session import MeshLike, Session

#: A soft map: its spec or its id.
SoftMapLike = Mapping[str, Any] | str
_MESH_ID = re.compile(r"mesh-[0-9a-f]{32}")


class Client(Session):
    """A connection to a softmaps service: everything `Session` does, and whole questions in one call.

    Parameters
    ----------
    url : str
        Where it is, such as ``http://127.0.0.1:8000``.
    token : str, optional
        Bearer token, if the service wants one.
    patience : float
        Seconds for which requests are repeated while the service is full or away.

    Raises
    ------
    Unusable
        If the address is none.
    """

    def energy(
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
        regularisation: float = 1e-5,
        gradient: bool = False,
        progress: Callable[[Job], None] | None = None,
        timeout: float | None = None,
    ) -> Energies:
        """Energies and densities of a soft map between two meshes, from uploads to arrays.

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
        regularisation : float
            ε.
        gradient : bool
            Whether gradients with respect to the coefficients are wanted too.
        progress : callable, optional
            Called with the job as it advances.
        timeout : float, optional
            Seconds to wait for the job at most.

        Returns
        -------
        Energies
            E_D and E_b, their densities and, if asked for, gradients.

        Raises
        ------
        ClientError
            `Invalid`, `JobFailed`, `WaitedTooLong` and others; see ``service.refusals``.
        Unusable
            If the map fits neither the vertices nor a matrix.
        """
        asked = self.softmap(
            source, target, map, size=size, method=method, cutoff=cutoff, sharpness=sharpness, sigma=sigma
        )
        spec = {"kind": "energy", "softmap": asked, "regularisation": regularisation, "gradient": gradient}
        job = self.wait(self.submit(spec).id, progress, timeout)
        return self.energies(job.id, asked["source"]["mesh"], asked["target"]["mesh"])

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
        source, target, map, size, method, cutoff, sharpness, sigma
            As in `energy`.

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

    def momentum(
        self,
        softmap: SoftMapLike,
        face: int | Sequence[int],
        direction: ArrayLike,
        *,
        regularisation: float = 1e-5,
        progress: Callable[[Job], None] | None = None,
        timeout: float | None = None,
    ) -> Motion:
        """How mass moves on the target as a source point moves, or several.

        Parameters
        ----------
        softmap : mapping or str
            Spec, such as `softmap` returns, or id.
        face : int or sequence of int
            Source faces.
        direction : (3,) or (k, 3) array_like
            Where the point moves in each.
        regularisation, progress, timeout
            As in `energy`.

        Returns
        -------
        Motion
            Velocity and momentum in every target face.

        Raises
        ------
        ClientError
            `Invalid`, `JobFailed`, `WaitedTooLong` and others; see ``service.refusals``.
        """
        faces = face if isinstance(face, int) else [int(one) for one in face]
        question = {"face": faces, "direction": np.asarray(direction, dtype=np.float64).tolist()}
        spec = {"kind": "momentum", "softmap": softmap, **question, "regularisation": regularisation}
        job = self.wait(self.submit(spec).id, progress, timeout)
        return Motion(id=job.id, **self.arrays(job.id))

    def path(
        self,
        softmap: SoftMapLike,
        source_path: Sequence[int],
        start: int,
        *,
        step: float = 0.01,
        regularisation: float = 1e-5,
        progress: Callable[[Job], None] | None = None,
        timeout: float | None = None,
    ) -> TracedPath:
        """Path on the target that follows a path on the source.

        Parameters
        ----------
        softmap : mapping or str
            Spec, such as `softmap` returns, or id.
        source_path : sequence of int
            Source vertices, joined by shortest paths.
        start : int
            Target vertex that the first of them corresponds to.
        step : float
            Longest step along the source path, in √area of the source.
        regularisation, progress, timeout
            As in `energy`.

        Returns
        -------
        TracedPath

        Raises
        ------
        ClientError
            `Invalid`, `JobFailed`, `WaitedTooLong` and others; see ``service.refusals``.
        """
        question = {"source_path": [int(one) for one in source_path], "start": int(start), "step": step}
        spec = {"kind": "path", "softmap": softmap, **question, "regularisation": regularisation}
        job = self.wait(self.submit(spec).id, progress, timeout)
        values = self.artifact(job.id).values
        return TracedPath(
            id=job.id, length=values["length"], stopped=values["stopped"], **self.arrays(job.id)
        )

    def map_spec(
        self, map: str | ArrayLike, source: Upload, target: Upload, sigma: float | None = None
    ) -> dict[str, Any]:
        """The `map` of a softmap spec, its numbers uploaded if it has any.

        Parameters
        ----------
        map : str or array_like
            As in `energy`.
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

    def energies(self, id: str, source: str, target: str) -> Energies:
        """Read an energy artifact, given the ids of its meshes.

        Raises
        ------
        ClientError
            As `artifact`.
        """
        values = self.artifact(id).values
        arrays = self.arrays(id)
        return Energies(
            id=id,
            source=source,
            target=target,
            dirichlet=float(values["dirichlet"]),
            bijectivity=float(values["bijectivity"]),
            dirichlet_density=arrays["dirichlet_density"],
            bijectivity_density=arrays["bijectivity_density"],
            gradients={
                name.removesuffix("_gradient"): array
                for name, array in arrays.items()
                if name.endswith("_gradient")
            },
        )

    def lineage(self, id: str) -> list[Artifact]:
        """An artifact and all it was made from, parents first.

        Raises
        ------
        ClientError
            As `artifact`.
        """
        found: dict[str, Artifact] = {}

        def visit(one: str) -> None:
            if one not in found:
                artifact = self.artifact(one)
                for parent in artifact.parents.values():
                    visit(parent)
                found[one] = artifact

        visit(id)
        return list(found.values())

    def mesh(self, mesh: MeshLike) -> Upload:
        """Upload a mesh, or look up one that was uploaded.

        Parameters
        ----------
        mesh : path, bytes, (vertices, faces) or mesh id
            As in `energy`.

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
