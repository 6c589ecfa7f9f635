"""An array of the store as bytes of HTTP: npy, raw or JSON, some rows, a byte range; block by block.

RFC 9110: content negotiation in section 12.5.1, validators in 8.8, ranges in 14.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import re
import zipfile
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from starlette.concurrency import iterate_in_threadpool, run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse

from service.errors import NotAcceptable, RangeRefused, Refused
from worker.manifests import DTYPES
from worker.store import Manifest, Store, StoredArray

NPY, RAW, JSON = "application/x-npy", "application/octet-stream", "application/json"
#: Representations of an array, the first one by default.
REPRESENTATIONS = (NPY, RAW, JSON)
#: Content never changes under an address; where a token is needed, no shared cache may keep it.
CACHE_PUBLIC = "public, max-age=31536000, immutable"
CACHE_PRIVATE = "private, max-age=31536000, immutable"
#: Bytes handed to the network at once: a slow reader holds no more.
_PIECE = 256 * 2**10
#: Numbers read at once: about a block of the store, which is verified whole each time.
_JSON_READ = 2**20
#: Numbers written as JSON at once; the interpreter serves nobody else meanwhile.
_JSON_WRITTEN = 10_000
Bytes = bytes | memoryview
_ROWS = re.compile(r"(-?[0-9]{1,18})?:(-?[0-9]{1,18})?")
_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")


def chosen(accept: str | None, offered: tuple[str, ...] = REPRESENTATIONS) -> str:
    """Media type that an Accept header likes best; the first offered one where it does not care.

    Raises
    ------
    NotAcceptable
        If it likes none.
    """
    ranges = [_accepted(item) for item in (accept or "*/*").split(",")]

    def quality(media_type: str) -> float:
        main = media_type.partition("/")[0]
        # The most specific range that covers a type decides, even if it forbids.
        matches = [
            (specific, q)
            for wanted, q in ranges
            for specific, pattern in ((2, media_type), (1, f"{main}/*"), (0, "*/*"))
            if wanted == pattern
        ]
        return max(matches, default=(0, 0.0))[1]

    best = max(offered, key=quality)
    if quality(best) <= 0:
        raise NotAcceptable(f"this can be had as {', '.join(offered)}")
    return best


def _accepted(item: str) -> tuple[str, float]:
    """Media range and quality of one item of an Accept header."""
    wanted, *parameters = (part.strip() for part in item.lower().split(";"))
    q = 1.0
    for parameter in parameters:
        name, _, value = parameter.partition("=")
        if name.strip() == "q":
            q = float(value) if re.fullmatch(r" *(0(\.[0-9]{0,3})?|1(\.0{0,3})?) *", value) else 0.0
    return wanted, q


@dataclass(frozen=True)
class Rows:
    """Rows of a stored array: `start` up to, not including, `stop`."""

    array: StoredArray
    start: int
    stop: int

    @classmethod
    def asked(cls, array: StoredArray, rows: str | None) -> Rows:
        """Rows that ``a:b`` means, as in a Python slice without a step; all for None.

        Raises
        ------
        Refused
            If it is no such slice.
        """
        match = _ROWS.fullmatch(rows if rows is not None else ":")
        if match is None:
            wanted = "Input should be a slice like 0:10, 5: or :-1"
            raise Refused("A parameter was refused; see errors", [("/query/rows", wanted)])
        bounds = [int(bound) if bound else None for bound in match.groups()]
        start, stop, _ = slice(*bounds).indices(array.shape[0])
        return cls(array, start, max(start, stop))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of these rows."""
        return (self.stop - self.start, *self.array.shape[1:])

    @property
    def begin(self) -> int:
        """First byte of these rows in the array."""
        return self.start * self.array.row_bytes

    @property
    def end(self) -> int:
        """First byte after them."""
        return self.stop * self.array.row_bytes

    def npy_header(self) -> bytes:
        """What comes before the bytes in a .npy file."""
        out = io.BytesIO()
        description = {"descr": DTYPES[self.array.dtype].str, "fortran_order": False, "shape": self.shape}
        np.lib.format.write_array_header_1_0(out, description)
        return out.getvalue()


