"""Lines and numbers of the text formats, read strictly."""

from __future__ import annotations

import io
from collections.abc import Iterator

from service.parsing.polygons import InvalidFile


def lines(content: bytes, *, joined_by: bytes = b"\n") -> Iterator[tuple[int, list[bytes]]]:
    """Words of every line that has any, with its number from 1; ``#`` starts a comment.

    A line that ends with ``joined_by`` goes on in the next one (by default none does).

    Raises
    ------
    InvalidFile
        If the file is no plain text: UTF-16, or with NUL bytes.
    """
    if content[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        raise InvalidFile("the file is UTF-16 text: save it as UTF-8 or ASCII")
    if b"\0" in content:
        raise InvalidFile("the file has NUL bytes: it is not text, or it was cut while being copied")
    if b"\n" not in content:
        content = content.replace(b"\r", b"\n")
    joined: list[bytes] = []
    first = 0
    for number, line in enumerate(io.BytesIO(content.removeprefix(b"\xef\xbb\xbf")), start=1):
        words = (line.partition(b"#")[0] if b"#" in line else line).split()
        if not words:
            continue
        first = first if joined else number
        if words[-1].endswith(joined_by):
            joined += [*words[:-1], words[-1][:-1]]
            continue
        yield first, [word for word in joined if word] + words if joined else words
        joined = []
    if joined:
        yield first, [word for word in joined if word]


def floats(words: list[bytes], where: str) -> list[float]:
    """Numbers of ``words``.

    Raises
    ------
    InvalidFile
        Naming ``where`` and the word that is no number.
    """
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    # float() takes 1_000 for a number; no mesh format does.
    if len(numbers) < len(words) or any(b"_" in word for word in words):
        raise InvalidFile(f"{where}: {_wrong(words, float)} is not a number")
    return numbers


def ints(words: list[bytes], where: str) -> list[int]:
    """Whole numbers of ``words``.

    Raises
    ------
    InvalidFile
        Naming ``where`` and the word that is no whole number, or one beyond 64 bits.
    """
    try:
        numbers = [int(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) < len(words) or any(b"_" in word for word in words):
        raise InvalidFile(f"{where}: {_wrong(words, int)} is not a whole number")
    if numbers and not -(2**63) <= min(numbers) <= max(numbers) < 2**63:
        raise InvalidFile(f"{where}: an index does not fit 64 bits")
    return numbers


def _wrong(words: list[bytes], kind: type[float] | type[int]) -> str:
    for word in words:
        try:
            kind(word)
        except ValueError:
            break
        if b"_" in word:
            break
    return repr(word[:40].decode("ascii", "replace"))
