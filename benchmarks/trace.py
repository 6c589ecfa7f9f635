"""How well traced paths follow the known image of a path, and what of the error is due to steps.

    python -m benchmarks.trace            # both tables, some three minutes on one core
    python -m benchmarks.trace sphere     # or one of: sphere, wolves

Soft maps of point maps: the identity and a rotation of a sphere of 3,000 vertices, the identity and its
reflection in equal parts, and the true map between two poses of a wolf of 4,344 vertices. Printed are mean
and largest distance of the traced path from the image of the source path, in √area, against the longest
step: for `solver.trace`, and for Euler steps, as in the paper, in a field that is constant on each face or
averaged to the vertices.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import trimesh
from scipy import sparse
from scipy.spatial.transform import Rotation

from service.figures.spheres import located
from solver import Basis, Mesh, SoftMap, maxent_basis, poisson_basis, potential, trace
from solver.flow import gradient_matrix
from solver.shortest import SurfacePoints, shortest_path
from solver.walks import layout, walk
from tests.conftest import DATA
from tests.solver.shapes import fibonacci_sphere

STEPS = (0.02, 0.01, 0.005, 0.0025)
WOLVES = DATA / "pairs" / "academic_tosca_wolf0_wolf1"
SPHERE = 3000


@dataclass(frozen=True)
class Traced:
    """Points on the target (k, 3), where the source path was then, and why it ended."""

    points: np.ndarray
    source_faces: np.ndarray
    source_barycentric: np.ndarray
    stopped: str


@dataclass(frozen=True)
class Case:
    """A soft map, a path on its source, a start on its target, and the image of the path."""

    name: str
    softmap: SoftMap
    path: SurfacePoints
    start: tuple[int, np.ndarray]
    image: Callable[[Traced], np.ndarray]


def solvers_way(case: Case, step: float) -> Traced:
    found = trace(case.softmap, (case.path.faces, case.path.barycentric), case.start, step)
    return Traced(found.points, found.source_faces, found.source_barycentric, found.stopped)


def euler(case: Case, step: float, averaged: bool) -> Traced:
    """Steps γ ← γ + ∇Q·γ₀' of one length (eq. 14)."""
    source, target = case.softmap.source.mesh, case.softmap.target.mesh
    pieces = shortest_path(layout(source), case.path)
    corners = source.unit_vertices[source.faces[pieces.faces]]
    moves = np.einsum("kc,kcx->kx", pieces.end - pieces.start, corners)
    distinct, place = np.unique(pieces.faces, return_inverse=True)
    q, frames = potential(case.softmap, faces=distinct)
    gradients, surface = gradient_matrix(case.softmap.target), layout(target)
    at = walk(surface, case.start[0], tuple(case.start[1].tolist()), 0j)
    trail, source_faces, source_barycentric = [at], [pieces.faces[0]], [pieces.start[0]]
    for k, move in enumerate(moves):
        field = (gradients @ ((frames[place[k]] @ move) @ q[place[k]])).reshape(-1, 3)
        if averaged:
            field = vertex_means(target) @ field
        count = int(np.ceil(np.linalg.norm(move) / step))
        for i in range(count):
            vector = at.barycentric @ field[target.faces[at.face]] if averaged else field[at.face]
            along, across = target.frames[at.face] @ vector / count
            at = walk(surface, at.face, at.barycentric, complex(along, across))
            trail.append(at)
            source_faces.append(pieces.faces[k])
            source_barycentric.append(pieces.start[k] + (i + 1) / count * (pieces.end - pieces.start)[k])
            if at.stopped:
                break
        if at.stopped:
            break
    corners = target.vertices[target.faces[[one.face for one in trail]]]
    points = np.einsum("kc,kcx->kx", [one.barycentric for one in trail], corners)
    return Traced(points, np.array(source_faces), np.array(source_barycentric), at.stopped or "end")


def vertex_means(mesh: Mesh) -> sparse.csr_array:
    """From values on faces to values at vertices, weighted by areas."""
    faces = np.repeat(np.arange(mesh.n_faces), 3)
    weights = sparse.csr_array((mesh.face_areas[faces], (mesh.faces.ravel(), faces)))
    return sparse.diags_array(1 / weights.sum(axis=1)) @ weights


METHODS: dict[str, Callable[[Case, float], Traced]] = {
    "solver.trace": solvers_way,
    "Euler, averaged field": partial(euler, averaged=True),
    "Euler, field of faces": partial(euler, averaged=False),
}


