"""How cost grows with faces and with functions, with fitted exponents, and where each stage's time goes.

    python -m benchmarks.growth [--faces] [--functions] [--draw]

Pairs of ellipsoids of 1,000 to 200,000 faces with 300 functions, then of 10,000 faces with 50 to 1000
functions; no data is needed. The energy is solved for 2048 faces spread over the mesh, and scaled to all. All
times are of one thread, the least of three where they are short. Without options everything is measured and
drawn, which takes five minutes; measurements stay in a file, so that parts can be repeated.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from solver import Mesh, SoftMap, bijectivity, poisson_basis, spectrum, wks_of
from solver.assembly import plan_of, systems
from solver.chunks import solved_chunks
from tests.solver.shapes import fibonacci_sphere
from worker import specs
from worker.sizes import (
    BasisSize,
    MapSize,
    MeshSize,
    basis_cost,
    energy_cost,
    softmap_cost,
    spectrum_cost,
)
from worker.tasks import blas_pools

ROOT = Path(__file__).resolve().parents[1]
FIGURE = ROOT / "docs/figures/growth.png"
FACES = (1_000, 3_000, 10_000, 30_000, 100_000, 200_000)
FUNCTIONS = (50, 100, 200, 300, 500, 700, 1000)
USUAL_FACES, USUAL_FUNCTIONS = 10_000, 300
EIGENPAIRS, COUNT = 200, 100
SOLVED_FACES = 2048
#: Faces above which comparing descriptors would take minutes; the energy's cost does not depend on the map.
MOST_COMPARED = 100_000
#: Axes of the two ellipsoids, all different: no eigenvalue is repeated.
AXES = ((1.0, 1.13, 1.29), (1.0, 1.3, 1.8))
STAGES = ("basis", "spectrum", "softmap", "plan", "energy", "bijectivity")
COLOURS = ("#4477aa", "#66ccee", "#228833", "#ccbb44", "#ee6677", "#aa3377")


def best(act: Callable[[], Any]) -> tuple[float, Any]:
    """Least seconds of up to three runs, as many as fit in a second, and the last result."""
    seconds: list[float] = []
    while len(seconds) < 3 and sum(seconds) < 1.0:
        begun = time.perf_counter()
        made = act()
        seconds.append(time.perf_counter() - begun)
    return min(seconds), made


def measured(n_faces: int, size: int) -> dict[str, float]:
    """Seconds of every stage on one pair of ellipsoids."""
    ball = fibonacci_sphere(n_faces // 2 + 2)
    meshes = [Mesh(ball.vertices * axes, ball.faces) for axes in AXES]
    took: dict[str, float] = {"faces": meshes[0].n_faces, "functions": size}
    took["basis"], target = best(lambda: poisson_basis(meshes[1], size))
    source = poisson_basis(meshes[0], size)
    softmap = SoftMap.from_points(source, target, np.arange(ball.n_vertices))
    took["spectrum"], other = best(lambda: spectrum(meshes[1], EIGENPAIRS))
    if n_faces <= MOST_COMPARED:
        one = spectrum(meshes[0], EIGENPAIRS)
        signatures = wks_of(one, other, COUNT), wks_of(other, one, COUNT)
        took["softmap"], softmap = best(lambda: SoftMap.from_descriptors(source, target, *signatures))
    begun = time.perf_counter()
    plan_of(target)
    took["plan"] = time.perf_counter() - begun
    laid = systems(softmap, 1e-5)
    some = np.unique(np.linspace(0, meshes[0].n_faces - 1, SOLVED_FACES).astype(np.int64))
    solving, _ = best(lambda: max(chunk.residual for chunk in solved_chunks(laid, some)))
    took["energy"] = solving * meshes[0].n_faces / some.size
    took["bijectivity"], _ = best(lambda: bijectivity(softmap))
    print("  ".join(f"{name} {value:.3g}" for name, value in took.items()), flush=True)
    return took


class Pair:
    """Sizes as the service's cost model asks for them: every id is of one pair."""

    def __init__(self, row: dict[str, float]) -> None:
        n_faces, n_vertices = int(row["faces"]), int(row["faces"]) // 2 + 2
        self._basis = BasisSize(MeshSize(n_vertices, n_faces, 1), int(row["functions"]))

    def mesh(self, id_: str) -> MeshSize:
        return self._basis.mesh

    def basis(self, id_: str) -> BasisSize:
        return self._basis

    def softmap(self, id_: str) -> MapSize:
        return MapSize(self._basis, self._basis)

    def descriptor(self, id_: str) -> tuple[int, int]:
        return self._basis.mesh.n_vertices, COUNT


