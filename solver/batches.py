"""A batch of faces from mixing to energy, a face in each lane; nothing larger than a batch ever exists.

Each kernel is one line of the mathematics (eqs. 10–13, prop. 7). What is summed over faces is summed face by
face in order, so that results do not depend on which faces share a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from solver.assembly import SOURCE, TARGET, TENSOR, Systems
from solver.cholesky import FACTOR, FLOATS, INTEGERS, Factor, kernel, solve_lanes, types
from solver.lanes import (
    LANES,
    absolute,
    add,
    add_product,
    divide,
    empty_lanes,
    larger,
    load,
    load_four,
    multiply,
    splat,
    store,
    store_four,
    subtract,
    subtract_product,
    where_above,
)
from solver.mesh import FloatArray, IntArray

#: Groups of lanes that make a batch: A is assembled for all at once, and solved for one after the other.
GROUPS = 4


class Work(NamedTuple):
    """Arrays of lanes that a batch is worked out in; each thread has its own.

    Attributes
    ----------
    matrix : (GROUPS · 4 G, LANES)
        Entries of A in the order of the tensor's groups, for one group of lanes after the other.
    blended : (GROUPS · n, LANES)
        c̃, the groups of lanes side by side.
    forms : (GROUPS · n, LANES)
        Σ_s q_sᵀ Wⱼ q_s, likewise.
    means : (GROUPS · n, LANES)
        u = Uᵀc̃, one group of lanes after the other.
    right, x : (GROUPS · 2n, LANES)
        b and q likewise, the two directions side by side.
    diagonal : (n, LANES)
        Diagonal of A, doubled where a face is grounded.
    rest : (3n, LANES)
        Aq − b in both directions, and sums of the rows of |A|.
    weights : (GROUPS · 3 m, LANES)
        mean_f(β₀ᵢ), g_f1[i], g_f2[i] of each of at most m source functions that live on a group's faces.
    summary : (GROUPS · 3, LANES)
        Heaviest function, energy density, residual.
    """

    matrix: FloatArray
    blended: FloatArray
    forms: FloatArray
    means: FloatArray
    right: FloatArray
    x: FloatArray
    diagonal: FloatArray
    rest: FloatArray
    weights: FloatArray
    summary: FloatArray


class Slots(NamedTuple):
    """Which source functions live on the faces of a batch.

    Attributes
    ----------
    of : ndarray of int64, shape (n₀,)
        −1 between batches.
    active : ndarray of int64, shape (GROUPS · m,)
        Those of each group of lanes, ascending.
    counts : ndarray of int64, shape (GROUPS,)
        How many they are.
    """

    of: IntArray
    active: IntArray
    counts: IntArray


class Bench(NamedTuple):
    """One thread's room to work in."""

    work: Work
    factor: Factor
    slots: Slots


class Gradient(NamedTuple):
    """Sums over faces that the gradient is made of, for the source functions of a chunk of faces; or empty.

    Attributes
    ----------
    line : ndarray of int64, shape (n₀,), or (0,) if there is nothing to sum
        Row below of each source function that lives on the faces.
    area : ndarray of float64, shape (1, faces)
    slopes : ndarray of float64, shape (m, n)
        Σ_fs area₀ g_fs q_fsᵀ.
    forms : ndarray of float64, shape (m, n)
        Σ_f area₀ mean_f(β₀) (Σ_s q_fsᵀ Wⱼ q_fs)ⱼ.
    """

    line: IntArray
    area: FloatArray
    slopes: FloatArray
    forms: FloatArray


WORK = types.NamedUniTuple(FLOATS, len(Work._fields), Work)
SLOTS = types.NamedUniTuple(INTEGERS, len(Slots._fields), Slots)
BENCH = types.NamedTuple([WORK, FACTOR, SLOTS], Bench)
POTENTIAL = types.Array(types.float64, 3, "C")
GRADIENT = types.NamedTuple([INTEGERS, FLOATS, FLOATS, FLOATS], Gradient)

HEAVIEST, DENSITY, RESIDUAL = 0, 1, 2


