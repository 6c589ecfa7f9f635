"""What can go wrong for a client, one type a cause.

ClientError
├── Unusable              what the client was given is no map or no address (a ValueError too)
├── Unreachable           nobody answers at the address, or the answer breaks off
│   └── Silence           nothing more came within the time given
├── WaitedTooLong         the job is not finished within the client's own patience; carries the job
├── JobFailed             the job ended without a result; carries the job
│   └── JobDismissed      somebody dismissed it
└── Refused               the service refused; carries its problem document (RFC 9457)
    ├── Unauthorized      401
    ├── NotFound          404
    ├── Conflict          409
    ├── Gone              410  carries the spec that makes it again
    ├── TooLarge          413
    ├── Unavailable       429, 503  after all retries
    └── Invalid           400, 415, 422  a body, mesh, array or spec that is wrong
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import httpx

if TYPE_CHECKING:
    from service.answers import Job


class ClientError(Exception):
    """Anything that a client can expect to go wrong."""


class Unusable(ClientError, ValueError):
    """What the client was given is no map, or no address."""


class Unreachable(ClientError):
    """Nobody answers at the address, or the answer breaks off."""


class Silence(Unreachable):
    """An answer had begun, but nothing more came within the time given."""


class WaitedTooLong(ClientError):
    """A job that is not finished within the client's patience; it goes on."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"{job.id} is still {job.status} ({job.progress:.0f} %)")
        self.job = job


class JobFailed(ClientError):
    """A job that ended without a result."""

    def __init__(self, job: Job) -> None:
        error = job.error or {}
        where = f" [{error['task']}]" if error.get("task") not in (None, job.id) else ""
        super().__init__(f"{job.id} {job.status}: {error.get('detail', 'no reason is recorded')}{where}")
        self.job = job


class JobDismissed(JobFailed):
    """A job that somebody dismissed."""

    def __init__(self, job: Job) -> None:
        super().__init__(job)
        self.args = (f"{job.id} was dismissed",)


class Refused(ClientError):
    """The service refused a request.

    Parameters
    ----------
    status : int
        Of the HTTP response.
    problem : mapping
        Its problem document; empty if it sent none.

    Attributes
    ----------
    errors : tuple of (str, str)
        JSON pointers into the body and what is wrong there.
    """

    def __init__(self, status: int, problem: Mapping[str, Any]) -> None:
        self.status, self.problem = status, problem
        self.errors = tuple(
            (str(e.get("pointer", "")), str(e.get("detail", ""))) for e in problem.get("errors", [])
        )
        said = str(problem.get("detail") or problem.get("title") or f"HTTP status {status}")
        super().__init__("; ".join([said, *(f"{pointer}: {detail}" for pointer, detail in self.errors)]))


class Unauthorized(Refused):
    """The token is missing or wrong."""


class NotFound(Refused):
    """No such job, artifact or array."""


class Conflict(Refused):
    """The state of a job forbids it."""


class Gone(Refused):
    """The artifact was forgotten; `spec` makes it again."""

    @property
    def spec(self) -> Mapping[str, Any] | None:
        """What to submit, or None for an upload."""
        spec: Mapping[str, Any] | None = self.problem.get("spec")
        return spec


class TooLarge(Refused):
    """A body beyond the service's limits."""


class Unavailable(Refused):
    """The service is full or misses something it needs."""


class Invalid(Refused):
    """A body, mesh, array or spec that is wrong."""


_KINDS: Mapping[int, type[Refused]] = {
    400: Invalid,
    401: Unauthorized,
    404: NotFound,
    409: Conflict,
    410: Gone,
    413: TooLarge,
    415: Invalid,
    422: Invalid,
    429: Unavailable,
    503: Unavailable,
}


def refusal(response: httpx.Response) -> Refused:
    """Error of a response that was read, by its status.

    Parameters
    ----------
    response : httpx.Response
        With a status of 400 or more.

    Returns
    -------
    Refused
        Of the type that the status stands for.
    """
    problem: Any = None
    if response.headers.get("content-type", "").startswith(("application/problem+json", "application/json")):
        try:
            problem = response.json()
        except ValueError:
            problem = None
    return _KINDS.get(response.status_code, Refused)(
        response.status_code, problem if isinstance(problem, Mapping) else {}
    )
