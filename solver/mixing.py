"""Mixing and assembling the systems of a batch of faces (eqs. 10–12), a face in each lane.

Each kernel is one line of the mathematics. With c̃_f = (1−ε) c_f + ε ∫β, A_f = Σⱼ c̃_fj Wⱼ and u_f = Uᵀ c̃_f.
"""

from __future__ import annotations

from solver.assembly import SOURCE, TENSOR
from solver.cholesky import FLOATS, INTEGERS, kernel, types
from solver.lanes import (
    LANES,
    add,
    add_product,
    divide,
    load,
    load_four,
    multiply,
    splat,
    store,
    store_four,
    subtract_product,
    where_above,
)

#: Groups of lanes that make a batch: A is assembled for all at once, and solved for one after the other.
GROUPS = 4
#: Row of a summary that holds each face's heaviest function.
HEAVIEST = 0


@kernel(types.int64(SOURCE, INTEGERS, types.int64, FLOATS, INTEGERS, INTEGERS))
def gather(source, faces, first, weights, slot, active):  # type: ignore[no-untyped-def]
    """Functions of some faces, ascending, with mean_f(β₀) and g_fs; the last face fills spare lanes."""
    count = 0
    for lane in range(LANES):
        face = faces[min(first + lane, faces.size - 1)]
        for corner in range(3 * face, 3 * face + 3):
            vertex = source.corner[corner]
            for k in range(source.start[vertex], source.start[vertex + 1]):
                function = source.function[k]
                if slot[function] < 0:
                    slot[function] = 0
                    place = count
                    while place > 0 and active[place - 1] > function:
                        active[place] = active[place - 1]
                        place -= 1
                    active[place] = function
                    count += 1
    for place in range(count):
        slot[active[place]] = place
    for row in range(3 * count):
        store(weights, row, splat(0.0))
    for lane in range(LANES):
        face = faces[min(first + lane, faces.size - 1)]
        for corner in range(3 * face, 3 * face + 3):
            vertex = source.corner[corner]
            for k in range(source.start[vertex], source.start[vertex + 1]):
                row, value = 3 * slot[source.function[k]], source.value[0, k]
                weights[row, lane] += value / 3
                weights[row + 1, lane] += value * source.slope[corner, 0]
                weights[row + 2, lane] += value * source.slope[corner, 1]
    for place in range(count):
        slot[active[place]] = -1
    return count


@kernel(
    types.void(SOURCE, FLOATS, types.float64, INTEGERS, FLOATS, types.int64, FLOATS, FLOATS, FLOATS, FLOATS)
)
def mix(source, integrals, regularisation, active, weights, group, blended, means, right, summary):  # type: ignore[no-untyped-def]
    """c̃ = (1−ε) Cᵀ mean(β₀) + ε ∫β, u = (1−ε) (CU)ᵀ mean(β₀) + ε ∫β, b_s = (1−ε) (CU)ᵀ g_s, argmax c."""
    n = integrals.shape[1]
    keep = splat(1 - regularisation)
    heaviest, most = splat(0.0), splat(-1.0)
    for j in range(0, n, 2):
        c, u, b0, b1 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        d, v, e0, e1 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for k in range(active.size):
            mean, slope, slope1 = load(weights, 3 * k), load(weights, 3 * k + 1), load(weights, 3 * k + 2)
            i = active[k]
            c = add_product(splat(source.coefficients[j, i]), mean, c)
            d = add_product(splat(source.coefficients[j + 1, i]), mean, d)
            weight = splat(source.received[j, i])
            u = add_product(weight, mean, u)
            b0, b1 = add_product(weight, slope, b0), add_product(weight, slope1, b1)
            weight = splat(source.received[j + 1, i])
            v = add_product(weight, mean, v)
            e0, e1 = add_product(weight, slope, e0), add_product(weight, slope1, e1)
        heaviest = where_above(c, most, splat(float(j)), heaviest)
        most = where_above(c, most, c, most)
        heaviest = where_above(d, most, splat(float(j + 1)), heaviest)
        most = where_above(d, most, d, most)
        spread = splat(regularisation * integrals[0, j])
        store(blended, GROUPS * j + group, add_product(keep, c, spread))
        store(means, j, add_product(keep, u, spread))
        store(right, 2 * j, multiply(keep, b0))
        store(right, 2 * j + 1, multiply(keep, b1))
        spread = splat(regularisation * integrals[0, j + 1])
        store(blended, GROUPS * (j + 1) + group, add_product(keep, d, spread))
        store(means, j + 1, add_product(keep, v, spread))
        store(right, 2 * j + 2, multiply(keep, e0))
        store(right, 2 * j + 3, multiply(keep, e1))
    store(summary, HEAVIEST, heaviest)


@kernel(types.void(FLOATS, FLOATS))
def project(means, right):  # type: ignore[no-untyped-def]
    """Make constants orthogonal to b: b ← b − (1ᵀb) u / (1ᵀu)."""
    total, first, second = splat(0.0), splat(0.0), splat(0.0)
    for k in range(len(means)):
        total = add(total, load(means, k))
        first = add(first, load(right, 2 * k))
        second = add(second, load(right, 2 * k + 1))
    first, second = divide(first, total), divide(second, total)
    for k in range(len(means)):
        u = load(means, k)
        store(right, 2 * k, subtract_product(u, first, load(right, 2 * k)))
        store(right, 2 * k + 1, subtract_product(u, second, load(right, 2 * k + 1)))


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
            row = 4 * function[k]
            w0, w1, w2, w3 = load_four(blended, row)
            entry = splat(value[k, 0])
            a0, a1 = add_product(entry, w0, a0), add_product(entry, w1, a1)
            a2, a3 = add_product(entry, w2, a2), add_product(entry, w3, a3)
            entry = splat(value[k, 1])
            b0, b1 = add_product(entry, w0, b0), add_product(entry, w1, b1)
            b2, b3 = add_product(entry, w2, b2), add_product(entry, w3, b3)
            entry = splat(value[k, 2])
            c0, c1 = add_product(entry, w0, c0), add_product(entry, w1, c1)
            c2, c3 = add_product(entry, w2, c2), add_product(entry, w3, c3)
            entry = splat(value[k, 3])
            d0, d1 = add_product(entry, w0, d0), add_product(entry, w1, d1)
            d2, d3 = add_product(entry, w2, d2), add_product(entry, w3, d3)
        row = 4 * group
        store_four(matrix, row, a0, b0, c0, d0)
        store_four(matrix, row + n, a1, b1, c1, d1)
        store_four(matrix, row + 2 * n, a2, b2, c2, d2)
        store_four(matrix, row + 3 * n, a3, b3, c3, d3)


@kernel(types.void(FLOATS, FLOATS, INTEGERS, FLOATS))
def ground(summary, matrix, where, diagonal):  # type: ignore[no-untyped-def]
    """Diagonal of A, doubled at each face's heaviest function: exact, since 1ᵀb = 0."""
    for k in range(where.size):
        store(diagonal, k, load(matrix, where[k]))
    for lane in range(LANES):
        diagonal[int(summary[HEAVIEST, lane]), lane] *= 2
