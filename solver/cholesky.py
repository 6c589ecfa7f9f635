"""One sparsity pattern, thousands of matrices: factor and solve several at once, a matrix in each lane.

Left-looking and supernodal: every panel gathers the updates of the earlier panels in tiles whose sums never
leave the registers, then is factored in place (A = L Lᵀ). Each lane sees the same operations in the same
order whatever its neighbours hold, so results do not depend on how faces are batched. See
docs/decisions/kernel.md for measurements.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
from numba.core import types as numba_types

from solver.lanes import (
    STRIP,
    STRIP_ROWS,
    TILE_COLUMNS,
    TILE_ROWS,
    divide,
    finish_strip,
    item,
    load,
    multiply,
    splat,
    square_root,
    store,
    subtract_product,
    update_tile,
    where_above,
)
from solver.mesh import FloatArray, IntArray
from solver.symbolic import Panels

#: Pivot, relative to its diagonal entry, at which columns count as linearly dependent. The systems of real
#: maps stay above 1e-5.
PIVOT_TOLERANCE = 1e-12


class Entries(NamedTuple):
    """Where the entries of the lower triangle go in the panels.

    Attributes
    ----------
    start : ndarray of int64, shape (S + 1,)
        Entries ``start[s]`` to ``start[s + 1]`` of the lists below belong to panel s.
    entry : ndarray of int64, shape (E,)
        Row in the array of entries.
    cell : ndarray of int64, shape (E,)
        Row in the panels' storage.
    """

    start: IntArray
    entry: IntArray
    cell: IntArray


class Factor(NamedTuple):
    """Arrays of lanes that hold one factorisation.

    Attributes
    ----------
    values : ndarray of float64, shape (panels.start[-1], LANES)
        The panels of L.
    inverse : ndarray of float64, shape (n, LANES)
        1 / L_kk.
    failed : ndarray of float64, shape (2, LANES)
        Last column whose pivot was too small or not a number (and was replaced by 1), and that pivot; −1 and
        0 if all were good.
    """

    values: FloatArray
    inverse: FloatArray
    failed: FloatArray


#: Numba's own types, which carry no annotations.
types: Any = numba_types

INTEGERS = types.Array(types.int64, 1, "C")
FLOATS = types.Array(types.float64, 2, "C")
PANELS = types.NamedUniTuple(INTEGERS, len(Panels._fields), Panels)
ENTRIES = types.NamedUniTuple(INTEGERS, len(Entries._fields), Entries)
FACTOR = types.NamedUniTuple(FLOATS, len(Factor._fields), Factor)


def kernel(signature: Any) -> Any:
    """Compile for one signature when imported, or load from the cache; kernels hold no lock.

    Parameters
    ----------
    signature : numba signature

    Returns
    -------
    decorator

    Raises
    ------
    numba.core.errors.NumbaError
        If the function does not compile, which is a mistake in it.
    """
    return numba.njit(signature, cache=True, nogil=True, error_model="numpy")


@kernel(types.void(FLOATS, INTEGERS, *[types.int64] * 8))
def _update(values, places, begin, lines, columns, stride, depth, place, target, width):  # type: ignore[no-untyped-def]
    """X[place[i], place[j]] −= Σ_k A[i, k] A[j, k] for lines i of A and its first lines j ≤ i."""
    for i in range(0, lines, TILE_ROWS):
        rows = min(TILE_ROWS, lines - i)
        for j in range(0, min(columns, i + rows), TILE_COLUMNS):
            update_tile(
                values, places, begin + i * stride, begin + j * stride, stride, depth, place + i, place + j,
                target, width, rows, min(TILE_COLUMNS, columns - j),
            )  # fmt: skip


@kernel(types.void(FACTOR, FLOATS, *[types.int64] * 5))
def _factor_columns(factor, diagonal, column, begin, lines, width, count):  # type: ignore[no-untyped-def]
    """Factor `count` columns that earlier ones no longer touch: pivots, then the lines below."""
    values, inverse, failed = factor
    for j in range(count):
        pivot = load(values, begin + j * width + j)
        for k in range(j):
            term = load(values, begin + j * width + k)
            pivot = subtract_product(term, term, pivot)
        least = multiply(splat(PIVOT_TOLERANCE), load(diagonal, column + j))
        store(failed, 0, where_above(pivot, least, load(failed, 0), splat(float(column + j))))
        store(failed, 1, where_above(pivot, least, load(failed, 1), pivot))
        pivot = where_above(pivot, least, pivot, splat(1.0))
        scale = divide(splat(1.0), square_root(pivot))
        store(inverse, column + j, scale)
        store(values, begin + j * width + j, multiply(pivot, scale))
        for i in range(j + 1, count):
            entry = load(values, begin + i * width + j)
            for k in range(j):
                entry = subtract_product(
                    load(values, begin + i * width + k), load(values, begin + j * width + k), entry
                )
            store(values, begin + i * width + j, multiply(entry, scale))
    for i in range(count, lines):
        line = begin + i * width
        for j in range(count):
            entry = load(values, line + j)
            for k in range(j):
                entry = subtract_product(load(values, line + k), load(values, begin + j * width + k), entry)
            store(values, line + j, multiply(entry, load(inverse, column + j)))


@kernel(types.void(PANELS, ENTRIES, FLOATS, FLOATS, FACTOR, types.int64))
def _factor_panel(panels, entries, matrix, diagonal, factor, panel):  # type: ignore[no-untyped-def]
    """One panel of L: its entries of A, what earlier panels take from them, then its own columns."""
    values = factor.values
    start, width, column = panels.start[panel], panels.width[panel], panels.first[panel]
    lines = panels.row_start[panel + 1] - panels.row_start[panel]
    for i in range(width):
        for cell in range(start + i * width, start + i * width + i + 1):
            store(values, cell, splat(0.0))
    for cell in range(start + width * width, panels.start[panel + 1]):
        store(values, cell, splat(0.0))
    for k in range(entries.start[panel], entries.start[panel + 1]):
        store(values, item(entries.cell, k), load(matrix, item(entries.entry, k)))
    for k in range(width):
        store(values, start + k * width + k, load(diagonal, column + k))
    for u in range(panels.update_start[panel], panels.update_start[panel + 1]):
        other, a, b, place = panels.updates[4 * u : 4 * u + 4]
        depth = panels.width[other]
        below = panels.row_start[other + 1] - panels.row_start[other] - a
        begin = panels.start[other] + a * depth
        _update(values, panels.places, begin, below, b - a, depth, depth, place, start, width)
    for k in range(0, width, STRIP):
        count = min(STRIP, width - k)
        begin = start + k * width
        whole = count == STRIP
        # A whole strip's lines below the triangle are updated and substituted while they are in registers.
        own = count if whole else lines - k
        if k > 0:
            _update(values, panels.places, begin, own, count, width, k, k, start, width)
        _factor_columns(factor, diagonal, column + k, begin + k, own, width, count)
        if whole:
            for i in range(k + STRIP, lines, STRIP_ROWS):
                rows = min(STRIP_ROWS, lines - i)
                finish_strip(values, factor.inverse, column + k, begin, start + i * width, width, k, rows)


@kernel(types.void(PANELS, FACTOR, types.int64, FLOATS))
def _forwards(panels, factor, panel, x):  # type: ignore[no-untyped-def]
    """One panel of L y = b: its own columns, then what they take from the lines below, four at a time."""
    values, start, width = factor.values, panels.start[panel], panels.width[panel]
    own = 2 * panels.first[panel]
    rows, first = panels.rows, panels.row_start[panel]
    lines = panels.row_start[panel + 1] - first
    for i in range(width):
        x0, x1 = load(x, own + 2 * i), load(x, own + 2 * i + 1)
        for k in range(i):
            entry = load(values, start + i * width + k)
            x0 = subtract_product(entry, load(x, own + 2 * k), x0)
            x1 = subtract_product(entry, load(x, own + 2 * k + 1), x1)
        scale = load(factor.inverse, panels.first[panel] + i)
        store(x, own + 2 * i, multiply(x0, scale))
        store(x, own + 2 * i + 1, multiply(x1, scale))
    whole = width + (lines - width) // 4 * 4
    for i in range(width, whole, 4):
        at = first + i
        a, b, c, d = (
            2 * item(rows, at), 2 * item(rows, at + 1), 2 * item(rows, at + 2), 2 * item(rows, at + 3)
        )  # fmt: skip
        a0, a1, b0, b1 = load(x, a), load(x, a + 1), load(x, b), load(x, b + 1)
        c0, c1, d0, d1 = load(x, c), load(x, c + 1), load(x, d), load(x, d + 1)
        line = start + i * width
        for k in range(width):
            x0, x1 = load(x, own + 2 * k), load(x, own + 2 * k + 1)
            entry = load(values, line + k)
            a0, a1 = subtract_product(entry, x0, a0), subtract_product(entry, x1, a1)
            entry = load(values, line + width + k)
            b0, b1 = subtract_product(entry, x0, b0), subtract_product(entry, x1, b1)
            entry = load(values, line + 2 * width + k)
            c0, c1 = subtract_product(entry, x0, c0), subtract_product(entry, x1, c1)
            entry = load(values, line + 3 * width + k)
            d0, d1 = subtract_product(entry, x0, d0), subtract_product(entry, x1, d1)
        store(x, a, a0)
        store(x, a + 1, a1)
        store(x, b, b0)
        store(x, b + 1, b1)
        store(x, c, c0)
        store(x, c + 1, c1)
        store(x, d, d0)
        store(x, d + 1, d1)
    for i in range(whole, lines):
        x0, x1 = load(x, 2 * item(rows, first + i)), load(x, 2 * item(rows, first + i) + 1)
        for k in range(width):
            entry = load(values, start + i * width + k)
            x0 = subtract_product(entry, load(x, own + 2 * k), x0)
            x1 = subtract_product(entry, load(x, own + 2 * k + 1), x1)
        store(x, 2 * item(rows, first + i), x0)
        store(x, 2 * item(rows, first + i) + 1, x1)


@kernel(types.void(PANELS, FACTOR, types.int64, FLOATS))
def _backwards(panels, factor, panel, x):  # type: ignore[no-untyped-def]
    """One panel of Lᵀ x = y: what the lines below take from its columns, four at a time, then the columns."""
    values, start, width = factor.values, panels.start[panel], panels.width[panel]
    own = 2 * panels.first[panel]
    rows, first = panels.rows, panels.row_start[panel]
    lines = panels.row_start[panel + 1] - first
    whole = width // 4 * 4
    for k in range(0, whole, 4):
        column = own + 2 * k
        a0, a1, b0, b1 = load(x, column), load(x, column + 1), load(x, column + 2), load(x, column + 3)
        c0, c1, d0, d1 = load(x, column + 4), load(x, column + 5), load(x, column + 6), load(x, column + 7)
        for i in range(width, lines):
            x0, x1 = load(x, 2 * item(rows, first + i)), load(x, 2 * item(rows, first + i) + 1)
            line = start + i * width + k
            entry = load(values, line)
            a0, a1 = subtract_product(entry, x0, a0), subtract_product(entry, x1, a1)
            entry = load(values, line + 1)
            b0, b1 = subtract_product(entry, x0, b0), subtract_product(entry, x1, b1)
            entry = load(values, line + 2)
            c0, c1 = subtract_product(entry, x0, c0), subtract_product(entry, x1, c1)
            entry = load(values, line + 3)
            d0, d1 = subtract_product(entry, x0, d0), subtract_product(entry, x1, d1)
        store(x, column, a0)
        store(x, column + 1, a1)
        store(x, column + 2, b0)
        store(x, column + 3, b1)
        store(x, column + 4, c0)
        store(x, column + 5, c1)
        store(x, column + 6, d0)
        store(x, column + 7, d1)
    for k in range(whole, width):
        x0, x1 = load(x, own + 2 * k), load(x, own + 2 * k + 1)
        for i in range(width, lines):
            entry = load(values, start + i * width + k)
            x0 = subtract_product(entry, load(x, 2 * item(rows, first + i)), x0)
            x1 = subtract_product(entry, load(x, 2 * item(rows, first + i) + 1), x1)
        store(x, own + 2 * k, x0)
        store(x, own + 2 * k + 1, x1)
    for i in range(width - 1, -1, -1):
        scale = load(factor.inverse, panels.first[panel] + i)
        x0, x1 = multiply(load(x, own + 2 * i), scale), multiply(load(x, own + 2 * i + 1), scale)
        store(x, own + 2 * i, x0)
        store(x, own + 2 * i + 1, x1)
        for k in range(i):
            entry = load(values, start + i * width + k)
            store(x, own + 2 * k, subtract_product(entry, x0, load(x, own + 2 * k)))
            store(x, own + 2 * k + 1, subtract_product(entry, x1, load(x, own + 2 * k + 1)))


@kernel(types.void(PANELS, ENTRIES, FLOATS, FLOATS, FACTOR, FLOATS))
def solve_lanes(panels, entries, matrix, diagonal, factor, x):  # type: ignore[no-untyped-def]
    """Factor A = L Lᵀ and solve A x = b in every lane, for two right-hand sides.

    Parameters
    ----------
    panels : Panels
    entries : Entries
    matrix : (E, LANES) float64
        Entries of the lower triangle.
    diagonal : (n, LANES) float64
        Diagonal entries, which replace those of `matrix`.
    factor : Factor
        Overwritten.
    x : (2n or more, LANES) float64
        Row 2k + s holds entry k of right-hand side s; overwritten by the solution.
    """
    store(factor.failed, 0, splat(-1.0))
    store(factor.failed, 1, splat(0.0))
    for panel in range(panels.first.size):
        _factor_panel(panels, entries, matrix, diagonal, factor, panel)
        _forwards(panels, factor, panel, x)
    for panel in range(panels.first.size - 1, -1, -1):
        _backwards(panels, factor, panel, x)


@kernel(types.void(PANELS, FACTOR, FLOATS))
def solve_again(panels, factor, x):  # type: ignore[no-untyped-def]
    """Solve A x = b in every lane, for two more right-hand sides, with a factor that `solve_lanes` left.

    Parameters
    ----------
    panels : Panels
    factor : Factor
    x : (2n or more, LANES) float64
        Row 2k + s holds entry k of right-hand side s; overwritten by the solution.
    """
    for panel in range(panels.first.size):
        _forwards(panels, factor, panel, x)
    for panel in range(panels.first.size - 1, -1, -1):
        _backwards(panels, factor, panel, x)