def table(cases: Iterator[Case]) -> None:
    """Mean and largest deviation from the image for each step."""
    print(f"\n{'':58}" + "".join(f"{f'step {step}':>17}" for step in STEPS) + f"{'seconds':>9}")
    for case in cases:
        for name, method in METHODS.items():
            print(f"{case.name:36}{name:22}", end="")
            for step in STEPS:
                begin = time.perf_counter()
                found = method(case, step)
                seconds = time.perf_counter() - begin
                gaps = np.linalg.norm(found.points - case.image(found), axis=1)
                gaps /= case.softmap.target.mesh.length_scale
                print(f"{gaps.mean():9.4f}/{gaps.max():7.4f}", end="")
            print(f"{seconds:9.2f}  {found.stopped}", flush=True)


def spheres() -> Iterator[Case]:
    mesh = fibonacci_sphere(SPHERE)
    t = np.linspace(0, 4, 25)
    tilt = np.pi / 2 + 0.5 * np.sin(2 * t)
    wave = np.column_stack([np.sin(tilt) * np.cos(t), np.sin(tilt) * np.sin(t), np.cos(tilt)])
    high = np.column_stack([0.7 * np.cos(t[:13]), 0.7 * np.sin(t[:13]), np.full(13, np.sqrt(0.51))])
    turn, mirror = Rotation.from_rotvec([0.4, 1.1, -0.7]).as_matrix(), np.diag([1.0, 1, -1])
    for make, size in ((maxent_basis, 300), (maxent_basis, 1000), (poisson_basis, 300)):
        basis: Basis = make(mesh, size)
        maps = {}
        for label, matrix in (("identity", np.eye(3)), ("rotation", turn), ("reflection", mirror)):
            image = SurfacePoints(*located(mesh, mesh.vertices @ matrix.T))
            maps[label] = SoftMap.from_points(basis, basis, image.faces, image.barycentric)
        maps["both"] = SoftMap.mixture([maps["identity"], maps["reflection"]], [0.5, 0.5])
        for label, softmap, curve, matrix in (
            ("identity", maps["identity"], wave, np.eye(3)),
            ("rotation", maps["rotation"], wave, turn),
            ("with reflection, above", maps["both"], high, np.eye(3)),
            ("with reflection, below", maps["both"], high, mirror),
        ):
            start = SurfacePoints(*located(mesh, curve[:1] @ matrix.T))

            def image_of(found: Traced, matrix: np.ndarray = matrix) -> np.ndarray:
                corners = mesh.vertices[mesh.faces[found.source_faces]]
                return np.einsum("kc,kcx->kx", found.source_barycentric, corners) @ matrix.T

            name = f"{make.__name__[:-6]} {size}, {label}"
            path = SurfacePoints(*located(mesh, curve))
            yield Case(name, softmap, path, (start.faces[0], start.barycentric[0]), image_of)


def wolves() -> Iterator[Case]:
    source, target = (
        Mesh(loaded.vertices, loaded.faces)
        for file in ("source__wolf0.off", "target__wolf1.off")
        for loaded in [trimesh.load(WOLVES / file, process=False, maintain_order=True)]
    )

    def image(found: Traced) -> np.ndarray:
        """Both wolves have the same triangles."""
        corners = target.vertices[target.faces[found.source_faces]]
        return np.einsum("kc,kcx->kx", found.source_barycentric, corners)

    for make, size in ((maxent_basis, 300), (maxent_basis, 1000), (poisson_basis, 300)):
        bases = make(source, size), make(target, size)
        softmap = SoftMap.from_points(*bases, np.arange(source.n_vertices))
        for label, path in wolf_paths(source):
            start = int(path.faces[0]), path.barycentric[0]
            yield Case(f"{make.__name__[:-6]} {size}, {label}", softmap, path, start, image)


#: Places on the wolf of unit area, and paths between them.
PLACES = {
    "back": (0.0, 0.10, 0.17),
    "paw": (0.10, -0.25, -0.36),
    "hip": (0.09, -0.25, -0.05),
    "knee": (0.1, -0.25, -0.2),
    "side": (0.11, 0.13, 0.03),
}
PATHS = (("knee", "hip", "side"), ("side", "back"), ("paw", "hip"))


def wolf_paths(wolf: Mesh) -> Iterator[tuple[str, SurfacePoints]]:
    for stops in PATHS:
        vertices = [int(np.linalg.norm(wolf.unit_vertices - PLACES[stop], axis=1).argmin()) for stop in stops]
        corners = np.array([np.argwhere(wolf.faces == vertex)[0] for vertex in vertices])
        yield f"{stops[0]} to {stops[-1]}", SurfacePoints(corners[:, 0], np.eye(3)[corners[:, 1]])


TABLES = {"sphere": spheres, "wolves": wolves}

if __name__ == "__main__":
    for wanted in sys.argv[1:] or TABLES:
        table(TABLES[wanted]())
