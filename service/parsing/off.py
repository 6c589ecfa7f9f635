"""OFF, read here because trimesh takes a truncated file for a smaller mesh.

A record starts on a line of its own and may run over several; what follows it on its last line is colours.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator

import numpy as np

from service.parsing.polygons import InvalidFile, Limits, Polygons
from service.parsing.text import floats, ints, lines

_KEYWORD = re.compile(rb"(ST)?(C)?(N)?(4)?(n)?OFF")


def read(content: bytes, limits: Limits) -> Polygons:
    """Vertices and polygons of an OFF file, exactly as many as its header announces.

    Raises
    ------
    InvalidFile
        Naming the line that is wrong.
    TooLarge
        If the header announces more than the limits.
    """
    records = _Records(content)
    n_vertices, n_faces = records.counts()
    # The shortest vertex is "0 0 0" and a line end, the shortest face "3 0 1 2" and one.
    if n_vertices * 6 + n_faces * 8 > len(content) + 2:
        raise InvalidFile(
            f"the header announces {n_vertices:,} vertices and {n_faces:,} faces; "
            f"the file of {len(content):,} bytes cannot hold them"
        )
    limits.check(n_vertices, n_faces)
    coordinates, sizes, corners = array("d"), array("q"), array("q")
    extras: set[int] = set()
    for k in range(n_vertices):
        where, words, rest = records.take(3, f"vertex {k}")
        coordinates.extend(floats(words, where))
        extras.add(rest)
    if len(extras) > 1:
        raise InvalidFile("vertices must all have as many numbers, each vertex on a line of its own")
    for k in range(n_faces):
        where, words, rest = records.take(1, f"face {k}", keep=True)
        (size,) = ints(words, where)
        if size < 3:
            raise InvalidFile(f"{where} has {size} corners; a face needs three")
        where, words, _ = records.take(size, f"face {k}")
        sizes.append(size)
        corners.extend(ints(words, where))
    records.finish(n_vertices, n_faces)
    notes = ("numbers after the three coordinates of each vertex were left out",) if extras - {0} else ()
    vertices = np.array(coordinates).reshape(-1, 3)
    return Polygons(vertices, np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64), notes)


class _Records:
    """The words of an OFF file, record by record."""

    def __init__(self, content: bytes) -> None:
        self._lines: Iterator[tuple[int, list[bytes]]] = lines(content)
        self._words: list[bytes] = []
        self._number = 0

    def _more(self, what: str) -> None:
        found = next(self._lines, None)
        if found is None:
            raise InvalidFile(f"the file ends before {what}: it is truncated, or its header counts wrongly")
        self._number, self._words = found

    def counts(self) -> tuple[int, int]:
        """Check the keyword and return the announced numbers of vertices and faces."""
        self._more("its OFF keyword")
        keyword = _KEYWORD.match(self._words[0])
        if keyword is None:
            raise InvalidFile("the file does not begin with the keyword OFF")
        if keyword[4] or keyword[5]:
            raise InvalidFile("only OFF with three coordinates a vertex is supported")
        # Some writers put no space between the keyword and the first count.
        self._words = [word for word in [self._words[0][keyword.end() :], *self._words[1:]] if word]
        if [word.upper() for word in self._words[:1]] == [b"BINARY"]:
            raise InvalidFile("binary OFF is not supported: save it as text, or as binary PLY")
        if not self._words:
            self._more("its counts")
        where, words = f"line {self._number}", self._words
        self._words = []
        counts = ints(words, where)
        if len(counts) not in {2, 3} or min(counts) < 0:
            raise InvalidFile(f"{where}: the counts of vertices, faces and edges are expected")
        return counts[0], counts[1]

    def take(self, count: int, what: str, *, keep: bool = False) -> tuple[str, list[bytes], int]:
        """Return the place, ``count`` words, and how many more stood on the line (dropped unless kept)."""
        taken: list[bytes] = []
        while len(taken) < count:
            if not self._words:
                self._more(what)
            needed = count - len(taken)
            taken += self._words[:needed]
            self._words = self._words[needed:]
        rest = len(self._words)
        if not keep:
            self._words = []
        return f"line {self._number}, {what}", taken, rest

    def finish(self, n_vertices: int, n_faces: int) -> None:
        """Refuse a file that goes on after what its header announces."""
        found = next(self._lines, None)
        if found is not None:
            raise InvalidFile(
                f"line {found[0]}: the file goes on after the {n_vertices} vertices and {n_faces} faces "
                "that its header announces"
            )
