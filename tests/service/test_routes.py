"""Uploads over HTTP: meshes and arrays, line by line of the contract."""

from __future__ import annotations

import io
import socket
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from service import receiving
from tests.service.conftest import HTTP, Service, is_problem, until
from tests.service.files import FACES, TETRAHEDRON, glb, obj, off, ply, scene, stl

# Meshes -----------------------------------------------------------------------------------------------------


def test_a_mesh_is_created_once_and_known_ever_after(http: httpx.Client) -> None:
    moved = TETRAHEDRON + 1
    first = http.post("/v1/meshes?format=off&name=a corner", content=off(moved))
    assert first.status_code == 201
    facts = first.json()
    assert facts["name"] == "a corner"
    assert {k: facts[k] for k in ("kind", "n_vertices", "n_faces", "n_components", "n_boundary_loops")} == {
        "kind": "mesh",
        "n_vertices": 4,
        "n_faces": 4,
        "n_components": 1,
        "n_boundary_loops": 0,
    }
    assert facts["euler_characteristic"] == 2
    assert facts["area"] == pytest.approx(1.5 + np.sqrt(3) / 2)
    assert first.headers["location"] == f"/v1/artifacts/{facts['id']}"
    vertices = http.get(facts["arrays"]["vertices"]["href"])
    np.testing.assert_array_equal(np.load(io.BytesIO(vertices.content)), moved)
    # The same arrays from another format, under another name: the same mesh.
    again = http.post("/v1/meshes?format=obj&name=other", content=obj(moved))
    assert again.status_code == 200
    assert again.json() == facts | {"format": "obj"}


@pytest.mark.parametrize(
    ("query", "content", "content_type"),
    [
        ("?format=OBJ", obj(), "text/plain"),
        ("", obj(), "model/obj"),
        ("", off(), "application/octet-stream"),
        ("", ply(">"), "application/octet-stream"),
        ("", glb(*scene()), "model/gltf-binary"),
        ("?format=ply", ply(""), "application/x-www-form-urlencoded"),
    ],
)
def test_the_format_is_told_or_seen(
    http: httpx.Client, tetrahedron: str, query: str, content: str | bytes, content_type: str
) -> None:
    answer = http.post(f"/v1/meshes{query}", content=content, headers={"Content-Type": content_type})
    assert (answer.status_code, answer.json()["id"]) == (200, tetrahedron)


def test_a_form_may_carry_the_file(http: httpx.Client, tetrahedron: str) -> None:
    answer = http.post("/v1/meshes", files={"file": ("corner.OBJ", obj(), "application/octet-stream")})
    assert (answer.status_code, answer.json()["id"]) == (200, tetrahedron)
    assert is_problem(http.post("/v1/meshes", files={"other": ("corner.obj", obj())}), 400, "named file")
    assert is_problem(http.post("/v1/meshes", files={"file": ("corner.xyz", obj())}), 415, "?format=")
    broken = http.post(
        "/v1/meshes", content=b"--x\r\n", headers={"Content-Type": "multipart/form-data; boundary=x"}
    )
    assert is_problem(broken, 400)


def test_unknown_formats_are_415(http: httpx.Client) -> None:
    assert is_problem(http.post("/v1/meshes", content=obj()), 415, "off|obj|ply|stl|glb")
    assert is_problem(http.post("/v1/meshes?format=dae", content=obj()), 415, "off, obj, ply, stl, glb")


def test_wrong_meshes_are_422_and_named(http: httpx.Client) -> None:
    assert is_problem(http.post("/v1/meshes?format=off", content=off()[:-9]), 422, "truncated")
    nan = off().replace("0.0 0.0 1.0", "0.0 0.0 nan")
    assert is_problem(http.post("/v1/meshes?format=off", content=nan), 422, "vertex 3")
    assert is_problem(http.post("/v1/meshes?format=off", content=b""), 422, "empty")
    assert is_problem(http.post("/v1/meshes?format=off&name=" + "n" * 201, content=off()), 422, "/query/name")


def test_stl_says_that_it_was_welded(http: httpx.Client) -> None:
    answer = http.post("/v1/meshes?format=stl", content=stl(TETRAHEDRON[FACES])).json()
    assert answer["n_vertices"] == 4
    assert "corners with equal bits are one vertex" in answer["warnings"][0]


def test_too_large_bodies_are_413_announced_or_not(tight: Service) -> None:
    with tight.client() as http:
        content = off() + "# " + "x" * 80_000
        assert is_problem(http.post("/v1/meshes?format=off", content=content), 413, "60,000 bytes")
        chunks = (content[k : k + 1000].encode() for k in range(0, len(content), 1000))
        assert is_problem(http.post("/v1/meshes?format=off", content=chunks), 413)
        assert is_problem(http.post("/v1/meshes", files={"file": ("a.off", content)}), 413)
        assert is_problem(http.post("/v1/jobs", json={"kind": "basis", "mesh": "m" * 600}), 413)
        assert is_problem(http.post("/v1/arrays", json=list(range(300))), 413)
        assert is_problem(http.post("/v1/arrays", content=npy(np.zeros(20)), headers=NPY), 413, "160 bytes")
        assert is_problem(http.post("/v1/arrays", content=bytes(10_000), headers=NPY), 413)


