"""What a Cholesky factorisation will touch, found once for every matrix of one sparsity pattern.

Columns are put in a fill-reducing order (multiple minimum degree) and gathered into supernodes: runs of
columns with the same rows below them, stored as one dense panel. The numbers come in solver.cholesky.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from solver.mesh import IntArray

#: Share of a panel that may be zeros when supernodes are merged, in panels of up to ``NARROW`` columns and in
#: wider ones: every update reads and writes its target, so that few updates are worth some idle arithmetic.
NARROW, NARROW_PADDING, PADDING = 8, 0.3, 0.1
#: Widest panel: what a panel is updated by should stay in the first cache.
WIDEST = 32


class Panels(NamedTuple):
    """Supernodes in the order in which they are factored, as arrays that compiled kernels read.

    Attributes
    ----------
    first, width : ndarray of int64, shape (S,)
        First column of each panel, and how many.
    row_start : ndarray of int64, shape (S + 1,)
    rows : ndarray of int64
        Rows of panel s are ``rows[row_start[s]:row_start[s + 1]]``, ascending, its own columns first.
    start : ndarray of int64, shape (S + 1,)
        Where each panel's numbers start; a panel is stored line by line.
    update_start : ndarray of int64, shape (S + 1,)
    updates : ndarray of int64, shape (4 ·,)
        Four numbers for each update of panel s: an earlier panel, the lines [a, b) of it that are columns of
        s, and where in ``places`` the lines of s start that its lines from a on go to.
    places : ndarray of int64
        Begins with 0, 1, 2, …, which is where a panel's lines go in itself.
    """

    first: IntArray
    width: IntArray
    row_start: IntArray
    rows: IntArray
    start: IntArray
    update_start: IntArray
    updates: IntArray
    places: IntArray


@dataclass(frozen=True, eq=False)
class Symbolic:
    """Order and panels of all matrices of one pattern.

    Attributes
    ----------
    order : ndarray of int64, shape (n,)
        Column k of the factor is column ``order[k]`` of the matrix.
    panels : Panels
    """

    order: IntArray
    panels: Panels

    def cells(self, rows: IntArray, columns: IntArray) -> IntArray:
        """Where in the panels' storage the entries (row ≥ column) of the reordered matrix stand."""
        panels = self.panels
        owner = np.repeat(np.arange(panels.first.size), panels.width)[columns]
        keys = (
            np.repeat(np.arange(panels.first.size), np.diff(panels.row_start)) * self.order.size + panels.rows
        )
        line = np.searchsorted(keys, owner * self.order.size + rows) - panels.row_start[owner]
        return panels.start[owner] + line * panels.width[owner] + columns - panels.first[owner]

    @property
    def multiplications(self) -> int:
        """Multiplications of one factorisation, each with an addition."""
        lines = np.diff(self.panels.row_start)
        columns = self.panels.width
        return (
            int(sum(((line - np.arange(wide)) ** 2).sum() for line, wide in zip(lines, columns, strict=True)))
            // 2
        )


def analyse(pattern: sparse.csr_array) -> Symbolic:
    """Order, supernodes and updates for symmetric matrices with the given pattern.

    Parameters
    ----------
    pattern : csr_array, shape (n, n)
        Symmetric, with a full diagonal; its values do not matter.

    Returns
    -------
    Symbolic

    Raises
    ------
    ValueError
        Never for a symmetric pattern with a full diagonal.
    """
    order = _fill_reducing_order(pattern)
    order = order[_postorder(_structure(pattern, order)[1])]
    structure, parent = _structure(pattern, order)
    return Symbolic(order, _panels(_supernodes(structure, parent), order.size))


