"""Artifacts over HTTP: what is known of one, and its numbers in every representation, condition and range."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.representations import JSON, NPY, RAW, chosen, matches
from tests.service.conftest import HTTP, Service, energy, is_problem, serving
from worker.settings import Settings
from worker.specs import array_id

NUMBERS = np.arange(60, dtype=np.float64).reshape(10, 3, 2) / 7


@pytest.fixture(scope="session")
def numbers(service: Service) -> str:
    """Address of an uploaded array (10, 3, 2)."""
    with service.client() as http:
        answer = http.post("/v1/arrays", json=NUMBERS.tolist())
    return str(answer.json()["arrays"]["array"]["href"])


@pytest.fixture(scope="session")
def large(service: Service) -> tuple[str, np.ndarray]:
    """Id and numbers of an array of 24 MB, which the store keeps in several blocks."""
    array = np.random.default_rng(7).standard_normal((1_000_000, 3))
    id_ = array_id(array)
    service.rooms.store.put(
        id_, kind="array", spec=None, parents={}, values={"name": None}, arrays={"array": array}, made={}
    )
    return id_, array


def body(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


# Representations --------------------------------------------------------------------------------------------


def test_npy_is_the_default_and_what_numpy_writes(http: httpx.Client, numbers: str) -> None:
    for accept in ("*/*", NPY, "application/*;q=0.5", "text/html, */*;q=0.1"):
        answer = http.get(numbers, headers={"Accept": accept})
        assert answer.headers["content-type"] == NPY
        assert answer.content == body(NUMBERS)
        assert int(answer.headers["content-length"]) == len(answer.content)


def test_raw_bytes_come_with_shape_and_type(http: httpx.Client, numbers: str) -> None:
    answer = http.get(numbers, headers={"Accept": RAW})
    assert answer.content == NUMBERS.astype("<f8").tobytes()
    assert answer.headers["array-shape"] == "10,3,2"
    assert answer.headers["array-dtype"] == "float64"


def test_json_is_nested_lists_with_every_digit(http: httpx.Client, numbers: str) -> None:
    answer = http.get(numbers, headers={"Accept": f"{JSON}, {NPY};q=0.9"})
    assert answer.headers["content-type"] == JSON
    assert answer.json() == NUMBERS.tolist()


def test_json_writes_null_for_what_is_not_finite(http: httpx.Client, service: Service) -> None:
    array = np.array([1.0, np.nan, np.inf])
    id_ = array_id(array)
    service.rooms.store.put(
        id_, kind="array", spec=None, parents={}, values={"name": None}, arrays={"array": array}, made={}
    )
    assert http.get(f"/v1/artifacts/{id_}/arrays/array", headers={"Accept": JSON}).json() == [1.0, None, None]


def test_arrays_of_many_blocks_arrive_whole(http: httpx.Client, large: tuple[str, np.ndarray]) -> None:
    id_, array = large
    href = f"/v1/artifacts/{id_}/arrays/array"
    assert http.get(href, headers={"Accept": RAW}).content == array.tobytes()
    assert http.get(href).content == body(array)
    part = http.get(f"{href}?rows=340000:360000", headers={"Accept": JSON})
    np.testing.assert_array_equal(np.array(part.json()), array[340_000:360_000])


@pytest.mark.parametrize(
    ("accept", "expected"),
    [
        (None, NPY),
        ("", NPY),
        ("*/*", NPY),
        ("application/json", JSON),
        ("Application/JSON ; Q=0.2", JSON),
        ("application/json;q=0.2, application/octet-stream;q=0.3", RAW),
        ("*/*;q=0.1, application/json", JSON),
        ("*/*, application/x-npy;q=0", RAW),
        ("application/*, application/x-npy;q=0, application/octet-stream;q=0", JSON),
        ("application/x-npy;q=0.001", NPY),
        ("application/json;q=2", None),
        ("text/html", None),
        ("image/png, application/json;q=0", None),
    ],
)
def test_accept_is_weighed_by_quality_and_specificity(accept: str | None, expected: str | None) -> None:
    from service.errors import NotAcceptable

    if expected is None:
        with pytest.raises(NotAcceptable):
            chosen(accept)
    else:
        assert chosen(accept) == expected


def test_what_nobody_offers_is_406(http: httpx.Client, numbers: str) -> None:
    assert is_problem(http.get(numbers, headers={"Accept": "text/html"}), 406, NPY)


# Rows -------------------------------------------------------------------------------------------------------


@HTTP
@given(st.none() | st.integers(-12, 12), st.none() | st.integers(-12, 12), st.sampled_from([NPY, RAW, JSON]))
def test_rows_are_a_python_slice(
    http: httpx.Client, numbers: str, start: int | None, stop: int | None, accept: str
) -> None:
    rows = f"{'' if start is None else start}:{'' if stop is None else stop}"
    answer = http.get(numbers, params={"rows": rows}, headers={"Accept": accept})
    expected = NUMBERS[start:stop]
    assert answer.headers["array-shape"] == ",".join(map(str, expected.shape))
    if accept == NPY:
        assert answer.content == body(expected)
    elif accept == RAW:
        assert answer.content == expected.tobytes()
    else:
        assert answer.json() == expected.tolist()


@pytest.mark.parametrize("rows", ["", "1", "1:2:3", "a:b", "1.5:2", ":" + "9" * 30, "0:1\n", "٣:٤"])
def test_rows_that_are_no_slice_are_422(http: httpx.Client, numbers: str, rows: str) -> None:
    assert is_problem(http.get(numbers, params={"rows": rows}), 422, "/query/rows")


# Conditions and ranges --------------------------------------------------------------------------------------


def test_every_representation_has_its_own_strong_tag(http: httpx.Client, numbers: str) -> None:
    tags = set()
    for accept in (NPY, RAW, JSON):
        for rows in ("", "?rows=0:2", "?rows=2:4"):
            answer = http.get(numbers + rows, headers={"Accept": accept})
            tags.add(answer.headers["etag"])
            assert answer.headers["vary"] == "Accept"
            assert answer.headers["cache-control"] == "public, max-age=31536000, immutable"
    assert len(tags) == 9
    assert not any(tag.startswith("W/") for tag in tags)
    # However the same rows are asked for, they are the same.
    assert http.get(numbers + "?rows=-10:10").headers["etag"] == http.get(numbers).headers["etag"]


def test_what_is_known_is_not_sent_again(http: httpx.Client, numbers: str) -> None:
    tag = http.get(numbers).headers["etag"]
    for known in (tag, f'"other", {tag}', f"W/{tag}", "*"):
        answer = http.get(numbers, headers={"If-None-Match": known})
        assert (answer.status_code, answer.content) == (304, b"")
        assert answer.headers["etag"] == tag
        assert answer.headers["vary"] == "Accept"
        assert "content-length" not in answer.headers
    assert http.get(numbers, headers={"If-None-Match": '"other"'}).status_code == 200
    assert http.get(numbers, headers={"If-None-Match": tag, "Accept": RAW}).status_code == 200
    assert not matches(None, tag)


@HTTP
@given(st.integers(0, 700), st.none() | st.integers(0, 700), st.sampled_from([NPY, RAW]), st.booleans())
@example(0, 0, NPY, False)
@example(100, 200, NPY, True)
def test_a_byte_range_is_that_part_of_the_whole(
    http: httpx.Client, numbers: str, first: int, last: int | None, accept: str, part: bool
) -> None:
    address = numbers + ("?rows=3:9" if part else "")
    whole = http.get(address, headers={"Accept": accept}).content
    asked = f"bytes={first}-{'' if last is None else last}"
    answer = http.get(address, headers={"Accept": accept, "Range": asked})
    if last is not None and last < first:
        assert (answer.status_code, answer.content) == (200, whole)  # not understood: everything
    elif first >= len(whole):
        assert is_problem(answer, 416)
        assert answer.headers["content-range"] == f"bytes */{len(whole)}"
    else:
        end = len(whole) if last is None else min(len(whole), last + 1)
        assert answer.status_code == 206
        assert answer.content == whole[first:end]
        assert answer.headers["content-range"] == f"bytes {first}-{end - 1}/{len(whole)}"
        assert answer.headers["accept-ranges"] == "bytes"


def test_the_last_bytes_and_ranges_over_blocks(http: httpx.Client, large: tuple[str, np.ndarray]) -> None:
    id_, array = large
    whole = body(array)
    href = f"/v1/artifacts/{id_}/arrays/array"
    assert http.get(href, headers={"Range": "bytes=-100"}).content == whole[-100:]
    assert http.get(href, headers={"Range": "bytes=8000000-9000000"}).content == whole[8_000_000:9_000_001]
    assert is_problem(http.get(href, headers={"Range": "bytes=-0"}), 416)


def test_a_range_of_another_version_is_the_whole(http: httpx.Client, numbers: str) -> None:
    whole = http.get(numbers)
    headers = {"Range": "bytes=0-9", "If-Range": whole.headers["etag"]}
    assert http.get(numbers, headers=headers).status_code == 206
    for other in ('"other"', "Wed, 21 Oct 2015 07:28:00 GMT", "W/" + whole.headers["etag"]):
        assert http.get(numbers, headers=headers | {"If-Range": other}).content == whole.content
    for unknown in ("bytes=0-1,4-5", "lines=0-1", "bytes=a-b", "bytes=-", "bytes"):
        answer = http.get(numbers, headers={"Range": unknown})
        assert (answer.status_code, answer.content) == (200, whole.content)


def test_head_is_get_without_a_body(http: httpx.Client, numbers: str, large: tuple[str, np.ndarray]) -> None:
    addresses = [
        numbers,
        f"{numbers}?rows=1:2",
        f"/v1/artifacts/{large[0]}/arrays/array",
        "/healthz",
        "/v1/jobs",
    ]
    for address in [*addresses, "/v1/nowhere"]:
        head, get = http.head(address), http.get(address)
        assert (head.status_code, head.content) == (get.status_code, b"")
        ignored = {"date"}
        assert {k: v for k, v in head.headers.items() if k not in ignored} == {
            k: v for k, v in get.headers.items() if k not in ignored
        }
    assert http.head(numbers, headers={"Range": "bytes=0-4"}).headers["content-length"] == "5"


# All arrays in one file -------------------------------------------------------------------------------------


def test_npz_is_what_numpy_loads_and_always_the_same_bytes(http: httpx.Client, ball: str) -> None:
    answer = http.get(f"/v1/artifacts/{ball}.npz")
    assert answer.headers["content-type"] == "application/zip"
    assert answer.headers["content-disposition"] == f'attachment; filename="{ball}.npz"'
    arrays = np.load(io.BytesIO(answer.content))
    listed = http.get(f"/v1/artifacts/{ball}").json()["arrays"]
    assert set(arrays) == set(listed) == {"vertices", "faces"}
    for name, entry in listed.items():
        np.testing.assert_array_equal(arrays[name], np.load(io.BytesIO(http.get(entry["href"]).content)))
    assert http.get(f"/v1/artifacts/{ball}.npz").content == answer.content
    tag = answer.headers["etag"]
    assert http.get(f"/v1/artifacts/{ball}.npz", headers={"If-None-Match": tag}).status_code == 304
    head = http.head(f"/v1/artifacts/{ball}.npz")
    assert (head.status_code, head.headers["etag"]) == (200, tag)
    assert is_problem(http.get(f"/v1/artifacts/{ball}.npz", headers={"Accept": JSON}), 406)


def test_npz_of_large_arrays_is_sound(http: httpx.Client, large: tuple[str, np.ndarray]) -> None:
    id_, array = large
    content = io.BytesIO(http.get(f"/v1/artifacts/{id_}.npz").content)
    assert zipfile.ZipFile(content).testzip() is None
    content.seek(0)
    np.testing.assert_array_equal(np.load(content)["array"], array)


# What is known of an artifact -------------------------------------------------------------------------------


def test_pages_go_through_all_artifacts_of_a_kind_once(http: httpx.Client) -> None:
    ids = {http.post("/v1/arrays", json=[k, k + 0.5]).json()["id"] for k in range(5)}
    found: list[str] = []
    query: dict[str, Any] = {"kind": "array", "limit": 2}
    while True:
        page = http.get("/v1/artifacts", params=query).json()
        assert len(page["items"]) <= 2
        found += [item["id"] for item in page["items"]]
        if page["next"] is None:
            break
        query["cursor"] = page["next"]
    assert found == sorted(set(found))
    assert ids <= set(found)
    assert http.get("/v1/artifacts?kind=nothing").json() == {"items": [], "next": None}
    assert is_problem(http.get("/v1/artifacts?kind=Not a kind"), 422, "/query/kind")


def test_unknown_artifacts_and_arrays_are_404(http: httpx.Client, ball: str) -> None:
    for id_ in ("energy-" + "0" * 32, "nonsense", "..%2f..%2fetc%2fpasswd", "mesh-" + "0" * 32):
        for address in (id_, f"{id_}.npz", f"{id_}/arrays/vertices"):
            assert is_problem(http.get(f"/v1/artifacts/{address}"), 404)
    assert is_problem(http.get(f"/v1/artifacts/{ball}/arrays/colours"), 404, "vertices, faces")


def test_what_was_forgotten_is_410_with_the_spec_that_brings_it_back(
    http: httpx.Client, service: Service, ball: str, worker: object
) -> None:
    job = http.post("/v1/jobs", json=energy(ball, 12), headers={"Prefer": "wait=30"}).json()
    before = http.get(job["links"]["artifact"]).json()
    kept = {item["id"] for item in http.get("/v1/artifacts?limit=200").json()["items"]} - {job["id"]}
    assert service.rooms.store.evict(0, keep=kept) == (job["id"],)
    answer = http.get(job["links"]["artifact"])
    assert is_problem(answer, 410)
    assert answer.json()["spec"] == before["spec"]
    assert is_problem(http.get(before["arrays"]["dirichlet_density"]["href"]), 410)
    again = http.post("/v1/jobs", json=answer.json()["spec"], headers={"Prefer": "wait=30"})
    assert (again.status_code, again.json()["id"]) == (200, job["id"])
    assert http.get(job["links"]["artifact"]).json()["values"] == before["values"]


def test_damaged_numbers_are_never_served(lonely: Settings) -> None:
    with serving(lonely) as service, service.client() as http:
        uploaded = http.post("/v1/arrays", json=NUMBERS.tolist()).json()
        for path in (service.settings.store_folder / "blobs").rglob("*"):
            if path.is_file():
                damage(path)
        answer = http.get(uploaded["arrays"]["array"]["href"])
        assert is_problem(answer, 410, "upload it again")
        assert is_problem(http.get(f"/v1/artifacts/{uploaded['id']}"), 410)
        again = http.post("/v1/arrays", json=NUMBERS.tolist())
        assert again.status_code == 201
        assert http.get(uploaded["arrays"]["array"]["href"]).content == body(NUMBERS)


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.chmod(0o644)
    path.write_bytes(content)


@HTTP
@given(
    st.dictionaries(
        st.sampled_from(["Accept", "Range", "If-Range", "If-None-Match"]),
        st.text(st.characters(min_codepoint=33, max_codepoint=255, exclude_categories=["Cc"]), max_size=30),
    )
)
def test_no_header_makes_the_service_fail(http: httpx.Client, numbers: str, headers: dict[str, str]) -> None:
    sent = {name: value.encode("latin-1") for name, value in headers.items()}
    answer = http.get(numbers, headers=sent)  # type: ignore[arg-type]
    assert answer.status_code in {200, 206, 304, 406, 416}
    if answer.status_code == 200 and answer.headers["content-type"] == JSON:
        assert json.loads(answer.content) == NUMBERS.tolist()
