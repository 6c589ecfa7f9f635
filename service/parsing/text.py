"""Lines and numbers of the text formats, read strictly."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator

from service.parsing.polygons import InvalidFile


def lines(content: bytes, *, joined_by: bytes = b"") -> Iterator[tuple[int, list[bytes]]]:
    """Words of every line that has any, with its number from 1; ``#`` starts a comment.

    A line that ends with ``joined_by``, if that is given, goes on in the next one.

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
    content = content.removeprefix(b"\xef\xbb\xbf")
    comments, joins = b"#" in content, bool(joined_by) and joined_by in content
    joined: list[bytes] = []
    first = 0
    for number, line in enumerate(io.BytesIO(content), start=1):
        words = (line.partition(b"#")[0] if comments else line).split()
        if not words:
            continue
        if not joins:
            yield number, words
            continue
        first = first if joined else number
        if words[-1].endswith(joined_by):
            joined += [*words[:-1], words[-1].removesuffix(joined_by)]
            continue
        yield first, [word for word in joined if word] + words
        joined = []
    if joined:
        yield first, [word for word in joined if word]


def refuse_underscores(content: bytes, pattern: bytes = rb"_") -> None:
    """Refuse numbers like 1_000, which Python reads and no mesh format has.

    Parameters
    ----------
    content : bytes
        The file.
    pattern : bytes
        A regular expression, by lines, of an underscore where a number stands.

    Raises
    ------
    InvalidFile
        Naming the line.
    """
    found = re.search(pattern, content, re.MULTILINE) if b"_" in content else None
    if found is not None:
        line = content.count(b"\n", 0, found.end()) + 1
        raise InvalidFile(f"line {line}: a number with an underscore is not a number here")


def wrong_number(words: Iterable[bytes], kind: type[float] | type[int], where: str) -> InvalidFile:
    """Refusal of the first word that Python does not read as such a number, or that is beyond 64 bits."""
    name = "number" if kind is float else "whole number"
    for word in words:
        try:
            kind(word)
        except ValueError:
            return InvalidFile(f"{where}: {word[:40].decode('ascii', 'replace')!r} is not a {name}")
    return InvalidFile(f"{where}: an index does not fit 64 bits")