def bench(systems: Systems) -> Bench:
    """Room for one thread to work on the systems of a soft map.

    Parameters
    ----------
    systems : Systems

    Returns
    -------
    Bench

    Raises
    ------
    MemoryError
        If there is no room.
    """
    target = systems.plan.target
    n = target.integrals.size
    active = min(len(systems.source.coefficients), LANES * systems.widest)
    return Bench(
        Work(
            matrix=empty_lanes(GROUPS * target.tensor.row.size),
            blended=empty_lanes(GROUPS * n),
            forms=empty_lanes(GROUPS * n),
            means=empty_lanes(GROUPS * n),
            right=empty_lanes(GROUPS * 2 * n),
            x=empty_lanes(GROUPS * 2 * n),
            diagonal=empty_lanes(n),
            rest=empty_lanes(3 * n),
            weights=empty_lanes(GROUPS * 3 * active),
            summary=empty_lanes(GROUPS * 3),
        ),
        Factor(empty_lanes(int(target.panels.start[-1])), empty_lanes(n), empty_lanes(2)),
        Slots(
            np.full(len(systems.source.coefficients), -1),
            np.empty(GROUPS * active, dtype=np.int64),
            np.zeros(GROUPS, dtype=np.int64),
        ),
    )


@kernel(types.int64(SOURCE, INTEGERS, types.int64, FLOATS, INTEGERS, INTEGERS))
def _gather(source, faces, first, weights, slot, active):  # type: ignore[no-untyped-def]
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


@kernel(types.void(SOURCE, FLOATS, types.float64, INTEGERS, FLOATS, WORK, types.int64))
def _mix(source, integrals, regularisation, active, weights, work, group):  # type: ignore[no-untyped-def]
    """c̃ = (1−ε) Cᵀ mean(β₀) + ε ∫β, u = (1−ε) (CU)ᵀ mean(β₀) + ε ∫β, b_s = (1−ε) (CU)ᵀ g_s, argmax c."""
    n = integrals.shape[1]
    keep = splat(1 - regularisation)
    heaviest, most = splat(0.0), splat(-1.0)
    for j in range(0, n, 2):
        c, u, b0, b1 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        d, v, e0, e1 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for k in range(active.size):
            mean, slope, slope1 = load(weights, 3 * k), load(weights, 3 * k + 1), load(weights, 3 * k + 2)
            row = source.coefficients[active[k]]
            c, d = add_product(splat(row[j]), mean, c), add_product(splat(row[j + 1]), mean, d)
            row = source.received[active[k]]
            weight = splat(row[j])
            u = add_product(weight, mean, u)
            b0, b1 = add_product(weight, slope, b0), add_product(weight, slope1, b1)
            weight = splat(row[j + 1])
            v = add_product(weight, mean, v)
            e0, e1 = add_product(weight, slope, e0), add_product(weight, slope1, e1)
        heaviest = where_above(c, most, splat(float(j)), heaviest)
        most = where_above(c, most, c, most)
        heaviest = where_above(d, most, splat(float(j + 1)), heaviest)
        most = where_above(d, most, d, most)
        row = group * n + j
        spread = splat(regularisation * integrals[0, j])
        store(work.blended, GROUPS * j + group, add_product(keep, c, spread))
        store(work.means, row, add_product(keep, u, spread))
        store(work.right, 2 * row, multiply(keep, b0))
        store(work.right, 2 * row + 1, multiply(keep, b1))
        spread = splat(regularisation * integrals[0, j + 1])
        store(work.blended, GROUPS * (j + 1) + group, add_product(keep, d, spread))
        store(work.means, row + 1, add_product(keep, v, spread))
        store(work.right, 2 * row + 2, multiply(keep, e0))
        store(work.right, 2 * row + 3, multiply(keep, e1))
    store(work.summary, 3 * group + HEAVIEST, heaviest)


@kernel(types.void(FLOATS, FLOATS))
def _project(means, right):  # type: ignore[no-untyped-def]
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
def _assemble(tensor, blended, matrix):  # type: ignore[no-untyped-def]
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
def _ground(summary, matrix, where, diagonal):  # type: ignore[no-untyped-def]
    """Diagonal of A, doubled at each face's heaviest function: exact, since 1ᵀb = 0."""
    for k in range(where.size):
        store(diagonal, k, load(matrix, where[k]))
    for lane in range(LANES):
        diagonal[int(summary[HEAVIEST, lane]), lane] *= 2


@kernel(types.void(FLOATS, FLOATS))
def _shift(means, x):  # type: ignore[no-untyped-def]
    """Shift q so that u · q = 0."""
    total, first, second = splat(0.0), splat(0.0), splat(0.0)
    for k in range(len(means)):
        u = load(means, k)
        total = add(total, u)
        first = add_product(u, load(x, 2 * k), first)
        second = add_product(u, load(x, 2 * k + 1), second)
    first, second = divide(first, total), divide(second, total)
    for k in range(len(means)):
        store(x, 2 * k, subtract(load(x, 2 * k), first))
        store(x, 2 * k + 1, subtract(load(x, 2 * k + 1), second))


