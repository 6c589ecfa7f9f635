"""Specs of the usual questions, and maps from files and arrays: what is meant, or a refusal that says why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from service.refusals import Unusable

#: Maps that need no numbers.
NAMED_MAPS = ("wks", "hks", "uniform")


@dataclass(frozen=True)
class BasisOptions:
    """How both bases are made; None leaves the service's default.

    Attributes
    ----------
    size : int
        Functions of each basis.
    method : {"poisson", "maxent"}, optional
        The paper's, or local maximum entropy.
    cutoff : float, optional
        Of the poisson basis, in (0, 1).
    sharpness : float, optional
        Of the maxent basis, from 0.5 to 50.
    """

    size: int = 300
    method: str | None = None
    cutoff: float | None = None
    sharpness: float | None = None

    def spec(self, mesh: str, size: int | None = None) -> dict[str, Any]:
        """Spec of a basis on a mesh."""
        fields: dict[str, Any] = {"kind": "basis", "mesh": mesh, "size": size or self.size}
        chosen = {"method": self.method, "cutoff": self.cutoff, "sharpness": self.sharpness}
        return fields | {name: value for name, value in chosen.items() if value is not None}


def named_map(name: str, sigma: float | None = None) -> dict[str, Any]:
    """The `map` of a softmap spec that is known by name.

    Parameters
    ----------
    name : {"wks", "hks", "uniform"}
        Descriptors that both meshes are compared by, or no comparison at all.
    sigma : float, optional
        How far descriptors reach, in units of their root-mean-square distance.

    Returns
    -------
    dict
        Ready for a spec.

    Raises
    ------
    Unusable
        If there is no such map.
    """
    if name not in NAMED_MAPS:
        raise Unusable(f"{name!r} is no map; the names are {', '.join(NAMED_MAPS)}")
    if name == "uniform":
        return {"type": "uniform"}
    fields = {"type": "descriptors", "descriptor": name}
    return fields if sigma is None else {**fields, "sigma": sigma}


def map_kind(array: NDArray[Any], n_source: int, n_target: int) -> Literal["points", "matrix"]:
    """What an array of numbers says about a map: targets of all source vertices, or coefficients.

    Parameters
    ----------
    array : ndarray
        V₀ integers (also as one column) are targets, an n₀×n matrix holds coefficients.
    n_source, n_target : int
        Vertices of the two meshes.

    Returns
    -------
    str
        ``points`` or ``matrix``.

    Raises
    ------
    Unusable
        If it is neither beyond doubt; says why.
    """
    if array.dtype.kind not in "iuf":
        raise Unusable(f"a map is made of numbers, not of {array.dtype}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise Unusable(f"number {_first(~np.isfinite(array))} of the map is not finite")
    if array.ndim == 2 and array.shape[1] > 1:
        return "matrix"
    if array.ndim not in {1, 2}:
        raise Unusable(f"a map has one or two axes, not the shape {array.shape}")
    flat = array.ravel()
    if len(flat) != n_source:
        raise Unusable(
            f"the map has {len(flat)} entries, the source {n_source} vertices, the target {n_target}; "
            "a point map names the target vertex of every source vertex"
        )
    if array.dtype.kind == "f":
        raise Unusable("a point map holds whole numbers, written without a decimal point")
    if flat.min() < 0:
        at = _first(flat < 0)
        raise Unusable(f"entry {at} of the map is {flat[at]}; every source vertex needs a target, from 0 on")
    if flat.max() >= n_target:
        at = _first(flat >= n_target)
        hint = (
            "; the map seems to count from 1: subtract 1" if (flat.min(), flat.max()) == (1, n_target) else ""
        )
        raise Unusable(
            f"entry {at} of the map is {flat[at]}, but the target's vertices are 0 to {n_target - 1}{hint}"
        )
    return "points"


def read_map(path: Path) -> NDArray[Any]:
    """Numbers of a map file, as they stand in it.

    Parameters
    ----------
    path : Path
        A ``.npy`` array, or a ``.txt`` with one row of numbers a line, separated by blanks or commas.

    Returns
    -------
    ndarray
        Integers if all numbers are written as integers, else float64; one axis if each line has one number.

    Raises
    ------
    Unusable
        If it is neither; says why.
    OSError
        If it cannot be read.
    """
    ending = path.suffix.lower()
    if ending == ".npy":
        try:
            array: NDArray[Any] = np.load(path, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise Unusable(f"{path} is no .npy file of numbers: {error}") from None
        return array
    if ending != ".txt":
        raise Unusable(
            f"{path}: maps are read from .txt and .npy; formats such as .map and .vts differ in where they "
            "count from, so write down the target of every source vertex, counted from 0"
        )
    rows = [
        line.replace(",", " ").split()
        for line in path.read_text(encoding="utf-8").splitlines()
        if line.strip()
    ]
    if not rows:
        raise Unusable(f"{path} is empty")
    for number, row in enumerate(rows, start=1):
        if len(row) != len(rows[0]):
            raise Unusable(f"{path}: row {number} has {len(row)} numbers, the first has {len(rows[0])}")
    for convert, kind in ((int, np.int64), (float, np.float64)):
        try:
            table = np.array([[convert(word) for word in row] for row in rows], dtype=kind)
        except (ValueError, OverflowError):
            continue
        return table[:, 0] if table.shape[1] == 1 else table
    raise Unusable(f"{path} holds something that is no number")


def _first(where: NDArray[np.bool_]) -> int:
    return int(np.flatnonzero(where)[0])


def softmap(source: Mapping[str, Any], target: Mapping[str, Any], map_: Mapping[str, Any]) -> dict[str, Any]:
    """Spec of a soft map between two bases (specs or ids)."""
    return {"kind": "softmap", "source": source, "target": target, "map": map_}


def optimal_softmap(
    bases: BasisOptions, source: str, target: str, landmarks: Sequence[tuple[int, int]], **options: Any
) -> dict[str, Any]:
    """Spec of an optimal soft map between two meshes, on bases that have the landmarks as first samples.

    Parameters
    ----------
    bases : BasisOptions
        How both bases are made.
    source, target : str
        Ids of the meshes.
    landmarks : sequence of (int, int)
        Pairs of a source and a target vertex.
    **options
        More of the map's fields; None leaves the service's default. Its ``method`` is called ``optimiser``.

    Returns
    -------
    dict
        Ready to be submitted.
    """
    pairs = [[int(v0), int(v)] for v0, v in landmarks]

    def side(mesh: str, end: int) -> dict[str, Any]:
        first = list(dict.fromkeys(pair[end] for pair in pairs))
        return bases.spec(mesh) | ({"first": first} if first else {})

    named = {"method" if name == "optimiser" else name: value for name, value in options.items()}
    chosen = {name: value for name, value in named.items() if value is not None}
    return softmap(side(source, 0), side(target, 1), {"type": "optimal", "landmarks": pairs, **chosen})
