"""PLY, text and binary, read here because trimesh refuses mixed polygons and takes truncated text for whole.

A file is elements in the order of its header, an element is rows of properties, and a property is a number or
a list with its length before it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from service.parsing.polygons import InvalidFile, Limits, Polygons
from service.parsing.text import lines, refuse_underscores, wrong_number

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER = re.compile(rb"ply[ \t]*(\r\n|\n|\r)")
Column = npt.NDArray[np.generic]


@dataclass(frozen=True)
class _Property:
    name: str
    type: str
    length_type: str  # empty for a number

    @property
    def whole(self) -> bool:
        return self.type[0] in "iu"


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


#: The rows of an element: a column for a number, lengths and all values one after the other for a list.
Rows = dict[str, tuple[Column, Column]]


class _Body(Protocol):
    def rows(self, element: _Element) -> Rows: ...
    def finish(self) -> tuple[str, ...]: ...


def read(content: bytes, limits: Limits) -> Polygons:
    """Vertices and polygons of a PLY file; one ``tristrips`` element stands for faces.

    Raises
    ------
    InvalidFile
        If rows and header disagree.
    TooLarge
        If the header announces more than the limits.
    """
    order, elements, start = _header(content)
    for element in elements:
        if element.count > len(content) - start and element.properties:
            raise InvalidFile(
                f"the header announces {element.count:,} rows of {element.name!r}; "
                f"the file of {len(content):,} bytes cannot hold them"
            )
        if element.name in {"vertex", "face"}:
            limits.check(*((element.count, 0) if element.name == "vertex" else (0, element.count)))
    body: _Body = _Binary(content, start, order) if order else _Text(content[start:])
    found: dict[str, Rows] = {}
    for element in elements:
        if element.name in found:
            raise InvalidFile(f"the header declares {element.name!r} twice")
        found[element.name] = body.rows(element)
    notes = body.finish()
    vertex = found.get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise InvalidFile("the file has no vertices with x, y and z")
    vertices = np.stack([vertex[axis][1].astype(np.float64) for axis in "xyz"], axis=1)
    if "face" in found:
        sizes, corners = _indices("face", found["face"])
        return Polygons(vertices, sizes, corners, notes)
    if "tristrips" in found:
        faces = _unrolled(*_indices("tristrips", found["tristrips"]))
        return Polygons.from_triangles(
            vertices, faces, (*notes, "triangle strips were unrolled into triangles")
        )
    raise InvalidFile("the file has no faces: points make no surface")


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """Byte order (empty for text), elements, and where the rows begin."""
    opening = _HEADER.match(content)
    if opening is None:
        raise InvalidFile("the file does not begin with the line 'ply'")
    # The first data byte may be a newline too: a carriage return takes it along only if lines end with both.
    closing = re.compile(
        rb"[\r\n]end_header[ \t]*(?:" + (rb"\r" if opening[1] == b"\r" else rb"\r?\n") + rb"|$)"
    )
    end = closing.search(content)
    if end is None:
        raise InvalidFile("the PLY header has no end_header line")
    order = None
    elements: list[_Element] = []
    for line in re.split(rb"[\r\n]+", content[opening.end() : end.start()]):
        words = line.decode("latin-1").split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, _] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", name, count] if count.isdecimal() and len(count) < 20:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if (
                elements and _TYPES.get(length, "f")[0] != "f" and kind in _TYPES
            ):
                elements[-1].properties.append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[kind], ""))
            case _:
                raise InvalidFile(
                    f"a line of the PLY header is not understood: {line[:60].decode('ascii', 'replace')!r}"
                )
    if order is None:
        raise InvalidFile("the PLY header names no format")
    for element in elements:
        names = [prop.name for prop in element.properties]
        if len(set(names)) < len(names):
            raise InvalidFile(f"the PLY header declares a property of {element.name!r} twice")
    return order, elements, end.end()


def _indices(element: str, rows: Rows) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    for name in ("vertex_indices", "vertex_index"):
        if name in rows:
            lengths, values = rows[name]
            if values.dtype.kind not in "iu" or len(values) != lengths.sum():
                raise InvalidFile(f"{name} of {element!r} must be lists of whole numbers")
            return lengths.astype(np.int64), values.astype(np.int64)
    raise InvalidFile(f"the element {element!r} has no vertex_indices")


def _unrolled(sizes: npt.NDArray[np.int64], values: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Triangles (F, 3) of strips, which −1 may also end; every other one is turned, stitches are dropped."""
    ends = np.zeros(len(values) + 1, dtype=bool)
    ends[np.cumsum(sizes)] = True
    # A −1 after each strip makes both ways of ending one the same.
    strip = np.insert(values, np.flatnonzero(ends), -1)
    position = np.arange(len(strip))
    begins = np.maximum.accumulate(np.where(strip == -1, position + 1, 0))
    a, b, c = strip[:-2], strip[1:-1], strip[2:]
    odd = (position - begins)[:-2] % 2 == 1
    faces = np.stack([np.where(odd, b, a), np.where(odd, a, b), c], axis=1)
    whole: npt.NDArray[np.bool_] = (a != -1) & (b != -1) & (c != -1) & (a != b) & (b != c) & (c != a)
    return np.ascontiguousarray(faces[whole])


