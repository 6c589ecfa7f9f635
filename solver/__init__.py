"""Soft maps between triangle meshes, and how continuous they are (Solomon, Guibas, Butscher, SGP 2013).

======================  ==================  ==========  ==================================================
symbol                  code                shape       meaning
======================  ==================  ==========  ==================================================
M₀, M                   source, target                  triangle meshes, each scaled to total area 1
β₀ᵢ, βⱼ                 basis.functions     (V, n)      partition of unity, values at vertices
μⱼ                      basis.densities     (F, n)      per-face mean of βⱼ over its integral
C                       coefficients        (n₀, n)     the soft map: C ≥ 0, rows sum to 1
V_f^s                   frames              (F₀, 2, 3)  orthonormal tangents of each source face
q_f^s                   potential           (F₀, 2, n)  transportation potential
e(f)                    dirichlet.density   (F₀,)       Dirichlet energy per unit source area
b(t)                    bijectivity.density (F,)        mass received per unit target area
======================  ==================  ==========  ==================================================

>>> import numpy as np
>>> around, across = np.meshgrid(np.arange(24), np.arange(12), indexing="ij")
>>> index = around * 12 + across
>>> a, b, c, d = (np.roll(index, step, (0, 1)).ravel() for step in [(0, 0), (-1, 0), (-1, -1), (0, -1)])
>>> s, t = np.pi * around.ravel() / 12, np.pi * across.ravel() / 6
>>> vertices = np.stack([(3 + np.cos(t)) * np.cos(s), (3 + np.cos(t)) * np.sin(s), np.sin(t)], axis=1)
>>> torus = Mesh(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]))
>>> basis = poisson_basis(torus, size=40)
>>> identity = SoftMap.from_points(basis, basis, np.arange(torus.n_vertices))
>>> nothing = SoftMap.uniform(basis, basis)
>>> bool(dirichlet(identity).energy > 1), bool(dirichlet(nothing).energy < 1e-20)
(True, True)
>>> round(bijectivity(nothing).energy, 9)
1.0
"""

from solver.attachment import descriptor_cost, landmark_distances
from solver.basis import Basis, poisson_basis
from solver.descriptors import Spectrum, hks, hks_of, spectrum, wks, wks_of
from solver.energy import (
    Bijectivity,
    Dirichlet,
    bijectivity,
    dirichlet,
    dirichlet_block,
    gather_dirichlet,
)
from solver.errors import (
    InvalidBasis,
    InvalidDescriptor,
    InvalidMesh,
    InvalidSoftMap,
    SingularSystem,
    SolverError,
)
from solver.feasible import LinearConstraint
from solver.flow import mass_density, momentum, velocity
from solver.maxent import maxent_basis
from solver.mesh import Mesh
from solver.optimal import OptimalMap, optimal_softmap
from solver.pointmap import PointMap, pointmap
from solver.potential import FACE_BLOCK, Potential, potential, potential_block
from solver.prolongation import prolong
from solver.quality import MapQuality, map_quality, mass_within
from solver.search import Iteration
from solver.softmap import SoftMap
from solver.trace import Path, trace

__all__ = [
    "FACE_BLOCK",
    "Basis",
    "Bijectivity",
    "Dirichlet",
    "InvalidBasis",
    "InvalidDescriptor",
    "InvalidMesh",
    "InvalidSoftMap",
    "Iteration",
    "LinearConstraint",
    "MapQuality",
    "Mesh",
    "OptimalMap",
    "Path",
    "PointMap",
    "Potential",
    "SingularSystem",
    "SoftMap",
    "SolverError",
    "Spectrum",
    "bijectivity",
    "descriptor_cost",
    "dirichlet",
    "dirichlet_block",
    "gather_dirichlet",
    "hks",
    "hks_of",
    "landmark_distances",
    "map_quality",
    "mass_density",
    "mass_within",
    "maxent_basis",
    "momentum",
    "optimal_softmap",
    "pointmap",
    "poisson_basis",
    "potential",
    "potential_block",
    "prolong",
    "spectrum",
    "trace",
    "velocity",
    "wks",
    "wks_of",
]
