"""Energies of rotation-invariant maps of the sphere beside their exact values, for both bases.

    python -m benchmarks.sphere

ρ(x, y) ∝ exp(κ⟨x, y⟩) on the unit-area sphere, collocated: C_i = ∫ρ(p_i, ·)β. By symmetry its energy density
is constant, so the standard deviation over faces measures the basis. Exact energies solve a one-dimensional
boundary-value problem (tests/solver/test_energy.py).
"""

from __future__ import annotations

import numpy as np

from solver import Basis, SoftMap, dirichlet, poisson_basis
from solver.fem import mass
from solver.maxent import maxent_basis
from tests.solver.shapes import fibonacci_sphere
from tests.solver.test_energy import sphere_energy

VERTICES = 3000
KAPPAS = (1.0, 5.0, 20.0)
SIZES = (100, 300, 600)


def concentrated(basis: Basis, kappa: float) -> SoftMap:
    """The map whose row i is the density around sample i, integrated against every function."""
    points = basis.mesh.unit_vertices
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    density = np.exp(kappa * (points[basis.samples] @ points.T - 1)) * mass(basis.mesh)
    rows = (basis.functions.T @ density.T).T
    return SoftMap(basis, basis, rows / rows.sum(axis=1, keepdims=True))


def main() -> None:
    """Print one row a basis and κ."""
    mesh = fibonacci_sphere(VERTICES)
    print(f"sphere of {VERTICES} vertices; E_D (its relative error; standard deviation of the density)")
    print(f"{'basis':10}{'κ':>4}{'exact':>10}" + "".join(f"{f'n = {size}':>28}" for size in SIZES))
    for name, make in (("poisson", poisson_basis), ("maxent", maxent_basis)):
        bases = [make(mesh, size=size) for size in SIZES]
        for kappa in KAPPAS:
            exact = sphere_energy(kappa)
            row = f"{name:10}{kappa:4.0f}{exact:10.6f}"
            for basis in bases:
                found = dirichlet(concentrated(basis, kappa))
                error, spread = found.energy / exact - 1, found.density.std()
                row += f"{found.energy:12.6f} ({error:+.4f}; {spread:.4f})"
            print(row, flush=True)


if __name__ == "__main__":
    main()
