"""Maps from files and arrays: what is meant beyond doubt is taken, all else refused with its reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.asking import BasisOptions, map_kind, named_map, read_map
from service.refusals import Unusable

N_SOURCE, N_TARGET = 6, 4


def lines(*words: object) -> str:
    return "\n".join(map(str, words)) + "\n"


def test_target_lists_and_matrices(tmp_path: Path) -> None:
    points, matrix = tmp_path / "points.txt", tmp_path / "matrix.txt"
    points.write_text(lines(3, 0, 1, 1, 2, 0))
    array = read_map(points)
    assert array.dtype == np.int64
    assert array.tolist() == [3, 0, 1, 1, 2, 0]
    assert map_kind(array, N_SOURCE, N_TARGET) == "points"
    matrix.write_text("0.5, 0.5\n\n1 0\n")
    array = read_map(matrix)
    assert array.tolist() == [[0.5, 0.5], [1.0, 0.0]]
    assert map_kind(array, N_SOURCE, N_TARGET) == "matrix"
    np.save(tmp_path / "column.npy", np.array([[0], [1], [2], [3], [0], [1]], dtype=np.uint8))
    assert map_kind(read_map(tmp_path / "column.npy"), N_SOURCE, N_TARGET) == "points"


@pytest.mark.parametrize(
    ("words", "content"),
    [
        ("counts? from 1", lines(1, 2, 3, 4, 1, 2)),
        ("3 entries, the source 6 vertices, the target 4", lines(0, 1, 2)),
        ("entry 2 of the map is -1", lines(0, 1, -1, 0, 0, 0)),
        ("entry 5 of the map is 9, but the target's vertices are 0 to 3$", lines(0, 1, 2, 3, 0, 9)),
        ("number 1 of the map is not finite", lines(0, "nan", 0, 0, 0, 0)),
        ("whole numbers", lines(0.5, 0, 0, 0, 0, 0)),
        ("no number", "here be dragons"),
        ("row 3 has 1 numbers, the first has 2", "0 1\n1 0\n2\n"),
        ("is empty", "\n \n"),
    ],
)
def test_text_that_is_no_map(words: str, content: str, tmp_path: Path) -> None:
    path = tmp_path / "map.txt"
    path.write_text(content)
    with pytest.raises(Unusable, match=words):
        map_kind(read_map(path), N_SOURCE, N_TARGET)


@pytest.mark.parametrize(
    ("words", "array"),
    [
        ("one or two axes", np.zeros((2, 2, 2))),
        ("made of numbers", np.array(["a", "b"])),
        ("made of numbers", np.array([True] * 6)),
    ],
)
def test_arrays_that_are_no_map(words: str, array: np.ndarray) -> None:
    with pytest.raises(Unusable, match=words):
        map_kind(array, N_SOURCE, N_TARGET)


def test_files_that_are_no_map(tmp_path: Path) -> None:
    for name, words in (("map.vts", "differ in where they count from"), ("map.npy", "no .npy file")):
        (tmp_path / name).write_text("1\n2\n")
        with pytest.raises(Unusable, match=words):
            read_map(tmp_path / name)
    np.save(tmp_path / "objects.npy", np.array([{}, []], dtype=object), allow_pickle=True)
    with pytest.raises(Unusable, match=r"no \.npy file"):
        read_map(tmp_path / "objects.npy")
    with pytest.raises(OSError, match="nowhere"):
        read_map(tmp_path / "nowhere.txt")


def test_specs_leave_defaults_to_the_service() -> None:
    assert BasisOptions(20).spec("mesh-0") == {"kind": "basis", "mesh": "mesh-0", "size": 20}
    assert BasisOptions(cutoff=0.2).spec("mesh-0", 7)["cutoff"] == 0.2
    maxent = {"kind": "basis", "mesh": "mesh-0", "size": 300, "method": "maxent", "sharpness": 2.0}
    assert BasisOptions(method="maxent", sharpness=2.0).spec("mesh-0") == maxent
    assert BasisOptions().spec("mesh-0", 7)["size"] == 7
    assert named_map("wks") == {"type": "descriptors", "descriptor": "wks"}
    assert named_map("hks", 0.3)["sigma"] == 0.3
    assert named_map("uniform") == {"type": "uniform"}
    with pytest.raises(Unusable, match="'sks' is no map; the names are wks, hks, uniform"):
        named_map("sks")
