"""Partitions of unity on a mesh, and what the energies need of them (sections 4.2 to 4.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse import linalg

from solver.errors import InvalidBasis
from solver.fem import face_mean, intrinsic_delaunay_stiffness, mass, stiffness
from solver.geodesics import Samples, farthest_point_samples
from solver.mesh import FloatArray, IntArray, Mesh

#: How far a row of a stored basis may be from summing to 1: rounding of a few additions, nothing else.
ROW_SUM_TOLERANCE = 1e-12

#: Functions of norm 1 whose distance from the span of others is below the root of this are dependent.
RANK_TOLERANCE = 1e-12

#: The share of `poisson_basis` in its progress that choosing samples takes.
SAMPLING_SHARE = 0.25


@dataclass(frozen=True, eq=False)
class Basis:
    """A partition of unity β₁ … βₙ: non-negative piecewise-linear functions that sum to 1 (section 4.2).

    Parameters
    ----------
    mesh : Mesh
        Where the functions live.
    functions : csr_array of float64, shape (V, n)
        Value of each function at each vertex; rows sum to 1, and are empty at unreferenced vertices.
    samples : array_like of int, shape (n,)
        The vertex each function belongs to.
    cells : array_like of int, shape (V,)
        The function whose cell each vertex lies in; −1 at unreferenced vertices.

    Raises
    ------
    InvalidBasis
        Shapes that do not match, values that are negative or not finite, rows that do not sum to 1, functions
        that are zero everywhere, samples or cells out of range.
    """

    mesh: Mesh
    functions: sparse.csr_array
    samples: IntArray
    cells: IntArray

    def __post_init__(self) -> None:
        functions = _checked_functions(self.mesh, self.functions)
        object.__setattr__(self, "functions", functions)
        n_vertices, size = functions.shape
        samples = _checked_indices("samples", self.samples, size, np.arange(n_vertices)[self.mesh.referenced])
        cells = _checked_indices("cells", self.cells, n_vertices, np.arange(-1, size))
        stray = np.flatnonzero((cells == -1) == self.mesh.referenced)
        if stray.size:
            message = f"cells[{stray[0]}] is {cells[stray[0]]}, but −1 means a vertex in no face"
            raise InvalidBasis(message, index=int(stray[0]), value=int(cells[stray[0]]))
        object.__setattr__(self, "samples", samples)
        object.__setattr__(self, "cells", cells)

    @property
    def size(self) -> int:
        """Number of functions n."""
        return int(self.functions.shape[1])

    def require_independent(self) -> None:
        """Refuse linearly dependent functions, with which a target's potential would not be unique.

        Raises
        ------
        InvalidBasis
            Naming a function that is a combination of others. On a source such a basis is harmless.

        Notes
        -----
        Few functions are often dependent: where each cell touches all others, all functions are the same.
        """
        weighted = sparse.diags_array(mass(self.mesh)) @ self.functions
        gram = (self.functions.T @ weighted).toarray()
        scale = 1 / np.sqrt(gram.diagonal())
        _, pivots, rank, _ = lapack.dpstrf(gram * scale * scale[:, None], tol=RANK_TOLERANCE)
        if rank < self.size:
            j = int(pivots[rank:].min()) - 1
            message = (
                f"function {j}, at vertex {self.samples[j]}, is a combination of others "
                f"({self.size} functions of rank {rank}); ask for more functions, or for one"
            )
            raise InvalidBasis(message, index=j, value=int(rank))

    @cached_property
    def integrals(self) -> FloatArray:
        """Integral ∫βⱼ of each function over the unit mesh, float64 (n,); they sum to 1."""
        integrals: FloatArray = self.functions.T @ mass(self.mesh)
        return integrals

    @cached_property
    def face_means(self) -> sparse.csr_array:
        """Mean of each function on each face, csr (F, n); rows sum to 1."""
        return sparse.csr_array(face_mean(self.mesh) @ self.functions)

    @cached_property
    def densities(self) -> sparse.csr_array:
        """Densities μⱼ = mean_f(βⱼ) / ∫βⱼ per unit area, csr (F, n); each integrates to 1."""
        return sparse.csr_array(self.face_means @ sparse.diags_array(1 / self.integrals))

    @cached_property
    def overlap(self) -> sparse.csr_array:
        """U[j, k] = ∫ μⱼ βₖ (eq. 11), csr (n, n); rows sum to 1."""
        weighted = sparse.diags_array(self.mesh.face_areas) @ self.face_means
        return sparse.csr_array(self.densities.T @ weighted)

    @cached_property
    def density_products(self) -> sparse.csr_array:
        """V[j, k] = ∫ μⱼ μₖ (section 4.6), csr (n, n), symmetric."""
        weighted = sparse.diags_array(self.mesh.face_areas) @ self.densities
        return sparse.csr_array(self.densities.T @ weighted)


def poisson_basis(
    mesh: Mesh,
    size: int = 300,
    cutoff: float = 0.1,
    first: int | list[int] | IntArray = 0,
    progress: Callable[[float], None] | None = None,
) -> Basis:
    """Partition of unity from Δf = −1 on one-rings of farthest-point cells (section 4.2).

    Parameters
    ----------
    mesh : Mesh
        Any mesh.
    size : int
        Number of functions n, from the number of components to that of vertices.
    cutoff : float
        In (0, 1): f is cut to 0 below this fraction of its minimum on the function's own cell.
    first : int or sequence of int
        The first samples, distinct.
    progress : callable, optional
        Called with the fraction done, from 0 to 1; may raise to abort.

    Returns
    -------
    Basis
        Always the same for the same arguments.

    Raises
    ------
    InvalidBasis
        A size, cutoff or first sample out of range; a cell on which no positive solution could be found.

    Notes
    -----
    Where a one-ring of cells is a whole component there is no boundary, and f is 1 on it. Where obtuse
    triangles make f negative on its cell, that one function is solved again with the intrinsic Delaunay
    Laplacian, for which the maximum principle holds; the others, which were right, stay as they are.
    """
    if not 0 < cutoff < 1:
        raise InvalidBasis(f"cutoff must lie between 0 and 1, not {cutoff}", value=cutoff)

    def report(start: float, end: float) -> Callable[[float], None] | None:
        return None if progress is None else lambda done: progress(start + (end - start) * done)

    samples = farthest_point_samples(mesh, size, first, report(0.0, SAMPLING_SHARE))
    bumps = _bumps(mesh, samples, cutoff, report(SAMPLING_SHARE, 1.0))
    rows, values = zip(*bumps, strict=True)
    columns = np.repeat(np.arange(size), [len(r) for r in rows])
    raw = sparse.csr_array(
        (np.concatenate(values), (np.concatenate(rows), columns)), shape=(mesh.n_vertices, size)
    )
    sums = np.where(mesh.referenced, raw.sum(axis=1), 1.0)
    functions = sparse.csr_array(sparse.diags_array(1 / sums) @ raw)
    return Basis(mesh, functions, samples.vertices, samples.cells)


def _bumps(
    mesh: Mesh, samples: Samples, cutoff: float, progress: Callable[[float], None] | None
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Yield γ(f) of each sample as (vertices, values), zeros left out."""
    masses = mass(mesh)
    laplacians = _Laplacians(mesh)
    size = len(samples.vertices)
    by_cell = np.argsort(samples.cells, kind="stable")
    bounds = np.searchsorted(samples.cells[by_cell], np.arange(size + 1))
    members = [by_cell[bounds[j] : bounds[j + 1]] for j in range(size)]
    component_sizes = np.bincount(mesh.components[mesh.referenced])
    local = np.full(mesh.n_vertices, -1, dtype=np.int64)
    for j, ring in enumerate(_rings(mesh, samples)):
        patch = np.concatenate([members[k] for k in ring])
        patch.sort()
        if patch.size == component_sizes[mesh.components[samples.vertices[j]]]:
            yield patch, np.ones(patch.size)
        else:
            local[patch] = np.arange(patch.size)
            own = local[members[j]]
            for laplacian in laplacians:
                f = _solve_on_patch(laplacian, patch, local, masses[patch])
                lowest = float(f[own].min())
                if lowest > 0 and np.isfinite(f).all():
                    break
            else:
                message = (
                    f"no positive solution around function {j} at vertex {samples.vertices[j]}: "
                    f"its lowest value is {lowest}, the triangles there are too thin"
                )
                raise InvalidBasis(message, index=j, value=lowest)
            local[patch] = -1
            f = _cut(f, lowest, cutoff)
            yield patch[f > 0], f[f > 0]
        if progress is not None:
            progress((j + 1) / size)