@kernel(types.void(TENSOR, FLOATS, FLOATS, FLOATS, FLOATS, FLOATS))
def _measure(tensor, matrix, right, x, rest, summary):  # type: ignore[no-untyped-def]
    """Density Σ_s b_s · q_s, and residual ‖Aq−b‖∞ / (‖A‖∞‖q‖∞ + ‖b‖∞)."""
    zero = splat(0.0)
    n = len(right) // 2
    for row in range(n):
        store(rest, 3 * row, load(right, 2 * row))
        store(rest, 3 * row + 1, load(right, 2 * row + 1))
        store(rest, 3 * row + 2, zero)
    for k in range(tensor.row.size):
        row, column = tensor.row[k], tensor.column[k]
        entry = load(matrix, k)
        size = absolute(entry)
        at, other = 3 * row, 2 * column
        store(rest, at, subtract_product(entry, load(x, other), load(rest, at)))
        store(rest, at + 1, subtract_product(entry, load(x, other + 1), load(rest, at + 1)))
        store(rest, at + 2, add(size, load(rest, at + 2)))
        if row != column:
            at, other = 3 * column, 2 * row
            store(rest, at, subtract_product(entry, load(x, other), load(rest, at)))
            store(rest, at + 1, subtract_product(entry, load(x, other + 1), load(rest, at + 1)))
            store(rest, at + 2, add(size, load(rest, at + 2)))
    density, size = zero, zero
    q0, b0, off0 = zero, zero, zero
    q1, b1, off1 = zero, zero, zero
    for row in range(n):
        x0, x1 = load(x, 2 * row), load(x, 2 * row + 1)
        right0, right1 = load(right, 2 * row), load(right, 2 * row + 1)
        density = add_product(right1, x1, add_product(right0, x0, density))
        q0, q1 = larger(q0, absolute(x0)), larger(q1, absolute(x1))
        b0, b1 = larger(b0, absolute(right0)), larger(b1, absolute(right1))
        off0, off1 = (
            larger(off0, absolute(load(rest, 3 * row))),
            larger(off1, absolute(load(rest, 3 * row + 1))),
        )
        size = larger(size, load(rest, 3 * row + 2))
    scale0, scale1 = add_product(size, q0, b0), add_product(size, q1, b1)
    worst = where_above(scale0, zero, divide(off0, scale0), off0)
    worst = larger(worst, where_above(scale1, zero, divide(off1, scale1), off1))
    store(summary, DENSITY, density)
    store(summary, RESIDUAL, worst)


@kernel(types.void(TENSOR, FLOATS, FLOATS))
def _multiply(tensor, x, products):  # type: ignore[no-untyped-def]
    """Products Σ_s q_s[row] q_s[column] of every entry, doubled off the diagonal."""
    for entry in range(tensor.row.size):
        row, column = 2 * tensor.row[entry], 2 * tensor.column[entry]
        product = multiply(load(x, row), load(x, column))
        product = add_product(load(x, row + 1), load(x, column + 1), product)
        store(products, entry, product if row == column else add(product, product))


@kernel(types.void(TENSOR, FLOATS, FLOATS))
def _quadratic_forms(tensor, products, forms):  # type: ignore[no-untyped-def]
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
            row = 4 * function[k]
            f0, f1, f2, f3 = load_four(forms, row)
            entry = splat(value[k, 0])
            f0, f1 = add_product(entry, a0, f0), add_product(entry, a1, f1)
            f2, f3 = add_product(entry, a2, f2), add_product(entry, a3, f3)
            entry = splat(value[k, 1])
            f0, f1 = add_product(entry, b0, f0), add_product(entry, b1, f1)
            f2, f3 = add_product(entry, b2, f2), add_product(entry, b3, f3)
            entry = splat(value[k, 2])
            f0, f1 = add_product(entry, c0, f0), add_product(entry, c1, f1)
            f2, f3 = add_product(entry, c2, f2), add_product(entry, c3, f3)
            entry = splat(value[k, 3])
            f0, f1 = add_product(entry, d0, f0), add_product(entry, d1, f1)
            f2, f3 = add_product(entry, d2, f2), add_product(entry, d3, f3)
            store_four(forms, row, f0, f1, f2, f3)


