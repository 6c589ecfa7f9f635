"""Every error is a problem document, and says nothing that it should not."""

from __future__ import annotations

import asyncio
import errno

import httpx
import pytest
import redis.exceptions
from fastapi import FastAPI

from service.errors import STATUS_OF, TITLES, ApiProblem, Refused, register
from service.uploads import InvalidUpload, ReaderLost
from tests.service.conftest import is_problem
from worker.fields import SpecError
from worker.queue import Busy, TooCostly
from worker.store import UnknownArtifact


def raising(error: Exception) -> httpx.Response:
    """Answer of an app whose only endpoint raises."""
    app = FastAPI()
    register(app)

    @app.get("/")
    def fail() -> None:
        raise error

    async def asked() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://here") as client:
            return await client.get("/")

    return asyncio.run(asked())


def test_every_status_of_the_table_has_a_title() -> None:
    statuses = {*STATUS_OF.values(), *(kind.status for kind in ApiProblem.__subclasses__())}
    assert statuses <= TITLES.keys()
    assert len({slug for slug, _ in TITLES.values()}) == len(TITLES)


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (SpecError(("/size", "too large")), 422),
        (TooCostly(("", "too long")), 422),
        (InvalidUpload("line 7"), 422),
        (Refused("no", [("/query/rows", "wrong")]), 422),
        (Busy("full"), 429),
        (UnknownArtifact("energy-0", "is not known"), 404),
        (ReaderLost("gone"), 503),
        (redis.exceptions.ConnectionError("secret.host:6379"), 503),
        (redis.exceptions.TimeoutError("secret.host:6379"), 503),
        (OSError(errno.ENOSPC, "No space left", "/secret/folder"), 503),
        (OSError(errno.EACCES, "Permission denied", "/secret/folder"), 500),
        (RuntimeError("secret"), 500),
        (AssertionError(), 500),
    ],
)
def test_exceptions_have_their_status_and_keep_secrets(error: Exception, status: int) -> None:
    answer = raising(error)
    assert is_problem(answer, status)
    assert "secret" not in answer.text
    assert "Traceback" not in answer.text
    assert ("retry-after" in answer.headers) == (status in {429, 503})


def test_pointers_are_handed_on() -> None:
    answer = raising(SpecError(("/softmap/map/targets/5", "is -1")))
    assert answer.json()["errors"] == [{"pointer": "/softmap/map/targets/5", "detail": "is -1"}]


def test_unknown_addresses_and_methods_are_problems(http: httpx.Client) -> None:
    assert is_problem(http.get("/nowhere"), 404, "/docs")
    assert is_problem(http.get("/v1"), 404)
    assert is_problem(http.get("/v1/jobs/a/b/c/d"), 404)
    for method, address, allowed in (("PUT", "/v1/jobs", "POST"), ("DELETE", "/v1/meshes", "POST")):
        answer = http.request(method, address)
        assert is_problem(answer, 405)
        assert allowed in answer.headers["allow"]


def test_addresses_that_are_no_text_are_answered(http: httpx.Client) -> None:
    for id_ in ("%ff%fe", "%00", "%ed%a0%80", "a" * 5000):
        assert is_problem(http.get(f"/v1/artifacts/{id_}"), 404)
        assert is_problem(http.get(f"/v1/jobs/{id_}"), 404)
    assert is_problem(http.get("/v1/jobs?status=%ed%a0%80"), 422)
    assert is_problem(http.get("/v1/jobs?cursor=" + "c" * 300), 422, "/query/cursor")
