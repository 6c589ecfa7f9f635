"""What the maximum-entropy basis gains over the paper's, and what it costs.

    python -m benchmarks.bases            # all tables, some six minutes on one core
    python -m benchmarks.bases sphere     # or one of: sphere, meshes, large

Accuracy is that of the Dirichlet density e(f) of a fixed smooth soft map, taken at the functions' samples
(C_i = ∫ρ(pᵢ, ·)β). On the sphere ρ(x, y) ∝ exp(κ⟨x, y⟩), whose density is constant and whose energy solves a
boundary-value problem in one dimension.
On the others ρ is the heat kernel of the surface, and the reference is e(f) of the hat functions themselves,
the finest basis there is: a finite element solution that shares no line with the solver.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import trimesh
from scipy import sparse
from scipy.sparse import linalg

from solver import Basis, Mesh, SoftMap, dirichlet, poisson_basis, potential
from solver.assembly import plan_of
from solver.fem import hat_gradients, intrinsic_delaunay_stiffness, mass
from solver.maxent import maxent_basis
from tests.conftest import DATA
from tests.solver.shapes import fibonacci_sphere
from tests.solver.test_energy import sphere_energy

KAPPAS = (1.0, 5.0, 20.0)
#: Time of the heat kernel: as wide as κ = 5 is on the sphere.
HEAT_TIME, HEAT_STEPS = 0.008, 8
#: Source faces whose density is compared on real meshes.
FACES = 300
#: The regularisation that the solver has by default.
EPSILON = 1e-5

MESHES = {
    "wolf": "academic_tosca_wolf0_wolf1/source__wolf0.off",
    "cat": "academic_tosca5k_cat0_cat10/source__cat0.off",
    "arm": "free_arm_woman_man/source__arm_woman.obj",
    "hand": "free_hand_woman_man/source__hand_woman.obj",
}
MAKERS: dict[str, Callable[[Mesh, int], Basis]] = {
    "poisson": poisson_basis,
    "maxent γ 1.8": lambda mesh, size: maxent_basis(mesh, size, sharpness=1.8),
    "maxent γ 3": maxent_basis,
    "maxent γ 5": lambda mesh, size: maxent_basis(mesh, size, sharpness=5.0),
}


def read(path: Path) -> Mesh:
    """A mesh with the file's own order of vertices."""
    loaded = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
    return Mesh(loaded.vertices, loaded.faces)


def timed(make: Callable[[Mesh, int], Basis], mesh: Mesh, size: int) -> tuple[Basis, float]:
    begin = time.perf_counter()
    return make(mesh, size), time.perf_counter() - begin


def costs(basis: Basis) -> str:
    """Functions at a vertex, neighbours of a function, and multiplications (thousands) of a factorisation."""
    row = basis.functions.nnz / basis.mesh.referenced.sum()
    neighbours = basis.overlap.nnz / basis.size
    return f"{row:7.1f}{neighbours:9.1f}{plan_of(basis).symbolic.multiplications / 1000:10.0f}"


def collocated(basis: Basis, kernel: np.ndarray) -> SoftMap:
    """C_i = ∫ρ(pᵢ, ·)β, of a density given at the samples (n, V)."""
    received = np.asarray((np.maximum(kernel, 0) * mass(basis.mesh)) @ basis.functions)
    return SoftMap(basis, basis, received / received.sum(axis=1, keepdims=True))


def rotation_invariant(basis: Basis, kappa: float) -> SoftMap:
    points = basis.mesh.vertices
    return collocated(basis, np.exp(kappa * (points[basis.samples] @ points.T - 1)))


def deviation(basis: Basis, kappa: float) -> tuple[float, float, float]:
    """Energy, standard deviation of its density over the surface, and seconds of the solve."""
    softmap = rotation_invariant(basis, kappa)
    begin = time.perf_counter()
    found = dirichlet(softmap)
    seconds = time.perf_counter() - begin
    spread = np.sqrt(basis.mesh.face_areas @ (found.density - found.energy) ** 2)
    return found.energy, float(spread), seconds


def sphere() -> None:
    """Energy and density of rotation-invariant maps on a sphere of 3,000 vertices."""
    mesh, exact = fibonacci_sphere(3000), {kappa: sphere_energy(kappa) for kappa in KAPPAS}
    print("\nSphere, 3,000 vertices: error of E_D / standard deviation of e(f)\n")
    print(f"{'basis':14}{'n':>5}" + "".join(f"{f'κ = {kappa:g}':>20}" for kappa in KAPPAS), end="")
    print(f"{'at vertex':>11}{'overlaps':>9}{'k mult.':>10}{'basis s':>9}{'solve s':>9}")
    for name, make in MAKERS.items():
        for size in (150, 300, 600):
            basis, seconds = timed(make, mesh, size)
            print(f"{name:14}{size:5}", end="")
            for kappa in KAPPAS:
                energy, spread, solving = deviation(basis, kappa)
                print(f"{energy - exact[kappa]:12.4f} /{spread:6.4f}", end="")
            print(f"    {costs(basis)}{seconds:9.2f}{solving:9.2f}", flush=True)


