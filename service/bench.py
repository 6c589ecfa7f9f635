"""The command `bench`: the solver beside dense LAPACK, SuperLU and CHOLMOD on this machine, in turns."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from service.console import Screen, errors_in_words, table
from service.creature import creature
from service.options import Json
from service.parsing import InvalidFile, Limits, read_mesh
from service.rivals import face_systems, rivals, timed
from worker.settings import Settings, usable_cores

if TYPE_CHECKING:
    from solver import SoftMap

#: Vertices and faces.
Shape = tuple[NDArray[np.float64], NDArray[np.int64]]

#: Catmull-Clark steps of the built-in pair: 1114 vertices and 2224 faces.
BENCH_SUBDIVISIONS = 1
#: Faces that each rival solves in a turn; they cost the same whichever these are.
RIVAL_FACES = 64


@dataclass(frozen=True)
class Contender:
    """How one way to solve did.

    Attributes
    ----------
    name : str
    threads : int
    microseconds : float
        Least time a face.
    median : float
        Median time a face, in microseconds.
    ratio : float
        Median over turns of its time to the solver's on one thread in the same turn.
    residual : float
        Largest relative residual.
    difference : float
        Largest difference of its densities from the solver's, relative to the largest density.
    """

    name: str
    threads: int
    microseconds: float
    median: float
    ratio: float
    residual: float
    difference: float


@dataclass(frozen=True)
class Comparison:
    """What was compared, and how everybody did.

    Attributes
    ----------
    sizes : dict
        Vertices, faces and functions of the source and the target.
    energy : float
        Dirichlet energy.
    preparing : float
        Seconds that the first solve on the target took beyond a later one: order, panels, the tensor W.
    contenders : tuple of Contender
        The solver on one thread first.
    versions : dict
        Of what decides times and bits, and the processor.
    """

    sizes: dict[str, int]
    energy: float
    preparing: float
    contenders: tuple[Contender, ...]
    versions: dict[str, str]


def compared(softmap: SoftMap, *, threads: int, repeats: int, regularisation: float = 1e-5) -> Comparison:
    """Solve a soft map's faces in every way in turns, and compare.

    Parameters
    ----------
    softmap : SoftMap
    threads : int
        Threads of the solver's second contender.
    repeats : int
        Turns; everybody has one in each.
    regularisation : float
        ε.

    Returns
    -------
    Comparison

    Raises
    ------
    SolverError
        If the solver refuses the soft map.
    """
    from solver import dirichlet  # noqa: PLC0415  (the command line starts without)
    from worker.tasks import blas_pools, versions  # noqa: PLC0415

    n_faces = softmap.source.mesh.n_faces
    some = np.unique(np.linspace(0, n_faces - 1, RIVAL_FACES).astype(np.int64))
    with blas_pools().limit(limits=1):
        first, found = timed(lambda: dirichlet(softmap, regularisation))
        systems = face_systems(softmap, some, regularisation)
        others = rivals(systems)
        turns: dict[str, Callable[[], Any]] = {
            "softmaps": lambda: dirichlet(softmap, regularisation),
            f"softmaps, {threads} threads": lambda: dirichlet(softmap, regularisation, threads=threads),
            "softmaps, with gradient": lambda: dirichlet(softmap, regularisation, gradient=True),
            **others,
        }
        seconds: dict[str, list[float]] = {name: [] for name in turns}
        answers: dict[str, Any] = {}
        for _ in range(repeats):
            for name, act in turns.items():
                elapsed, answers[name] = timed(act)
                seconds[name].append(elapsed / (some.size if name in others else n_faces))
    own = seconds["softmaps"]
    contenders = []
    for name, taken in seconds.items():
        if name in others:
            residual, densities = systems.residual(answers[name]), systems.densities(answers[name])
        else:
            residual, densities = answers[name].residual, answers[name].density[some]
        contenders.append(
            Contender(
                name,
                threads if name.endswith("threads") else 1,
                1e6 * min(taken),
                1e6 * median(taken),
                median(mine / its for mine, its in zip(taken, own, strict=True)),
                residual,
                _difference(densities, found.density[some]),
            )
        )
    return Comparison(
        _sizes(softmap),
        found.energy,
        first - median(own) * n_faces,
        tuple(contenders),
        versions() | {"processor": _processor()},
    )


def bench(
    source: Annotated[
        Path | None, typer.Argument(help="Source mesh file; the creature if not given.")
    ] = None,
    target: Annotated[Path | None, typer.Argument(help="Target mesh file.")] = None,
    size: Annotated[int, typer.Option(min=2, help="Functions of each basis.")] = 300,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads to compare with one; the cores there are.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Turns that everybody has.")] = 7,
    json: Json = False,
) -> None:
    """Measure the solver on this machine, in turns with LAPACK, SuperLU and (if installed) CHOLMOD."""
    screen = Screen(json)
    if (source is None) != (target is None):
        raise typer.BadParameter("name a target as well as a source, or neither")
    with errors_in_words(screen):
        from solver import SolverError  # noqa: PLC0415

        try:
            with screen.waiting("measuring (the first time, kernels are compiled)"):
                pair = _pair(source, target)
                found = compared(
                    wks_map(pair[0], pair[1], size), threads=threads or usable_cores(), repeats=repeats
                )
        except (SolverError, InvalidFile, ValueError) as error:
            screen.fail(str(error))
    screen.answer(asdict(found))
    rows = [
        (
            each.name,
            f"{each.microseconds:.1f}",
            f"{each.median:.1f}",
            f"{each.ratio:.2f}",
            f"{each.residual:.0e}",
            f"{each.difference:.0e}",
        )
        for each in found.contenders
    ]
    sizes = found.sizes
    title = f"{sizes['source_faces']:,} faces → {sizes['target_vertices']:,} vertices, {size} functions"
    screen.show(
        table(title, ("µs a face", "least", "median", "ratio", "residual", "Δ density"), rows),
        f"E_D = {found.energy:.12g}; preparing the target took {found.preparing:.2f} s more, once",
        ", ".join(f"{name} {version}" for name, version in found.versions.items()),
    )


def wks_map(source: Shape, target: Shape, size: int) -> SoftMap:
    """Soft map of wave kernel signatures between two meshes, given as vertices and faces.

    Parameters
    ----------
    source, target : (vertices, faces)
    size : int
        Functions of each basis.

    Returns
    -------
    SoftMap

    Raises
    ------
    SolverError
        If the solver refuses a mesh.
    """
    from solver import Mesh, SoftMap, poisson_basis, spectrum, wks_of  # noqa: PLC0415

    meshes = [Mesh(*each) for each in (source, target)]
    bases = [poisson_basis(mesh, size) for mesh in meshes]
    one, other = (spectrum(mesh) for mesh in meshes)
    return SoftMap.from_descriptors(bases[0], bases[1], wks_of(one, other), wks_of(other, one))


def _pair(source: Path | None, target: Path | None) -> tuple[Shape, Shape]:
    """Vertices and faces of both meshes."""
    if source is None or target is None:
        return creature("standing", BENCH_SUBDIVISIONS), creature("trotting", BENCH_SUBDIVISIONS)
    return mesh_of(source), mesh_of(target)


def mesh_of(path: Path) -> Shape:
    """Vertices and faces of a mesh file.

    Parameters
    ----------
    path : Path
        Its ending says its format.

    Returns
    -------
    vertices : ndarray of float64, shape (V, 3)
    faces : ndarray of int64, shape (F, 3)

    Raises
    ------
    InvalidFile, ValueError, OSError
        If it is no mesh, no format, or cannot be read.
    """
    settings = Settings()
    limits = Limits(settings.max_vertices, settings.max_faces)
    parsed = read_mesh(path.read_bytes(), path.suffix[1:].lower(), limits)
    return parsed.vertices, parsed.faces


def _difference(one: NDArray[Any], other: NDArray[Any]) -> float:
    return float(np.abs(one - other).max() / np.abs(other).max())


def _sizes(softmap: SoftMap) -> dict[str, int]:
    ends = {"source": softmap.source, "target": softmap.target}
    return {
        f"{end}_{what}": int(value)
        for end, basis in ends.items()
        for what, value in (
            ("vertices", basis.mesh.n_vertices),
            ("faces", basis.mesh.n_faces),
            ("functions", basis.size),
        )
    }


def _processor() -> str:
    """What the processor calls itself, and how many of its cores may be used."""
    name = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):  # noqa: PTH110  (Linux alone)
        with open("/proc/cpuinfo") as lines:  # noqa: PTH123
            name = next((line.partition(":")[2].strip() for line in lines if "model name" in line), name)
    return f"{name}, {usable_cores()} cores"
