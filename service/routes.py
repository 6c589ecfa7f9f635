"""The endpoints of uploads and jobs, a few lines each; those of artifacts are in `service.artifacts`."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncGenerator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy.typing as npt
from anyio.to_thread import run_sync
from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import JSONResponse, Response, StreamingResponse

from service.arrays import read_npy
from service.errors import NotFound, UnsupportedFormat
from service.openapi import ARRAY_BODY, JOB_BODY, MESH_BODY, SNAPSHOT_CONTENT, known, problems
from service.receiving import BoundedRequest, mesh_file
from service.replies import (
    ArrayReply,
    JobPage,
    JobReply,
    MeshReply,
    array_reply,
    job_reply,
    mesh_reply,
)
from service.representations import passing_response
from service.rooms import Cursor, Id, InRooms, Limit, Name, Rooms, Wait, check_id
from service.watch import FINISHED, Watch
from worker.bodies import parse_array
from worker.jobs import Job, Status
from worker.questions import parse
from worker.specs import array_id, mesh_id
from worker.store import Manifest, Store

#: Longest wait that one request may ask for, in seconds.
MAX_WAIT_SECONDS = 60.0
#: Seconds between two comments that keep a quiet event stream open.
KEEP_ALIVE_SECONDS = 15.0
#: What a .npy header may take beside the numbers.
_NPY_HEADER_BYTES = 4096
_LAST_EVENT = "final"

router = APIRouter(prefix="/v1")


@router.post(
    "/meshes",
    tags=["uploads"],
    summary="Upload a triangle mesh",
    status_code=201,
    response_model=MeshReply,
    responses={200: known(MeshReply), **problems(400, 408, 413, 415, 422, 503)},
    openapi_extra=MESH_BODY,
)
async def upload_mesh(request: Request, rooms: InRooms, name: Name = None) -> Response:
    """Store a mesh; the same vertices and faces have the same id. Vertex order is the file's."""
    began = time.monotonic()
    file, file_format = await mesh_file(request, rooms.uploads, rooms.settings.max_upload_bytes)
    with file:
        async with rooms.uploads.turn:
            mesh = await rooms.uploads.read_mesh(file, file_format)
            arrays = {"vertices": mesh.vertices, "faces": mesh.faces}
            id_ = await asyncio.to_thread(mesh_id, mesh.vertices, mesh.faces)
            values = {"name": name, "format": file_format, **mesh.facts}
            upload = _Upload(id_, "mesh", values, arrays, began)
            manifest, status = await asyncio.to_thread(_stored, rooms.store, upload)
    # The same mesh may have come before in another file: what is said is about this one.
    reply = mesh_reply(manifest).model_copy(
        update={"format": file_format, "warnings": mesh.facts["warnings"]}
    )
    return JSONResponse(reply.model_dump(), status, {"Location": f"/v1/artifacts/{id_}"})


@router.post(
    "/arrays",
    tags=["uploads"],
    summary="Upload an array",
    status_code=201,
    response_model=ArrayReply,
    responses={200: known(ArrayReply), **problems(400, 408, 413, 415, 422)},
    openapi_extra=ARRAY_BODY,
)
async def upload_array(request: Request, rooms: InRooms, name: Name = None) -> Response:
    """Store an array as int64 or float64: point maps, descriptors, coefficients, barycentric coordinates."""
    began = time.monotonic()
    settings, media_type = rooms.settings, _media_type(request)
    if media_type == "application/x-npy":
        limit = settings.max_array_bytes
        file = await rooms.uploads.receive(BoundedRequest(request, limit + _NPY_HEADER_BYTES).stream())
        with file, rooms.uploads.file() as scratch:
            async with rooms.uploads.turn:
                array = await asyncio.to_thread(read_npy, file, scratch, limit)
                manifest, status = await asyncio.to_thread(_stored_array, rooms.store, array, name, began)
    elif _is_json(media_type):
        body = await BoundedRequest(request, settings.max_json_bytes).body()
        array = await run_in_threadpool(parse_array, body)
        manifest, status = await asyncio.to_thread(_stored_array, rooms.store, array, name, began)
    else:
        raise UnsupportedFormat("arrays come as application/x-npy or application/json")
    location = {"Location": f"/v1/artifacts/{manifest.id}"}
    return JSONResponse(array_reply(manifest).model_dump(), status, location)


@dataclass(frozen=True, eq=False)
class _Upload:
    id: str
    kind: str
    values: dict[str, Any]
    arrays: dict[str, npt.NDArray[Any]]
    began: float


def _stored_array(
    store: Store, array: npt.NDArray[Any], name: str | None, began: float
) -> tuple[Manifest, int]:
    return _stored(store, _Upload(array_id(array), "array", {"name": name}, {"array": array}, began))


def _stored(store: Store, new: _Upload) -> tuple[Manifest, int]:
    """Manifest of an upload, and 200 if it was known already, else 201."""
    standing = store.manifest(new.id)
    if standing is not None:
        return standing, 200
    seconds = round(time.monotonic() - new.began, 6)
    made = {"seconds": seconds, "threads": 1, "versions": {"softmaps": version("softmaps")}}
    written = store.put(
        new.id, kind=new.kind, spec=None, parents={}, values=new.values, arrays=new.arrays, made=made
    )
    return written, 201


