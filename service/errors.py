"""What can go wrong in a request, and the problem document (RFC 9457) that says so: one table.

ApiProblem
├── NotParseable          400  the body or a parameter cannot be read at all
├── Unauthorized          401  the bearer token is missing or wrong
├── NotFound              404  no such job, artifact or array
├── NotAcceptable         406  no representation that the request accepts
├── Conflict              409  the job runs, or has finished already
├── Gone                  410  it was forgotten; carries the spec to POST
├── UnsupportedFormat     415  a body of an unknown format
├── RangeRefused          416  a byte range outside the representation
├── Refused               422  a mesh, array, spec or parameter that is wrong
├── JobFailed             424  the job that should make it failed; carries the job
└── NotReady              503  something this service needs is away
"""

from __future__ import annotations

import errno
import json
import logging
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import redis.exceptions
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.responses import Response

from service.replies import job_reply
from service.uploads import InvalidUpload, ReaderLost, SlowUpload, TooLargeUpload
from worker.fields import MAX_ERRORS, MalformedBody, SpecError
from worker.queue import Busy, FinishedJob, UnknownJob
from worker.store import CorruptArtifact, GoneArtifact, UnknownArtifact

#: Seconds after which a client should try again when this service is full or waits for something.
RETRY_SECONDS = 5
PROBLEM_TYPE = "application/problem+json"

log = logging.getLogger(__name__)


class ApiProblem(Exception):
    """A request that was refused.

    Parameters
    ----------
    detail : str
        What is wrong, for the user.
    errors : sequence of (str, str)
        JSON pointers into the body, or ``/query/…``, and what is wrong there.
    headers : mapping of str
        Further headers of the answer.
    **members
        Further members of the problem document.
    """

    status: ClassVar[int] = 500

    def __init__(
        self,
        detail: str,
        errors: Sequence[tuple[str, str]] = (),
        headers: Mapping[str, str] | None = None,
        **members: Any,
    ) -> None:
        super().__init__(detail)
        self.detail, self.errors, self.headers, self.members = detail, errors, headers or {}, members


class NotParseable(ApiProblem):
    """A body or a parameter that cannot be read at all."""

    status = 400


class Unauthorized(ApiProblem):
    """A request without the bearer token."""

    status = 401


class NotFound(ApiProblem):
    """An id or name that is not known here."""

    status = 404


class NotAcceptable(ApiProblem):
    """No representation that the request accepts."""

    status = 406


class Conflict(ApiProblem):
    """A request that the state of a job forbids."""

    status = 409


class Gone(ApiProblem):
    """Something forgotten that can be asked for again."""

    status = 410


class UnsupportedFormat(ApiProblem):
    """A body of an unknown format."""

    status = 415


class RangeRefused(ApiProblem):
    """A byte range outside the representation."""

    status = 416


class Refused(ApiProblem):
    """Something readable that is wrong."""

    status = 422


class JobFailed(ApiProblem):
    """An artifact whose job failed."""

    status = 424


class NotReady(ApiProblem):
    """Something that this service needs is away."""

    status = 503


#: Slug of a problem's type, and its title, by status.
TITLES: Mapping[int, tuple[str, str]] = {
    400: ("not-parseable", "The request cannot be read"),
    401: ("unauthorized", "A bearer token is required"),
    404: ("not-found", "There is no such thing"),
    405: ("method-not-allowed", "This method is not allowed here"),
    406: ("not-acceptable", "There is no representation that the request accepts"),
    408: ("timeout", "The body did not arrive in time"),
    409: ("conflict", "The state of the job forbids this"),
    410: ("gone", "It was forgotten and can be made again"),
    413: ("too-large", "The request is too large"),
    415: ("unsupported-format", "The format of the body is not supported"),
    416: ("range-refused", "The byte range cannot be served"),
    422: ("refused", "The request is readable but wrong"),
    424: ("job-failed", "The job that makes it failed"),
    429: ("busy", "Too much is waiting already"),
    500: ("internal", "Something is wrong on our side"),
    503: ("not-ready", "The service cannot do this now"),
}