def estimated(row: dict[str, float]) -> dict[str, float]:
    """Seconds that the service expects of the stages that are tasks; a plan is part of an energy."""
    sizes: Any = Pair(row)
    mesh, basis, softmap, descriptor = (
        f"{kind}-{'0' * 32}" for kind in ("mesh", "basis", "softmap", "descriptor")
    )
    comparing = specs.SoftMap(
        source=basis, target=basis, map=specs.Descriptors(source=descriptor, target=descriptor)
    )
    return {
        "basis": basis_cost(specs.PoissonBasis(mesh=mesh, size=int(row["functions"])), sizes).seconds,
        "spectrum": spectrum_cost(specs.Spectrum(mesh=mesh, eigenpairs=EIGENPAIRS), sizes).seconds,
        "softmap": softmap_cost(comparing, sizes).seconds,
        "energy": energy_cost(specs.Energy(softmap=softmap), sizes).seconds - row["plan"],
    }


def print_errors(rows: list[dict[str, float]]) -> None:
    """Estimate over measurement for every stage and size."""
    for row in rows:
        ratios = {stage: value / row[stage] for stage, value in estimated(row).items() if stage in row}
        words = "  ".join(f"{stage} {ratio:.2f}" for stage, ratio in ratios.items())
        print(f"estimated / measured, {row['faces']:,.0f} faces, {row['functions']:.0f} functions: {words}")


def exponent(rows: list[dict[str, float]], by: str, stage: str) -> float:
    """Slope of log time over log size, over the larger half of the sizes."""
    there = [row for row in rows if stage in row]
    upper = there[len(there) // 2 :]
    slope, _ = np.polyfit(
        [math.log(row[by]) for row in upper], [math.log(row[stage]) for row in upper], deg=1
    )
    return float(slope)


def draw(series: dict[str, list[dict[str, float]]], path: Path) -> None:
    """Time of every stage against faces and against functions, and the shares of the usual question."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(11, 3.8), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=(4, 4, 2.6))
    for ax, by in zip(axes, ("faces", "functions"), strict=False):
        rows = series[by]
        for stage, colour in zip(STAGES, COLOURS, strict=True):
            label = f"{stage}  ∝ {'F' if by == 'faces' else 'n'}^{exponent(rows, by, stage):.2f}"
            points = [(row[by], row[stage]) for row in rows if stage in row]
            ax.loglog(*zip(*points, strict=True), "o-", color=colour, ms=3, label=label)
        fixed = "functions" if by == "faces" else "faces"
        ax.set(
            xlabel=f"{by} {'F' if by == 'faces' else 'n'}",
            ylabel="seconds, one thread",
            title=f"{rows[0][fixed]:,.0f} {fixed}",
        )
        ax.set_ylim(top=10 * max(row[stage] for row in rows for stage in STAGES if stage in row))
        ax.grid(alpha=0.3, which="major")
        ax.legend(fontsize=7, frameon=False)
    shares(axes[2], series["faces"])
    figure.savefig(path, dpi=100)


def shares(ax: Any, rows: list[dict[str, float]]) -> None:
    """Stacked shares of the stages, both meshes' bases and spectra counted."""
    twice = {"basis", "spectrum"}
    rows = [row for row in rows if set(STAGES) <= set(row)]
    parts = np.array([[row[stage] * (1 + (stage in twice)) for stage in STAGES] for row in rows])
    parts *= 100 / parts.sum(axis=1, keepdims=True)
    bottom = np.zeros(len(rows))
    for k, colour in enumerate(COLOURS):
        ax.bar(range(len(rows)), parts[:, k], bottom=bottom, color=colour, width=0.8)
        bottom += parts[:, k]
    ax.set_xticks(range(len(rows)), [f"{row['faces'] / 1000:.0f}k" for row in rows], fontsize=7)
    ax.set(xlabel="faces", ylabel="percent of the whole", title="where the time goes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    for part in ("faces", "functions", "draw"):
        parser.add_argument(f"--{part}", action="store_true")
    parser.add_argument("--file", type=Path, default=Path("growth.json"), help="where measurements are kept")
    arguments = parser.parse_args()
    everything = not (arguments.faces or arguments.functions or arguments.draw)
    series = json.loads(arguments.file.read_text()) if arguments.file.exists() else {}
    measured(FACES[0], 50)  # loads libraries and touches memory
    with blas_pools().limit(limits=1):
        if arguments.faces or everything:
            series["faces"] = [measured(each, USUAL_FUNCTIONS) for each in FACES]
        if arguments.functions or everything:
            series["functions"] = [measured(USUAL_FACES, each) for each in FUNCTIONS]
    arguments.file.write_text(json.dumps(series, indent=1))
    for by, rows in series.items():
        print_errors(rows)
        print("exponents by", by, {stage: round(exponent(rows, by, stage), 2) for stage in STAGES})
    if arguments.draw or everything:
        draw(series, FIGURE)


if __name__ == "__main__":
    main()
