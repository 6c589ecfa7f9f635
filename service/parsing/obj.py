"""Wavefront OBJ, read here because point maps count vertices in the order of the ``v`` lines.

trimesh reorders or splits them at texture seams, and drops faces that it cannot read.
"""

from __future__ import annotations

from array import array
from collections import Counter
from itertools import islice

import numpy as np

from service.parsing.polygons import InvalidFile, Limits, Polygons
from service.parsing.text import lines, refuse_underscores, wrong_number

#: Statements that say nothing about vertices or faces.
_IGNORED = frozenset(
    b"vt vn g o s mg usemtl mtllib usemap maplib shadow_obj trace_obj lod bevel c_interp d_interp".split()
)
#: Geometry that is no polygon; leaving it out is said.
_LEFT_OUT = {
    **dict.fromkeys((b"p",), "points"),
    **dict.fromkeys((b"l",), "lines"),
    **dict.fromkeys(
        b"vp cstype deg bmat step curv curv2 surf parm trim hole scrv sp end con ctech stech".split(),
        "statements of free-form surfaces",
    ),
}


def read(content: bytes, limits: Limits) -> Polygons:
    """Vertices in the order of the ``v`` lines, and the polygons of the ``f`` lines.

    Colours and weights after the coordinates, texture coordinates and normals are ignored.

    Raises
    ------
    InvalidFile
        Naming the line that is wrong.
    TooLarge
        As soon as there are more vertices or triangles than the limits.
    """
    refuse_underscores(content, rb"^[ \t]*[vf][ \t][^#\n]*_")
    coordinates, sizes, corners = array("d"), array("q"), array("q")
    left_out: Counter[str] = Counter()
    n_vertices = n_triangles = 0
    for number, words in lines(content, joined_by=b"\\"):
        keyword = words[0]
        if keyword == b"v":
            if len(words) < 4:
                raise InvalidFile(f"line {number}: a vertex needs three coordinates")
            try:
                coordinates.extend(map(float, words[1:4]))
            except ValueError:
                raise wrong_number(words[1:4], float, f"line {number}") from None
            n_vertices += 1
            if n_vertices > limits.vertices:
                limits.check(n_vertices, 0)
        elif keyword == b"f":
            size = len(words) - 1
            if size < 3:
                raise InvalidFile(f"line {number}: the face has {size} corners; a face needs three")
            corners.extend(_corners(words[1:], n_vertices, number))
            sizes.append(size)
            n_triangles += size - 2
            if n_triangles > limits.faces:
                limits.check(0, n_triangles)
        elif keyword in _LEFT_OUT:
            left_out[_LEFT_OUT[keyword]] += 1
        elif keyword not in _IGNORED:
            found = keyword[:40].decode("ascii", "replace")
            raise InvalidFile(f"line {number}: {found!r} is no OBJ statement")
    polygons = Polygons(
        np.array(coordinates).reshape(-1, 3),
        np.array(sizes, dtype=np.int64),
        np.array(corners, dtype=np.int64) - 1,
        tuple(f"{what} were left out ({count} of them)" for what, count in left_out.items()),
    )
    _check_furthest(polygons, content)
    return polygons


def _corners(words: list[bytes], n_vertices: int, number: int) -> list[int]:
    """Vertices of a face, counted from 1; a negative index counts back from the last vertex read so far."""
    if b"/" in words[0]:
        words = [word.partition(b"/")[0] for word in words]
    try:
        face = [int(word) for word in words]
    except ValueError:
        raise wrong_number(words, int, f"line {number}") from None
    if min(face) <= 0:
        for k, index in enumerate(face):
            if index == 0:
                raise InvalidFile(f"line {number}: the face names vertex 0; OBJ counts from 1")
            if n_vertices + index < 0:
                raise InvalidFile(
                    f"line {number}: the face names vertex {index}; only {n_vertices} stand before it"
                )
            face[k] = index if index > 0 else n_vertices + 1 + index
    if max(face) >= 2**63:
        raise wrong_number((), int, f"line {number}")
    return face


def _check_furthest(polygons: Polygons, content: bytes) -> None:
    """Refuse a vertex that never comes, by the line of its face: indices may point forward."""
    n_vertices = len(polygons.vertices)
    if n_vertices and polygons.corners.size and (furthest := int(polygons.corners.max())) >= n_vertices:
        face = polygons.polygon_of(int(polygons.corners.argmax()))
        numbers = (number for number, words in lines(content, joined_by=b"\\") if words[0] == b"f")
        line = next(islice(numbers, face, None))
        raise InvalidFile(
            f"line {line}: the face names vertex {furthest + 1}, counted from 1; "
            f"the file has {n_vertices} vertices"
        )