def test_a_client_that_waits_for_100_continue_is_refused_before_it_sends(service: Service) -> None:
    with socket.create_connection(service.url.removeprefix("http://").split(":")) as raw:
        raw.sendall(
            b"POST /v1/meshes?format=off HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999999\r\n"
            b"Expect: 100-continue\r\n\r\n"
        )
        raw.settimeout(5)
        assert raw.recv(12) == b"HTTP/1.1 413"


def test_a_compressed_body_is_415(http: httpx.Client) -> None:
    headers = {"Content-Encoding": "gzip"}
    assert is_problem(http.post("/v1/meshes?format=off", content=off(), headers=headers), 415, "compressed")


def test_a_sender_that_leaves_is_no_error_of_ours(
    service: Service, http: httpx.Client, caplog: pytest.LogCaptureFixture
) -> None:
    with socket.create_connection(service.url.removeprefix("http://").split(":")) as raw:
        raw.sendall(b"POST /v1/meshes?format=off HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\nOFF\n")
    left = 'method="POST",route="/v1/meshes",status="400"'
    until(lambda: left in http.get("/metrics").text)
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


def test_a_sender_that_pauses_is_given_up(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiving, "IDLE_SECONDS", 0.2)
    with socket.create_connection(service.url.removeprefix("http://").split(":")) as raw:
        raw.sendall(b"POST /v1/meshes?format=off HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\nOFF\n")
        raw.settimeout(5)
        assert raw.recv(12) == b"HTTP/1.1 408"


# Arrays -----------------------------------------------------------------------------------------------------

NPY = {"Content-Type": "application/x-npy"}


def npy(array: np.ndarray, **options: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, array, **options)
    return out.getvalue()


def stored(http: httpx.Client, answer: httpx.Response) -> np.ndarray:
    assert answer.status_code in {200, 201}, answer.text
    return np.load(io.BytesIO(http.get(answer.json()["arrays"]["array"]["href"]).content))


@HTTP
@given(
    hnp.arrays(
        st.one_of(
            hnp.integer_dtypes(endianness="?"), hnp.unsigned_integer_dtypes(endianness="?", sizes=(8, 16, 32))
        )
        | hnp.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
        hnp.array_shapes(max_dims=4, max_side=5),
        elements={"allow_nan": False, "allow_infinity": False},
    ),
    st.booleans(),
)
def test_any_real_array_comes_back_equal(http: httpx.Client, array: np.ndarray, fortran: bool) -> None:
    sent = np.asfortranarray(array) if fortran else array
    answer = http.post("/v1/arrays", content=npy(sent), headers=NPY)
    back = stored(http, answer)
    np.testing.assert_array_equal(back, array)
    assert back.dtype == (np.float64 if array.dtype.kind == "f" else np.int64)
    assert answer.json()["shape"] == list(array.shape)
    assert answer.json()["dtype"] == back.dtype.name


def test_json_lists_and_files_of_equal_numbers_are_one_array(http: httpx.Client) -> None:
    from_json = http.post("/v1/arrays?name=weights", json=[[0.25, 0.75], [1, 0]])
    assert from_json.status_code == 201
    assert from_json.json()["name"] == "weights"
    from_file = http.post("/v1/arrays", content=npy(np.array([[0.25, 0.75], [1, 0]])), headers=NPY)
    assert (from_file.status_code, from_file.json()) == (200, from_json.json())
    assert http.post("/v1/arrays", json=[1, 2]).json()["dtype"] == "int64"


class Evil:
    def __reduce__(self) -> Any:
        return (open, ("/tmp/softmaps-was-here", "w"))


@pytest.mark.parametrize(
    ("content", "part"),
    [
        (npy(np.array([Evil()], dtype=object), allow_pickle=True), "integers or real numbers"),
        (npy(np.array([1 + 2j])), "integers or real numbers"),
        (npy(np.array(["text"])), "integers or real numbers"),
        (npy(np.array([True])), "integers or real numbers"),
        (npy(np.zeros(1, dtype="f8,f8")), "integers or real numbers"),
        (npy(np.array([0.0, np.nan])), "number 1 of the array"),
        (npy(np.array([[0.0, 1], [2, -np.inf]])), "number 3 of the array"),
        (npy(np.array([2**63], dtype=np.uint64)), "63 bits"),
        (npy(np.zeros(())), "at least one number"),
        (npy(np.zeros((0, 3))), "at least one number"),
        (npy(np.zeros(4))[:-1], "announces 32 bytes"),
        (npy(np.zeros(4)) + b"x", "announces 32 bytes"),
        (npy(np.zeros(4)).replace(b"(4,)", b"(-4,)"), ""),
        (npy(np.zeros(4)).replace(b"(4,), ", b"(1e9,)"), "header"),
        (b"\x93NUMPY\x09\x00", "readable header"),
        (b"", "readable header"),
    ],
)
def test_wrong_arrays_are_422(http: httpx.Client, content: bytes, part: str) -> None:
    assert is_problem(http.post("/v1/arrays", content=content, headers=NPY), 422, part)


def test_wrong_json_arrays_are_400_or_422(http: httpx.Client) -> None:
    assert is_problem(http.post("/v1/arrays", json=[[1, 2], [3]]), 422, "/1")
    assert is_problem(http.post("/v1/arrays", json={"a": 1}), 422)
    headers = {"Content-Type": "application/json"}
    assert is_problem(http.post("/v1/arrays", content=b"[1, NaN]", headers=headers), 400, "NaN")
    assert is_problem(http.post("/v1/arrays", content=b"1,2,3", headers={"Content-Type": "text/csv"}), 415)
