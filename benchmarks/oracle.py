"""Energies of real meshes beside a dense, independent solution of every face.

    python -m benchmarks.oracle [--size 60] [--faces N]

Three pairs (closed, with a boundary, of genus 3), each with a peaked point map and a spread descriptor map.
Printed are the worst relative differences of density (to the largest density), of energy and of gradient (to
the largest entry). The dense twin holds size³ numbers and solves size² ones for every face: with 300
functions, compare the first few hundred faces.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import trimesh

from solver import Basis, Mesh, SoftMap, hks, poisson_basis
from solver.energy import dirichlet_block
from tests.conftest import DATA
from tests.solver.dense import dense_dirichlet

CASES = {
    "wolf → wolf, closed": (
        "pairs/academic_tosca_wolf0_wolf1/source__wolf0.off",
        "pairs/academic_tosca_wolf0_wolf1/target__wolf1.off",
    ),
    "arm → arm, boundary": (
        "pairs/free_arm_woman_man/source__arm_woman.obj",
        "pairs/free_arm_woman_man/target__arm_man.obj",
    ),
    "3holes → 3holes, genus 3": ("robust/genus/3holes.off", "robust/genus/3holes.off"),
}


def read(path: Path) -> Mesh:
    """A mesh with the file's own order of vertices."""
    loaded = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
    return Mesh(loaded.vertices, loaded.faces)


def maps(source: Basis, target: Basis) -> Iterator[tuple[str, SoftMap]]:
    """The true point map, whose faces see few functions, and a descriptor map, whose faces see all."""
    yield "points", SoftMap.from_points(source, target, np.arange(source.mesh.n_vertices))
    descriptors = hks(source.mesh, partner=target.mesh), hks(target.mesh, partner=source.mesh)
    yield "hks", SoftMap.from_descriptors(source, target, *descriptors)


def main() -> None:
    """Print one row a map."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, default=60)
    parser.add_argument("--faces", type=int, default=1_000_000)
    asked = parser.parse_args()
    print(
        f"{'pair':26}{'map':8}{'energy':>12}{'Δdensity':>12}{'Δenergy':>12}{'Δgradient':>12}{'residual':>12}"
    )
    for name, files in CASES.items():
        source, target = (poisson_basis(read(DATA / file), size=asked.size) for file in files)
        for kind, softmap in maps(source, target):
            n_faces = min(asked.faces, source.mesh.n_faces)
            found = dirichlet_block(softmap, 0, n_faces, gradient=True)
            exact = dense_dirichlet(softmap, faces=np.arange(n_faces))
            assert found.gradient is not None
            differences = (
                np.abs(found.density - exact.density).max() / exact.density.max(),
                abs(found.energy - exact.energy) / exact.energy,
                np.abs(found.gradient - exact.gradient).max() / np.abs(exact.gradient).max(),
                found.residual,
            )
            print(f"{name:26}{kind:8}{found.energy:12.6f}" + "".join(f"{each:12.1e}" for each in differences))


if __name__ == "__main__":
    main()
