"""Bytes of a request → arrays: received onto disk without a name, read in a guarded child, mapped back.

The API process never holds a mesh file in memory and never parses one.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import mmap
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator
from dataclasses import asdict, dataclass
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from service.nursery import ALIGNMENT, FRAME, RESULT, Order, send
from worker.settings import Settings

#: Bytes gathered in memory before they go to disk.
_BATCH = 2**20
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
#: Seconds the nursery has to end after its owner hung up.
_STOP_SECONDS = 5.0


class UploadError(Exception):
    """An upload that was refused; the message is for the user."""


class InvalidUpload(UploadError):
    """A file or array that is wrong."""


class TooLargeUpload(UploadError):
    """A body, file or array above a limit."""


class SlowUpload(UploadError):
    """A sender that paused for too long."""


class ReaderLost(UploadError):
    """The process that reads uploads ended; the next upload starts another."""


@dataclass(frozen=True, eq=False)
class ReadMesh:
    """An uploaded mesh.

    Attributes
    ----------
    vertices : ndarray (V, 3) float64
        In the file's units and order; mapped from disk, read-only.
    faces : ndarray (F, 3) int64
        Likewise.
    facts : dict
        n_vertices, n_faces, area, n_components, euler_characteristic, n_boundary_loops, warnings.
    """

    vertices: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int64]
    facts: dict[str, Any]


class Uploads:
    """Receives bodies and has meshes read, a few at a time.

    Parameters
    ----------
    settings : Settings
        Limits, and the folder whose disk holds bodies while they are read.
    nursery : Nursery
        Where meshes are read.
    """

    def __init__(self, settings: Settings, nursery: Nursery) -> None:
        self._settings = settings
        self._nursery = nursery
        self._folder = settings.data / "uploads"
        self._folder.mkdir(parents=True, exist_ok=True)
        # As many children as cores; further uploads wait for their turn.
        self.turn = asyncio.Semaphore(os.cpu_count() or 1)

    def file(self) -> IO[bytes]:
        """Open an empty file without a name, on the disk of the store."""
        return tempfile.TemporaryFile(dir=self._folder)

    async def receive(self, stream: AsyncIterator[bytes]) -> IO[bytes]:
        """Bytes of a body, on disk: an open file without a name, at its beginning."""
        file = self.file()
        batch = bytearray()
        try:
            async for chunk in stream:
                batch += chunk
                if len(batch) >= _BATCH:
                    await asyncio.to_thread(file.write, batch)
                    batch = bytearray()
            await asyncio.to_thread(file.write, batch)
            file.seek(0)
        except BaseException:
            file.close()
            raise
        return file

    async def read_mesh(self, file: IO[bytes], file_format: str) -> ReadMesh:
        """Read a mesh file in a child process; to be called with `turn` held.

        Parameters
        ----------
        file : file
            What `receive` returned.
        file_format : str
            One of `service.parsing.FORMATS`.

        Returns
        -------
        ReadMesh
            Of a mesh that the solver accepts.

        Raises
        ------
        InvalidUpload
            Saying where the file is wrong, or that it took too long or too much memory.
        TooLargeUpload
            If the mesh has more vertices or faces than the settings allow.
        ReaderLost
            If the nursery ended meanwhile.
        """
        settings = self._settings
        file.flush()
        # The child shares the position of the file.
        os.lseek(file.fileno(), 0, os.SEEK_SET)
        with self.file() as result:
            outcome = await self._nursery.read(
                Order(
                    number=0,
                    file_format=file_format,
                    seconds=settings.upload_seconds,
                    memory_bytes=settings.upload_memory_bytes,
                    max_vertices=settings.max_vertices,
                    max_faces=settings.max_faces,
                ),
                file.fileno(),
                result.fileno(),
            )
            if outcome == "late":
                raise InvalidUpload(f"reading the file takes longer than {settings.upload_seconds:g} s")
            if outcome != "read":
                raise InvalidUpload("the file cannot be read: its reader died of it")
            return await asyncio.to_thread(_mapped, result)


def _mapped(result: IO[bytes]) -> ReadMesh:
    """Facts and arrays that a child wrote, the arrays mapped from the file."""
    view = mmap.mmap(result.fileno(), 0, access=mmap.ACCESS_READ)
    (length,) = RESULT.unpack_from(view)
    facts = json.loads(view[RESULT.size : RESULT.size + length])
    if "refused" in facts:
        raise (TooLargeUpload if facts["refused"] == "too large" else InvalidUpload)(facts["detail"])
    start = RESULT.size + length
    start += -start % ALIGNMENT
    n_vertices, n_faces = facts["n_vertices"], facts["n_faces"]
    vertices = np.frombuffer(view, np.float64, 3 * n_vertices, start).reshape(-1, 3)
    faces = np.frombuffer(view, np.int64, 3 * n_faces, start + vertices.nbytes).reshape(-1, 3)
    return ReadMesh(vertices, faces, facts)


class Nursery:
    """The owner's end of `service.nursery`: starts it, and hands each outcome to who waits for it."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._listener: asyncio.Task[None] | None = None
        self._waiting: dict[int, asyncio.Future[str]] = {}
        self._number = 0

    @property
    def pid(self) -> int | None:
        """Process id, None while there is none."""
        return self._process.pid if self._process is not None else None

    async def start(self) -> None:
        """Start the process; it goes on importing after this returns, and orders wait for it."""
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "service.nursery", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Threads of a BLAS must not exist where children are forked.
                env=os.environ | dict.fromkeys(_ONE_THREAD, "1"),
                start_new_session=True,
            )
        ours.setblocking(False)
        self._channel = ours
        self._listener = asyncio.create_task(self._listen(ours))

    async def stop(self) -> None:
        """End it, and every reader with it."""
        process, listener, channel = self._process, self._listener, self._channel
        self._process = self._listener = self._channel = None
        if listener is not None:
            listener.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await listener
        if channel is not None:
            channel.close()
        if process is not None:
            try:
                await asyncio.to_thread(process.wait, _STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                await asyncio.to_thread(process.wait)

    async def read(self, order: Order, upload: int, result: int) -> str:
        """Have one file read.

        Parameters
        ----------
        order : Order
            Its `number` is given here.
        upload, result : int
            Descriptors of open files.

        Returns
        -------
        {"read", "late", "died"}
            What became of the child.

        Raises
        ------
        ReaderLost
            If the nursery ended meanwhile.
        """
        if self._listener is None or self._listener.done():
            await self.stop()
            await self.start()
        assert self._channel is not None, "it was started just now"
        self._number += 1
        number = self._number
        waiting: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._waiting[number] = waiting
        try:
            # Orders are a few hundred bytes and as few as cores: the socket's buffer always takes them.
            send(self._channel, asdict(order) | {"number": number}, (upload, result))
            return await waiting
        except OSError as error:
            raise ReaderLost("the process that reads uploads ended; try again") from error
        finally:
            self._waiting.pop(number, None)

    async def _listen(self, channel: socket.socket) -> None:
        reader, writer = await asyncio.open_connection(sock=channel.dup())
        try:
            while True:
                (length,) = FRAME.unpack(await reader.readexactly(FRAME.size))
                frame = json.loads(await reader.readexactly(length))
                waiting = self._waiting.get(frame["number"])
                if waiting is not None and not waiting.done():
                    waiting.set_result(frame["outcome"])
        except (asyncio.IncompleteReadError, ConnectionError):
            pass  # it ended
        finally:
            writer.close()
            for waiting in self._waiting.values():
                if not waiting.done():
                    waiting.set_exception(ReaderLost("the process that reads uploads ended; try again"))
