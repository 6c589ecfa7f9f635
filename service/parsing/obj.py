"""Wavefront OBJ, read here because point maps count vertices in the order of the ``v`` lines.

trimesh reorders or splits them at texture seams, and drops faces that it cannot read.
"""

from __future__ import annotations

from array import array
from collections import Counter

import numpy as np

from service.parsing.polygons import InvalidFile, Limits, Polygons
from service.parsing.text import floats, ints, lines

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
    coordinates, sizes, corners = array("d"), array("q"), array("q")
    left_out: Counter[str] = Counter()
    n_vertices = n_triangles = 0
    # Indices may point forward; the furthest is checked at the end, by its line.
    furthest, furthest_line = 0, 0
    for number, (keyword, *words) in lines(content, joined_by=b"\\"):
        if keyword == b"v":
            if len(words) < 3:
                raise InvalidFile(f"line {number}: a vertex needs three coordinates")
            coordinates.extend(floats(words[:3], f"line {number}"))
            n_vertices += 1
            if n_vertices > limits.vertices:
                limits.check(n_vertices, 0)
        elif keyword == b"f":
            if len(words) < 3:
                raise InvalidFile(f"line {number}: the face has {len(words)} corners; a face needs three")
            face = ints([word.partition(b"/")[0] for word in words], f"line {number}")
            if min(face) <= 0:
                face = [_absolute(index, n_vertices, number) for index in face]
            if max(face) > furthest:
                furthest, furthest_line = max(face), number
            corners.extend(index - 1 for index in face)
            sizes.append(len(face))
            n_triangles += len(face) - 2
            if n_triangles > limits.faces:
                limits.check(0, n_triangles)
        elif keyword in _LEFT_OUT:
            left_out[_LEFT_OUT[keyword]] += 1
        elif keyword not in _IGNORED:
            raise InvalidFile(
                f"line {number}: {keyword[:40].decode('ascii', 'replace')!r} is no OBJ statement"
            )
    if furthest > n_vertices:
        raise InvalidFile(
            f"line {furthest_line}: the face names vertex {furthest}, counted from 1; "
            f"the file has {n_vertices} vertices"
        )
    notes = tuple(f"{what} were left out ({count} of them)" for what, count in left_out.items())
    vertices = np.array(coordinates).reshape(-1, 3)
    return Polygons(vertices, np.array(sizes, dtype=np.int64), np.array(corners, dtype=np.int64), notes)


def _absolute(index: int, n_vertices: int, number: int) -> int:
    """Index from 1 of a corner; a negative one counts back from the last vertex read so far."""
    if index > 0:
        return index
    if index == 0:
        raise InvalidFile(f"line {number}: the face names vertex 0; OBJ counts from 1")
    if n_vertices + index < 0:
        raise InvalidFile(
            f"line {number}: the face names vertex {index}; only {n_vertices} vertices stand before it"
        )
    return n_vertices + 1 + index
