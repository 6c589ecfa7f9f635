"""The app as a whole: light to import, healthy, described, guarded, and steady when Redis is not."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import pytest

from service import app
from service.app import create_app
from service.embedded import EmbeddedRedis
from tests.service.conftest import Service, children, energy, is_problem, serving, sphere, until
from worker import specs
from worker.settings import Settings

ROOT = Path(__file__).resolve().parents[2]


def test_importing_the_app_is_light() -> None:
    """Nothing heavy is loaded, and all that is not FastAPI costs less time than FastAPI twice."""
    code = """
import sys, time
began = time.process_time()
import fastapi.openapi.models
between = time.process_time()
import service.app
heavy = {"scipy", "numba", "trimesh", "solver", "potpourri3d", "matplotlib"} & sys.modules.keys()
print(sorted(heavy), (time.process_time() - between) / (between - began))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    heavy, ratio = done.stdout.rsplit(" ", 1)
    assert heavy == "[]"
    assert float(ratio) < 2


def test_a_redis_must_be_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="SOFTMAPS_REDIS_URL"):
        create_app(Settings(data=tmp_path))


# Health -----------------------------------------------------------------------------------------------------


def test_health_readiness_and_numbers(http: httpx.Client, ball: str, worker: object) -> None:
    assert http.get("/healthz").json()["status"] == "ok"
    http.post("/v1/jobs", json=energy(ball, 13), headers={"Prefer": "wait=30"})
    ready = http.get("/readyz")
    assert (ready.status_code, ready.json()["workers"]) == (200, 1)
    answer = http.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    numbers = dict(line.rsplit(" ", 1) for line in answer.text.splitlines() if not line.startswith("#"))
    assert numbers["softmaps_workers"] == "1"
    assert numbers["softmaps_redis_up"] == "1"
    assert int(numbers["softmaps_store_bytes"]) > 0
    assert int(numbers['softmaps_http_requests_total{method="GET",route="/healthz",status="200"}']) >= 1
    jobs = 'softmaps_http_request_seconds_bucket{route="/v1/jobs",le='
    buckets = [int(value) for name, value in numbers.items() if name.startswith(jobs)]
    assert buckets == sorted(buckets)
    assert buckets[-1] == int(numbers['softmaps_http_request_seconds_count{route="/v1/jobs"}'])
    # Prometheus reads a name, labels and a number, and nothing else.
    pattern = re.compile(r'[a-z_]+(\{([a-z]+="[^"]*",?)+\})? [0-9.e+-]+')
    assert all(pattern.fullmatch(line) for line in answer.text.splitlines() if not line.startswith("#"))


def test_addresses_of_strangers_make_no_new_numbers(http: httpx.Client) -> None:
    for k in range(5):
        http.get(f"/nowhere/{k}")
        http.request("BREW", f"/v1/artifacts/pot-{k}")
    text = http.get("/metrics").text
    assert "nowhere" not in text
    assert "pot-" not in text
    assert "BREW" not in text


def test_without_workers_the_service_is_not_ready(idle: Service) -> None:
    with idle.client() as http:
        answer = http.get("/readyz")
    assert is_problem(answer, 503, "no worker")
    assert "retry-after" in answer.headers


# Description ------------------------------------------------------------------------------------------------


def test_the_openapi_document_is_complete(http: httpx.Client) -> None:
    document = http.get("/openapi.json").json()
    expected = {
        ("/v1/meshes", "post"),
        ("/v1/arrays", "post"),
        ("/v1/jobs", "post"),
        ("/v1/jobs", "get"),
        ("/v1/jobs/{id}", "get"),
        ("/v1/jobs/{id}", "delete"),
        ("/v1/jobs/{id}/events", "get"),
        ("/v1/jobs/{id}/snapshot", "get"),
        ("/v1/artifacts", "get"),
        ("/v1/artifacts/{id}", "get"),
        ("/v1/artifacts/{id}.npz", "get"),
        ("/v1/artifacts/{id}/arrays/{name}", "get"),
        ("/healthz", "get"),
        ("/readyz", "get"),
        ("/metrics", "get"),
    }
    operations = {(path, method) for path, methods in document["paths"].items() for method in methods}
    assert operations == expected
    names = set(re.findall(r'"#/components/schemas/([^"]+)"', json.dumps(document)))
    assert names <= document["components"]["schemas"].keys()
    asked = {model.__name__ for model in specs.MODELS if not model.private}
    assert {"Problem", "PoissonBasis", "MaxentBasis", "Momentum"} | asked <= names
    assert "HTTPValidationError" not in document["components"]["schemas"]