@kernel(types.void(FLOATS, INTEGERS, FLOATS, FLOATS, types.int64, types.float64, GRADIENT))
def _accumulate(weights, active, x, forms, lane, area, gradient):  # type: ignore[no-untyped-def]
    """Add one face to the sums of the gradient; `forms` starts at the face's group of lanes."""
    n = gradient.slopes.shape[1]
    first, second, form = np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        first[k] = area * x[2 * k, lane]
        second[k] = area * x[2 * k + 1, lane]
        form[k] = area * forms[GROUPS * k, lane]
    for k in range(active.size):
        mean = weights[3 * k, lane]
        if mean == 0:  # a function of another face
            continue
        slope, slope1 = weights[3 * k + 1, lane], weights[3 * k + 2, lane]
        line = gradient.line[active[k]]
        slopes, sums = gradient.slopes[line], gradient.forms[line]
        for j in range(n):
            slopes[j] += slope * first[j] + slope1 * second[j]
            sums[j] += mean * form[j]


@kernel(types.void(FLOATS, FLOATS, FLOATS, types.int64, types.int64, FLOATS))
def _report(summary, failed, diagonal, first, count, results):  # type: ignore[no-untyped-def]
    """Density, residual, last dependent column or −1 and its relative pivot, a line for each face."""
    for lane in range(count):
        column = int(failed[0, lane])
        result = results[first + lane]
        result[0], result[1], result[2] = summary[DENSITY, lane], summary[RESIDUAL, lane], column
        result[3] = failed[1, lane]
        if column >= 0 and diagonal[column, lane] != 0:
            result[3] /= diagonal[column, lane]


@kernel(types.void(TARGET, SOURCE, BENCH, INTEGERS, types.float64, FLOATS, INTEGERS, POTENTIAL, GRADIENT))
def solve_faces(  # type: ignore[no-untyped-def]
    target, source, bench, faces, regularisation, results, order, potential, gradient
):
    """Solve the systems of some faces, batch by batch.

    Parameters
    ----------
    target : Target
    source : Source
    bench : Bench
    faces : (k,) int64
    regularisation : float
        ε.
    results : (k, 4) float64
        Filled with each face's density, its residual, a column that depends on others or −1, and its
        pivot relative to its diagonal entry.
    order : (n,) int64
        Column k of the factor is function ``order[k]``.
    potential : (k, 2, n) float64, or of size 0
        Filled with q.
    gradient : Gradient
        Sums to which the faces are added, or empty ones.
    """
    work, factor, slots = bench
    n, n_entries = target.integrals.size, target.tensor.row.size
    most = len(work.weights) // (3 * GROUPS)
    for begin in range(0, faces.size, GROUPS * LANES):
        for group in range(GROUPS):
            weights = work.weights[3 * most * group : 3 * most * (group + 1)]
            active = slots.active[most * group : most * (group + 1)]
            count = _gather(source, faces, begin + group * LANES, weights, slots.of, active)
            slots.counts[group] = count
            _mix(source, target.integrals, regularisation, active[:count], weights, work, group)
        _assemble(target.tensor, work.blended, work.matrix)
        for group in range(GROUPS):
            first = begin + group * LANES
            if first >= faces.size:
                break
            count = min(LANES, faces.size - first)
            matrix = work.matrix[group * n_entries : (group + 1) * n_entries]
            means = work.means[group * n : (group + 1) * n]
            right = work.right[group * 2 * n : (group + 1) * 2 * n]
            x = work.x[group * 2 * n : (group + 1) * 2 * n]
            summary = work.summary[3 * group : 3 * group + 3]
            _ground(summary, matrix, target.tensor.diagonal, work.diagonal)
            _project(means, right)
            for row in range(len(x)):
                store(x, row, load(right, row))
            solve_lanes(target.panels, target.entries, matrix, work.diagonal, factor, x)
            _shift(means, x)
            _measure(target.tensor, matrix, right, x, work.rest, summary)
            _report(summary, factor.failed, work.diagonal, first, count, results)
            if gradient.line.size > 0:
                _multiply(target.tensor, x, matrix)
            if potential.size > 0:
                for lane in range(count):
                    for j in range(order.size):
                        potential[first + lane, 0, order[j]] = x[2 * j, lane]
                        potential[first + lane, 1, order[j]] = x[2 * j + 1, lane]
        if gradient.line.size == 0:
            continue
        _quadratic_forms(target.tensor, work.matrix, work.forms)
        for k in range(begin, min(begin + GROUPS * LANES, faces.size)):
            group, lane = divmod(k - begin, LANES)
            weights = work.weights[3 * most * group : 3 * most * (group + 1)]
            active = slots.active[most * group : most * group + slots.counts[group]]
            x = work.x[group * 2 * n : (group + 1) * 2 * n]
            _accumulate(weights, active, x, work.forms[group:], lane, gradient.area[0, k], gradient)
