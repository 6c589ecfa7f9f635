"""The systems A_f q = b_f of a soft map, laid out for kernels that assemble them for several faces at once.

With c̃_f = (1−ε) c_f + ε ∫β the blend costs nothing: Σⱼ ∫βⱼ μⱼ = 1, so A_f = Σⱼ c̃_fj Wⱼ and u_f = Uᵀ c̃_f.
Everything of the target is in the order in which its columns are eliminated.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

from solver.basis import Basis
from solver.cholesky import ENTRIES, FLOATS, INTEGERS, PANELS, Entries, kernel, types
from solver.errors import SolverError
from solver.fem import hat_gradients
from solver.mesh import FloatArray, IntArray
from solver.softmap import SoftMap
from solver.symbolic import Panels, Symbolic, analyse
from solver.tensor import TargetTensor, target_tensor

#: Entries of A assembled at once, so that one load of c̃ⱼ serves all of them.
GROUP = 4


class Tensor(NamedTuple):
    """W in groups of four entries of the lower triangle, chosen so that the same Wⱼ reach them.

    Attributes
    ----------
    start : ndarray of int64, shape (G + 1,)
        Terms ``start[g]`` to ``start[g + 1]`` make group g.
    function : ndarray of int64, shape (·,)
        j of each term.
    value : ndarray of float64, shape (·, 4)
        Wⱼ at the group's four entries.
    row, column : ndarray of int64, shape (4 G,)
        The entries, group by group, in about the order of the panels; zeros at (0, 0) fill up the last group.
    diagonal : ndarray of int64, shape (n,)
        Where the diagonal stands among the entries.
    """

    start: IntArray
    function: IntArray
    value: FloatArray
    row: IntArray
    column: IntArray
    diagonal: IntArray


class Rows(NamedTuple):
    """Entries of every row of A, on both sides of the diagonal.

    Attributes
    ----------
    start : ndarray of int64, shape (n + 1,)
        Where each row's entries start.
    entry : ndarray of int64, shape (·,)
        Place among the tensor's entries.
    column : ndarray of int64, shape (·,)
    """

    start: IntArray
    entry: IntArray
    column: IntArray


class Target(NamedTuple):
    """All that kernels read of a target basis.

    Attributes
    ----------
    panels : Panels
    entries : Entries
    tensor : Tensor
    rows : Rows
    integrals : ndarray of float64, shape (1, n)
        ∫βⱼ; here, in C and in CU, n is rounded up to an even number by a column of zeros.
    """

    panels: Panels
    entries: Entries
    tensor: Tensor
    rows: Rows
    integrals: FloatArray


class Source(NamedTuple):
    """All that kernels read of a source basis and of C.

    Attributes
    ----------
    corner : ndarray of int64, shape (3 F₀,)
        Corners of each face.
    slope : ndarray of float64, shape (3 F₀, 2)
        ⟨∇₀λ, V_f^s⟩ of the hat function of each corner.
    start : ndarray of int64, shape (V₀ + 1,)
        Where each vertex's functions start.
    function : ndarray of int64, shape (nnz,)
    value : ndarray of float64, shape (1, nnz)
        β₀ᵢ at the vertex.
    coefficients, received : ndarray of float64, shape (n₀, n)
        C and CU.
    """

    corner: IntArray
    slope: FloatArray
    start: IntArray
    function: IntArray
    value: FloatArray
    coefficients: FloatArray
    received: FloatArray


TENSOR = types.NamedTuple([INTEGERS, INTEGERS, FLOATS, INTEGERS, INTEGERS, INTEGERS], Tensor)
ROWS = types.NamedUniTuple(INTEGERS, len(Rows._fields), Rows)
TARGET = types.NamedTuple([PANELS, ENTRIES, TENSOR, ROWS, FLOATS], Target)
SOURCE = types.NamedTuple([INTEGERS, FLOATS, INTEGERS, INTEGERS, FLOATS, FLOATS, FLOATS], Source)


@dataclass(frozen=True, eq=False)
class Plan:
    """What all solves on one target basis share; made once for each basis.

    Attributes
    ----------
    symbolic : Symbolic
    target : Target
    """

    symbolic: Symbolic
    target: Target


@dataclass(frozen=True, eq=False)
class Systems:
    """The systems of all faces of a soft map, ready for the kernels.

    Attributes
    ----------
    softmap : SoftMap
    regularisation : float
        ε.
    plan : Plan
    source : Source
    widest : int
        Bound on the functions that live on a face of the source.
    """

    softmap: SoftMap
    regularisation: float
    plan: Plan
    source: Source
    widest: int


@dataclass(frozen=True, eq=False)
class Layout:
    """What all soft maps from one source basis share; made once for each basis.

    Attributes
    ----------
    corner, slope, start, function, value
        As in `Source`.
    widest : int
        Bound on the functions that live on a face.
    """

    corner: IntArray
    slope: FloatArray
    start: IntArray
    function: IntArray
    value: FloatArray
    widest: int


_plans: weakref.WeakKeyDictionary[Basis, Plan] = weakref.WeakKeyDictionary()
_layouts: weakref.WeakKeyDictionary[Basis, Layout] = weakref.WeakKeyDictionary()


def systems(softmap: SoftMap, regularisation: float) -> Systems:
    """Lay out the systems A_f q_fs = b_fs of a soft map (eqs. 10–12).

    Parameters
    ----------
    softmap : SoftMap
    regularisation : float
        ε, strictly between 0 and 1.

    Returns
    -------
    Systems

    Raises
    ------
    SolverError
        If the regularisation is not strictly between 0 and 1.
    InvalidBasis
        If a function of the target vanishes on every face.
    """
    if not 0 < regularisation < 1:
        message = f"the regularisation must be strictly between 0 and 1, not {regularisation}"
        raise SolverError(message, value=float(regularisation))
    plan, layout = plan_of(softmap.target), _layout_of(softmap.source)
    order = plan.symbolic.order
    source = Source(
        corner=layout.corner,
        slope=layout.slope,
        start=layout.start,
        function=layout.function,
        value=layout.value,
        coefficients=_even(softmap.coefficients[:, order]),
        received=_even((softmap.coefficients @ softmap.target.overlap)[:, order]),
    )
    return Systems(softmap, float(regularisation), plan, source, layout.widest)


def _layout_of(basis: Basis) -> Layout:
    layout = _layouts.get(basis)
    if layout is None:
        mesh, functions = basis.mesh, basis.functions
        layout = _layouts[basis] = Layout(
            corner=mesh.faces.ravel().astype(np.int64),
            slope=(hat_gradients(mesh) @ mesh.frames.transpose(0, 2, 1)).reshape(-1, 2),
            start=functions.indptr.astype(np.int64),
            function=functions.indices.astype(np.int64),
            value=np.array(functions.data, dtype=np.float64, ndmin=2),
            widest=int(np.diff(functions.indptr)[mesh.faces].sum(axis=1).max()),
        )
    return layout


def plan_of(basis: Basis) -> Plan:
    """Order, panels and tensor of a target basis, made at the first call for it.

    Parameters
    ----------
    basis : Basis

    Returns
    -------
    Plan

    Raises
    ------
    InvalidBasis
        If a function vanishes on every face.
    """
    plan = _plans.get(basis)
    if plan is None:
        plan = _plans[basis] = _plan(basis)
    return plan


def _plan(basis: Basis) -> Plan:
    tensor = target_tensor(basis)
    pattern = sparse.coo_array(
        (np.ones(tensor.rows.size), (tensor.rows, tensor.columns)), shape=(basis.size,) * 2
    )
    symbolic = analyse(sparse.csr_array(pattern + pattern.T))
    grouped = _grouped(tensor, symbolic)
    integrals = _even(basis.integrals[symbolic.order][None, :])
    rows, columns = grouped.row[: tensor.rows.size], grouped.column[: tensor.rows.size]
    start, entry = _near(rows, columns, symbolic.order.size)
    row = np.repeat(np.arange(symbolic.order.size), np.diff(start))
    target = Target(
        panels=symbolic.panels,
        entries=_entries(symbolic, rows, columns),
        tensor=grouped,
        rows=Rows(start, entry, rows[entry] + columns[entry] - row),
        integrals=integrals,
    )
    return Plan(symbolic, target)


def _even(columns: FloatArray) -> FloatArray:
    """An array with a zero column more if their number is odd: kernels take them two by two."""
    return np.ascontiguousarray(np.pad(columns, [(0, 0), (0, columns.shape[1] % 2)]))


def _grouped(tensor: TargetTensor, symbolic: Symbolic) -> Tensor:
    """W in groups of entries that share most of their terms, in the order of elimination."""
    n = symbolic.order.size
    place = np.argsort(symbolic.order)
    a, b = place[tensor.rows], place[tensor.columns]
    rows, columns = np.maximum(a, b), np.minimum(a, b)
    values = sparse.csr_array(tensor.values[:, symbolic.order])
    values.sort_indices()
    chosen = _groups(
        values.indptr.astype(np.int64),
        values.indices.astype(np.int64),
        rows,
        columns,
        *_near(rows, columns, n),
    )
    # Groups in the order of their first cell, so that what panels read one after the other lies together.
    whole = chosen[: chosen.size // GROUP * GROUP].reshape(-1, GROUP)
    sort = np.argsort(symbolic.cells(rows, columns)[whole].min(axis=1), kind="stable")
    chosen = np.concatenate([whole[sort].ravel(), chosen[whole.size :]])

    padding = -chosen.size % GROUP
    group = np.repeat(np.arange((chosen.size + padding) // GROUP), GROUP)[: chosen.size]
    taken = values[chosen].tocoo()
    terms, term = np.unique(group[taken.row] * n + taken.col, return_inverse=True)
    value = np.zeros((terms.size, GROUP))
    value[term, taken.row % GROUP] = taken.data
    of_group, function = np.divmod(terms, n)
    start = np.searchsorted(of_group, np.arange(group[-1] + 2)).astype(np.int64)
    rows, columns = rows[chosen], columns[chosen]
    diagonal = np.empty(n, dtype=np.int64)
    diagonal[rows[rows == columns]] = np.flatnonzero(rows == columns)
    rows, columns = np.pad(rows, (0, padding)), np.pad(columns, (0, padding))
    return Tensor(start, function.astype(np.int64), value, rows, columns, diagonal)


@kernel(INTEGERS(INTEGERS, INTEGERS, INTEGERS, INTEGERS, INTEGERS, INTEGERS))
def _groups(start, function, row, column, near_start, near):  # type: ignore[no-untyped-def]
    """Order of entries in which every four share most terms: each group grows by its cheapest neighbour."""
    n_entries = row.size
    chosen = np.empty(n_entries, np.int64)
    used = np.zeros(n_entries, np.bool_)
    marked = np.full(near_start.size - 1, -1)
    n_chosen = 0
    following = 0
    for group in range(-(-n_entries // GROUP)):
        terms = 0
        seed = -1
        for _ in range(min(GROUP, n_entries - n_chosen)):
            best, least = -1, 1 << 62
            if seed >= 0:
                for middle in (row[seed], column[seed]):
                    for k in range(near_start[middle], near_start[middle + 1]):
                        other = near[k]
                        if used[other]:
                            continue
                        common = 0
                        for term in range(start[other], start[other + 1]):
                            common += marked[function[term]] == group
                        cost = start[other + 1] - start[other] + terms - 2 * common
                        if cost < least:
                            best, least = other, cost
            while best < 0 and used[following]:
                following += 1
            if best < 0:
                best = following
            if seed < 0:
                seed = best
            used[best] = True
            chosen[n_chosen] = best
            n_chosen += 1
            for term in range(start[best], start[best + 1]):
                terms += marked[function[term]] != group
                marked[function[term]] = group
    return chosen


def _entries(symbolic: Symbolic, rows: IntArray, columns: IntArray) -> Entries:
    cells = symbolic.cells(rows, columns)
    entry = np.argsort(cells)
    start = np.searchsorted(cells[entry], symbolic.panels.start)
    return Entries(start.astype(np.int64), entry.astype(np.int64), cells[entry].astype(np.int64))


def _near(rows: IntArray, columns: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Entries of each row of the full pattern: where each row's start, and the entries."""
    below = np.flatnonzero(rows != columns)
    row = np.concatenate([rows, columns[below]])
    sort = np.argsort(row, kind="stable")
    start = np.searchsorted(row[sort], np.arange(n + 1)).astype(np.int64)
    return start, np.concatenate([np.arange(rows.size), below])[sort]
