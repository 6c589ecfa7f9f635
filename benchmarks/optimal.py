"""Optimal soft maps: energy, proven gap, iterations, seconds, and the error of the point map read off each.

    python -m benchmarks.optimal sphere
    python -m benchmarks.optimal wolves 60 150 300 [--folder DIR] [--basis poisson] [--tolerance 1e-3]

Spheres have one and three landmarks and are their own truth. Wolves have three, the first farthest-point
samples of one and their true images on the other; each size starts from the uniform map, and from the one
before it, prolonged. DIR holds ``source__wolf0.off``, ``target__wolf1.off`` and ``gt.txt``. Errors are means
over every eighth vertex, in √area.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from solver import (
    Basis,
    Mesh,
    OptimalMap,
    map_quality,
    mass_within,
    maxent_basis,
    optimal_softmap,
    pointmap,
    poisson_basis,
)
from solver.geodesics import farthest_point_samples
from solver.mesh import IntArray
from solver.softmap import SoftMap
from tests.solver.shapes import icosphere, load

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "pairs" / "academic_tosca_wolf0_wolf1"
MAKERS = {"poisson": poisson_basis, "maxent": maxent_basis}
THREADS = 2
#: Gap over energy at which evaluations are counted.
LEVELS = (1e-2, 1e-3)


def head() -> None:
    """Print the names of the columns."""
    print(
        f"{'map':24}{'n':>5}{'start':>10}{'energy':>11}{'gap/E':>9}{'its':>5}{'evals':>7}{'to 1e-2':>9}"
        f"{'to 1e-3':>9}{'s':>8}{'peak':>8}{'bary':>8}{'in 0.1':>8}"
    )


def row(name: str, start: str, found: OptimalMap, truth: IntArray) -> None:
    """Print what is known of one optimal map."""
    softmap, last = found.softmap, found.history[-1]
    source, target = softmap.source.mesh, softmap.target.mesh
    some = np.arange(0, source.n_vertices, 8)
    errors = [
        map_quality(source, target, pointmap(softmap, method).targets, truth, sources=some).mean
        for method in ("peak", "barycentre")
    ]
    within = float(np.nanmean(mass_within(softmap, truth, 0.1, some)))
    reached = [
        next((str(each.evaluations) for each in found.history if each.gap <= level * each.energy), "–")
        for level in LEVELS
    ]
    print(
        f"{name:24}{softmap.source.size:5d}{start:>10}{found.energy:11.6f}{found.relative_gap:9.1e}"
        f"{found.iterations:5d}{last.evaluations:7d}{reached[0]:>9}{reached[1]:>9}{last.seconds:8.1f}"
        f"{errors[0]:8.4f}{errors[1]:8.4f}{within:8.4f}",
        flush=True,
    )


def spheres(tolerance: float) -> None:
    """One and three landmarks, both bases, 60 functions."""
    mesh = icosphere(3)
    here = np.arange(mesh.n_vertices)
    for name, maker in MAKERS.items():
        basis = maker(mesh, size=60)
        for held in ([0], [0, 20, 41]):
            pairs = [(int(basis.samples[k]), int(basis.samples[k])) for k in held]
            found = optimal_softmap(basis, basis, pairs, tolerance=tolerance, threads=THREADS)
            row(f"sphere, {len(held)} held, {name}", "uniform", found, here)


def wolves(folder: Path, sizes: list[int], name: str, tolerance: float) -> None:
    """Three landmarks at growing sizes, from the uniform map and from the size before."""
    source, target = load(folder / "source__wolf0.off"), load(folder / "target__wolf1.off")
    truth = np.loadtxt(folder / "gt.txt", dtype=np.int64)
    pairs = landmarks(source, truth, 3)
    coarse: SoftMap | None = None
    for size in sizes:
        bases = marked(MAKERS[name], source, target, size, pairs)
        found = optimal_softmap(*bases, pairs, tolerance=tolerance, threads=THREADS)
        row(f"wolves, {name}", "uniform", found, truth)
        if coarse is not None:
            found = optimal_softmap(*bases, pairs, tolerance=tolerance, start=coarse, threads=THREADS)
            row(f"wolves, {name}", f"n = {coarse.source.size}", found, truth)
        coarse = found.softmap


def landmarks(source: Mesh, truth: IntArray, count: int) -> list[tuple[int, int]]:
    """Farthest-point samples of the source and their true images."""
    vertices = farthest_point_samples(source, count, 0).vertices
    return [(int(vertex), int(truth[vertex])) for vertex in vertices]


def marked(maker, source: Mesh, target: Mesh, size: int, pairs: list[tuple[int, int]]) -> tuple[Basis, Basis]:  # type: ignore[no-untyped-def]
    """Bases whose first samples are the landmarks."""
    first = [[pair[side] for pair in pairs] for side in (0, 1)]
    return maker(source, size=size, first=first[0]), maker(target, size=size, first=first[1])


def main() -> None:
    """Print one row a map."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shape", choices=["sphere", "wolves"])
    parser.add_argument("sizes", nargs="*", type=int, default=[60, 150])
    parser.add_argument("--folder", type=Path, default=FOLDER)
    parser.add_argument("--basis", choices=sorted(MAKERS), default="maxent")
    parser.add_argument("--tolerance", type=float, default=1e-3)
    asked = parser.parse_args()
    head()
    if asked.shape == "sphere":
        spheres(asked.tolerance)
    else:
        wolves(asked.folder, asked.sizes, asked.basis, asked.tolerance)


if __name__ == "__main__":
    main()
