"""The Python client against a real stack, and against services that misbehave."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from service.answers import Job
from service.client import Client
from service.creature import creature
from service.off import off
from service.refusals import (
    ClientError,
    Conflict,
    Invalid,
    JobDismissed,
    JobFailed,
    NotFound,
    Refused,
    Silence,
    Unauthorized,
    Unavailable,
    Unreachable,
    Unusable,
    WaitedTooLong,
)
from service.stack import Stack
from worker.settings import Settings

Mesh = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    settings = Settings(data=tmp_path_factory.mktemp("stack"), threads=1, token="open sesame")
    with Stack(settings, workers=1) as running_stack:
        yield running_stack


@pytest.fixture
def client(stack: Stack) -> Iterator[Client]:
    with Client(stack.url, "open sesame") as connected:
        yield connected


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    """An icosahedron, subdivided twice and made a little uneven, so that farthest points are no ties."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    vertices = np.asarray(ball.vertices) * (1.0, 1.13, 1.29)
    return vertices, np.asarray(ball.faces, dtype=np.int64)


@pytest.fixture(scope="module")
def triangle() -> Mesh:
    """Two components, which no target may have."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]])
    return vertices, np.array([[0, 1, 2], [3, 4, 5]])


def basis(mesh: str, size: int) -> dict[str, object]:
    return {"kind": "basis", "mesh": mesh, "size": size}


def test_every_way_to_give_a_mesh_is_the_same_mesh(client: Client, sphere: Mesh, tmp_path: Path) -> None:
    path = tmp_path / "sphere.off"
    path.write_bytes(off(*sphere))
    from_arrays = client.upload_mesh(sphere)
    assert from_arrays.n_vertices == len(sphere[0])
    assert from_arrays.warnings == ()
    assert client.upload_mesh(path).id == from_arrays.id
    assert client.upload_mesh(str(path)).id == from_arrays.id
    assert client.upload_mesh(path.read_bytes(), format="off").id == from_arrays.id
    assert client.mesh(from_arrays.id).n_vertices == len(sphere[0])
    assert np.array_equal(client.array(from_arrays.id, "vertices"), sphere[0])
    assert np.array_equal(client.array(from_arrays.id, "faces"), sphere[1])


def test_arrays_come_back_as_they_were(client: Client, rng: np.random.Generator) -> None:
    sent = rng.normal(size=(37, 5))
    uploaded = client.upload_array(sent, name="numbers")
    assert uploaded.facts["name"] == "numbers"
    back = client.array(uploaded.id, "array")
    assert back.tobytes() == sent.tobytes()
    back[0, 0] = 1.0  # it is the caller's own
    assert np.array_equal(client.array(uploaded.id, "array", rows=(10, 20)), sent[10:20])
    assert client.array(uploaded.id, "array", rows=(5, 5)).shape == (0, 5)
    whole = client.arrays(client.upload_array(np.arange(4)).id)
    assert list(whole) == ["array"]
    assert whole["array"].dtype == np.int64


def test_energies_of_the_three_kinds_of_map(client: Client, sphere: Mesh) -> None:
    seen: list[Job] = []
    found = client.energy(sphere, sphere, "wks", size=12, gradient=True, progress=seen.append, timeout=120)
    assert found.dirichlet_density.shape == found.bijectivity_density.shape == (len(sphere[1]),)
    assert found.dirichlet > 0
    assert found.bijectivity >= 1 - 1e-9
    assert found.gradients["dirichlet"].shape == found.gradients["bijectivity"].shape == (12, 12)
    assert [job.status for job in seen][-1] == "successful"
    progress = [job.progress for job in seen]
    assert progress == sorted(progress)
    assert progress[-1] == 100

    identity = client.energy(sphere, sphere, np.arange(len(sphere[0])), size=12, timeout=120)
    assert identity.source == identity.target
    assert identity.gradients == {}
    softmap = client.lineage(identity.id)[-2]
    assert softmap.kind == "softmap"
    coefficients = client.array(softmap.id, "coefficients")
    again = client.energy(sphere, sphere, coefficients, size=12, timeout=120)
    assert again.dirichlet == pytest.approx(identity.dirichlet, rel=1e-12)
    smooth = client.energy(
        sphere, sphere, np.arange(len(sphere[0])), size=12, method="maxent", sharpness=2.0, timeout=120
    )
    assert client.lineage(smooth.id)[1].spec["sharpness"] == 2.0  # the basis behind it
    assert 0 < smooth.dirichlet < 2
    assert client.energy(sphere, sphere, "uniform", size=12, timeout=120).dirichlet == pytest.approx(
        0, abs=1e-12
    )


def test_momentum_and_paths(client: Client, sphere: Mesh) -> None:
    identity = client.softmap(sphere, sphere, np.arange(len(sphere[0])), size=12)
    one = client.momentum(identity, 5, [1.0, 0.5, 0.25], timeout=60)
    assert one.velocity.shape == one.momentum.shape == (len(sphere[1]), 3)
    # A soft map may be named by its id, once it is there; each of several faces is as if asked alone.
    softmap = client.artifact(one.id).parents["softmap"]
    both = client.momentum(softmap, np.array([9, 5]), [[0, 0, 1], [2.0, 1.0, 0.5]], timeout=60)
    assert both.momentum.shape == (2, len(sphere[1]), 3)
    assert np.allclose(both.momentum[1], 2 * one.momentum, rtol=1e-9, atol=1e-12)

    followed = client.path(softmap, [0, 40, 100], 0, step=0.05, timeout=60)
    assert followed.stopped == "end"
    corners = sphere[0][sphere[1][followed.faces]]
    assert np.allclose(followed.points, np.einsum("kc,kcx->kx", followed.barycentric, corners))
    assert np.allclose(followed.source_points[[0, -1]], sphere[0][[0, 100]])
    steps = np.linalg.norm(np.diff(followed.points, axis=0), axis=1)
    assert 0 < steps.sum() <= followed.length * (1 + 1e-12)

    points = client.pointmap(softmap, "barycentre", timeout=60)
    assert points.targets.shape == points.confidence.shape == (len(sphere[0]),)
    # A vertex goes to one nearby, and a point map is a map to ask about again.
    corners = sphere[0][points.targets]
    assert np.linalg.norm(corners - sphere[0], axis=1).mean() < 0.4
    assert client.pointmap(client.softmap(sphere, sphere, points.targets, size=12)).confidence.min() > 0

    with pytest.raises(Invalid, match="/face/1"):
        client.momentum(softmap, [0, 320], [[1, 0, 0]] * 2)
    with pytest.raises(Invalid, match="/start"):
        client.path(softmap, [0], 162)


def test_an_optimal_map_is_watched_dropped_and_gone_on_with(client: Client, sphere: Mesh) -> None:
    landmarks = [(0, 0), (40, 41), (100, 99)]
    seen: list[Job] = []

    def watch(job: Job) -> None:
        seen.append(job)
        # Drop it as soon as it has come some way.
        if job.values.get("iteration", 0) >= 20:
            client.dismiss(next(task.id for task in job.tasks if task.kind == "softmap"))

    options = {"size": 24, "method": "maxent", "optimiser": "softmax", "tolerance": 1e-9, "timeout": 120}
    with pytest.raises(JobDismissed) as dropped:
        client.optimise(sphere, sphere, landmarks, max_iterations=800, progress=watch, **options)
    running = [job for job in seen if job.values]
    assert "energy" in running[-1].phase
    assert {"iteration", "energy", "gap", "evaluations"} == set(running[-1].values)
    energies = [job.values["energy"] for job in running]
    assert energies == sorted(energies, reverse=True)
    # What it had found stays to be looked at, and asking again goes on from there.
    id_ = dropped.value.job.id
    snapshot = client.snapshot(id_)
    assert snapshot.shape == (24, 24)
    assert np.allclose(snapshot.sum(axis=1), 1)
    found = client.optimise(sphere, sphere, landmarks, max_iterations=800, **options)
    assert found.id == id_
    assert found.iterations <= 800
    assert found.history["energy"].shape == (found.iterations + 1,)
    assert found.history["seconds"][-1] > float(client.artifact(id_).made["seconds"])
    with pytest.raises(NotFound, match="see its artifact"):
        client.snapshot(id_)

    # The other method proves the same optimum in far fewer iterations; a landmark's row is held.
    proven = client.optimise(sphere, sphere, landmarks, **{**options, "optimiser": None, "tolerance": 1e-3})
    assert proven.converged
    assert proven.iterations < 60
    assert found.energy - (proven.energy - proven.gap) >= -1e-9
    assert proven.energy == pytest.approx(proven.dirichlet + proven.bijectivity, rel=1e-12)
    assert np.sort(proven.coefficients[:3], axis=1)[:, -1] == pytest.approx(1)


def test_the_lineage_has_parents_first(client: Client, sphere: Mesh) -> None:
    found = client.energy(sphere, sphere, "uniform", size=12, timeout=120)
    lineage = client.lineage(found.id)
    seen: set[str] = set()
    for artifact in lineage:
        assert set(artifact.parents.values()) <= seen
        seen.add(artifact.id)
    assert [one.kind for one in lineage] == ["mesh", "basis", "softmap", "energy"]
    assert all(one.seconds >= 0 for one in lineage)


def test_the_same_question_is_the_same_job(client: Client, sphere: Mesh) -> None:
    mesh = client.upload_mesh(sphere)
    first = client.submit(basis(mesh.id, 7), wait=30)
    assert first.finished
    assert first.seconds is not None
    assert client.submit(basis(mesh.id, 7)) == first
    assert client.job(first.id) == first
    assert first.id in [job.id for job in client.jobs("successful")]
    assert first.id not in [job.id for job in client.jobs("failed")]


def test_jobs_are_read_page_by_page(client: Client, sphere: Mesh) -> None:
    mesh = client.upload_mesh(sphere)
    asked = [client.submit(basis(mesh.id, size)).id for size in range(2, 60)]
    listed = [job.id for job in client.jobs()]
    assert set(asked) <= set(listed)
    assert len(listed) == len(set(listed))
    for id_ in asked:
        client.wait(id_, timeout=60)


def test_refusals_have_their_types(client: Client, stack: Stack, triangle: Mesh) -> None:
    with pytest.raises(Invalid, match="kind") as invalid:
        client.submit({"kind": "nothing of the kind"})
    assert invalid.value.status == 422
    assert invalid.value.errors[0][0].startswith("/")
    with pytest.raises(NotFound):
        client.job("energy-" + "0" * 32)
    with pytest.raises(NotFound):
        client.artifact("energy-" + "0" * 32)
    with pytest.raises(Invalid):
        client.upload_mesh(b"no mesh at all", format="off")
    with pytest.raises(Invalid, match="connected"):
        client.energy(triangle, triangle, "uniform", size=3)
    with Client(stack.url, "abracadabra") as stranger, pytest.raises(Unauthorized):
        list(stranger.jobs())
    with Client(stack.url) as stranger, pytest.raises(Unauthorized, match="Bearer"):
        stranger.upload_array([1, 2])


def test_a_failed_job_carries_its_reason(client: Client, sphere: Mesh) -> None:
    mesh = client.upload_mesh(sphere)
    targets = client.upload_array(np.full(len(sphere[0]), -1))
    softmap = {
        "kind": "softmap",
        "source": basis(mesh.id, 12),
        "target": basis(mesh.id, 12),
        "map": {"type": "points", "targets": targets.id},
    }
    with pytest.raises(JobFailed, match="-1") as failed:
        client.wait(client.submit(softmap).id, timeout=60)
    assert failed.value.job.status == "failed"
    with pytest.raises(ClientError):
        client.artifact(failed.value.job.id)


def test_waiting_ends_and_the_job_can_be_dismissed(client: Client) -> None:
    vertices, faces = creature()
    mesh = client.upload_mesh((vertices, faces))
    spec = {"kind": "spectrum", "mesh": mesh.id, "eigenpairs": 900}
    job = client.submit(spec)
    for progress in (None, lambda job: None):
        with pytest.raises(WaitedTooLong) as late:
            client.wait(job.id, progress, timeout=0.2)
        assert late.value.job.id == job.id
    assert client.dismiss(job.id).status == "dismissed"
    with pytest.raises(JobDismissed):
        client.wait(job.id, timeout=10)
    done = client.submit(basis(mesh.id, 3))
    client.wait(done.id, timeout=60)
    with pytest.raises(Conflict):
        client.dismiss(done.id)


def test_maps_that_fit_nothing_never_leave(client: Client, sphere: Mesh) -> None:
    count = len(sphere[0])
    with pytest.raises(Unusable, match=f"{count - 1} entries, the source {count} vertices"):
        client.energy(sphere, sphere, np.arange(count - 1), size=5)
    with pytest.raises(Unusable, match="seems to count from 1"):
        client.energy(sphere, sphere, np.arange(1, count + 1), size=5)
    with pytest.raises(Unusable, match="'sks' is no map"):
        client.energy(sphere, sphere, "sks", size=5)


# Services that misbehave

Reply = Callable[[BaseHTTPRequestHandler], None]


@contextmanager
def answering(*replies: Reply) -> Iterator[tuple[str, list[str]]]:
    """Serve some replies, one a request, the last one for ever; and note who asked for what."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def answer(self) -> None:
            self.rfile.read(int(self.headers.get("content-length", 0)))
            asked.append(f"{self.command} {self.path}")
            replies[min(len(asked), len(replies)) - 1](self)

        do_GET = do_POST = do_DELETE = answer  # noqa: N815

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}", asked
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def send(status: int, body: bytes, announced: int | None = None, **headers: str) -> Reply:
    def reply(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(status)
        for name, value in headers.items():
            handler.send_header(name.replace("_", "-"), value)
        handler.send_header("Content-Length", str(len(body) if announced is None else announced))
        handler.end_headers()
        handler.wfile.write(body)
        if announced is not None:
            handler.close_connection = True

    return reply


DONE = b'{"id": "array-1", "kind": "array", "shape": [2], "dtype": "int64"}'


@pytest.mark.parametrize("status", [429, 503])
def test_it_waits_as_it_is_told_and_asks_again(status: int) -> None:
    later = send(status, b"{}", Retry_After="0")
    with answering(later, later, send(201, DONE)) as (url, asked), Client(url) as client:
        assert client.upload_array([1, 2]).id == "array-1"
    assert asked == ["POST /v1/arrays"] * 3


def test_its_patience_ends() -> None:
    with answering(send(503, b'{"detail": "no worker"}', Retry_After="3")) as (url, asked):
        with Client(url, patience=0.5) as client, pytest.raises(Unavailable):
            client.job("energy-1")
        assert len(asked) == 1


def test_what_is_no_softmaps_is_said_to_be_none() -> None:
    hello, bad = send(200, b"<html>hello</html>"), send(502, b"<html>bad gateway</html>")
    with answering(hello, bad) as (url, _), Client(url) as client:
        with pytest.raises(Unreachable, match="not softmaps"):
            client.job("energy-1")
        with pytest.raises(Refused, match="502"):
            client.job("energy-1")


def test_an_array_that_breaks_off_is_no_array() -> None:
    cut = send(200, b"\0" * 100, announced=800, Array_Shape="100", Array_Dtype="float64")
    with answering(cut) as (url, _), Client(url) as client, pytest.raises(Unreachable, match="broke off"):
        client.array("array-1", "array")


def test_events_that_stop_are_looked_after() -> None:
    running = (
        b'{"id": "basis-1", "kind": "basis", "status": "%s", "progress": %d, "phase": "", "tasks": [], '
        b'"created_at": null, "started_at": null, "finished_at": null, "error": null, "values": {}}'
    )
    first, last = running % (b"running", 10), running % (b"successful", 100)
    stream = b"id: 1\ndata: " + first + b"\n\n"
    with (
        answering(send(200, first), send(200, stream), send(200, last)) as (url, asked),
        Client(url) as client,
    ):
        seen: list[float] = []
        assert client.wait("basis-1", lambda job: seen.append(job.progress)).status == "successful"
    assert seen == [10, 100]
    assert asked[1] == "GET /v1/jobs/basis-1/events"


def test_a_silent_answer_is_not_waited_for() -> None:
    with answering(send(200, b"abc", announced=10)) as (url, _), Client(url) as client:
        transport = client._transport
        with pytest.raises((Silence, Unreachable)), transport.stream("GET", "/", silence=0.2) as response:
            response.read()


def test_nobody_there() -> None:
    with Client("http://127.0.0.1:9", patience=0.1) as client:
        assert not client.ready()
        with pytest.raises(Unreachable, match=r"no answer from http://127.0.0.1:9"):
            client.job("energy-1")


@pytest.mark.parametrize("url", ["127.0.0.1:8000", "ftp://somewhere", "", "http://"])
def test_addresses_that_are_none(url: str) -> None:
    with pytest.raises(Unusable, match="say http://host:port"):
        Client(url)


def test_ready(client: Client) -> None:
    assert client.ready()