async def array_response(
    request: Request, store: Store, manifest: Manifest, name: str, asked: str | None, cache: str
) -> Response:
    """Answer a GET or HEAD for an array: negotiated, conditional, ranged, streamed.

    Raises
    ------
    NotAcceptable, Refused, RangeRefused
        For headers and parameters that cannot be met.
    CorruptArtifact, GoneArtifact
        If the first block is no longer whole.
    """
    media_type = chosen(request.headers.get("accept"))
    stored = manifest.arrays[name]
    rows = Rows.asked(stored, asked)
    short = {NPY: "npy", RAW: "raw", JSON: "json"}[media_type]
    part = "" if rows.shape == stored.shape else f"-{rows.start}-{rows.stop}"
    etag = f'"{stored.sha256[:32]}-{short}{part}"'
    headers = {
        "ETag": etag,
        "Vary": "Accept",
        "Cache-Control": cache,
        "Array-Shape": ",".join(map(str, rows.shape)),
        "Array-Dtype": stored.dtype,
    }
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    if media_type == JSON:
        return await _answer(request, 200, headers, media_type, _json_rows(store, manifest, name, rows))
    prefix = rows.npy_header() if media_type == NPY else b""
    size = len(prefix) + rows.end - rows.begin
    span = _span(request, etag, size)
    first, last = span or (0, size)
    headers |= {"Accept-Ranges": "bytes", "Content-Length": str(last - first)}
    if span:
        headers["Content-Range"] = f"bytes {first}-{last - 1}/{size}"
    content = _bytes(store, manifest, name, rows, prefix, first, last)
    return await _answer(request, 206 if span else 200, headers, media_type, content)


async def npz_response(request: Request, store: Store, manifest: Manifest, cache: str) -> Response:
    """Answer all arrays of an artifact as one .npz file, written as it is sent.

    Equal arrays give equal bytes.

    Raises
    ------
    NotAcceptable
        If the request accepts no such file.
    CorruptArtifact, GoneArtifact
        If the first block is no longer whole.
    """
    content = "".join(f"{name}:{array.sha256}\n" for name, array in manifest.arrays.items())
    etag = f'"{hashlib.sha256(content.encode()).hexdigest()[:32]}-npz"'
    headers = {"ETag": etag, "Cache-Control": cache, "Vary": "Accept"}
    headers["Content-Disposition"] = f'attachment; filename="{manifest.id}.npz"'
    chosen(request.headers.get("accept"), ("application/zip", "application/x-npz", RAW))
    if matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    return await _answer(request, 200, headers, "application/zip", _zipped(store, manifest))


def passing_response(request: Request, array: npt.NDArray[np.float64], headers: dict[str, str]) -> Response:
    """Answer an array that is about to be another, as npy or raw; no one may keep it.

    Raises
    ------
    NotAcceptable
        If the request accepts neither.
    """
    media_type = chosen(request.headers.get("accept"), (NPY, RAW))
    headers = headers | {"Cache-Control": "no-store", "Vary": "Accept"}
    headers |= {"Array-Shape": ",".join(map(str, array.shape)), "Array-Dtype": array.dtype.name}
    content = np.ascontiguousarray(array, dtype=DTYPES[array.dtype.name])
    body = io.BytesIO()
    if media_type == NPY:
        np.save(body, content, allow_pickle=False)
    else:
        body.write(content.data)
    return Response(body.getvalue(), 200, headers, media_type)


def matches(header: str | None, etag: str) -> bool:
    """Whether an If-None-Match header names this entity tag; weak comparison, as it must be there."""
    tags = [tag.strip().removeprefix("W/") for tag in (header or "").split(",")]
    return "*" in tags or etag in tags


