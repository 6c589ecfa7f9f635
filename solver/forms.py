"""What the tensor W does lane by lane: A = Σⱼ c̃ⱼ Wⱼ, how well A q = b holds, and the forms qᵀ Wⱼ q.

For `solver.batches`, which says what each array of lanes holds.
"""

from __future__ import annotations

from solver.assembly import ROWS, TENSOR
from solver.cholesky import FLOATS, kernel, types
from solver.lanes import (
    absolute,
    add,
    add_product,
    divide,
    item,
    larger,
    load,
    load_four,
    load_splat,
    multiply,
    splat,
    store,
    store_four,
    subtract_product,
    where_above,
)

#: Rows of a batch's summary: each face's heaviest function, density, residual, and 1ᵀb_s / 1ᵀu.
HEAVIEST, DENSITY, RESIDUAL, FIRST, SECOND = range(5)
SUMMARY = 5


@kernel(types.void(TENSOR, FLOATS, FLOATS))
def assemble(tensor, blended, matrix):  # type: ignore[no-untyped-def]
    """A = Σⱼ c̃ⱼ Wⱼ for all four groups of lanes, so that W is read once for them."""
    start, function, value, rows = tensor.start, tensor.function, tensor.value, tensor.row
    n = rows.size
    for group in range(start.size - 1):
        a0, a1, a2, a3 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        b0, b1, b2, b3 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        c0, c1, c2, c3 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        d0, d1, d2, d3 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for k in range(start[group], start[group + 1]):
            row = 4 * item(function, k)
            w0, w1, w2, w3 = load_four(blended, row)
            entry = load_splat(value, 4 * k)
            a0, a1 = add_product(entry, w0, a0), add_product(entry, w1, a1)
            a2, a3 = add_product(entry, w2, a2), add_product(entry, w3, a3)
            entry = load_splat(value, 4 * k + 1)
            b0, b1 = add_product(entry, w0, b0), add_product(entry, w1, b1)
            b2, b3 = add_product(entry, w2, b2), add_product(entry, w3, b3)
            entry = load_splat(value, 4 * k + 2)
            c0, c1 = add_product(entry, w0, c0), add_product(entry, w1, c1)
            c2, c3 = add_product(entry, w2, c2), add_product(entry, w3, c3)
            entry = load_splat(value, 4 * k + 3)
            d0, d1 = add_product(entry, w0, d0), add_product(entry, w1, d1)
            d2, d3 = add_product(entry, w2, d2), add_product(entry, w3, d3)
        row = 4 * group
        store_four(matrix, row, a0, b0, c0, d0)
        store_four(matrix, row + n, a1, b1, c1, d1)
        store_four(matrix, row + 2 * n, a2, b2, c2, d2)
        store_four(matrix, row + 3 * n, a3, b3, c3, d3)


@kernel(types.void(ROWS, FLOATS, FLOATS, FLOATS, FLOATS))
def measure(rows, matrix, right, x, summary):  # type: ignore[no-untyped-def]
    """Density Σ_s b_s · q_s, and residual ‖Aq−b‖∞ / (‖A‖∞‖q‖∞ + ‖b‖∞)."""
    zero = splat(0.0)
    density, size = zero, zero
    q0, b0, off0 = zero, zero, zero
    q1, b1, off1 = zero, zero, zero
    for row in range(rows.start.size - 1):
        right0, right1 = load(right, 2 * row), load(right, 2 * row + 1)
        rest0, rest1, absolutes = right0, right1, zero
        for k in range(rows.start[row], rows.start[row + 1]):
            entry, other = load(matrix, item(rows.entry, k)), 2 * item(rows.column, k)
            rest0 = subtract_product(entry, load(x, other), rest0)
            rest1 = subtract_product(entry, load(x, other + 1), rest1)
            absolutes = add(absolute(entry), absolutes)
        x0, x1 = load(x, 2 * row), load(x, 2 * row + 1)
        density = add_product(right1, x1, add_product(right0, x0, density))
        q0, q1 = larger(q0, absolute(x0)), larger(q1, absolute(x1))
        b0, b1 = larger(b0, absolute(right0)), larger(b1, absolute(right1))
        off0, off1 = larger(off0, absolute(rest0)), larger(off1, absolute(rest1))
        size = larger(size, absolutes)
    scale0, scale1 = add_product(size, q0, b0), add_product(size, q1, b1)
    worst = where_above(scale0, zero, divide(off0, scale0), off0)
    worst = larger(worst, where_above(scale1, zero, divide(off1, scale1), off1))
    store(summary, DENSITY, density)
    store(summary, RESIDUAL, worst)


@kernel(types.void(TENSOR, FLOATS, FLOATS))
def pair_products(tensor, x, products):  # type: ignore[no-untyped-def]
    """Products Σ_s q_s[row] q_s[column] of every entry, doubled off the diagonal."""
    for entry in range(tensor.row.size):
        row, column = 2 * item(tensor.row, entry), 2 * item(tensor.column, entry)
        product = multiply(load(x, row), load(x, column))
        product = add_product(load(x, row + 1), load(x, column + 1), product)
        store(products, entry, product if row == column else add(product, product))


@kernel(types.void(TENSOR, FLOATS, FLOATS))
def quadratic_forms(tensor, products, forms):  # type: ignore[no-untyped-def]
    """Σ_s q_sᵀ Wⱼ q_s for every j: the transpose of the assembly, for all four groups of lanes."""
    start, function, value, rows = tensor.start, tensor.function, tensor.value, tensor.row
    n = rows.size
    for row in range(len(forms)):
        store(forms, row, splat(0.0))
    for group in range(start.size - 1):
        row = 4 * group
        a0, b0, c0, d0 = load_four(products, row)
        a1, b1, c1, d1 = load_four(products, row + n)
        a2, b2, c2, d2 = load_four(products, row + 2 * n)
        a3, b3, c3, d3 = load_four(products, row + 3 * n)
        for k in range(start[group], start[group + 1]):
            row = 4 * item(function, k)
            f0, f1, f2, f3 = load_four(forms, row)
            entry = load_splat(value, 4 * k)
            f0, f1 = add_product(entry, a0, f0), add_product(entry, a1, f1)
            f2, f3 = add_product(entry, a2, f2), add_product(entry, a3, f3)
            entry = load_splat(value, 4 * k + 1)
            f0, f1 = add_product(entry, b0, f0), add_product(entry, b1, f1)
            f2, f3 = add_product(entry, b2, f2), add_product(entry, b3, f3)
            entry = load_splat(value, 4 * k + 2)
            f0, f1 = add_product(entry, c0, f0), add_product(entry, c1, f1)
            f2, f3 = add_product(entry, c2, f2), add_product(entry, c3, f3)
            entry = load_splat(value, 4 * k + 3)
            f0, f1 = add_product(entry, d0, f0), add_product(entry, d1, f1)
            f2, f3 = add_product(entry, d2, f2), add_product(entry, d3, f3)
            store_four(forms, row, f0, f1, f2, f3)
