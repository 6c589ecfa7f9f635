"""Bodies of requests: bounded in size and patience, and which format they are in."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from pathlib import PurePath
from typing import IO

from starlette.datastructures import UploadFile
from starlette.requests import Request
from starlette.types import Message

from service.errors import NotParseable, UnsupportedFormat
from service.parsing import FORMATS, MEDIA_TYPES, sniffed
from service.uploads import SlowUpload, TooLargeUpload, Uploads

#: Longest pause of a sender within a body, in seconds.
IDLE_SECONDS = 30.0
#: Bytes copied at once from a multipart file.
_CHUNK = 2**20
#: A body that is too large is read on for so long before it is refused: most clients listen only then.
_DRAIN_SECONDS = 10.0


class BoundedRequest(Request):
    """A request whose body is refused as soon as it exceeds a limit, or pauses for too long.

    Parameters
    ----------
    request : Request
        Not read yet.
    limit : int
        Most bytes of the body.

    Raises
    ------
    UnsupportedFormat
        If the body is compressed.
    TooLargeUpload
        At once if its Content-Length says so, else while it is read.
    SlowUpload
        While it is read, if nothing arrives for `IDLE_SECONDS`.
    """

    def __init__(self, request: Request, limit: int) -> None:
        super().__init__(request.scope, self._bounded, request._send)
        self._inner = request.receive
        self._limit = limit
        self._size = 0
        if request.headers.get("content-encoding", "identity").lower() != "identity":
            raise UnsupportedFormat("compressed bodies are not supported: send the file as it is")
        announced = request.headers.get("content-length", "")
        self._too_large = announced.isdecimal() and int(announced) > limit

    async def _bounded(self) -> Message:
        refusal = TooLargeUpload(f"the body is larger than {self._limit:,} bytes")
        # A client that expects "100 Continue" has sent nothing yet, and need not.
        if self._too_large and self.headers.get("expect", "").lower() == "100-continue":
            raise refusal
        message = await self._message()
        if self._too_large or self._size > self._limit:
            await self._drained(message)
            raise refusal
        return message

    async def _message(self) -> Message:
        try:
            async with asyncio.timeout(IDLE_SECONDS):
                message = await self._inner()
        except TimeoutError:
            raise SlowUpload(f"nothing of the body arrived for {IDLE_SECONDS:g} s") from None
        self._size += len(message.get("body", b""))
        return message

    async def _drained(self, message: Message) -> None:
        """Read on, throwing away, until the body ends, or is twice as large as allowed, or takes too long."""
        until = time.monotonic() + _DRAIN_SECONDS
        while message.get("more_body") and self._size < 2 * self._limit and time.monotonic() < until:
            message = await self._message()


async def mesh_file(request: Request, uploads: Uploads, limit: int) -> tuple[IO[bytes], str]:
    """Body of an uploaded mesh, on disk, and its format.

    The format is what ``?format=`` says, else the media type, else the name of a multipart `file`, else what
    the first bytes show beyond doubt.

    Raises
    ------
    UnsupportedFormat
        If it is none of `FORMATS`.
    NotParseable
        If a multipart body has no `file`.
    TooLargeUpload, SlowUpload
        See `BoundedRequest`.
    """
    bounded = BoundedRequest(request, limit)
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    named = request.query_params.get("format")
    found = _known(named) if named is not None else MEDIA_TYPES.get(media_type)
    if media_type != "multipart/form-data":
        file = await uploads.receive(bounded.stream())
    else:
        part = await _file_part(bounded)
        try:
            found = found or MEDIA_TYPES.get((part.content_type or "").lower()) or _by_name(part.filename)
            file = await uploads.receive(_chunks(part))
        finally:
            await part.close()
    if found is None:
        found = sniffed(file.read(512))
        file.seek(0)
    if found is None:
        file.close()
        raise UnsupportedFormat(f"say which format the file has: ?format={'|'.join(FORMATS)}")
    return file, found


def _known(name: str) -> str:
    if name.lower() not in FORMATS:
        raise UnsupportedFormat(f"the formats are {', '.join(FORMATS)}")
    return name.lower()


def _by_name(filename: str | None) -> str | None:
    ending = PurePath(filename or "").suffix.lower().removeprefix(".")
    return ending if ending in FORMATS else None


async def _file_part(request: Request) -> UploadFile:
    form = await request.form(max_files=1, max_fields=10)
    part = form.get("file")
    if not isinstance(part, UploadFile):
        await form.close()
        raise NotParseable("a multipart body needs one part named file, with a filename")
    return part


async def _chunks(part: UploadFile) -> AsyncIterator[bytes]:
    while chunk := await part.read(_CHUNK):
        yield chunk
