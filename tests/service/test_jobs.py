"""Jobs over HTTP: asked, waited for, followed, refused, dismissed."""

from __future__ import annotations

import asyncio
import itertools
import json
import subprocess
import time

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.service.conftest import HTTP, Service, energy, is_problem, sphere, until


def test_a_question_is_asked_waited_for_and_answered(http: httpx.Client, ball: str, worker: object) -> None:
    spec = energy(ball)
    asked = http.post("/v1/jobs", json=spec)
    assert asked.status_code == 202
    job = asked.json()
    assert asked.headers["location"] == job["links"]["self"] == f"/v1/jobs/{job['id']}"
    assert asked.headers["retry-after"] == "1"
    assert job["status"] in {"accepted", "running"}
    assert 0 <= job["progress"] <= 100
    done = http.get(f"/v1/jobs/{job['id']}?wait=30").json()
    assert done["status"] == "successful"
    assert done["progress"] == 100
    assert [task["kind"] for task in done["tasks"]] == ["basis", "softmap", "energy"]
    assert done["created_at"] <= done["started_at"] <= done["finished_at"]
    assert done["error"] is None
    artifact = http.get(done["links"]["artifact"]).json()
    assert artifact["values"]["bijectivity"] == pytest.approx(1.0)
    assert artifact["values"]["dirichlet"] == pytest.approx(0.0, abs=1e-18)
    assert artifact["parents"]["softmap"].startswith("softmap-")
    assert artifact["spec"]["regularisation"] == 1e-5
    assert {"seconds", "threads", "versions"} <= artifact["made"].keys()
    again = http.post("/v1/jobs", json=spec)
    assert (again.status_code, again.json()["id"]) == (200, job["id"])
    assert "retry-after" not in again.headers


def test_prefer_wait_is_honoured_and_said(http: httpx.Client, ball: str, worker: object) -> None:
    answer = http.post("/v1/jobs", json=energy(ball, 9), headers={"Prefer": "respond-async, wait=30; x"})
    assert (answer.status_code, answer.json()["status"]) == (200, "successful")
    assert answer.headers["preference-applied"] == "wait=30"
    for useless in ("wait", "wait=soon", "wait=-1", "wait=nan", "return=minimal"):
        answer = http.post("/v1/jobs", json=energy(ball, 9), headers={"Prefer": useless})
        assert "preference-applied" not in answer.headers
    assert (
        http.post("/v1/jobs", json=energy(ball, 9), headers={"Prefer": "wait=9999"}).headers[
            "preference-applied"
        ]
        == "wait=60"
    )


def test_a_map_with_wrong_values_is_a_failed_job_that_names_them(
    http: httpx.Client, ball: str, worker: object
) -> None:
    targets = list(range(66))
    targets[5] = -1
    spec = energy(ball, map={"type": "points", "targets": targets})
    answer = http.post("/v1/jobs", json=spec, headers={"Prefer": "wait=30"})
    assert (answer.status_code, answer.json()["status"]) == (200, "failed")
    error = answer.json()["error"]
    assert (error["index"], error["value"]) == (5, -1)
    assert error["task"].startswith("softmap-")
    artifact = http.get(answer.json()["links"]["artifact"])
    assert is_problem(artifact, 424, "-1")
    assert artifact.json()["job"]["status"] == "failed"
    assert is_problem(http.delete(answer.json()["links"]["self"]), 409, "failed already")


def test_events_tell_every_change_and_end_with_the_final_state(
    http: httpx.Client, ball: str, worker: object
) -> None:
    job = http.post("/v1/jobs", json=energy(ball, 10)).json()
    with http.stream("GET", job["links"]["events"]) as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        fields = [line.partition(": ")[::2] for line in stream.iter_lines() if line]
    states = [json.loads(value) for name, value in fields if name == "data"]
    assert states[-1]["status"] == "successful"
    assert all(a != b for a, b in itertools.pairwise(states))
    progress = [state["progress"] for state in states]
    assert progress == sorted(progress)
    assert fields[-2] == ("id", "final")
    # What an EventSource asks when it connects again: there is no more.
    assert http.get(job["links"]["events"], headers={"Last-Event-ID": "final"}).status_code == 204