def test_every_example_of_the_document_is_a_spec(http: httpx.Client) -> None:
    from worker.questions import parse

    body = http.get("/openapi.json").json()["paths"]["/v1/jobs"]["post"]["requestBody"]
    examples = body["content"]["application/json"]["examples"]
    for example in examples.values():
        parse(json.dumps(example["value"]))
    shown = {
        kind for example in examples.values() for kind in re.findall(r'"kind": "(\w+)"', json.dumps(example))
    }
    assert shown == set(specs.PUBLIC_KINDS)


def test_the_page_lists_every_operation_and_asks_no_other_host(http: httpx.Client) -> None:
    page = http.get("/docs")
    assert page.headers["content-type"].startswith("text/html")
    for path in http.get("/openapi.json").json()["paths"]:
        assert f"<code>{path}</code>" in page.text
    assert "//" not in page.text.replace("application/", "")
    assert "<script" not in page.text
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert http.get("/").json()["links"]["docs"] == "/docs"


# The token --------------------------------------------------------------------------------------------------


def test_with_a_token_everything_but_health_needs_it(lonely: Settings) -> None:
    guarded = Settings(data=lonely.data, redis_url=lonely.redis_url, token="open sesame")
    with serving(guarded) as service, service.client() as http:
        assert http.get("/healthz").status_code == 200
        assert is_problem(http.get("/readyz"), 503)
        wrong = [
            "",
            "Bearer",
            "Bearer open",
            "Bearer open sesame!",
            "Basic open sesame",
            "open sesame",
            "Bearer ö",
        ]
        for address in ("/", "/docs", "/openapi.json", "/metrics", "/v1/jobs", "/nowhere"):
            for given in wrong:
                answer = http.get(address, headers={"Authorization": given.encode("latin-1")})  # type: ignore[dict-item]
                assert is_problem(answer, 401)
                assert answer.headers["www-authenticate"] == "Bearer"
        http.headers["Authorization"] = "bearer open sesame"
        mesh = http.post("/v1/meshes?format=off", content=sphere(0))
        assert mesh.status_code == 201
        # Nothing that needs a token may stay in a shared cache.
        cached = http.get(mesh.json()["arrays"]["faces"]["href"]).headers["cache-control"]
        assert cached == "private, max-age=31536000, immutable"


# Redis away -------------------------------------------------------------------------------------------------


def test_without_redis_results_are_served_and_the_rest_says_so(tmp_path: Path) -> None:
    server = EmbeddedRedis(tmp_path / "redis")
    try:
        with serving(Settings(data=tmp_path, redis_url=server.url)) as service, service.client() as http:
            mesh = http.post("/v1/meshes?format=off", content=sphere(1)).json()
            job = http.post("/v1/jobs", json=energy(mesh["id"])).json()
            server.stop()
            assert http.get("/healthz").status_code == 200
            assert http.get(f"/v1/artifacts/{mesh['id']}").json()["values"]["n_faces"] == 32
            assert http.get(mesh["arrays"]["vertices"]["href"]).status_code == 200
            assert http.get(f"/v1/artifacts/{mesh['id']}.npz").status_code == 200
            assert http.post("/v1/meshes?format=off", content=sphere(0)).status_code == 201
            assert is_problem(http.get("/v1/artifacts/energy-" + "0" * 32), 404)
            for answer in (
                http.get("/readyz"),
                http.get(job["links"]["self"]),
                http.post("/v1/jobs", json=energy(mesh["id"], 9)),
                http.delete(job["links"]["self"]),
            ):
                assert is_problem(answer, 503, "Redis")
                assert int(answer.headers["retry-after"]) > 0
            assert "softmaps_redis_up 0" in http.get("/metrics").text
    finally:
        server.stop()


def test_the_recovering_loop_outlives_a_redis_that_goes(
    lonely: Settings, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "RECONCILE_SECONDS", 0.02)
    gone = EmbeddedRedis(lonely.data / "redis")
    gone.stop()
    with (
        caplog.at_level(logging.WARNING, "service.app"),
        serving(Settings(data=lonely.data, redis_url=gone.url)) as restless,
        restless.client() as http,
    ):
        until(lambda: sum("nothing is recovered" in record.message for record in caplog.records) >= 3)
        assert http.get("/healthz").status_code == 200


def test_the_service_leaves_no_thread_and_no_process(lonely: Settings) -> None:
    before = children(os.getpid())
    with serving(lonely) as service, service.client() as http:
        assert http.post("/v1/meshes?format=off", content=sphere(0)).status_code == 201
        assert children(os.getpid()) > before
        names = {thread.name for thread in threading.enumerate()}
        assert "reconcile" in names
    assert children(os.getpid()) == before