def _span(request: Request, etag: str, size: int) -> tuple[int, int] | None:
    """First byte and the one after the last that a Range header asks for; None for everything.

    A range that is not understood, several ranges, or one of another version mean everything.
    """
    asked = _RANGE.fullmatch(request.headers.get("range", "").replace(" ", "").lower())
    if asked is None or asked.groups() == ("", "") or request.headers.get("if-range", etag) != etag:
        return None
    if not asked[1]:
        first, last = max(0, size - int(asked[2])), size
    else:
        first, last = int(asked[1]), min(size, int(asked[2]) + 1 if asked[2] else size)
        if asked[2] and int(asked[2]) < first:
            return None
    if first >= last:
        size_alone = {"Content-Range": f"bytes */{size}"}
        raise RangeRefused(f"the representation has {size} bytes", headers=size_alone)
    return first, last


async def _answer(
    request: Request, status: int, headers: dict[str, str], media_type: str, content: Iterator[Bytes]
) -> Response:
    if request.scope.get("head"):
        response = Response(None, status, headers, media_type)
        if "Content-Length" not in headers:
            del response.headers["content-length"]  # it is not known, which is not the same as 0
        return response
    # The first piece is fetched before the status is sent, so that damage found there is still told.
    first = await run_in_threadpool(next, content, b"")
    return StreamingResponse(_pieces(first, content), status, headers, media_type)


async def _pieces(first: Bytes, rest: Iterator[Bytes]) -> AsyncIterator[bytes]:
    async def blocks() -> AsyncIterator[Bytes]:
        yield first
        async for block in iterate_in_threadpool(rest):
            yield block

    async for block in blocks():
        for start in range(0, len(block), _PIECE):
            yield bytes(block[start : start + _PIECE])


def _bytes(
    store: Store, manifest: Manifest, name: str, rows: Rows, prefix: bytes, first: int, last: int
) -> Iterator[Bytes]:
    """Bytes [first, last) of a prefix followed by the bytes of some rows."""
    if first < len(prefix):
        # Together with the first block, so that a damaged one is found before anything is sent.
        raw = store.raw(manifest, name, rows.begin, rows.begin + max(0, last - len(prefix)))
        yield prefix[first:last] + bytes(next(raw, b""))
        yield from raw
    else:
        offset = rows.begin - len(prefix)
        yield from store.raw(manifest, name, offset + first, offset + last)


def _json_rows(store: Store, manifest: Manifest, name: str, rows: Rows) -> Iterator[bytes]:
    """Nested lists, some rows at a time; what is not finite becomes null."""
    row = max(1, math.prod(rows.shape[1:]))
    read, written = max(1, _JSON_READ // row), max(1, _JSON_WRITTEN // row)
    separator = b"["
    for start in range(rows.start, rows.stop, read):
        block = store.array(manifest, name, start, min(rows.stop, start + read))
        for first in range(0, len(block), written):
            values: Any = block[first : first + written]
            if values.dtype.kind == "f" and not (finite := np.isfinite(values)).all():
                values = np.where(finite, values.astype(object), None)
            text = json.dumps(values.tolist(), separators=(",", ":"), allow_nan=False)
            yield separator + text[1:-1].encode()
            separator = b","
    yield b"]" if separator == b"," else b"[]"


class _Sink(io.RawIOBase):
    """Where a zip file is written: hands on what came, and cannot go back."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, content: Any) -> int:
        self._parts.append(bytes(content))
        return len(self._parts[-1])

    def take(self) -> bytes:
        content = b"".join(self._parts)
        self._parts.clear()
        return content


def _zipped(store: Store, manifest: Manifest) -> Iterator[bytes]:
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name, stored in manifest.arrays.items():
            # A fixed date: the same arrays are the same file.
            info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            with archive.open(info, "w", force_zip64=stored.nbytes >= 2**31 - 2**16) as entry:
                entry.write(Rows.asked(stored, None).npy_header())
                for block in store.raw(manifest, name):
                    entry.write(block)
                    yield sink.take()
    yield sink.take()
