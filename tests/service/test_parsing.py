"""Files become the arrays that are in them, or a refusal that says where they are wrong."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from service.parsing import FORMATS, InvalidFile, Limits, ParsedMesh, TooLarge, read_mesh, sniffed
from tests.service.files import FACES, TETRAHEDRON, glb, obj, off, ply, scene, stl, stl_text

LIMITS = Limits(vertices=1_000_000, faces=2_000_000)


def read(content: bytes | str, file_format: str, limits: Limits = LIMITS) -> ParsedMesh:
    return read_mesh(content if isinstance(content, bytes) else content.encode(), file_format, limits)


def refused(content: bytes | str, file_format: str) -> str:
    with pytest.raises(InvalidFile) as refusal:
        read(content, file_format)
    return str(refusal.value)


# Every format reads back what was written -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "file_format"),
    [
        (off(), "off"),
        (obj(), "obj"),
        (ply(""), "ply"),
        (ply("<"), "ply"),
        (ply(">"), "ply"),
        (glb(*scene()), "glb"),
    ],
)
def test_vertices_and_faces_come_back_in_order(content: bytes | str, file_format: str) -> None:
    mesh = read(content, file_format)
    np.testing.assert_array_equal(mesh.vertices, TETRAHEDRON)
    np.testing.assert_array_equal(mesh.faces, FACES)
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int64
    assert mesh.warnings == ()


@given(st.lists(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3), min_size=3, max_size=30))
def test_text_keeps_every_bit_of_a_coordinate(points: list[tuple[float, ...]]) -> None:
    vertices = np.array(points)
    for content, file_format in (
        (off(vertices, FACES[:1] % 3), "off"),
        (obj(vertices, FACES[:1] % 3), "obj"),
        (ply("", vertices, FACES[:1] % 3), "ply"),
    ):
        assert read(content, file_format).vertices.tobytes() == vertices.tobytes()


def test_stl_corners_with_equal_bits_become_one_vertex_in_order_of_appearance() -> None:
    for content in (stl(TETRAHEDRON[FACES]), stl_text(TETRAHEDRON[FACES])):
        mesh = read(content, "stl")
        np.testing.assert_array_equal(mesh.vertices, TETRAHEDRON[[0, 2, 1, 3]])
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], TETRAHEDRON[FACES])
        assert mesh.warnings == ("12 corners became 4 vertices: corners with equal bits are one vertex",)


def test_stl_corners_that_differ_in_one_bit_stay_apart() -> None:
    corners = TETRAHEDRON[FACES].astype(np.float32)
    corners[0, 0, 0] = np.nextafter(np.float32(0), np.float32(1))
    assert len(read(stl(corners), "stl").vertices) == 5


def test_unreferenced_vertices_stay() -> None:
    assert len(read(obj(faces=FACES[:1]), "obj").vertices) == 4


# The formats' own ways of writing ---------------------------------------------------------------------------


def test_obj_seams_relative_indices_and_continued_lines() -> None:
    text = "v 0 0 0\nv 1 0 0 1 0 0\nvt 0 0\nv 0 1 0\nvt 1 1\n#f 9 9 9\ng an f 1 2 3\n"
    text += "f 1/1/1 2/2 3//1\nf -3/1 \\\n 3 \\\n 2\n"
    mesh = read(text, "obj")
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 1]])


def test_obj_says_what_it_leaves_out() -> None:
    mesh = read(obj() + "p 1 2\nl 1 2\nl 2 3\n", "obj")
    assert mesh.warnings == ("points were left out (1 of them)", "lines were left out (2 of them)")


def test_off_with_comments_colours_and_records_over_several_lines() -> None:
    text = "# about\nCOFF3 1 0 # counts\n0 0\n0 255 0 0\n\n1 0 0 255 0 0\n0 1 0 1 2 3\n"
    text += "3\n0 1\n2 0.5 0.5 0.5 # grey\n"
    mesh = read(text, "off")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])
    np.testing.assert_array_equal(mesh.vertices[1], [1, 0, 0])
    assert mesh.warnings == ("numbers after the three coordinates of each vertex were left out",)


def test_ply_with_mixed_polygons_and_other_properties_in_both_byte_orders() -> None:
    for order in "<>":
        name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
        header = f"ply\r\nformat {name} 1.0\r\ncomment x\r\n"
        header += "element material 1\r\nproperty list uchar char text\r\nelement vertex 5\r\n"
        header += "property uchar red\r\nproperty float z\r\nproperty float y\r\nproperty float x\r\n"
        header += "element face 2\r\nproperty list uchar uint vertex_index\r\n"
        header += "property list int double uv\r\nend_header\r\n"
        body = struct.pack("B2b", 2, 1, 1)
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1), (2, 0)):
            body += struct.pack(order + "B3f", 7, 0, y, x)
        body += struct.pack(order + "B4Ii", 4, 0, 1, 2, 3, 0) + struct.pack(
            order + "B3Ii2d", 3, 1, 4, 2, 2, 0.5, 0.5
        )
        mesh = read(header.encode() + body, "ply")
        np.testing.assert_array_equal(mesh.vertices[4], [2, 0, 0])
        np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [1, 4, 2]])


def test_ply_strips_turn_every_other_triangle_and_drop_stitches() -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element tristrips 2\nproperty list int int vertex_indices\nend_header\n"
    body = "".join(f"{k} {k % 2} 0\n" for k in range(6)) + "8 0 1 2 3 -1 3 4 5\n5 0 1 1 2 3\n"
    mesh = read(header + body, "ply")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [2, 1, 3], [3, 4, 5], [1, 2, 3]])


def test_glb_nodes_are_placed_depth_first_by_their_transforms() -> None:
    half = np.sqrt(0.5)
    nodes: list[dict[str, object]] = [
        {"children": [2, 1], "translation": [10, 0, 0], "camera": 0},
        {"mesh": 0, "scale": [1, 1, -1]},
        {"mesh": 0, "rotation": [0, 0, half, half], "children": [3]},
        {"mesh": 0, "matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 5, 0, 1]},
    ]
    mesh = read(glb(*scene(nodes)), "glb")
    turned = TETRAHEDRON @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])  # x becomes y, y becomes −x
    doubled = (2 * TETRAHEDRON + [0, 5, 0]) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    expected = np.concatenate([turned, doubled, TETRAHEDRON * [1, 1, -1]]) + np.array([10, 0, 0])
    np.testing.assert_allclose(mesh.vertices, expected, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces[8:], FACES[:, ::-1] + 8)  # mirrored, so turned back


# Polygons ---------------------------------------------------------------------------------------------------


def polygon(points: list[tuple[float, float]], height: float = 0.0) -> ParsedMesh:
    rows = "".join(f"v {x} {y} {height * (k % 2)}\n" for k, (x, y) in enumerate(points))
    return read(f"{rows}f {' '.join(str(k + 1) for k in range(len(points)))}\n", "obj")


def areas(mesh: ParsedMesh) -> np.ndarray:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals: np.ndarray = np.cross(b - a, c - a)[:, 2] / 2
    return normals


def test_a_convex_polygon_is_a_fan_and_that_is_said() -> None:
    mesh = polygon([(0, 0), (2, 0), (3, 1), (1, 3), (0, 2)])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    assert mesh.warnings == ("polygons with more than three corners were split into triangles (1 of them)",)


@pytest.mark.parametrize(
    ("points", "area"),
    [
        ([(0, 0), (2, 0), (2, 2), (1.8, 0.2)], 0.4),  # an arrow: the other diagonal
        ([(0, 0), (1, 0), (2, 0), (2, 2), (0, 2)], 4.0),  # a corner that is none
        ([(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)], 7.0),  # the letter U
    ],
)
def test_a_concave_polygon_covers_its_area_once(points: list[tuple[float, float]], area: float) -> None:
    for shift in range(len(points)):
        mesh = polygon(points[shift:] + points[:shift])
        assert len(mesh.faces) == len(points) - 2
        assert (areas(mesh) > 0).all()
        assert areas(mesh).sum() == pytest.approx(area)


def test_a_polygon_with_a_slit_to_its_hole_is_covered_once() -> None:
    outer = [(0, 0), (4, 0), (4, 4), (0, 4)]
    hole = [(1, 1), (1, 3), (3, 3), (3, 1)]
    rows = "".join(f"v {x} {y} 0\n" for x, y in outer + hole)
    mesh = read(rows + "f 1 2 3 4 1 5 6 7 8 5\n", "obj")
    assert (areas(mesh) > 0).all()
    assert areas(mesh).sum() == pytest.approx(12.0)


@settings(max_examples=60)
@given(st.lists(st.floats(0.1, 1.0), min_size=4, max_size=14))
def test_any_star_shaped_polygon_is_covered_once(radii: list[float]) -> None:
    turns = 2 * np.pi * np.arange(len(radii)) / len(radii)
    points = [(r * np.cos(t), r * np.sin(t)) for r, t in zip(radii, turns, strict=True)]
    x, y = np.array(points).T
    mesh = polygon(points)
    assert (areas(mesh) > 0).all()
    assert areas(mesh).sum() == pytest.approx(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum())


@pytest.mark.parametrize(
    "face",
    ["1 3 2 4", "1 2 3 4 1 2 3 4", "1 1 2 3", "1 2 1 2"],
    ids=["bow tie", "twice", "repeated", "no area"],
)
def test_a_flat_polygon_that_crosses_or_covers_itself_is_refused(face: str) -> None:
    assert "face 0" in refused(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf {face}\n", "obj")


def test_a_bent_polygon_becomes_a_fan_and_that_is_said() -> None:
    square = "v -5 0 5\nv 5 0 5\nv 5 0 -5\nv -5 0 -5\nv 0 5 -5\nf 1 2 3 4 5\n"
    mesh = read(square, "obj")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    assert (
        mesh.warnings[1]
        == "polygons too bent to be seen flat became fans around their first corner (1 of them)"
    )


# Refusals ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "file_format", "part"),
    [
        ("", "off", "empty"),
        (off().replace("OFF", "MESH", 1), "off", "keyword OFF"),
        ("OFF BINARY\n", "off", "binary OFF"),
        ("4OFF\n1 1 0\n", "off", "three coordinates"),
        (off().replace("4 4 0", "4 5 0"), "off", "ends before face 4"),
        (off().replace("4 4 0", "4 3 0"), "off", "goes on after"),
        (off().replace("4 4 0", "99999999999 4 0"), "off", "cannot hold"),
        (off().replace("4 4 0", "-4 4 0"), "off", "counts"),
        (off().replace("3 0 2 1", "2 0 2"), "off", "has 2 corners"),
        (off().replace("3 0 2 1", "3 0 2 -1"), "off", "face 0 names vertex -1"),
        (off().replace("3 0 2 1", "3 0 2 4"), "off", "face 0 names vertex 4"),
        (off().replace("3 0 2 1", "3 0 2 1.5"), "off", "'1.5' is not a whole number"),
        (off().replace("1.0", "1_0.0", 1), "off", "line 4: a number with an underscore"),
        (
            "OFF\n6 2 0\n0 0 0 1 0 0\n0 1 0 0 0 1\n0 0 2 0 0 3\n3 0 1 2\n3 3 4 5\n",
            "off",
            "ends before vertex 5",
        ),
        (obj().replace("f 1 3 2", "f 1 3 9"), "obj", "line 5: the face names vertex 9"),
        (obj().replace("f 1 3 2", "f 1 3 0"), "obj", "OBJ counts from 1"),
        (obj().replace("f 1 3 2", "f 1 3 -5"), "obj", "only 4"),
        (obj().replace("f 1 3 2", "f 1 3"), "obj", "line 5: the face has 2 corners"),
        (obj().replace("v 1.0 0.0 0.0", "v 1.0 0.0"), "obj", "line 2"),
        (obj().replace("v 1.0", "V 1.0"), "obj", "no OBJ statement"),
        (obj().encode("utf-16"), "obj", "UTF-16"),
        (obj() + "\0", "obj", "NUL"),
        ("v 0 0 0\nv 1 0 0\np 1\n", "obj", "no faces"),
        (ply("<")[:-1], "ply", "ends inside its 4 rows of 'face'"),
        (ply("<") + b"x", "ply", "1 bytes follow"),
        (ply("").replace(b"face 4", b"face 5"), "ply", "ends inside its 5 rows of 'face'"),
        (ply("").replace(b"face 4", b"face 3"), "ply", "more lines follow"),
        (ply("").replace(b"vertex 4", b"vertex 9999"), "ply", "cannot hold"),
        (ply("").replace(b"3 0 2 1", b"3 0 2"), "ply", "fewer numbers"),
        (ply("").replace(b"3 0 2 1", b"-3 0 2 1"), "ply", "fewer numbers"),
        (ply("").replace(b"element face", b"element edge"), "ply", "no faces"),
        (ply("").replace(b"vertex_indices", b"indices"), "ply", "no vertex_indices"),
        (ply("").replace(b"property double y", b"property double w"), "ply", "x, y and z"),
        (ply("").replace(b"double y", b"double x"), "ply", "twice"),
        (ply("").replace(b"double y", b"quad y"), "ply", "not understood"),
        (ply("") + b"\0", "ply", "NUL"),
        (stl(TETRAHEDRON[FACES])[:-1], "stl", "announces 4 triangles"),
        (stl(TETRAHEDRON[FACES]) + b"x", "stl", "announces 4 triangles"),
        (stl_text(TETRAHEDRON[FACES], ""), "stl", "ends inside a solid"),
        (
            stl_text(TETRAHEDRON[FACES]).replace("endloop", "vertex 0 0 0\nendloop", 1),
            "stl",
            "'endloop' is expected",
        ),
        (stl_text(TETRAHEDRON[FACES]) + "\0", "stl", "announces"),
        (glb(*scene(), length=9), "glb", "announces 9 bytes"),
        (glb(*scene([{"children": [0]}])), "glb", "two parents"),
        (glb(*scene([{"mesh": 0, "children": [1, 1]}, {}])), "glb", "two parents"),
        (glb(*scene([{"mesh": 7}])), "glb", "inconsistent"),
        (glb(*scene(scenes=[{"nodes": [3]}])), "glb", "inconsistent"),
        (glb(*scene(extensionsRequired=["KHR_draco_mesh_compression"])), "glb", "KHR_draco"),
        (
            glb(*scene(accessors=[{"componentType": 5126, "count": 2**27, "type": "VEC3"}] * 2)),
            "glb",
            "sparse",
        ),
        (
            glb(*scene(buffers=[{"byteLength": 9, "uri": "/etc/passwd"}])),
            "glb",
            "keeps its geometry elsewhere",
        ),
    ],
)
def test_refusals_say_where_and_what(content: bytes | str, file_format: str, part: str) -> None:
    assert part in refused(content, file_format)


@pytest.mark.parametrize(
    "change", [{"count": 5}, {"count": -4}, {"byteOffset": 1}, {"type": "VEC2"}, {"count": True}]
)
def test_glb_arrays_that_do_not_fit_are_refused(change: dict[str, object]) -> None:
    header, binary = scene()
    accessors = header["accessors"]
    assert isinstance(accessors, list)
    accessors[0] |= change
    refused(glb(header, binary), "glb")


def test_too_many_vertices_or_faces_are_refused_before_they_are_built() -> None:
    for content, file_format in ((off(), "off"), (obj(), "obj"), (ply(), "ply"), (glb(*scene()), "glb")):
        with pytest.raises(TooLarge, match="4 vertices; this service takes at most 3"):
            read(content, file_format, Limits(3, 100))
    for content, file_format in ((off(), "off"), (ply(), "ply"), (stl(TETRAHEDRON[FACES]), "stl")):
        with pytest.raises(TooLarge, match="4 faces; this service takes at most 2"):
            read(content, file_format, Limits(100, 2))


WHOLE = {
    "off": off().encode(),
    "obj": obj().encode(),
    "ply": ply(),
    "stl": stl(TETRAHEDRON[FACES]),
    "glb": glb(*scene()),
}


@settings(max_examples=300, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(FORMATS), st.data())
def test_damaged_files_are_read_or_refused_and_nothing_else(file_format: str, data: st.DataObject) -> None:
    content = bytearray(WHOLE[file_format])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    content = content[: data.draw(st.integers(1, len(content)))]
    try:
        mesh = read(bytes(content), file_format)
    except (InvalidFile, TooLarge):
        return
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)


@settings(max_examples=150)
@given(st.sampled_from(FORMATS), st.binary(max_size=200))
@example("ply", b"ply\nformat ascii 1.0\nelement face 18446744073709551615\nend_header\n")
@example("ply", b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nend_header\n")
@example("off", b"OFF\n" + b"9" * 5000 + b" 1 0\n")
@example("obj", b"v 0 0 0\nf " + b"9" * 5000 + b" 1 1\n")
@example("stl", b"\0" * 34)  # a header and a count short of nothing: 84 − 50 bytes
def test_any_bytes_are_refused(file_format: str, content: bytes) -> None:
    refused(content, file_format)


# Formats told by their first bytes --------------------------------------------------------------------------


@pytest.mark.parametrize("file_format", ["off", "ply", "glb"])
def test_formats_are_told_by_their_first_bytes(file_format: str) -> None:
    assert sniffed(WHOLE[file_format]) == file_format


def test_text_stl_is_told_and_obj_is_not_guessed() -> None:
    assert sniffed(stl_text(TETRAHEDRON[FACES]).encode()) == "stl"
    assert sniffed(WHOLE["obj"]) is None
    assert sniffed(b"") is None


# Real files -------------------------------------------------------------------------------------------------

#: Files that are refused, and a word of the reason. All others must be read as the manifest counts them.
REFUSED = {
    "degenerate/Spider_binary.stl": "read",  # by the solver: its triangles have no area
    "formats/box_UTF16BE.obj": "UTF-16",
    "formats/box_longline.obj": "covers itself",
    "formats/number_formats.obj": "line 11: '3.1+e2' is not a number",
    "hostile/OutOfMemory.off": "353,535,235,358",
    "hostile/crash-30d6d0f7.ply": "end_header",
    "hostile/empty.obj": "no vertices",
    "hostile/empty.off": "empty",
    "hostile/empty.ply": "no vertices",
    "hostile/empty.stl": "no triangles",
    "hostile/empty_nodes.glb": "no vertices",
    "hostile/invalid.off": "0 corners",
    "hostile/issue623.ply": "fewer numbers",
    "hostile/malformed.obj": "vertex 0",
    "hostile/notenoughindices.obj": "2 corners",
    "hostile/obj_points.obj": "no faces",
    "hostile/obj_wireframe.obj": "no faces",
    "hostile/ply_empty_header.ply": "x, y and z",
    "hostile/ply_points_bin.ply": "no faces",
    "hostile/points_emptyface.ply": "no faces",
    "hostile/stl_empty_bin.stl": "no triangles",
}
#: Concave polygons, of which the manifest's fans cover more than there is.
CONCAVE = {"degenerate/tetris.obj", "formats/wallhole.obj", "polygons/concave_polygon.obj"}
#: The manifest counts what trimesh made of texture seams; the header says 502.
SEAMS = {"formats/fuze.ply", "formats/fuze_ascii.ply"}


def test_every_robust_file_is_read_as_the_manifest_counts_it_or_refused(data: Path) -> None:
    manifest = json.loads((data / "manifest.json").read_text())["robust"]
    assert len(manifest) > 100
    for name, entry in manifest.items():
        content = (data / "robust" / name).read_bytes()
        file_format = name.rpartition(".")[2].lower()
        reason = REFUSED.get(name)
        if reason is not None and reason != "read":
            assert reason in refused(content, file_format), name
            continue
        mesh = read(content, file_format)
        counts = entry["welded"] if file_format == "stl" or name in SEAMS else entry["raw"]
        assert (len(mesh.vertices), len(mesh.faces)) == (counts["V"], counts["F"]), name
        if name not in CONCAVE:
            a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
            area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
            assert area == pytest.approx(entry["raw"]["area"], rel=1e-6), name


def test_point_maps_of_real_pairs_count_vertices_as_we_do(data: Path) -> None:
    manifest = json.loads((data / "manifest.json").read_text())["pairs"]
    checked = 0
    for name in sorted(manifest):
        truth, sources = data / "pairs" / name / "gt.txt", list((data / "pairs" / name).glob("source__*"))
        if not truth.is_file() or not sources or sources[0].stat().st_size > 3e6:
            continue
        mesh = read(sources[0].read_bytes(), sources[0].suffix[1:].lower())
        assert len(mesh.vertices) == len(np.loadtxt(truth)), name
        checked += 1
    assert checked >= 5


def test_trimesh_reads_the_same_where_it_reads_rightly(data: Path) -> None:
    import trimesh

    for name in (
        "closed/spot_triangulated.obj",
        "genus/fertility.off",
        "closed/sphere_small.ply",
        "big/skull_100k.ply",
    ):
        path = data / "robust" / name
        ours = read(path.read_bytes(), path.suffix[1:])
        theirs = trimesh.load_mesh(path, process=False, maintain_order=True, skip_materials=True)
        np.testing.assert_array_equal(ours.vertices, theirs.vertices)
        np.testing.assert_array_equal(ours.faces, theirs.faces)
