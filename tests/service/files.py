"""Mesh files in every format, written here independently of the readers under test."""

from __future__ import annotations

import json
import struct

import numpy as np

TETRAHEDRON = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def off(vertices: np.ndarray = TETRAHEDRON, faces: np.ndarray = FACES) -> str:
    rows = [" ".join(map(repr, row)) for row in vertices.tolist()]
    rows += [f"{len(face)} {' '.join(map(str, face))}" for face in faces.tolist()]
    return f"OFF\n{len(vertices)} {len(faces)} 0\n" + "\n".join(rows) + "\n"


def obj(vertices: np.ndarray = TETRAHEDRON, faces: np.ndarray = FACES) -> str:
    rows = [f"v {' '.join(map(repr, row))}" for row in vertices.tolist()]
    return "\n".join(rows + [f"f {' '.join(map(str, face))}" for face in (faces + 1).tolist()]) + "\n"


def ply(order: str = "<", vertices: np.ndarray = TETRAHEDRON, faces: np.ndarray = FACES) -> bytes:
    name = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = f"ply\nformat {name} 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    if not order:
        return (header + off(vertices, faces).split("\n", 2)[2]).encode()
    rows = np.zeros(len(faces), np.dtype([("size", "u1"), ("face", order + "i4", 3)]))
    rows["size"], rows["face"] = 3, faces
    return header.encode() + vertices.astype(order + "f8").tobytes() + rows.tobytes()


def stl(corners: np.ndarray) -> bytes:
    facets = np.zeros(len(corners), np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")]))
    facets["c"] = corners
    return b"solid but binary".ljust(80) + struct.pack("<I", len(corners)) + facets.tobytes()


def stl_text(corners: np.ndarray, end: str = "endsolid\n") -> str:
    out = "solid some name\\\n"
    for triangle in corners.tolist():
        loop = "".join(f"vertex {' '.join(map(repr, corner))}\n" for corner in triangle)
        out += f"facet normal 0 0 0\nouter loop\n{loop}endloop\nendfacet\n"
    return out + end


def glb(header: dict[str, object], binary: bytes, length: int | None = None) -> bytes:
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    total = 28 + len(text) + len(binary) if length is None else length
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    return b"glTF" + struct.pack("<II", 2, total) + chunks


def scene(nodes: list[dict[str, object]] | None = None, **changes: object) -> tuple[dict[str, object], bytes]:
    """A GLB header and buffer with the tetrahedron as mesh 0."""
    points, indices = TETRAHEDRON.astype("<f4").tobytes(), FACES.astype("<u2").tobytes()
    header: dict[str, object] = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(points + indices)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(points)},
            {"buffer": 0, "byteOffset": len(points), "byteLength": len(indices)},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": nodes if nodes is not None else [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    return header | changes, points + indices