def _fill_reducing_order(pattern: sparse.csr_array) -> IntArray:
    """Multiple minimum degree, as SuperLU finds it on a diagonally dominant matrix of that pattern."""
    n = pattern.shape[0]
    ones = sparse.csc_array((np.ones(pattern.nnz), pattern.indices, pattern.indptr), shape=(n, n))
    dominant = sparse.csc_array(ones + 2.0 * n * sparse.eye_array(n))
    factor = linalg.splu(
        dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return np.argsort(factor.perm_c)


def _structure(pattern: sparse.csr_array, order: IntArray) -> tuple[list[IntArray], IntArray]:
    """Rows of every column of the factor, itself first, and parent in the elimination tree (−1 at a root)."""
    reordered = sparse.csr_array(pattern[order][:, order])
    reordered.sort_indices()
    n = order.size
    structure: list[IntArray] = []
    children: list[list[int]] = [[] for _ in range(n)]
    parent = np.full(n, -1, dtype=np.int64)
    for column in range(n):
        own = reordered.indices[reordered.indptr[column] : reordered.indptr[column + 1]]
        merged = np.concatenate([own] + [structure[child] for child in children[column]])
        rows = np.unique(merged[merged >= column]).astype(np.int64)
        structure.append(rows)
        if rows.size > 1:
            parent[column] = rows[1]
            children[rows[1]].append(column)
    return structure, parent


def _postorder(parent: IntArray) -> IntArray:
    """Columns with every subtree of the elimination tree in one run, its root last."""
    children: list[list[int]] = [[] for _ in range(parent.size)]
    roots: list[int] = []
    for column, above in enumerate(parent):
        (roots if above < 0 else children[above]).append(column)
    backwards, stack = [], roots
    while stack:
        column = stack.pop()
        backwards.append(column)
        stack.extend(children[column])
    return np.array(backwards[::-1], dtype=np.int64)


def _supernodes(structure: list[IntArray], parent: IntArray) -> list[tuple[int, int, IntArray]]:
    """Panels (first column, one past the last, rows): supernodes, merged while few zeros are stored."""
    nonzeros = _starts(np.array([rows.size for rows in structure], dtype=np.int64))

    def padding(first: int, stop: int, rows: IntArray) -> float:
        width = stop - first
        return float(1 - (nonzeros[stop] - nonzeros[first]) / (width * rows.size - width * (width - 1) // 2))

    found: list[tuple[int, int, IntArray]] = []
    for first, stop in _fundamental(structure, parent):
        panel = (first, stop, structure[first])
        while found and first <= parent[panel[0] - 1] < stop:
            begin, _, rows = found[-1]
            merged = (begin, stop, np.union1d(rows, np.concatenate([np.arange(begin, stop), panel[2]])))
            if padding(*merged) > (NARROW_PADDING if stop - begin <= NARROW else PADDING):
                break
            found.pop()
            panel = merged
        found.append(panel)
    return [narrow for panel in found for narrow in _cut(*panel)]


def _fundamental(structure: list[IntArray], parent: IntArray) -> list[tuple[int, int]]:
    """Runs of columns [first, stop) that have the same rows below them."""
    n = parent.size
    sizes = np.array([rows.size for rows in structure])
    joined = (parent[:-1] == np.arange(1, n)) & (sizes[:-1] == sizes[1:] + 1)
    bounds = np.concatenate([[0], np.flatnonzero(~joined) + 1, [n]])
    return [(int(a), int(b)) for a, b in pairwise(bounds)]


def _cut(first: int, stop: int, rows: IntArray) -> list[tuple[int, int, IntArray]]:
    """Panels no wider than ``WIDEST``, as even as possible."""
    pieces = -(-(stop - first) // WIDEST)
    bounds = np.linspace(first, stop, pieces + 1).astype(np.int64)
    return [(int(a), int(b), rows[rows >= a]) for a, b in pairwise(bounds)]


def _panels(supernodes: list[tuple[int, int, IntArray]], n: int) -> Panels:
    lines = [rows for _, _, rows in supernodes]
    first = np.array([a for a, _, _ in supernodes], dtype=np.int64)
    width = np.array([b - a for a, b, _ in supernodes], dtype=np.int64)
    owner = np.repeat(np.arange(width.size), width)
    longest = max(rows.size for rows in lines)
    places: list[IntArray] = [np.arange(longest)]
    n_places = longest
    updates: list[list[tuple[int, int, int, int]]] = [[] for _ in supernodes]
    for panel, rows in enumerate(lines):
        targets = owner[rows]
        begin = int(width[panel])
        while begin < rows.size:
            target = int(targets[begin])
            end = int(np.searchsorted(targets, target, side="right"))
            updates[target].append((panel, begin, end, n_places))
            places.append(np.searchsorted(lines[target], rows[begin:]))
            n_places += rows.size - begin
            begin = end
    sizes = np.array([rows.size for rows in lines], dtype=np.int64)
    flat = [update for those in updates for update in those]
    return Panels(
        first=first,
        width=width,
        row_start=_starts(sizes),
        rows=np.concatenate(lines).astype(np.int64),
        start=_starts(sizes * width),
        update_start=_starts(np.array([len(those) for those in updates], dtype=np.int64)),
        updates=np.array(flat, dtype=np.int64).ravel(),
        places=np.concatenate(places).astype(np.int64),
    )


def _starts(sizes: IntArray) -> IntArray:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