def _truncated(element: _Element) -> InvalidFile:
    return InvalidFile(
        f"the file ends inside its {element.count:,} rows of {element.name!r}, "
        "or one of them holds a list longer than the file"
    )


def _joined(element: _Element, lengths: dict[str, list[int]], parts: dict[str, list[Column]]) -> Rows:
    return {
        prop.name: (
            np.array(lengths[prop.name], dtype=np.int64),
            np.concatenate(parts[prop.name]) if parts[prop.name] else np.zeros(0, dtype=np.int64),
        )
        for prop in element.properties
    }


class _Binary:
    """Rows of a binary body: one view if all lists of an element are equally long, else one by one."""

    def __init__(self, content: bytes, start: int, order: str) -> None:
        self._content, self._at, self._order = content, start, order

    def rows(self, element: _Element) -> Rows:
        if element.count == 0 or not element.properties:
            nothing: Column = np.zeros(0, dtype=np.int64)
            return {prop.name: (nothing, nothing) for prop in element.properties}
        try:
            lengths = self._lengths(element)
        except ValueError:  # what NumPy says to an offset beyond the buffer
            raise _truncated(element) from None
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        for prop in element.properties:
            if prop.length_type:
                fields.append((f"{prop.name} length", self._order + prop.length_type, ()))
            shape = (lengths[prop.name],) if prop.length_type else ()
            fields.append((prop.name, self._order + prop.type, shape))
        row = np.dtype(fields)
        names = [prop.name for prop in element.properties]
        lists = [prop.name for prop in element.properties if prop.length_type]
        if self._at + row.itemsize * element.count <= len(self._content):
            table = np.frombuffer(self._content, row, element.count, self._at)
            if all((table[f"{name} length"] == lengths[name]).all() for name in lists):
                self._at += row.itemsize * element.count
                return {name: (np.full(element.count, lengths[name]), table[name].ravel()) for name in names}
        if not lists:
            raise _truncated(element)
        return self._ragged(element)

    def _lengths(self, element: _Element) -> dict[str, int]:
        """Lengths of the lists in the next row, 1 for numbers."""
        lengths = {}
        at = self._at
        for prop in element.properties:
            length = 1
            if prop.length_type:
                length = int(np.frombuffer(self._content, self._order + prop.length_type, 1, at)[0])
                at += int(prop.length_type[1])
            size = length * int(prop.type[1])
            if length < 0 or at + size > len(self._content):
                raise ValueError
            lengths[prop.name] = length
            at += size
        return lengths

    def _ragged(self, element: _Element) -> Rows:
        lengths: dict[str, list[int]] = {prop.name: [] for prop in element.properties}
        parts: dict[str, list[Column]] = {prop.name: [] for prop in element.properties}
        try:
            for _ in range(element.count):
                for prop in element.properties:
                    length = 1
                    if prop.length_type:
                        length = int(
                            np.frombuffer(self._content, self._order + prop.length_type, 1, self._at)[0]
                        )
                        self._at += int(prop.length_type[1])
                    if length < 0:
                        raise _truncated(element)
                    if length:  # NumPy refuses an empty view at the very end
                        parts[prop.name].append(
                            np.frombuffer(self._content, self._order + prop.type, length, self._at)
                        )
                    lengths[prop.name].append(length)
                    self._at += int(prop.type[1]) * length
        except ValueError:
            raise _truncated(element) from None
        return _joined(element, lengths, parts)

    def finish(self) -> tuple[str, ...]:
        if self._content[self._at :].strip():
            left = len(self._content) - self._at
            raise InvalidFile(f"{left:,} bytes follow the rows that the header announces")
        return ()