#: Exceptions of the rooms below, and the status each one means.
STATUS_OF: Mapping[type[Exception], int] = {
    MalformedBody: 400,
    SpecError: 422,
    InvalidUpload: 422,
    TooLargeUpload: 413,
    SlowUpload: 408,
    ReaderLost: 503,
    Busy: 429,
    UnknownJob: 404,
    FinishedJob: 409,
    UnknownArtifact: 404,
    GoneArtifact: 410,
    CorruptArtifact: 410,
    redis.exceptions.RedisError: 503,
}


def problem(
    status: int,
    detail: str,
    errors: Sequence[tuple[str, str]] = (),
    headers: Mapping[str, str] | None = None,
    members: Mapping[str, Any] | None = None,
) -> Response:
    """Answer a problem document."""
    slug, title = TITLES.get(status, ("error", "The request failed"))
    document = {
        "type": f"urn:softmaps:{slug}",
        "title": title,
        "status": status,
        "detail": detail,
        "errors": [{"pointer": pointer, "detail": what} for pointer, what in errors[:MAX_ERRORS]],
    }
    retry = {"Retry-After": str(RETRY_SECONDS)} if status in {429, 503} else {}
    return Response(
        # ASCII, so that whatever a message quotes can be sent.
        json.dumps(document | dict(members or {}), allow_nan=False).encode(),
        status,
        {**retry, "Cache-Control": "no-store", **(headers or {})},
        PROBLEM_TYPE,
    )


def register(app: FastAPI) -> None:
    """Make every error of an app a problem document."""
    app.add_exception_handler(ApiProblem, _api_problem)
    app.add_exception_handler(HTTPException, _http_exception)
    app.add_exception_handler(RequestValidationError, _invalid_parameters)
    app.add_exception_handler(OSError, _system_error)
    app.add_exception_handler(ClientDisconnect, _left)
    app.add_exception_handler(Exception, _unforeseen)
    for kind in STATUS_OF:
        app.add_exception_handler(kind, _known)


async def _api_problem(_: Request, error: Exception) -> Response:
    assert isinstance(error, ApiProblem)
    return problem(error.status, error.detail, error.errors, error.headers, error.members)


async def _known(_: Request, error: Exception) -> Response:
    status = next(status for kind, status in STATUS_OF.items() if isinstance(error, kind))
    if isinstance(error, redis.exceptions.RedisError):
        log.warning("Redis: %s", error)
        return problem(status, "Redis cannot be reached; finished results can still be read")
    if isinstance(error, SpecError):
        return problem(status, "The body was refused; see errors", error.errors)
    if isinstance(error, FinishedJob):
        members = {"job": job_reply(error.job).model_dump()}
        return problem(status, f"the job is {error.job.status} already", members=members)
    if isinstance(error, UnknownJob):
        return problem(status, "there is no such job")
    return problem(status, str(error))


async def _http_exception(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if error.status_code == 404:
        return problem(404, "There is no such address; see /docs")
    return problem(error.status_code, str(error.detail), headers=error.headers)


async def _invalid_parameters(_: Request, error: Exception) -> Response:
    """Say which parameters are wrong, without repeating what they hold."""
    assert isinstance(error, RequestValidationError)
    errors = [("/" + "/".join(map(str, one["loc"])), str(one["msg"])) for one in error.errors()[:MAX_ERRORS]]
    return problem(422, "A parameter was refused; see errors", errors)


async def _system_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, OSError)
    if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EMFILE, errno.ENFILE}:
        log.error("the system refuses: %s", error)
        return problem(503, "This machine is out of disk or of open files")
    return await _unforeseen(_, error)


async def _left(_: Request, error: Exception) -> Response:
    return problem(400, "The body ended before its end")  # nobody hears it


async def _unforeseen(_: Request, error: Exception) -> Response:
    log.error("an unforeseen error", exc_info=error)
    return problem(500, "An unforeseen error; the log of the service has more")