def heat_rows(mesh: Mesh, vertices: np.ndarray) -> np.ndarray:
    """Heat kernel ρ(v, ·) of some vertices (k, V), by implicit steps."""
    masses = mass(mesh)
    step = sparse.diags_array(masses) + HEAT_TIME / HEAT_STEPS * intrinsic_delaunay_stiffness(mesh)
    solver = linalg.splu(sparse.csc_array(step))
    heat = np.zeros((mesh.n_vertices, len(vertices)))
    heat[vertices, np.arange(len(vertices))] = 1 / masses[vertices]
    for _ in range(HEAT_STEPS):
        heat = solver.solve(masses[:, None] * heat)
    return heat.T


def finest_density(mesh: Mesh, faces: np.ndarray, corner_rows: np.ndarray) -> np.ndarray:
    """e(f) with hat functions, from ρ at the corners of the faces (k, 3, V)."""
    hats, areas, n = hat_gradients(mesh), mesh.face_areas, mesh.n_vertices
    rows, columns = np.repeat(mesh.faces, 3, axis=1).ravel(), np.tile(mesh.faces, (1, 3)).ravel()
    products = np.einsum("fix,fjx->fij", hats, hats) * areas[:, None, None]
    masses = mass(mesh)
    average = sparse.csr_array(
        (np.full(3 * len(areas), 1 / 3), (np.repeat(np.arange(len(areas)), 3), mesh.faces.ravel())),
        (len(areas), n),
    )
    found = np.empty(len(faces))
    for k, face in enumerate(faces):
        density = (1 - EPSILON) * (average @ corner_rows[k].mean(axis=0)) + EPSILON
        values = (products * density[:, None, None]).ravel()
        slopes = mesh.frames[face] @ hats[face].T @ corner_rows[k]  # ∂ρ/∂V_s at the vertices
        right = (1 - EPSILON) * ((areas * (average @ slopes.T).T) @ average)
        heaviest = int(np.argmax(masses * corner_rows[k].mean(axis=0)))
        matrix = sparse.csc_array((values, (rows, columns)), shape=(n, n)).tolil()
        matrix[heaviest, heaviest] *= 2
        right -= right.sum(axis=1, keepdims=True) * masses
        q = linalg.splu(sparse.csc_array(matrix), permc_spec="MMD_AT_PLUS_A").solve(right.T)
        found[k] = (q * right.T).sum()
    return found


def density_of(softmap: SoftMap, faces: np.ndarray) -> np.ndarray:
    """e(f) = Σ_s b_fs · q_fs on some faces."""
    basis = softmap.target
    q, frames = potential(softmap, EPSILON, faces)
    corners = softmap.source.mesh.faces[faces]
    hats = hat_gradients(softmap.source.mesh)[faces]
    slopes = np.einsum("ksx,kcx->ksc", frames, hats)
    received = softmap.source.functions @ (softmap.coefficients @ basis.overlap)
    right = (1 - EPSILON) * np.einsum("ksc,kcj->ksj", slopes, np.asarray(received)[corners])
    found: np.ndarray = np.einsum("ksj,ksj->k", right, q)
    return found


def references() -> Iterator[tuple[str, Mesh, np.ndarray, np.ndarray]]:
    """Real meshes, some of their faces, and the density there."""
    for name, file in MESHES.items():
        mesh = read(DATA / "pairs" / file)
        faces = np.random.default_rng(1).choice(mesh.n_faces, FACES, replace=False)
        corners, place = np.unique(mesh.faces[faces], return_inverse=True)
        yield name, mesh, faces, finest_density(mesh, faces, heat_rows(mesh, corners)[place.reshape(-1, 3)])


def meshes() -> None:
    """Error of the density of a heat kernel on real meshes."""
    print(f"\nReal meshes, heat-kernel map, {FACES} faces: mean / root mean square / largest error of e(f)\n")
    print(
        f"{'mesh':6}{'mean e':>8}  {'basis':14}{'n':>5}{'mean':>9}{'rms':>8}{'largest':>9}"
        f"{'at vertex':>12}{'overlaps':>9}{'k mult.':>10}"
    )
    for name, mesh, faces, exact in references():
        areas = mesh.face_areas[faces] / mesh.face_areas[faces].sum()
        for label, make in MAKERS.items():
            for size in (150, 300, 600):
                if 2 * size > mesh.n_vertices:
                    continue
                basis = make(mesh, size)
                errors = density_of(collocated(basis, heat_rows(mesh, basis.samples)), faces) - exact
                print(
                    f"{name:6}{areas @ exact:8.2f}  {label:14}{size:5}{areas @ abs(errors):9.3f}"
                    f"{np.sqrt(areas @ errors**2):8.3f}{abs(errors).max():9.2f}     {costs(basis)}",
                    flush=True,
                )


def large() -> None:
    """Seconds for many functions on large meshes."""
    print(f"\n{'vertices':>9}{'n':>6}{'poisson s':>11}{'maxent s':>10}")
    for n_vertices, size in ((3_000, 300), (50_000, 300), (50_000, 1000)):
        mesh = fibonacci_sphere(n_vertices)
        seconds = [timed(make, mesh, size)[1] for make in (poisson_basis, maxent_basis)]
        print(f"{n_vertices:9}{size:6}{seconds[0]:11.1f}{seconds[1]:10.1f}", flush=True)


TABLES = {"sphere": sphere, "meshes": meshes, "large": large}

if __name__ == "__main__":
    for wanted in sys.argv[1:] or TABLES:
        TABLES[wanted]()
