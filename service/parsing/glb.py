"""GLB (binary glTF 2.0): trimesh decodes the arrays, from a header cut down to plain geometry and checked.

Left alone, trimesh takes sparse or compressed arrays for zeros, loses the children of a camera's node, names
frames at random and spends gigabytes on a header of 600 bytes. None of that is left in what it is handed.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np

from service.parsing.polygons import Floats, Ints, InvalidFile, Limits, Polygons

_CHUNK_JSON, _CHUNK_BIN = 0x4E4F534A, 0x004E4942
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Component types of glTF and the bytes of one entry: three floats, or one unsigned integer.
_POSITIONS = {5126: 12}
_INDICES = {5121: 1, 5123: 2, 5125: 4}
#: Extensions that move, compress or multiply geometry; all others only change how it looks.
_GEOMETRY_EXTENSIONS = {
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
    "KHR_mesh_quantization",
    "EXT_mesh_gpu_instancing",
}
#: A chain of nodes this deep is no scene.
_MAX_DEPTH = 200
#: What Python says to a header whose parts are missing, of the wrong type or out of range.
_INCONSISTENT = (KeyError, IndexError, TypeError, ValueError, AttributeError, AssertionError, OverflowError)
#: A primitive is named by the index of its mesh and its own in there.
Key = tuple[int, int]
Header = dict[str, Any]


def read(content: bytes, limits: Limits) -> Polygons:
    """Triangles of the default scene, every node's meshes placed by its transforms.

    The order is the scene's: nodes depth first, children in the order of the file, a node's own mesh before
    its children, primitives in order; a mesh that two nodes place comes twice.

    Raises
    ------
    InvalidFile
        If the file is truncated, uses what is not supported here, or has no triangles.
    TooLarge
        If all placed meshes together exceed the limits.
    """
    try:
        header, binary = _chunks(content)
        notes = _check_extensions(header)
        primitives = _triangle_primitives(header, len(binary))
        left_out = sum(len(mesh["primitives"]) for mesh in header.get("meshes", [])) - len(primitives)
        if left_out:
            notes += (f"primitives of points or lines were left out ({left_out} of them)",)
        placements = list(_placements(header))
        chosen = [(key, matrix) for mesh, matrix in placements for key in primitives if key[0] == mesh]
        counts = [_counts(header, primitives[key]) for key, _ in chosen]
        limits.check(sum(n for n, _ in counts), sum(n for _, n in counts))
        decoded = _decoded(header, primitives, binary)
        return _placed([(*decoded[key], matrix) for key, matrix in chosen], notes)
    except _INCONSISTENT as error:
        what = f"{type(error).__name__}: {str(error)[:200]}"
        raise InvalidFile(f"the glTF header is inconsistent ({what})") from None


def _chunks(content: bytes) -> tuple[Header, bytes]:
    """JSON header and binary chunk of a GLB file."""
    if content[:4] != b"glTF" or len(content) < 20:
        raise InvalidFile("the file does not begin with a GLB header")
    version, length = struct.unpack_from("<II", content, 4)
    if version != 2:
        raise InvalidFile(f"only glTF 2.0 is supported, this is version {version}")
    if length != len(content):
        raise InvalidFile(f"the GLB header announces {length:,} bytes; the file has {len(content):,}")
    chunks: dict[int, bytes] = {}
    at = 12
    while at < length:
        if at + 8 > length:
            raise InvalidFile("the file ends inside the head of a chunk")
        size, kind = struct.unpack_from("<II", content, at)
        if at + 8 + size > length:
            raise InvalidFile(f"a chunk announces {size:,} bytes and only {length - at - 8:,} are left")
        chunks.setdefault(kind, content[at + 8 : at + 8 + size])
        at += 8 + size
    try:
        header = json.loads(chunks[_CHUNK_JSON])
    except (KeyError, ValueError, RecursionError):
        raise InvalidFile("the GLB file has no readable JSON chunk") from None
    if not isinstance(header, dict):
        raise InvalidFile("the JSON chunk is not an object")
    return header, chunks.get(_CHUNK_BIN, b"")


def _check_extensions(header: Header) -> tuple[str, ...]:
    used = {*header.get("extensionsUsed", []), *header.get("extensionsRequired", [])}
    refused = sorted(_GEOMETRY_EXTENSIONS & used)
    if refused:
        raise InvalidFile(f"glTF extension {refused[0]} is not supported: export plain geometry")
    primitives = [primitive for mesh in header.get("meshes", []) for primitive in mesh["primitives"]]
    if any("targets" in p for p in primitives) or any("skin" in node for node in header.get("nodes", [])):
        return ("skins and morph targets were ignored: the mesh is as stored, not as posed",)
    return ()


def _triangle_primitives(header: Header, n_bytes: int) -> dict[Key, dict[str, Any]]:
    """Primitives made of triangles; their arrays are plain and lie inside the file."""
    found = {}
    for m, mesh in enumerate(header.get("meshes", [])):
        for p, primitive in enumerate(mesh["primitives"]):
            mode = primitive.get("mode", _TRIANGLES)
            if mode == _FAN:
                raise InvalidFile("triangle fans (glTF mode 6) are not supported: export triangles")
            if mode not in {_TRIANGLES, _STRIP}:
                continue
            positions = primitive["attributes"]["POSITION"]
            kept = {"mode": mode, "positions": positions}
            _check_accessor(header, positions, "VEC3", _POSITIONS, n_bytes)
            if "indices" in primitive:
                kept["indices"] = primitive["indices"]
                _check_accessor(header, primitive["indices"], "SCALAR", _INDICES, n_bytes)
            found[m, p] = kept
    return found


def _check_accessor(header: Header, index: int, kind: str, sizes: dict[int, int], n_bytes: int) -> None:
    """Refuse an array of another kind or component type than those in ``sizes``, or one not in the file."""
    accessor = header["accessors"][_natural(index)]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise InvalidFile("sparse glTF arrays are not supported: export plain geometry")
    if accessor["type"] != kind or accessor["componentType"] not in sizes:
        raise InvalidFile("a glTF array of positions must be of floats, one of indices of unsigned integers")
    view = header["bufferViews"][_natural(accessor["bufferView"])]
    if _natural(view["buffer"]) != 0 or "uri" in header["buffers"][0]:
        raise InvalidFile("the GLB file keeps its geometry elsewhere: only its own buffer is read")
    size = sizes[accessor["componentType"]]
    stride = _natural(view.get("byteStride", size))
    count = _natural(accessor["count"])
    end = _natural(accessor.get("byteOffset", 0)) + (count - 1) * stride + size
    view_end = _natural(view.get("byteOffset", 0)) + _natural(view["byteLength"])
    if count == 0 or stride < size or end > view["byteLength"] or view_end > n_bytes:
        raise InvalidFile(f"a glTF array of {count:,} entries does not fit the {n_bytes:,} bytes of the file")


def _natural(value: object) -> int:
    """Refuse negative, fractional and boolean indices, which Python would take."""
    if type(value) is not int or value < 0:
        raise ValueError(f"{value!r} is no index")
    return value


def _counts(header: Header, primitive: dict[str, Any]) -> tuple[int, int]:
    """Vertices of a primitive, and the most triangles it can have."""
    n_vertices: int = header["accessors"][primitive["positions"]]["count"]
    count: int = header["accessors"][primitive.get("indices", primitive["positions"])]["count"]
    if primitive["mode"] == _TRIANGLES and count % 3:
        raise InvalidFile(f"a glTF primitive of triangles has {count} corners, which is no multiple of three")
    return n_vertices, count // 3 if primitive["mode"] == _TRIANGLES else max(count - 2, 0)


def _placements(header: Header) -> Iterator[tuple[int, Floats]]:
    """Mesh index and transform (4, 4) of every node that places a mesh, in the order of the scene."""
    nodes = header.get("nodes", [])
    children = [child for node in nodes for child in node.get("children", [])]
    if "scenes" in header:
        roots = header["scenes"][_natural(header.get("scene", 0))].get("nodes", [])
    else:
        roots = [k for k in range(len(nodes)) if k not in set(children)]
    if len({*children, *roots}) < len(children) + len(roots):
        raise InvalidFile("a glTF node has two parents or is its own ancestor")
    stack = [(root, np.eye(4), 0) for root in reversed(roots)]
    while stack:
        index, parent, depth = stack.pop()
        if depth > _MAX_DEPTH:
            raise InvalidFile(f"glTF nodes are nested more than {_MAX_DEPTH} deep")
        node = nodes[_natural(index)]
        matrix = parent @ _local(node)
        if "mesh" in node:
            header["meshes"][_natural(node["mesh"])]  # an IndexError if there is no such mesh
            yield node["mesh"], matrix
        stack += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]


def _local(node: dict[str, Any]) -> Floats:
    """Transform (4, 4) of a node: its matrix, or translation · rotation · scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), dtype=np.float64)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # R = I + 2w[v]ₓ + 2[v]ₓ² of a unit quaternion (v, w); glTF promises the unit length only roughly.
    rotation = np.eye(3) + 2 * (w * cross + cross @ cross) / max(x * x + y * y + z * z + w * w, 1e-300)
    matrix[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", [0, 0, 0])
    return matrix


def _decoded(
    header: Header, primitives: dict[Key, dict[str, Any]], binary: bytes
) -> dict[Key, tuple[Floats, Ints]]:
    """Vertices (V, 3) and faces (F, 3) of each primitive, decoded by trimesh."""
    import trimesh  # noqa: PLC0415  (slow to import, and only this format needs it)

    if not primitives:
        return {}
    used = [primitive["positions"] for primitive in primitives.values()]
    used += [primitive["indices"] for primitive in primitives.values() if "indices" in primitive]
    plain = {
        "asset": {"version": "2.0"},
        "accessors": [header["accessors"][index] for index in used],
        "bufferViews": header["bufferViews"],
        "buffers": [{"byteLength": len(binary)}],
        # One mesh a primitive, so that each has a name by which it is found again.
        "meshes": [
            {"name": f"{m}/{p}", "primitives": [_plain(primitive, used)]}
            for (m, p), primitive in primitives.items()
        ],
        "nodes": [{"mesh": k} for k in range(len(primitives))],
        "scenes": [{"nodes": list(range(len(primitives)))}],
    }
    text = json.dumps(plain).encode()
    text += b" " * (-len(text) % 4)
    start = b"glTF" + struct.pack("<IIII", 2, 28 + len(text) + len(binary), len(text), _CHUNK_JSON)
    file = BytesIO(b"".join([start, text, struct.pack("<II", len(binary), _CHUNK_BIN), binary]))
    # Its buffer has no address, so an empty resolver is enough: nothing beside the upload is ever read.
    scene = trimesh.load_scene(
        file, file_type="glb", resolver={}, process=False, maintain_order=True, skip_materials=True
    )
    meshes = {(m, p): scene.geometry[f"{m}/{p}"] for m, p in primitives}
    return {
        key: (np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64))
        for key, mesh in meshes.items()
    }