@router.post(
    "/jobs",
    tags=["jobs"],
    summary="Ask a question",
    status_code=202,
    response_model=JobReply,
    responses={200: known(JobReply), **problems(400, 408, 413, 415, 422, 429, 503)},
    openapi_extra=JOB_BODY,
)
async def submit_job(request: Request, rooms: InRooms) -> Response:
    """Submit a spec. The same spec is the same job; what failed or was dismissed runs again."""
    if not _is_json(_media_type(request)):
        raise UnsupportedFormat("specs come as application/json")
    body = await BoundedRequest(request, rooms.settings.max_json_bytes).body()
    tree = await run_in_threadpool(parse, body)
    job = await run_sync(rooms.dispatcher.submit, tree, limiter=rooms.patient)
    seconds = _preferred_wait(request)
    headers = {"Location": f"/v1/jobs/{job.id}"}
    if seconds is not None:
        job = await rooms.watch.finished(job, seconds)
        headers["Preference-Applied"] = f"wait={seconds:g}"
    return _job(job, 200 if job.status in FINISHED else 202, headers)


@router.get(
    "/jobs",
    tags=["jobs"],
    summary="List jobs, the newest first",
    response_model=JobPage,
    responses=problems(422, 503),
)
async def list_jobs(
    rooms: InRooms,
    status: Status | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> JobPage:
    """List the jobs that were asked for."""
    jobs, following = await run_in_threadpool(rooms.dispatcher.jobs, status, limit, cursor)
    return JobPage(items=[job_reply(job) for job in jobs], next=following)


@router.get(
    "/jobs/{id}",
    tags=["jobs"],
    summary="Look at a job",
    response_model=JobReply,
    responses=problems(404, 422, 503),
)
async def get_job(id: Id, rooms: InRooms, wait: Wait = 0.0) -> Response:
    """Look at a job, at once or when it is finished."""
    job = await _found_job(rooms, id)
    if wait > 0:
        job = await rooms.watch.finished(job, min(wait, MAX_WAIT_SECONDS))
    return _job(job, 200, {})


@router.get(
    "/jobs/{id}/events",
    tags=["jobs"],
    summary="Follow a job",
    response_class=StreamingResponse,
    responses={
        200: {
            "description": "A job an event",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        },
        204: {"description": "The final state was received already"},
        **problems(404, 503),
    },
)
async def follow_job(id: Id, request: Request, rooms: InRooms) -> Response:
    """Follow a job: its state now and after each change, the final one last (server-sent events)."""
    job = await _found_job(rooms, id)
    if request.headers.get("last-event-id") == _LAST_EVENT and job.status in FINISHED:
        return Response(status_code=204)  # what tells an EventSource to stop asking
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(_events(rooms.watch, job), 200, headers, "text/event-stream")


async def _events(watch: Watch, job: Job) -> AsyncGenerator[bytes]:
    changes = watch.changes(job)
    number = 0
    following = asyncio.ensure_future(anext(changes))
    try:
        while True:
            done, _ = await asyncio.wait({following}, timeout=KEEP_ALIVE_SECONDS)
            if not done:
                yield b": keep-alive\n\n"
                continue
            try:
                latest = following.result()
            except StopAsyncIteration:
                return
            number += 1
            event = _LAST_EVENT if latest.status in FINISHED else str(number)
            yield f"id: {event}\ndata: {job_reply(latest).model_dump_json()}\n\n".encode()
            following = asyncio.ensure_future(anext(changes))
    finally:
        following.cancel()
        await asyncio.gather(following, return_exceptions=True)
        await changes.aclose()


@router.get(
    "/jobs/{id}/snapshot",
    tags=["jobs"],
    summary="The best soft map so far",
    response_class=Response,
    responses={200: SNAPSHOT_CONTENT, **problems(404, 406, 503)},
)
async def get_snapshot(id: Id, request: Request, rooms: InRooms) -> Response:
    """Download the coefficients (n₀×n) that a running optimisation has found so far, as .npy or raw."""
    check_id(id)
    found = await run_in_threadpool(rooms.store.checkpoint, id)
    if found is None:
        raise NotFound(f"nothing is known of {id} before it is done, or it is done: see its artifact")
    headers = {"Iteration": str(found.values["iteration"])}
    return await run_in_threadpool(passing_response, request, found.arrays["coefficients"], headers)


@router.delete(
    "/jobs/{id}",
    tags=["jobs"],
    summary="Dismiss a job",
    response_model=JobReply,
    responses={202: {"model": JobReply, "description": "A task of it still runs"}, **problems(404, 409, 503)},
)
async def dismiss_job(id: Id, rooms: InRooms) -> Response:
    """Dismiss a job for everyone: queued work is dropped, running work is stopped."""
    check_id(id)
    dismissal = await run_sync(rooms.dispatcher.dismiss, id, limiter=rooms.patient)
    return _job(dismissal.job, 202 if dismissal.remains else 200, {})


async def _found_job(rooms: Rooms, id_: str) -> Job:
    check_id(id_)
    job = await run_in_threadpool(rooms.dispatcher.job, id_)
    if job is None:
        raise NotFound(f"there is no job {id_}")
    return job


def _job(job: Job, status: int, headers: dict[str, str]) -> Response:
    headers = {**headers, "Cache-Control": "no-store"}
    if job.status not in FINISHED:
        headers["Retry-After"] = "1"
    return JSONResponse(job_reply(job).model_dump(), status, headers)


def _media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def _is_json(media_type: str) -> bool:
    return media_type == "application/json" or media_type.endswith("+json")


def _preferred_wait(request: Request) -> float | None:
    """Seconds of ``Prefer: wait=N`` (RFC 7240), at most `MAX_WAIT_SECONDS`; None if it is not asked for."""
    for preference in ",".join(request.headers.getlist("prefer")).split(","):
        name, _, value = preference.partition(";")[0].partition("=")
        if name.strip().lower() == "wait":
            try:
                seconds = float(value.strip().strip('"'))
            except ValueError:
                return None
            return min(seconds, MAX_WAIT_SECONDS) if math.isfinite(seconds) and seconds >= 0 else None
    return None
