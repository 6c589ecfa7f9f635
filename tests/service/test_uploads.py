"""An upload is read in a process of its own, which can neither hang, nor grow, nor stay."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import pytest

from service.uploads import InvalidUpload, Nursery, ReaderLost, ReadMesh, TooLargeUpload, Uploads
from tests.service.conftest import children
from tests.service.files import FACES, TETRAHEDRON, obj, off, ply
from worker.settings import Settings

Answer = TypeVar("Answer")
Told = Callable[..., Any]


@pytest.fixture(scope="module")
def loop() -> Iterator[asyncio.Runner]:
    with asyncio.Runner() as runner:
        yield runner


@pytest.fixture(scope="module")
def nursery(loop: asyncio.Runner) -> Iterator[Nursery]:
    nursery = Nursery()
    loop.run(nursery.start())
    yield nursery
    loop.run(nursery.stop())


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data=tmp_path)


@pytest.fixture
def told(loop: asyncio.Runner, nursery: Nursery, settings: Settings) -> Told:
    """Tell a story about uploads, with some settings changed."""

    def tell(story: Callable[[Uploads], Coroutine[None, None, Answer]], **changes: float) -> Answer:
        return loop.run(story(Uploads(settings.model_copy(update=changes), nursery)))

    return tell


async def received(uploads: Uploads, *chunks: bytes | str) -> IO[bytes]:
    async def stream() -> AsyncIterator[bytes]:
        for chunk in chunks:
            yield chunk if isinstance(chunk, bytes) else chunk.encode()

    return await uploads.receive(stream())


async def read(uploads: Uploads, content: bytes | str, file_format: str) -> ReadMesh:
    with await received(uploads, content) as file:
        return await uploads.read_mesh(file, file_format)


def refusal(told: Told, content: bytes | str, file_format: str, **changes: float) -> str:
    with pytest.raises(InvalidUpload) as refused:
        told(lambda uploads: read(uploads, content, file_format), **changes)
    return str(refused.value)


def test_a_mesh_comes_back_with_its_facts(told: Told) -> None:
    mesh = told(lambda uploads: read(uploads, ply(), "ply"))
    np.testing.assert_array_equal(mesh.vertices, TETRAHEDRON)
    np.testing.assert_array_equal(mesh.faces, FACES)
    assert mesh.facts == {
        "n_vertices": 4,
        "n_faces": 4,
        "area": pytest.approx(1.5 + np.sqrt(3) / 2),
        "n_components": 1,
        "euler_characteristic": 2,
        "n_boundary_loops": 0,
        "warnings": [],
    }


def test_warnings_of_reader_and_solver_are_both_told(told: Told) -> None:
    text = obj(faces=FACES[:1]) + "p 1\n"
    warnings = told(lambda uploads: read(uploads, text, "obj")).facts["warnings"]
    assert warnings[0] == "points were left out (1 of them)"
    assert any("unreferenced" in warning or "no face" in warning for warning in warnings[1:])


def test_what_the_solver_refuses_is_named(told: Told) -> None:
    flat = off(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 1]]), FACES)
    assert "face 0" in refusal(told, flat, "off")
    assert "vertex 3" in refusal(told, off().replace("0.0 0.0 1.0", "0.0 0.0 nan"), "off")


def test_a_file_that_takes_too_long_is_refused(told: Told) -> None:
    assert "longer than 0.001 s" in refusal(told, obj() * 20_000, "obj", upload_seconds=0.001)


def test_a_file_that_takes_too_much_memory_is_refused(told: Told) -> None:
    text = "v 0.5 0.5 0.5\n" * 400_000
    assert "bytes of memory" in refusal(told, text, "obj", upload_memory_bytes=15_000_000)


def test_a_mesh_with_too_many_faces_is_too_large(told: Told) -> None:
    with pytest.raises(TooLargeUpload, match="at most 3"):
        told(lambda uploads: read(uploads, off(), "off"), max_faces=3)


def test_after_a_refusal_the_next_file_is_read(told: Told) -> None:
    async def story(uploads: Uploads) -> ReadMesh:
        for content in (b"", b"OFF", off()[:-9].encode()):
            with pytest.raises(InvalidUpload):
                await read(uploads, content, "off")
        return await read(uploads, off(), "off")

    assert told(story).facts["n_faces"] == 4


def test_a_killed_reader_is_an_answer_and_a_killed_nursery_is_replaced(told: Told, nursery: Nursery) -> None:
    async def story(uploads: Uploads) -> ReadMesh:
        await read(uploads, off(), "off")
        pid = nursery.pid
        assert pid is not None
        reading = asyncio.create_task(read(uploads, "v 0.5 0.5 0.5\n" * 400_000, "obj"))
        until = time.monotonic() + 10
        while not (readers := children(pid)) and time.monotonic() < until:
            await asyncio.sleep(0.001)
        os.kill(readers.pop(), signal.SIGKILL)
        with pytest.raises(InvalidUpload, match="died"):
            await reading
        os.kill(pid, signal.SIGKILL)
        await asyncio.sleep(0.05)
        return await read(uploads, off(), "off")

    assert told(story).facts["n_faces"] == 4


def test_no_process_and_no_file_is_left(settings: Settings) -> None:
    before = children(os.getpid())

    async def story() -> set[int]:
        nursery = Nursery()
        await nursery.start()
        reading = asyncio.create_task(read(Uploads(settings, nursery), "v 0.5 0.5 0.5\n" * 400_000, "obj"))
        until = time.monotonic() + 10
        while len(found := children(os.getpid())) < 2 + len(before) and time.monotonic() < until:
            await asyncio.sleep(0.001)
        await nursery.stop()
        with pytest.raises(ReaderLost):
            await reading
        return found - before

    started = asyncio.run(story())
    assert len(started) == 2
    assert not any(Path(f"/proc/{pid}").exists() for pid in started)
    assert list((settings.data / "uploads").iterdir()) == []


def test_many_at_once_all_come_back_right(told: Told) -> None:
    async def story(uploads: Uploads) -> list[ReadMesh]:
        return await asyncio.gather(*(read(uploads, off(TETRAHEDRON * k), "off") for k in range(1, 21)))

    for k, mesh in enumerate(told(story), start=1):
        np.testing.assert_array_equal(mesh.vertices, TETRAHEDRON * k)


def test_bodies_of_many_chunks_arrive_whole(told: Told) -> None:
    content = os.urandom(3_000_000)
    chunks = [content[start : start + 65_536] for start in range(0, len(content), 65_536)]

    async def story(uploads: Uploads) -> bytes:
        with await received(uploads, *chunks) as file:
            return file.read()

    assert told(story) == content