class _Text:
    """Rows of a text body, each on its own line; words after the declared properties are dropped."""

    def __init__(self, body: bytes) -> None:
        refuse_underscores(body)
        self._lines = lines(body)
        self.extra_words = False

    def rows(self, element: _Element) -> Rows:
        names = [prop.name for prop in element.properties]
        lengths: dict[str, list[int]] = {name: [1] * element.count for name in names}
        if not any(prop.length_type for prop in element.properties):
            flat: list[bytes] = []
            for row in range(element.count if names else 0):
                line = self._line(element)
                self._check_width(element, row, line, len(names))
                flat += line[: len(names)]
            words = {name: flat[k :: len(names)] for k, name in enumerate(names)}
        else:
            words = {name: [] for name in names}
            lengths |= {prop.name: [] for prop in element.properties if prop.length_type}
            for row in range(element.count):
                self._row_with_lists(element, row, lengths, words)
        columns = {prop.name: [_numbers(element, prop, words[prop.name])] for prop in element.properties}
        return _joined(element, lengths, columns)

    def _line(self, element: _Element) -> list[bytes]:
        for _, line in self._lines:
            return line
        raise _truncated(element)

    def _check_width(self, element: _Element, row: int, line: list[bytes], width: int) -> None:
        if len(line) != width:
            if len(line) < width:
                raise InvalidFile(f"row {row} of {element.name!r} has fewer numbers than declared")
            self.extra_words = True

    def _row_with_lists(
        self, element: _Element, row: int, lengths: dict[str, list[int]], words: dict[str, list[bytes]]
    ) -> None:
        line = self._line(element)
        at = 0
        for prop in element.properties:
            length = 1
            if prop.length_type:
                try:
                    length = int(line[at]) if at < len(line) else len(line)
                except ValueError:
                    raise wrong_number(line[at:], int, f"row {row} of {element.name!r}") from None
                at += 1
                lengths[prop.name].append(length)
            if not 0 <= length <= len(line) - at:
                raise InvalidFile(f"row {row} of {element.name!r} has fewer numbers than declared")
            words[prop.name] += line[at : at + length]
            at += length
        self._check_width(element, row, line, at)

    def finish(self) -> tuple[str, ...]:
        found = next(self._lines, None)
        if found is not None:
            raise InvalidFile("more lines follow the rows that the header announces")
        return ("numbers after the declared properties of a row were left out",) if self.extra_words else ()


def _numbers(element: _Element, prop: _Property, words: list[bytes]) -> Column:
    kind = int if prop.whole else float
    try:
        return np.array(list(map(kind, words)), dtype=np.int64 if prop.whole else np.float64)
    except (ValueError, OverflowError):
        raise wrong_number(words, kind, f"{prop.name} of {element.name!r}") from None
