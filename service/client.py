"""The Python client: `Client(url).energy(source, target)` goes from two meshes to energies and densities."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from service.answers import Artifact, Energies, Job, Motion, OptimalSoftMap, PointMap, TracedPath
from service.asking import BasisOptions, optimal_softmap
from service.preparing import Preparation
from service.session import MeshLike

#: A soft map: its spec or its id.
SoftMapLike = Mapping[str, Any] | str


class Client(Preparation):
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
        source, target, map, size, method, cutoff, sharpness, sigma
            As in `softmap`.
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

    def pointmap(
        self,
        softmap: SoftMapLike,
        method: str = "peak",
        *,
        progress: Callable[[Job], None] | None = None,
        timeout: float | None = None,
    ) -> PointMap:
        """Target vertex for every source vertex: where its mass peaks, or where on the surface it balances.

        Parameters
        ----------
        softmap : mapping or str
            Spec, such as `softmap` returns, or id.
        method : {"peak", "barycentre"}
            Which of the two.
        progress, timeout
            As in `energy`.

        Returns
        -------
        PointMap

        Raises
        ------
        ClientError
            `Invalid`, `JobFailed`, `WaitedTooLong` and others; see ``service.refusals``.
        """
        spec = {"kind": "pointmap", "softmap": softmap, "method": method}
        job = self.wait(self.submit(spec).id, progress, timeout)
        return PointMap(id=job.id, **self.arrays(job.id))

    def optimise(
        self,
        source: MeshLike,
        target: MeshLike,
        landmarks: Sequence[tuple[int, int]] = (),
        *,
        size: int = 60,
        method: str | None = None,
        cutoff: float | None = None,
        sharpness: float | None = None,
        start: SoftMapLike | None = None,
        progress: Callable[[Job], None] | None = None,
        timeout: float | None = None,
        **options: Any,
    ) -> OptimalSoftMap:
        """Soft map of least energy E_D + λE_b between two meshes that keeps landmarks, and the proof of it.

        Parameters
        ----------
        source, target, size, method, cutoff, sharpness
            As in `softmap`. Landmarks are the first samples of the bases.
        landmarks : sequence of (int, int)
            Pairs of a source and a target vertex.
        start : mapping or str, optional
            Spec or id of a soft map between the same meshes to start from, such as a coarser optimal one.
        progress, timeout
            As in `energy`; the job's ``values`` hold iteration, energy and gap; see also `snapshot`.
        **options
            ``bijectivity_weight`` (λ), ``tolerance``, ``max_iterations``, ``method`` as ``optimiser``,
            ``constraints``, ``attachment`` and ``regularisation`` of the spec; else the service's defaults.

        Returns
        -------
        OptimalSoftMap

        Raises
        ------
        ClientError
            `Invalid`, `JobFailed`, `WaitedTooLong` and others; see ``service.refusals``.
        """
        bases = BasisOptions(size, method, cutoff, sharpness)
        spec = optimal_softmap(
            bases, self.mesh(source).id, self.mesh(target).id, landmarks, start=start, **options
        )
        job = self.wait(self.submit(spec).id, progress, timeout)
        values, arrays = self.artifact(job.id).values, self.arrays(job.id)
        return OptimalSoftMap(
            id=job.id,
            coefficients=arrays.pop("coefficients"),
            history={name.removeprefix("history_"): array for name, array in arrays.items()},
            **values,
        )

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