def test_what_manifests_decide_is_422_with_pointers(http: httpx.Client, ball: str) -> None:
    unknown = energy("mesh-" + "0" * 32)
    answer = http.post("/v1/jobs", json=unknown)
    assert is_problem(answer, 422)
    assert answer.json()["errors"][0]["pointer"].startswith("/softmap/source")
    answer = http.post("/v1/jobs", json={"kind": "basis", "mesh": ball, "size": 67})
    assert is_problem(answer, 422)
    assert answer.json()["errors"][0]["pointer"] == "/size"
    short = energy(ball, map={"type": "points", "targets": [0, 1, 2]})
    assert is_problem(http.post("/v1/jobs", json=short), 422, "/softmap/map/targets")
    assert is_problem(http.post("/v1/jobs", json={"kind": "energy_block"}), 422, "/kind")


def test_bodies_that_are_no_json_are_400_and_other_media_415(http: httpx.Client) -> None:
    headers = {"Content-Type": "application/json"}
    for body in (
        b"",
        b"{",
        b'{"kind": NaN}',
        b'{"kind": "\\ud800"}',
        b"[" * 100_000,
        b'{"a":1,"a":2}',
        b"\xff",
    ):
        assert is_problem(http.post("/v1/jobs", content=body, headers=headers), 400)
    assert is_problem(http.post("/v1/jobs", content=b"{}", headers={"Content-Type": "text/plain"}), 415)


def test_errors_are_at_most_ten_and_echo_nothing(http: httpx.Client) -> None:
    body = {"kind": "basis"} | {f"secret-{k}": "secret" for k in range(20_000)}
    answer = http.post("/v1/jobs", json=body)
    assert is_problem(answer, 422)
    assert len(answer.json()["errors"]) == 10
    assert len(answer.content) < 5_000


