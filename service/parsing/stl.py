"""STL, binary and text, read here because trimesh takes wrong counts for an empty mesh.

STL stores three corners a triangle and no indices: corners with equal bits become one vertex, in order of
appearance.
"""

from __future__ import annotations

from array import array

import numpy as np
import numpy.typing as npt

from service.parsing.polygons import InvalidFile, Limits, Polygons
from service.parsing.text import lines, refuse_underscores, wrong_number

_HEADER_BYTES = 84
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_LINES_OF_A_FACET = (b"facet", b"outer", b"vertex", b"vertex", b"vertex", b"endloop", b"endfacet")


def read(content: bytes, limits: Limits) -> Polygons:
    """Triangles of an STL file, with equal corners welded.

    Raises
    ------
    InvalidFile
        If the file is truncated, or holds more than it announces.
    TooLarge
        If there are too many triangles.
    """
    announced = int.from_bytes(content[80:_HEADER_BYTES], "little") if len(content) >= _HEADER_BYTES else -1
    # The word "solid" decides nothing: many binary files begin with it.
    if announced >= 0 and len(content) == _HEADER_BYTES + announced * _FACET.itemsize:
        limits.check(0, announced)
        facets = np.frombuffer(content, dtype=_FACET, offset=_HEADER_BYTES)
        return _welded(np.ascontiguousarray(facets["corners"]).reshape(-1, 3), limits)
    if content[:80].lstrip().lower().startswith(b"solid") and b"\0" not in content:
        return _welded(_text_corners(content, limits), limits)
    if announced < 0:
        raise InvalidFile("the file is neither a text STL ('solid …') nor long enough for a binary one")
    needed = _HEADER_BYTES + announced * _FACET.itemsize
    raise InvalidFile(
        f"the binary STL announces {announced:,} triangles, which take {needed:,} bytes; "
        f"the file has {len(content):,}"
    )


def _text_corners(content: bytes, limits: Limits) -> npt.NDArray[np.float64]:
    """Corners (3 F, 3) of all solids of a text STL."""
    refuse_underscores(content, rb"(?i)^\s*vertex\s[^#\n]*_")
    corners = array("d")
    expected = 0
    solid = False
    for number, words in lines(content):
        keyword = words[0].lower()
        if expected == 0 and keyword in {b"solid", b"endsolid"}:
            if solid == (keyword == b"solid"):
                raise InvalidFile(f"line {number}: solid and endsolid do not match")
            solid = not solid
            continue
        if not solid or keyword != _LINES_OF_A_FACET[expected]:
            wanted = _LINES_OF_A_FACET[expected].decode() if solid else "solid"
            found = keyword[:40].decode("ascii", "replace")
            raise InvalidFile(f"line {number}: {wanted!r} is expected, not {found!r}")
        if keyword == b"vertex":
            if len(words) != 4:
                raise InvalidFile(f"line {number}: a corner needs three coordinates")
            try:
                corners.extend(map(float, words[1:]))
            except ValueError:
                raise wrong_number(words[1:], float, f"line {number}") from None
        expected = (expected + 1) % len(_LINES_OF_A_FACET)
        if expected == 0 and len(corners) > 9 * limits.faces:
            limits.check(0, len(corners) // 9)
    if solid:
        raise InvalidFile("the file ends inside a solid: it is truncated")
    return np.array(corners).reshape(-1, 3)


def _welded(corners: npt.NDArray[np.float32] | npt.NDArray[np.float64], limits: Limits) -> Polygons:
    if len(corners) == 0:
        raise InvalidFile("the file has no triangles")
    bits = corners.view(np.dtype((np.void, 3 * corners.itemsize))).ravel()
    _, first, inverse = np.unique(bits, return_index=True, return_inverse=True)
    limits.check(len(first), 0)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    note = f"{len(corners)} corners became {len(first)} vertices: corners with equal bits are one vertex"
    vertices = corners[first[order]].astype(np.float64)
    return Polygons.from_triangles(vertices, rank[inverse].reshape(-1, 3).astype(np.int64), (note,))