class _Laplacians:
    """The stiffness matrices to try, each computed only when the one before was not enough somewhere."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh

    @cached_property
    def _cotangent(self) -> sparse.csr_array:
        return stiffness(self._mesh)

    @cached_property
    def _delaunay(self) -> sparse.csr_array:
        return intrinsic_delaunay_stiffness(self._mesh)

    def __iter__(self) -> Iterator[sparse.csr_array]:
        yield self._cotangent
        yield self._delaunay


def _rings(mesh: Mesh, samples: Samples) -> list[IntArray]:
    """Cells joined to each cell by a mesh edge, with the cell itself, in order."""
    size = len(samples.vertices)
    one, other = samples.cells[mesh.edges].T
    links = np.concatenate([one * size + other, other * size + one, np.arange(size) * (size + 1)])
    cell, neighbour = np.divmod(np.unique(links), size)
    return np.split(neighbour, np.searchsorted(cell, np.arange(1, size)))


def _solve_on_patch(
    laplacian: sparse.csr_array, patch: IntArray, local: IntArray, masses: FloatArray
) -> FloatArray:
    """Solve K f = mass on the vertices of a patch, with f = 0 on all others; NaN where K is singular."""
    rows = laplacian[patch]
    columns = local[rows.indices]
    inside = columns >= 0
    starts = np.concatenate([[0], np.cumsum(inside)])[rows.indptr]
    shape = (patch.size, patch.size)
    # K is symmetric, so its rows are its columns.
    matrix = sparse.csc_array((rows.data[inside], columns[inside], starts), shape=shape)
    try:
        factor = linalg.splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError:  # exactly singular
        return np.full(patch.size, np.nan)
    solution: FloatArray = factor.solve(masses)
    return solution


def _cut(f: FloatArray, lowest: float, cutoff: float) -> FloatArray:
    """γ(f): 0 below c·m, f above m, and between them m t²((2 + c) − (1 + c)t), which joins them C¹."""
    t = np.clip((f / lowest - cutoff) / (1 - cutoff), 0.0, 1.0)
    return np.where(t < 1, lowest * t**2 * ((2 + cutoff) - (1 + cutoff) * t), f)


def _checked_functions(mesh: Mesh, given: Any) -> sparse.csr_array:
    try:
        functions = sparse.csr_array(given, dtype=np.float64, copy=True)
        functions.check_format(full_check=True)
    except (ValueError, TypeError) as error:
        raise InvalidBasis(f"functions are no sparse matrix of real numbers: {error}") from error
    if functions.ndim != 2 or functions.shape[0] != mesh.n_vertices or functions.shape[1] == 0:
        message = f"functions must have one row for each of {mesh.n_vertices} vertices, not {functions.shape}"
        raise InvalidBasis(message, value=str(functions.shape))
    functions.sum_duplicates()
    functions.eliminate_zeros()
    bad = np.flatnonzero(~(np.isfinite(functions.data) & (functions.data >= 0)))
    if bad.size:
        value = float(functions.data[bad[0]])
        j = int(functions.indices[bad[0]])
        raise InvalidBasis(f"function {j} has the value {value}", index=j, value=value)
    sums = functions.sum(axis=1)
    off = np.flatnonzero(np.abs(sums - mesh.referenced) > ROW_SUM_TOLERANCE)
    if off.size:
        v, total = int(off[0]), float(sums[off[0]])
        raise InvalidBasis(f"the functions sum to {total} at vertex {v}", index=v, value=total)
    zero = np.flatnonzero(np.bincount(functions.indices, minlength=functions.shape[1]) == 0)
    if zero.size:
        raise InvalidBasis(f"function {zero[0]} is zero everywhere", index=int(zero[0]), value=0.0)
    functions.data.setflags(write=False)
    return functions


def _checked_indices(name: str, given: Any, length: int, allowed: IntArray) -> IntArray:
    raw = np.asarray(given)
    if raw.shape != (length,) or raw.dtype.kind not in "iu":
        message = f"{name} must be {length} integers, not {raw.dtype} of shape {raw.shape}"
        raise InvalidBasis(message, value=str(raw.shape))
    stray = np.flatnonzero(~np.isin(raw, allowed))
    if stray.size:
        value = int(raw[stray[0]])
        raise InvalidBasis(f"{name}[{stray[0]}] is {value}, out of range", index=int(stray[0]), value=value)
    indices = raw.astype(np.int64)
    indices.setflags(write=False)
    return indices
