"""Point maps of optimal soft maps beside functional maps with ZoomOut (pyFM), from the same landmarks.

    python -m benchmarks.pointmaps [wolves] [cats] [people] [--folder DIR] [--size 150] [--landmarks 3]

Landmarks are the first farthest-point samples of the source and their true images. pyFM maps 50 × 50
functions from wave kernel signatures and landmark descriptors with its defaults; ZoomOut goes to 150. Ours
is the least E_D + E_b with landmarks alone, and with 300 times the cost of distances to them, on bases of
local maximum entropy. "Nearest profile" sends a vertex to the one with the most similar distances to the
landmarks. Errors are Princeton's, in √area, over 400 vertices, to the truth and to the nearer of it and its
symmetric twin where that is known; seconds include bases and spectra. DIR holds one folder for each pair.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pyFM.functional import FunctionalMapping
from pyFM.mesh import TriMesh
from scipy.spatial import cKDTree

from benchmarks.optimal import FOLDER, landmarks, marked
from solver import (
    Mesh,
    descriptor_cost,
    landmark_distances,
    map_quality,
    maxent_basis,
    optimal_softmap,
    pointmap,
)
from solver.geodesics import distances_from
from solver.mesh import IntArray
from tests.solver.shapes import load

PAIRS = {
    "wolves": ("academic_tosca_wolf0_wolf1", "source__wolf0.off", "target__wolf1.off"),
    "cats": ("academic_tosca5k_cat0_cat10", "source__cat0.off", "target__cat10.off"),
    "people": ("free_human_man_woman", "source__human_man.obj", "target__human_woman.obj"),
}
WEIGHT = 300.0
#: Source vertices whose errors are measured.
SOURCES = 400
TOLERANCE = 1e-2
THREADS = 2


def functional_map(source: Mesh, target: Mesh, pairs: list[tuple[int, int]]) -> dict[str, IntArray]:
    """Map by pyFM's defaults, refined by ZoomOut; its p2p runs from its second mesh to its first."""
    one, other = (TriMesh(mesh.unit_vertices, mesh.faces) for mesh in (target, source))
    model = FunctionalMapping(one, other)
    model.preprocess(landmarks=np.array(pairs)[:, ::-1])
    model.fit(K=(50, 50))
    refined = model.zoomout_refine(nit=20, step=5)
    return {"ZoomOut": np.asarray(model.get_p2p(refined), dtype=np.int64)}


def nearest_profile(source: Mesh, target: Mesh, pairs: list[tuple[int, int]]) -> dict[str, IntArray]:
    """Most similar distances to the landmarks."""
    here, there = (
        landmark_distances(mesh, [pair[side] for pair in pairs]) for side, mesh in enumerate((source, target))
    )
    return {"": cKDTree(there).query(here)[1].astype(np.int64)}


def optimal(
    source: Mesh, target: Mesh, pairs: list[tuple[int, int]], size: int, weight: float
) -> dict[str, IntArray]:
    """Peak and barycentre of an optimal soft map."""
    bases = marked(maxent_basis, source, target, size, pairs)
    profiles = [
        landmark_distances(mesh, [pair[side] for pair in pairs]) for side, mesh in enumerate((source, target))
    ]
    cost = weight * descriptor_cost(*bases, *profiles)
    found = optimal_softmap(*bases, pairs, tolerance=TOLERANCE, cost=cost, threads=THREADS)
    return {method: pointmap(found.softmap, method).targets for method in ("peak", "barycentre")}


def measure(pair: str, folder: Path, size: int, count: int) -> None:
    """Print a line for each map of one pair."""
    name, first, second = PAIRS[pair]
    source, target = load(folder / name / first), load(folder / name / second)
    truth = np.loadtxt(folder / name / "gt.txt", dtype=np.int64)
    symmetric = folder / name / "gt_sym.txt"
    twin = np.loadtxt(symmetric, dtype=np.int64) if symmetric.exists() else None
    pairs = landmarks(source, truth, count)
    known = [each for each in (truth, twin) if each is not None]
    sure = np.flatnonzero(np.all([each >= 0 for each in known], axis=0))
    some = sure[np.linspace(0, sure.size - 1, SOURCES).astype(np.int64)]
    # One field of distances a source vertex and truth serves all maps.
    fields = [np.stack([distances_from(target, int(vertex)) for vertex in each[some]]) for each in known]
    ways: dict[str, Callable[[], dict[str, IntArray]]] = {
        "nearest profile": lambda: nearest_profile(source, target, pairs),
        "functional map": lambda: functional_map(source, target, pairs),
        "optimal": lambda: optimal(source, target, pairs, size, 0.0),
        "optimal + distances": lambda: optimal(source, target, pairs, size, WEIGHT),
    }
    for way, run in ways.items():
        began = time.perf_counter()
        maps = run()
        seconds = time.perf_counter() - began
        for kind, targets in maps.items():
            errors = [field[np.arange(SOURCES), targets[some]] for field in fields]
            nearer = "–" if twin is None else f"{np.minimum(*errors).mean():.4f}"
            coverage = map_quality(source, target, targets, truth, sources=some[:1]).coverage
            print(
                f"{pair:8}{way:20}{kind:11}{errors[0].mean():8.4f}{nearer:>8}{(errors[0] <= 0.1).mean():8.3f}"
                f"{coverage:10.3f}{seconds:8.1f}",
                flush=True,
            )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description="Point maps side by side.")
    parser.add_argument("pairs", nargs="*", metavar="PAIR", default=list(PAIRS))
    parser.add_argument("--folder", type=Path, default=FOLDER.parent)
    parser.add_argument("--size", type=int, default=150)
    parser.add_argument("--landmarks", type=int, default=3)
    asked = parser.parse_args()
    print(f"{'pair':8}{'map':20}{'':11}{'error':>8}{'nearer':>8}{'≤ 0.1':>8}{'coverage':>10}{'s':>8}")
    for pair in asked.pairs:
        measure(pair, asked.folder, asked.size, asked.landmarks)


if __name__ == "__main__":
    main()