@HTTP
@given(
    st.binary(max_size=200)
    | st.text(max_size=100).map(str.encode)
    | st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    ).map(lambda value: json.dumps(value).encode())
)
def test_no_body_makes_the_service_fail(http: httpx.Client, body: bytes) -> None:
    answer = http.post("/v1/jobs", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in {400, 422}
    answer = http.post("/v1/arrays", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in {200, 201, 400, 422}


def test_unknown_jobs_are_404_whatever_they_are_called(http: httpx.Client, ball: str) -> None:
    for id_ in ("energy-" + "0" * 32, "nonsense", "..%2f..%2fetc", ball, "energy-" + "0" * 31 + "%0a"):
        assert is_problem(http.get(f"/v1/jobs/{id_}"), 404)
        assert is_problem(http.get(f"/v1/jobs/{id_}/events"), 404)
        assert is_problem(http.delete(f"/v1/jobs/{id_}"), 404)


def test_without_a_worker_a_job_waits_is_listed_and_dismissed(idle: Service) -> None:
    with idle.client() as http:
        mesh = http.post("/v1/meshes?format=off", content=sphere(1)).json()["id"]
        jobs = [http.post("/v1/jobs", json=energy(mesh, size)).json() for size in (5, 6, 7)]
        job = jobs[-1]
        assert job["status"] == "accepted"
        # A wait that is in vain takes its time and no longer.
        began = time.monotonic()
        waited = http.get(f"{job['links']['self']}?wait=0.3")
        assert 0.3 <= time.monotonic() - began < 2
        assert waited.json()["status"] == "accepted"
        assert waited.headers["retry-after"] == "1"
        pending = http.get(job["links"]["artifact"])
        assert is_problem(pending, 409, "accepted")
        assert pending.json()["job"]["id"] == job["id"]
        # Pages, the newest first.
        first = http.get("/v1/jobs?limit=2&status=accepted").json()
        assert [each["id"] for each in first["items"]] == [jobs[2]["id"], jobs[1]["id"]]
        second = http.get(
            "/v1/jobs", params={"limit": 2, "status": "accepted", "cursor": first["next"]}
        ).json()
        assert [each["id"] for each in second["items"]] == [jobs[0]["id"]]
        assert second["next"] is None
        assert http.get("/v1/jobs?status=running").json() == {"items": [], "next": None}
        for wrong in ("status=done", "limit=0", "limit=201", "limit=x", "wait=x"):
            where = job["links"]["self"] if "wait" in wrong else "/v1/jobs"
            assert is_problem(http.get(f"{where}?{wrong}"), 422, "/query/")
        # Dismissed: again 200, listed as such, no artifact, and back by asking again.
        for _ in range(2):
            answer = http.delete(job["links"]["self"])
            assert (answer.status_code, answer.json()["status"]) == (200, "dismissed")
        assert http.get("/v1/jobs?status=dismissed").json()["items"][0]["id"] == job["id"]
        assert is_problem(http.get(job["links"]["artifact"]), 409, "dismissed")
        assert http.post("/v1/jobs", json=energy(mesh, 7)).json()["status"] == "accepted"


def test_too_many_waiting_tasks_are_429_with_a_time_to_come_back(tight: Service) -> None:
    with tight.client() as http:
        mesh = http.post("/v1/meshes?format=off", content=sphere(1)).json()["id"]
        assert http.post("/v1/jobs", json=energy(mesh, 5)).status_code == 202
        answer = http.post("/v1/jobs", json=energy(mesh, 6))
        assert is_problem(answer, 429)
        assert int(answer.headers["retry-after"]) > 0


def test_too_costly_questions_are_422(tight: Service) -> None:
    with tight.client() as http:
        mesh = http.post("/v1/meshes?format=off", content=sphere(3)).json()["id"]
        assert is_problem(http.post("/v1/jobs", json=energy(mesh, 258, gradient=True)), 422, "would take")


def test_a_client_that_leaves_is_no_longer_waited_on(idle: Service) -> None:
    with idle.client() as http:
        mesh = http.post("/v1/meshes?format=off", content=sphere(1)).json()["id"]
        job = http.post("/v1/jobs", json=energy(mesh)).json()
        with http.stream("GET", job["links"]["events"]) as stream:
            line = next(stream.iter_lines())
            assert line == "id: 1"
            until(lambda: idle.rooms.watch.waiting == 1)
        until(lambda: idle.rooms.watch.waiting == 0)


def test_a_hundred_waiters_do_not_hold_up_the_service(idle: Service) -> None:
    async def story(service: Service, path: str) -> None:
        limits = httpx.Limits(max_connections=200)
        async with httpx.AsyncClient(base_url=service.url, timeout=60, limits=limits) as http:
            waiting = [asyncio.create_task(http.get(f"{path}?wait=50")) for _ in range(100)]
            while service.rooms.watch.waiting < 100:
                await asyncio.sleep(0.01)
            for _ in range(20):
                assert (await http.get("/healthz")).status_code == 200
            # All of that while not one of them had been let go.
            assert service.rooms.watch.waiting == 100
            assert (await http.delete(path)).status_code == 200
            answers = await asyncio.gather(*waiting)
        assert {answer.json()["status"] for answer in answers} == {"dismissed"}

    with idle.client() as http:
        mesh = http.post("/v1/meshes?format=off", content=sphere(1)).json()["id"]
        job = http.post("/v1/jobs", json=energy(mesh)).json()
        asyncio.run(story(idle, job["links"]["self"]))


def test_the_same_question_from_many_at_once_is_one_job(
    http: httpx.Client, ball: str, worker: subprocess.Popen[bytes], service: Service
) -> None:
    async def story() -> list[httpx.Response]:
        async with httpx.AsyncClient(base_url=service.url, timeout=60) as clients:
            asked = [
                clients.post("/v1/jobs", json=energy(ball, 11), headers={"Prefer": "wait=30"})
                for _ in range(8)
            ]
            return await asyncio.gather(*asked)

    answers = asyncio.run(story())
    assert {answer.status_code for answer in answers} == {200}
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert len({answer.json()["finished_at"] for answer in answers}) == 1
