"""Bytes of a mesh file → vertices and triangles in its own order, or a refusal that says where it is wrong.

Runs in a guarded child process (``service.nursery``): a file is anything that anybody sent. Nothing is
repaired, nothing is guessed, and every count that a file announces is checked.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass

import numpy as np

from service.parsing.polygons import Floats, Ints, InvalidFile, Limits, TooLarge

__all__ = [
    "FORMATS",
    "MEDIA_TYPES",
    "InvalidFile",
    "Limits",
    "ParsedMesh",
    "TooLarge",
    "read_mesh",
    "sniffed",
]

#: The formats, each the name of a module here with ``read(content, limits)``.
FORMATS = ("off", "obj", "ply", "stl", "glb")

#: What a Content-Type may say of them; it rarely does.
MEDIA_TYPES = {
    "model/obj": "obj",
    "model/stl": "stl",
    "application/sla": "stl",
    "application/vnd.ms-pki.stl": "stl",
    "model/gltf-binary": "glb",
    "model/ply": "ply",
    "application/ply": "ply",
    "model/off": "off",
}


@dataclass(frozen=True, eq=False)
class ParsedMesh:
    """Arrays of a mesh file.

    Attributes
    ----------
    vertices : ndarray (V, 3) float64
        Coordinates in the file's units, in the file's order.
    faces : ndarray (F, 3) int64
        Vertices of each triangle, polygons split in place.
    warnings : tuple of str
        What was left out or changed.
    """

    vertices: Floats
    faces: Ints
    warnings: tuple[str, ...]


def sniffed(beginning: bytes) -> str | None:
    """Format that the first bytes of a file show beyond doubt, or None; OBJ shows none."""
    head = beginning[:512].removeprefix(b"\xef\xbb\xbf").lstrip()
    if head.startswith(b"glTF"):
        return "glb"
    if head[:4] in {b"ply\n", b"ply\r", b"ply ", b"ply\t"}:
        return "ply"
    if head.lstrip(b"STCN4n").startswith(b"OFF"):
        return "off"
    if head.startswith(b"solid ") or head.startswith(b"solid\n"):
        return "stl"
    return None


def read_mesh(content: bytes, file_format: str, limits: Limits) -> ParsedMesh:
    """Vertices and triangles of a file in one of `FORMATS`.

    Parameters
    ----------
    content : bytes
        The whole file.
    file_format : str
        One of `FORMATS`.
    limits : Limits
        The most that is accepted.

    Returns
    -------
    ParsedMesh
        Every vertex of the file, referenced or not.

    Raises
    ------
    InvalidFile
        Naming the line, face or count that is wrong.
    TooLarge
        If the mesh exceeds the limits.
    """
    if not content:
        raise InvalidFile("the file is empty")
    reader = importlib.import_module(f"service.parsing.{FORMATS[FORMATS.index(file_format)]}")
    polygons = reader.read(content, limits)
    polygons.check(limits)
    faces, split = polygons.triangles()
    return ParsedMesh(np.ascontiguousarray(polygons.vertices), faces, (*polygons.notes, *split))
