"""OFF, read here because trimesh takes a truncated file for a smaller mesh.

A record starts on a line of its own and may run over several; what follows it on its last line is colours.
"""

from __future__ import annotations

import re
from array import array

import numpy as np

from service.parsing.polygons import InvalidFile, Limits, Polygons
from service.parsing.text import lines, refuse_underscores, wrong_number

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
    refuse_underscores(content, rb"^[^#\n]*_")
    records = _Records(content)
    n_vertices, n_faces = records.counts()
    # The shortest vertex is "0 0 0" and a line end, the shortest face "3 0 1 2" and one.
    if n_vertices * 6 + n_faces * 8 > len(content) + 2:
        raise InvalidFile(
            f"the header announces {n_vertices:,} vertices and {n_faces:,} faces; "
            f"the file of {len(content):,} bytes cannot hold them"
        )
    limits.check(n_vertices, n_faces)
    coordinates, extras = _vertices(records, n_vertices)
    sizes, corners = _faces(records, n_faces)
    records.finish(n_vertices, n_faces)
    notes = ("numbers after the three coordinates of each vertex were left out",) if extras else ()
    vertices = np.array(coordinates).reshape(-1, 3)
    return Polygons(vertices, np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64), notes)


def _vertices(records: _Records, count: int) -> tuple[array[float], int]:
    """Coordinates, and how many numbers follow them on every line."""
    coordinates = array("d")
    extras: set[int] = set()
    for k in range(count):
        words = records.next(3, "vertex", k)
        try:
            coordinates.extend(map(float, words[:3]))
        except ValueError:
            raise wrong_number(words[:3], float, records.where("vertex", k)) from None
        extras.add(len(words) - 3)
    if len(extras) > 1:
        raise InvalidFile("vertices must all have as many numbers, each vertex on a line of its own")
    return coordinates, max(extras, default=0)


def _faces(records: _Records, count: int) -> tuple[array[int], array[int]]:
    """Sizes, and the corners of all polygons one after the other."""
    sizes, corners = array("q"), array("q")
    for k in range(count):
        words = records.next(1, "face", k)
        try:
            size = int(words[0])
            if size < 3:
                raise InvalidFile(f"{records.where('face', k)} has {size} corners; a face needs three")
            if len(words) <= size:
                words = records.longer(words, size + 1, "face", k)
            corners.extend(map(int, words[1 : size + 1]))
        except (ValueError, OverflowError):
            raise wrong_number(words, int, records.where("face", k)) from None
        sizes.append(size)
    return sizes, corners


class _Records:
    """The words of an OFF file, record by record."""

    def __init__(self, content: bytes) -> None:
        self._lines = lines(content)
        self._number = 0

    def where(self, what: str, k: int) -> str:
        """Place of the record read last."""
        return f"line {self._number}, {what} {k}"

    def next(self, count: int, what: str, k: int) -> list[bytes]:
        """Words of the next line, and of further ones until there are ``count``."""
        for number, words in self._lines:
            self._number = number
            return words if len(words) >= count else self.longer(words, count, what, k)
        raise InvalidFile(f"the file ends before {what} {k}: it is truncated, or its header counts wrongly")

    def longer(self, words: list[bytes], count: int, what: str, k: int) -> list[bytes]:
        """Those words and the ones of following lines, until there are ``count``."""
        while len(words) < count:
            words = words + self.next(1, what, k)
        return words

    def counts(self) -> tuple[int, int]:
        """Check the keyword and return the announced numbers of vertices and faces."""
        words = self.next(1, "line", 1)
        keyword = _KEYWORD.match(words[0])
        if keyword is None:
            raise InvalidFile("the file does not begin with the keyword OFF")
        if keyword[4] or keyword[5]:
            raise InvalidFile("only OFF with three coordinates a vertex is supported")
        # Some writers put no space between the keyword and the first count.
        words = [word for word in [words[0][keyword.end() :], *words[1:]] if word]
        if [word.upper() for word in words[:1]] == [b"BINARY"]:
            raise InvalidFile("binary OFF is not supported: save it as text, or as binary PLY")
        words = words or self.next(1, "line", 2)
        try:
            counts = [int(word) for word in words]
        except ValueError:
            raise wrong_number(words, int, f"line {self._number}") from None
        if len(counts) not in {2, 3} or min(counts) < 0:
            raise InvalidFile(f"line {self._number}: the counts of vertices, faces and edges are expected")
        return counts[0], counts[1]

    def finish(self, n_vertices: int, n_faces: int) -> None:
        """Refuse a file that goes on after what its header announces."""
        found = next(self._lines, None)
        if found is not None:
            raise InvalidFile(
                f"line {found[0]}: the file goes on after the {n_vertices} vertices and {n_faces} faces "
                "that its header announces"
            )