def _plain(primitive: dict[str, Any], used: list[int]) -> dict[str, Any]:
    attributes = {"POSITION": used.index(primitive["positions"])}
    plain = {"mode": primitive["mode"], "attributes": attributes}
    return plain | ({"indices": used.index(primitive["indices"])} if "indices" in primitive else {})


def _placed(parts: list[tuple[Floats, Ints, Floats]], notes: tuple[str, ...]) -> Polygons:
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.int64)]
    offset = 0
    for points, triangles, matrix in parts:
        # An index must fail against its own part, not name a vertex of the next one.
        if triangles.size and (triangles.min() < 0 or triangles.max() >= len(points)):
            raise InvalidFile(f"a glTF primitive names vertex {triangles.max()} and has {len(points)}")
        vertices.append(points)
        faces.append(triangles + offset)
        if not np.array_equal(matrix, np.eye(4)):
            vertices[-1] = points @ matrix[:3, :3].T + matrix[:3, 3]
            if np.linalg.det(matrix[:3, :3]) < 0:  # a mirror turns every triangle over
                faces[-1] = faces[-1][:, ::-1]
        offset += len(points)
    if len(parts) > 1:
        notes += (f"{len(parts)} placed primitives became one mesh, in the order of the scene's nodes",)
    return Polygons.from_triangles(np.concatenate(vertices), np.concatenate(faces), notes)
