"""The endpoints of artifacts: what is known of one, and its numbers."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from service.errors import ApiProblem, Conflict, Gone, JobFailed, NotFound, NotReady
from service.openapi import ARRAY_CONTENT, NPZ_CONTENT, problems
from service.replies import ArtifactPage, ArtifactReply, artifact_reply, job_reply
from service.representations import array_response, npz_response
from service.rooms import Cursor, Id, InRooms, Limit, Rooms, check_id
from worker.jobs import Job
from worker.store import CorruptArtifact, GoneArtifact, Manifest

router = APIRouter(prefix="/v1", tags=["artifacts"])
_NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "Not modified"}}


@router.get(
    "/artifacts",
    summary="List artifacts",
    response_model=ArtifactPage,
    responses=problems(422),
)
async def list_artifacts(
    rooms: InRooms,
    kind: Annotated[str | None, Query(pattern="^[a-z_]{1,40}$")] = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> ArtifactPage:
    """List uploads and results, in the order of their ids."""
    found = await run_in_threadpool(rooms.store.manifests, kind, cursor or "", limit + 1)
    items = [artifact_reply(manifest) for manifest in found[:limit]]
    return ArtifactPage(items=items, next=items[-1].id if len(found) > limit else None)


@router.get(
    "/artifacts/{id}.npz",
    summary="All arrays of an artifact as one file",
    response_class=Response,
    responses={
        200: NPZ_CONTENT,
        **_NOT_MODIFIED,
        **problems(404, 406, 409, 410, 424, 503),
    },
)
async def get_npz(id: Id, request: Request, rooms: InRooms) -> Response:
    """Download all arrays, as `numpy.load` reads them."""
    manifest = await run_in_threadpool(_manifest, rooms, id)
    try:
        return await npz_response(request, rooms.store, manifest, rooms.cache)
    except (CorruptArtifact, GoneArtifact):
        raise await _forgotten(rooms, id) from None


@router.get(
    "/artifacts/{id}",
    summary="Look at an artifact",
    response_model=ArtifactReply,
    responses=problems(404, 409, 410, 424, 503),
)
async def get_artifact(id: Id, rooms: InRooms) -> ArtifactReply:
    """Values of a result or an upload, where it comes from, and the addresses of its arrays."""
    return artifact_reply(await run_in_threadpool(_manifest, rooms, id))


@router.get(
    "/artifacts/{id}/arrays/{name}",
    summary="Numbers of an array",
    response_class=Response,
    responses={
        200: ARRAY_CONTENT,
        206: {"description": "A byte range of npy or raw"},
        **_NOT_MODIFIED,
        **problems(404, 406, 409, 410, 416, 422, 424, 503),
    },
)
async def get_array(
    id: Id,
    name: str,
    request: Request,
    rooms: InRooms,
    rows: Annotated[str | None, Query(description="Rows a:b, as a Python slice without a step.")] = None,
) -> Response:
    """Download an array as .npy, as raw little-endian bytes in C order, or as JSON, by Accept."""
    manifest = await run_in_threadpool(_manifest, rooms, id)
    if name not in manifest.arrays:
        raise NotFound(f"the arrays of this artifact are {', '.join(manifest.arrays)}")
    try:
        return await array_response(request, rooms.store, manifest, name, rows, rooms.cache)
    except (CorruptArtifact, GoneArtifact):
        raise await _forgotten(rooms, id) from None


async def _forgotten(rooms: Rooms, id_: str) -> ApiProblem:
    """Why an artifact that stood a moment ago does not any more."""
    try:
        await run_in_threadpool(_manifest, rooms, id_)
    except ApiProblem as problem:
        return problem
    return NotReady("it was made anew meanwhile; ask again")


def _manifest(rooms: Rooms, id_: str) -> Manifest:
    """Manifest of an artifact, or the reason why there is none."""
    check_id(id_)
    manifest = rooms.store.manifest(id_)
    if manifest is not None:
        rooms.store.record_read(id_)
        return manifest
    job = rooms.dispatcher.job(id_)
    if job is not None:
        _refuse_for(job)
    tombstone = rooms.store.gone(id_)
    if tombstone is not None:
        what = "upload it again" if tombstone.spec is None else "POST its spec to /v1/jobs to have it again"
        raise Gone(f"this {tombstone.kind} was {tombstone.reason}; {what}", spec=tombstone.spec)
    raise NotFound(f"there is no artifact {id_}")


def _refuse_for(job: Job) -> None:
    """Say why a job has no artifact, unless it had one."""
    view = job_reply(job).model_dump()
    if job.status == "failed":
        detail = (job.error or {}).get("detail", "see the job's error")
        raise JobFailed(f"the job that makes it failed: {detail}", job=view)
    if job.status == "dismissed":
        raise Conflict("the job that makes it was dismissed; POST its spec to have it", job=view)
    if job.status != "successful":
        raise Conflict(f"the job that makes it is {job.status}", headers={"Retry-After": "1"}, job=view)
