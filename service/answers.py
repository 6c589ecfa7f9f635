"""What the service answers, as a client sees it: frozen, and whole from birth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

#: Statuses after which a job changes no more.
FINISHED = frozenset({"successful", "failed", "dismissed"})


@dataclass(frozen=True)
class Upload:
    """A mesh or an array that the service has.

    Attributes
    ----------
    id : str
        What specs name it by; the same arrays have the same id.
    facts : mapping
        The rest of the service's reply: counts, area, warnings, or shape and dtype.
    """

    id: str
    facts: Mapping[str, Any]

    @property
    def n_vertices(self) -> int:
        """Vertices of a mesh."""
        return int(self.facts["n_vertices"])

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is odd about a mesh, or was changed as it was read."""
        return tuple(self.facts.get("warnings", ()))


@dataclass(frozen=True)
class Task:
    """A piece of work of a job."""

    id: str
    kind: str
    status: str


@dataclass(frozen=True)
class Job:
    """A question and how far its answer is.

    Attributes
    ----------
    id, kind : str
        Of the artifact that will answer it.
    status : str
        ``accepted``, ``running``, ``successful``, ``failed`` or ``dismissed``.
    progress : float
        Percent of the estimated work.
    phase : str
        What happens now, in words.
    created_at, started_at, finished_at : str or None
        ISO 8601; None before it happens.
    error : mapping or None
        What went wrong, if it failed.
    values : mapping
        What is known so far: of a running optimisation its iteration, energy and gap.
    tasks : tuple of Task
        Parents first, itself last.
    """

    id: str
    kind: str
    status: str
    progress: float
    phase: str
    created_at: str | None
    started_at: str | None
    finished_at: str | None
    error: Mapping[str, Any] | None
    values: Mapping[str, Any]
    tasks: tuple[Task, ...]

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """Job of a reply; members that this client does not know are passed over."""
        fields = {name: document[name] for name in cls.__dataclass_fields__ if name != "tasks"}
        tasks = tuple(Task(task["id"], task["kind"], task["status"]) for task in document["tasks"])
        return cls(**fields, tasks=tasks)

    @property
    def document(self) -> dict[str, Any]:
        """The job as JSON would hold it."""
        return asdict(self)

    @property
    def finished(self) -> bool:
        """Whether it changes no more."""
        return self.status in FINISHED

    @property
    def seconds(self) -> float | None:
        """From the first task's start to the end, or None before."""
        if self.started_at is None or self.finished_at is None:
            return None
        return (
            datetime.fromisoformat(self.finished_at) - datetime.fromisoformat(self.started_at)
        ).total_seconds()


@dataclass(frozen=True)
class Artifact:
    """A result or an upload: what it is, where it comes from, its values and the shapes of its arrays."""

    id: str
    kind: str
    spec: Mapping[str, Any] | None
    parents: Mapping[str, str]
    values: Mapping[str, Any]
    arrays: Mapping[str, Mapping[str, Any]]
    made: Mapping[str, Any]

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> Self:
        """Artifact of a reply."""
        return cls(**{name: document[name] for name in cls.__dataclass_fields__})

    @property
    def seconds(self) -> float:
        """Seconds that making it took, its parents not included."""
        return float(self.made.get("seconds", 0.0))


@dataclass(frozen=True, eq=False)
class Energies:
    """The two energies of a soft map and their densities.

    Attributes
    ----------
    id : str
        Of the energy artifact.
    source, target : str
        Ids of the meshes.
    dirichlet, bijectivity : float
        E_D and E_b; both meshes have area 1.
    dirichlet_density : ndarray, (F₀,) float64
        Per unit area of the source's faces.
    bijectivity_density : ndarray, (F,) float64
        Mass per unit area of the target's faces.
    gradients : mapping of str to ndarray, (n₀, n) float64
        ``dirichlet`` and ``bijectivity``, if asked for.
    """

    id: str
    source: str
    target: str
    dirichlet: float
    bijectivity: float
    dirichlet_density: NDArray[np.float64]
    bijectivity_density: NDArray[np.float64]
    gradients: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Motion:
    """How mass moves on the target as source points move.

    Attributes
    ----------
    id : str
        Of the momentum artifact.
    velocity : ndarray, (F, 3) or (k, F, 3) float64
        In the units of the uploaded target, per target face.
    momentum : ndarray, (F, 3) or (k, F, 3) float64
        Velocity times the density of mass, whose mean is 1.
    """

    id: str
    velocity: NDArray[np.float64]
    momentum: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TracedPath:
    """A path on the target, and where the path that it follows was meanwhile on the source.

    Attributes
    ----------
    id : str
        Of the path artifact.
    length : float
        In the units of the uploaded target.
    stopped : str
        ``end`` if the source path was followed to its end; else what stopped it.
    points, source_points : ndarray, (k, 3) float64
        In the units of the uploaded meshes.
    faces, source_faces : ndarray, (k,) int64
        The face that each point is in.
    barycentric, source_barycentric : ndarray, (k, 3) float64
        Weights of the corners of that face.
    """

    id: str
    length: float
    stopped: str
    points: NDArray[np.float64]
    faces: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    source_points: NDArray[np.float64]
    source_faces: NDArray[np.int64]
    source_barycentric: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OptimalSoftMap:
    """A soft map of nearly least energy, and the proof of how nearly.

    Attributes
    ----------
    id : str
        Of the softmap artifact.
    coefficients : ndarray, (n₀, n) float64
    energy, dirichlet, bijectivity, attachment : float
        E = E_D + λE_b + ⟨K, C⟩, and its parts.
    gap : float
        No soft map that keeps the landmarks has less energy than ``energy − gap``.
    converged : bool
        Whether the gap is as small as was asked for.
    iterations : int
    history : mapping of str to ndarray, (iterations + 1,) float64
        ``energy``, ``gap``, ``evaluations`` and ``seconds`` after each iteration; first come the start's.
    """

    id: str
    coefficients: NDArray[np.float64]
    energy: float
    dirichlet: float
    bijectivity: float
    attachment: float
    gap: float
    converged: bool
    iterations: int
    history: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class PointMap:
    """A point map read off a soft map.

    Attributes
    ----------
    id : str
        Of the pointmap artifact.
    targets : ndarray, (V₀,) int64
        Target vertex of every source vertex, from 0 on; −1 at source vertices in no face.
    confidence : ndarray, (V₀,) float64
        Share of the vertex' mass around its target: 1 where the soft map is sure.
    """

    id: str
    targets: NDArray[np.int64]
    confidence: NDArray[np.float64]
