"""What the service answers: response models, for people in /docs and for machines in /openapi.json."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from worker.jobs import Job
from worker.store import Manifest

#: Where the API lives.
PREFIX = "/v1"


class _Reply(BaseModel):
    model_config = ConfigDict(frozen=True)


class StoredArrayReply(_Reply):
    """An array of an artifact."""

    shape: list[int] = Field(examples=[[5120, 2, 300]])
    dtype: Literal["float64", "int64", "int32", "bool"]
    href: str = Field(description="Where its numbers are.")
    sha256: str = Field(description="Of its little-endian C-order bytes.")


class MeshReply(_Reply):
    """An uploaded mesh. Lengths and areas are in the units of the file."""

    id: str = Field(examples=["mesh-6e27ac67bd1abbbc1b4d8e0b6a5a3d54"])
    kind: Literal["mesh"]
    name: str | None
    format: str
    n_vertices: int
    n_faces: int
    area: float
    n_components: int
    euler_characteristic: int
    n_boundary_loops: int
    warnings: list[str] = Field(description="What was changed or left out, and what is odd about the mesh.")
    arrays: dict[str, StoredArrayReply]


class ArrayReply(_Reply):
    """An uploaded array."""

    id: str = Field(examples=["array-0f343b0931126a20f133d67c2b018a3b"])
    kind: Literal["array"]
    name: str | None
    shape: list[int]
    dtype: Literal["float64", "int64"]
    arrays: dict[str, StoredArrayReply]


class TaskReply(_Reply):
    """A piece of work of a job."""

    id: str
    kind: str
    status: str


class JobLinks(_Reply):
    """Where a job's parts are."""

    self: str
    artifact: str
    events: str
    snapshot: str = Field(description="The best soft map so far, while one is optimised.")


class JobReply(_Reply):
    """A job: one question, whoever asked it."""

    id: str = Field(examples=["energy-9f86d081884c7d659a2feaa0c55ad015"])
    kind: str
    status: Literal["accepted", "running", "successful", "failed", "dismissed"]
    progress: float = Field(ge=0, le=100, description="Percent of the estimated work.")
    phase: str
    created_at: str | None
    started_at: str | None
    finished_at: str | None
    error: dict[str, Any] | None
    values: dict[str, Any] = Field(
        description="What is known so far: of a running optimisation its iteration, energy and gap; of a "
        "successful job its artifact's values."
    )
    tasks: list[TaskReply]
    links: JobLinks


class JobPage(_Reply):
    """Jobs, the newest first."""

    items: list[JobReply]
    next: str | None = Field(description="`cursor` of the next page; null on the last one.")


class ArtifactReply(_Reply):
    """A result or an upload: what it is, where it comes from, its values, and where its arrays are."""

    id: str
    kind: str
    spec: dict[str, Any] | None
    parents: dict[str, str]
    values: dict[str, Any]
    arrays: dict[str, StoredArrayReply]
    made: dict[str, Any]


class ArtifactPage(_Reply):
    """Artifacts, in the order of their ids."""

    items: list[ArtifactReply]
    next: str | None = Field(description="`cursor` of the next page; null on the last one.")


class ProblemError(_Reply):
    """One thing that is wrong."""

    pointer: str = Field(description="JSON pointer into the body, or /query/… for a parameter.")
    detail: str


class Problem(_Reply):
    """Why a request was refused (RFC 9457)."""

    type: str
    title: str
    status: int
    detail: str
    errors: list[ProblemError]


class Health(_Reply):
    """The service answers."""

    status: Literal["ok"]
    version: str


class Readiness(_Reply):
    """The service can work."""

    status: Literal["ready"]
    workers: int
    queued: int


def job_reply(job: Job) -> JobReply:
    """Job as it is answered."""
    base = f"{PREFIX}/jobs/{job.id}"
    return JobReply(
        id=job.id,
        kind=job.kind,
        status=job.status,
        progress=job.progress,
        phase=job.phase,
        created_at=job.created_at,
        started_at=job.started_at,
        finished_at=job.finished_at,
        error=job.error,
        values=dict(job.values),
        tasks=[TaskReply(id=task.id, kind=task.kind, status=task.status) for task in job.tasks],
        links=JobLinks(
            self=base,
            artifact=f"{PREFIX}/artifacts/{job.id}",
            events=f"{base}/events",
            snapshot=f"{base}/snapshot",
        ),
    )


def array_replies(manifest: Manifest) -> dict[str, StoredArrayReply]:
    """Arrays of an artifact, with their addresses."""
    base = f"{PREFIX}/artifacts/{manifest.id}/arrays"
    return {
        name: StoredArrayReply.model_validate(
            {"shape": list(a.shape), "dtype": a.dtype, "href": f"{base}/{name}", "sha256": a.sha256}
        )
        for name, a in manifest.arrays.items()
    }


def artifact_reply(manifest: Manifest) -> ArtifactReply:
    """Artifact as it is answered."""
    return ArtifactReply(
        id=manifest.id,
        kind=manifest.kind,
        spec=manifest.spec,
        parents=manifest.parents,
        values=manifest.values,
        arrays=array_replies(manifest),
        made=manifest.made,
    )


def mesh_reply(manifest: Manifest) -> MeshReply:
    """Uploaded mesh as it is answered."""
    return MeshReply(id=manifest.id, kind="mesh", arrays=array_replies(manifest), **manifest.values)


def array_reply(manifest: Manifest) -> ArrayReply:
    """Uploaded array as it is answered."""
    array = array_replies(manifest)["array"]
    return ArrayReply.model_validate(
        {"id": manifest.id, "kind": "array", "shape": array.shape, "dtype": array.dtype}
        | {"arrays": array_replies(manifest)}
        | manifest.values
    )
