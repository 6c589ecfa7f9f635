"""One solve of all faces in every way, for pytest-benchmark.

    pytest benchmarks/test_solve.py -n0 --benchmark-enable

Two arms of 1272 vertices each where the meshes are at hand, else the built-in creature with 1114 vertices.
`softmaps bench` has the same contenders take turns, which is what ratios should be read from.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from service.bench import BENCH_SUBDIVISIONS, RIVAL_FACES, mesh_of, wks_map
from service.creature import creature
from service.rivals import FaceSystems, face_systems, rivals
from solver import SoftMap, dirichlet
from tests.conftest import DATA
from worker.tasks import blas_pools, usable_cores, versions

ARMS = [DATA / "pairs/free_arm_woman_man" / name for name in ("source__arm_woman.obj", "target__arm_man.obj")]
SIZE, REGULARISATION = 300, 1e-5


@pytest.fixture(scope="module")
def softmap() -> SoftMap:
    if all(path.exists() for path in ARMS):
        source, target = map(mesh_of, ARMS)
    else:
        source, target = (creature(pose, BENCH_SUBDIVISIONS) for pose in ("standing", "trotting"))
    return wks_map(source, target, SIZE)


@pytest.fixture(scope="module")
def systems(softmap: SoftMap) -> FaceSystems:
    faces = np.unique(np.linspace(0, softmap.source.mesh.n_faces - 1, RIVAL_FACES).astype(np.int64))
    return face_systems(softmap, faces, REGULARISATION)


def note(benchmark: BenchmarkFixture, softmap: SoftMap, n_faces: int, **facts: Any) -> None:
    """Sizes, accuracy, threads and versions beside the time."""
    source, target = softmap.source, softmap.target
    benchmark.extra_info |= {
        "source_faces": source.mesh.n_faces,
        "target_vertices": target.mesh.n_vertices,
        "functions": target.size,
        "faces_solved": n_faces,
        "microseconds_a_face": 1e6 * benchmark.stats.stats.min / n_faces if benchmark.stats else None,
        **facts,
        **versions(),
    }


@pytest.mark.parametrize("gradient", [False, True], ids=["density", "gradient"])
@pytest.mark.parametrize("threads", sorted({1, usable_cores()}))
def test_softmaps(benchmark: BenchmarkFixture, softmap: SoftMap, threads: int, gradient: bool) -> None:
    def solve() -> Any:
        return dirichlet(softmap, REGULARISATION, gradient, threads)

    found = benchmark.pedantic(solve, rounds=5, warmup_rounds=1)
    assert found.residual < 1e-12
    n_faces = softmap.source.mesh.n_faces
    note(benchmark, softmap, n_faces, threads=threads, residual=found.residual, energy=found.energy)


@pytest.mark.parametrize("name", ["LAPACK, dense", "SuperLU", "CHOLMOD"])
def test_rivals(benchmark: BenchmarkFixture, softmap: SoftMap, systems: FaceSystems, name: str) -> None:
    solve: Callable[[], Any] | None = rivals(systems).get(name)
    if solve is None:
        pytest.skip("CVXOPT, which brings CHOLMOD, is not installed")
    with blas_pools().limit(limits=1):
        solutions = benchmark.pedantic(solve, rounds=5, warmup_rounds=1)
    residual = systems.residual(solutions)
    assert residual < 1e-12
    exact = dirichlet(softmap, REGULARISATION)
    difference = np.abs(systems.densities(solutions) - exact.density[systems.faces]).max()
    assert difference < 1e-9 * exact.density.max()
    note(benchmark, softmap, systems.faces.size, threads=1, residual=residual, energy=exact.energy)
