"""Second derivative of E_D + λE_b on super-faces: an operator that costs a few sparse solves.

    ⟨X, H X⟩ = 2 (1−ε)² Σ_κs r_κsᵀ A_κ⁻¹ r_κs + 2λ (Xᵀb₀)ᵀ V (Xᵀb₀),   r_κs = Uᵀ Xᵀ g_κs − N_κs Xᵀ m_κ

with N_κs[k, j] = (Wⱼ q_κs)_k: the first term of r is what moves b_f, the second what moves A_f. On the faces
themselves instead of super-faces this is exact. Super-faces stand side by side in the lanes of registers, as
faces do in solver.batches; columns are in the order in which they are eliminated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

from solver.assembly import GROUP, Plan, plan_of
from solver.basis import Basis
from solver.cholesky import FACTOR, FLOATS, INTEGERS, PANELS, Factor, kernel, solve_again, solve_lanes, types
from solver.lanes import (
    LANES,
    add_product,
    empty_lanes,
    load,
    multiply,
    splat,
    store,
    subtract,
    subtract_product,
)
from solver.mesh import FloatArray, IntArray
from solver.superfaces import SuperFaces


class Overlaps(NamedTuple):
    """Pattern of Uᵀ, which N shares, and where each term of W goes in N.

    Attributes
    ----------
    start : ndarray of int64, shape (n + 1,)
        Cells ``start[k]`` to ``start[k + 1]`` make row k.
    column : ndarray of int64, shape (P,)
    term_start : ndarray of int64, shape (E + 1,)
        Terms of each entry of W.
    row, other : ndarray of int64, shape (E,)
        Row and column of the entry.
    place, mirrored : ndarray of int64, shape (T,)
        Cells that a term adds to, for the entry and for its mirror image; P, a cell that nobody reads, where
        there is none.
    """

    start: IntArray
    column: IntArray
    term_start: IntArray
    row: IntArray
    other: IntArray
    place: IntArray
    mirrored: IntArray


OVERLAPS = types.NamedUniTuple(INTEGERS, len(Overlaps._fields), Overlaps)


@dataclass(frozen=True, eq=False)
class CurvatureModel:
    """What curvatures at different soft maps share.

    Attributes
    ----------
    source, target : Basis
    faces : SuperFaces
    regularisation : float
        ε.
    bijectivity_weight : float
        λ.
    threads : int
    plan : Plan
        Of the target.
    entries : csr_array, shape (E, n)
        W: ``entries @ c`` are the entries of Σⱼ cⱼ Wⱼ as the plan lists them.
    overlap, products : csr_array, shape (n, n)
        U and V.
    overlaps : Overlaps
    overlap_cells, terms : ndarray of float64, shapes (1, P) and (1, T)
        Values of Uᵀ and of W, for kernels.
    gather : csr_array, shape (3 · LANES · batches, n₀)
        Takes X to (Xᵀg₁, Xᵀg₂, Xᵀm) of each super-face; spare lanes take zeros.
    """

    source: Basis
    target: Basis
    faces: SuperFaces
    regularisation: float
    bijectivity_weight: float
    threads: int
    plan: Plan
    entries: sparse.csr_array
    overlap: sparse.csr_array
    products: sparse.csr_array
    overlaps: Overlaps
    overlap_cells: FloatArray
    terms: FloatArray
    gather: sparse.csr_array

    @property
    def order(self) -> IntArray:
        """Column k here is function ``order[k]`` of the target, int64 (n,)."""
        return self.plan.symbolic.order

    @property
    def batches(self) -> int:
        """Number of batches of super-faces."""
        return -(-self.faces.count // LANES)

    def at(self, coefficients: FloatArray) -> Curvature:
        """Curvature at a soft map.

        Parameters
        ----------
        coefficients : (n₀, n) float64
            C, its columns in elimination order.

        Returns
        -------
        Curvature

        Raises
        ------
        MemoryError
            If there is no room for a factor of each super-face.
        """
        return _curvature(self, coefficients)


def curvature_model(
    source: Basis,
    target: Basis,
    faces: SuperFaces,
    regularisation: float,
    bijectivity_weight: float,
    threads: int = 1,
) -> CurvatureModel:
    """Lay out what curvatures at different soft maps share.

    Parameters
    ----------
    source, target : Basis
    faces : SuperFaces
        Of the source.
    regularisation : float
        ε.
    bijectivity_weight : float
        λ.
    threads : int

    Returns
    -------
    CurvatureModel

    Raises
    ------
    InvalidBasis
        If a function of the target vanishes on every face.
    """
    plan = plan_of(target)
    order = plan.symbolic.order
    n = order.size
    tensor = plan.target.tensor
    group = np.repeat(np.arange(tensor.start.size - 1), np.diff(tensor.start))
    rows = GROUP * group[:, None] + np.arange(GROUP)
    entries = sparse.csr_array(
        (tensor.value.ravel(), (rows.ravel(), np.repeat(tensor.function, GROUP))), shape=(tensor.row.size, n)
    )
    entries.eliminate_zeros()
    overlap = sparse.csr_array(target.overlap[order][:, order])
    products = sparse.csr_array(target.density_products[order][:, order])
    overlaps, cells = _overlaps(overlap, entries, tensor.row, tensor.column)
    spare = sparse.csr_array((-faces.count % LANES, source.size))
    stacked = sparse.vstack([part for one in (*faces.slopes, faces.means) for part in (one, spare)]).tocsr()
    lanes = stacked.shape[0] // 3
    gather = sparse.csr_array(stacked[(np.arange(lanes)[:, None] + lanes * np.arange(3)).ravel()])
    return CurvatureModel(
        source=source,
        target=target,
        faces=faces,
        regularisation=regularisation,
        bijectivity_weight=bijectivity_weight,
        threads=threads,
        plan=plan,
        entries=entries,
        overlap=overlap,
        products=products,
        overlaps=overlaps,
        overlap_cells=cells,
        terms=entries.data[None, :].copy(),
        gather=gather,
    )


@dataclass(frozen=True, eq=False)
class Curvature:
    """Second derivative H at one soft map, as an operator on changes X with rows that sum to zero.

    Attributes
    ----------
    model : CurvatureModel
    weights : ndarray of float64, shape (K, n)
        Blended mixing weights c̃_κ.
    factors : list of (Factor, ndarray)
        Factors of A_κ, and N_κ, for each batch.
    """

    model: CurvatureModel
    weights: FloatArray
    factors: list[tuple[Factor, FloatArray]]

    def __call__(self, change: FloatArray) -> FloatArray:
        """Product H X, unique up to row constants.

        Parameters
        ----------
        change : (n₀, n) float64
            X, its columns in elimination order; rows sum to zero.

        Returns
        -------
        ndarray of float64, shape (n₀, n)

        Raises
        ------
        MemoryError
            If there is no room.
        """
        model = self.model
        n = model.order.size
        shape = (model.batches, LANES, 3, n)
        lanes = np.ascontiguousarray((model.gather @ change).reshape(shape).transpose(0, 3, 2, 1))
        x = lanes.reshape(model.batches, 3 * n, LANES)

        def curve(batches: IntArray) -> None:
            room = empty_lanes(2 * n)
            for k in batches:
                factor, bent = self.factors[k]
                _curve(
                    model.overlaps, model.overlap_cells, model.plan.target.panels, factor, bent, x[k], room
                )

        shared(curve, np.array_split(np.arange(model.batches), model.threads), model.threads)
        curved = np.ascontiguousarray(lanes.transpose(0, 3, 2, 1)).reshape(-1, n)
        product: FloatArray = model.gather.T @ curved
        product *= 2 * (1 - model.regularisation) ** 2
        integrals = model.source.integrals
        product += np.outer(2 * model.bijectivity_weight * integrals, model.products @ (integrals @ change))
        return product


def shared(work: Callable[[IntArray], None], parts: Iterable[IntArray], threads: int) -> None:
    """Do parts of some work on a pool of plain threads, or here if there is only one.

    Parameters
    ----------
    work : callable
    parts : iterable of ndarray of int64
    threads : int

    Raises
    ------
    Exception
        What the work raises.
    """
    if threads == 1:
        for part in parts:
            work(part)
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(work, parts):
            pass


def _curvature(model: CurvatureModel, coefficients: FloatArray) -> Curvature:
    plan = model.plan.target
    n, eps = model.order.size, model.regularisation
    spare = -model.faces.count % LANES
    means = np.concatenate([model.faces.means @ coefficients, np.tile(coefficients[:1], (spare, 1))])
    blended = (1 - eps) * means + eps * model.target.integrals[model.order]
    received = coefficients @ model.overlap
    right = np.zeros((len(blended), 2, n))
    for s, slope in enumerate(model.faces.slopes):
        right[: model.faces.count, s] = (1 - eps) * (slope @ received)
    u = blended @ model.overlap
    right -= right.sum(axis=2, keepdims=True) * (u / u.sum(axis=1, keepdims=True))[:, None]
    heaviest = means.argmax(axis=1)
    factors: list[tuple[Factor, FloatArray]] = [None] * model.batches  # type: ignore[list-item]

    def factor(batches: IntArray) -> None:
        matrix, diagonal, q = empty_lanes(model.entries.shape[0]), empty_lanes(n), empty_lanes(2 * n)
        for k in batches:
            here = slice(k * LANES, (k + 1) * LANES)
            matrix[:] = model.entries @ blended[here].T
            diagonal[:] = matrix[plan.tensor.diagonal]
            diagonal[heaviest[here], np.arange(LANES)] *= 2
            values = empty_lanes(int(plan.panels.start[-1]))
            made = Factor(values, empty_lanes(n), empty_lanes(2))
            q[:] = right[here].transpose(2, 1, 0).reshape(2 * n, LANES)
            solve_lanes(plan.panels, plan.entries, matrix, diagonal, made, q)
            bent = empty_lanes(2 * (model.overlaps.column.size + 1))
            _bend(model.overlaps, model.terms, q, bent)
            factors[k] = made, bent

    shared(factor, np.array_split(np.arange(model.batches), model.threads), model.threads)
    return Curvature(model, blended[: model.faces.count], factors)


def _overlaps(
    overlap: sparse.csr_array, entries: sparse.csr_array, rows: IntArray, columns: IntArray
) -> tuple[Overlaps, FloatArray]:
    transposed = sparse.csr_array(overlap.T)
    transposed.sort_indices()
    n = overlap.shape[0]
    keys = np.repeat(np.arange(n), np.diff(transposed.indptr)) * n + transposed.indices
    entry = np.repeat(np.arange(rows.size), np.diff(entries.indptr))
    # Wⱼ[k, ·] ≠ 0 needs a face where μⱼ and ∇βₖ do not vanish, and there βₖ does not vanish either.
    place = np.searchsorted(keys, rows[entry] * n + entries.indices)
    mirrored = np.searchsorted(keys, columns[entry] * n + entries.indices)
    mirrored[rows[entry] == columns[entry]] = keys.size
    pattern = Overlaps(
        transposed.indptr.astype(np.int64),
        transposed.indices.astype(np.int64),
        entries.indptr.astype(np.int64),
        rows,
        columns,
        place.astype(np.int64),
        mirrored.astype(np.int64),
    )
    return pattern, transposed.data[None, :].copy()


@kernel(types.void(OVERLAPS, FLOATS, FLOATS, FLOATS))
def _bend(overlaps, terms, q, bent):  # type: ignore[no-untyped-def]
    """N_s[k, j] = (Wⱼ q_s)_k for both directions, row 2p + s of `bent` for cell p."""
    zero = splat(0.0)
    for cell in range(len(bent)):
        store(bent, cell, zero)
    for entry in range(overlaps.row.size):
        a, b = 2 * overlaps.row[entry], 2 * overlaps.other[entry]
        a0, a1, b0, b1 = load(q, a), load(q, a + 1), load(q, b), load(q, b + 1)
        for k in range(overlaps.term_start[entry], overlaps.term_start[entry + 1]):
            value = splat(terms[0, k])
            cell = 2 * overlaps.place[k]
            store(bent, cell, add_product(value, b0, load(bent, cell)))
            store(bent, cell + 1, add_product(value, b1, load(bent, cell + 1)))
            cell = 2 * overlaps.mirrored[k]
            store(bent, cell, add_product(value, a0, load(bent, cell)))
            store(bent, cell + 1, add_product(value, a1, load(bent, cell + 1)))


@kernel(types.void(OVERLAPS, FLOATS, PANELS, FACTOR, FLOATS, FLOATS, FLOATS))
def _curve(overlaps, overlap, panels, factor, bent, x, r):  # type: ignore[no-untyped-def]
    """Rows 3j, 3j + 1, 3j + 2 of x are (Xᵀg₁, Xᵀg₂, Xᵀm)ⱼ: replaced by the adjoint of r applied to A⁻¹ r."""
    n = overlaps.start.size - 1
    for k in range(n):
        r0, r1 = splat(0.0), splat(0.0)
        for cell in range(overlaps.start[k], overlaps.start[k + 1]):
            weight, j = splat(overlap[0, cell]), 3 * overlaps.column[cell]
            mean = load(x, j + 2)
            r0 = subtract_product(load(bent, 2 * cell), mean, add_product(weight, load(x, j), r0))
            r1 = subtract_product(load(bent, 2 * cell + 1), mean, add_product(weight, load(x, j + 1), r1))
        store(r, 2 * k, r0)
        store(r, 2 * k + 1, r1)
    solve_again(panels, factor, r)
    for row in range(3 * n):
        store(x, row, splat(0.0))
    for k in range(n):
        z0, z1 = load(r, 2 * k), load(r, 2 * k + 1)
        for cell in range(overlaps.start[k], overlaps.start[k + 1]):
            weight, j = splat(overlap[0, cell]), 3 * overlaps.column[cell]
            store(x, j, add_product(weight, z0, load(x, j)))
            store(x, j + 1, add_product(weight, z1, load(x, j + 1)))
            moved = add_product(load(bent, 2 * cell), z0, multiply(load(bent, 2 * cell + 1), z1))
            store(x, j + 2, subtract(load(x, j + 2), moved))
