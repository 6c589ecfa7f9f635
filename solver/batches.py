"""A batch of faces from mixing to energy, a face in each lane; nothing larger than a batch ever exists.

Each kernel is one line of the mathematics (eqs. 10–13, prop. 7). What is summed over faces is summed face by
face in order, so that results do not depend on which faces share a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from solver.assembly import SOURCE, TARGET, Systems
from solver.cholesky import FACTOR, FLOATS, INTEGERS, Factor, factor_lanes, kernel, solve_lanes, types
from solver.lanes import (
    LANES,
    absolute,
    add,
    add_product,
    divide,
    empty_lanes,
    larger,
    load,
    multiply,
    splat,
    store,
    subtract_product,
    where_above,
)
from solver.mesh import FloatArray, IntArray


class Work(NamedTuple):
    """Arrays of lanes that a batch is worked out in; each thread has its own.

    Attributes
    ----------
    matrix : (4 G, LANES)
        Entries of A, in the order of the tensor's groups.
    diagonal : (n, LANES)
        Diagonal of A, doubled where a face is grounded.
    blended, means : (n, LANES)
        c̃ and u = Uᵀc̃.
    right, x : (2n, LANES)
        b and q, the two directions side by side.
    forms : (n, LANES)
        Σ_s q_sᵀ Wⱼ q_s.
    weights : (3 m, LANES)
        Mean and slopes of each of the m functions that live on the batch's faces.
    summary : (3, LANES)
        Heaviest function, energy density, residual.
    """

    matrix: FloatArray
    diagonal: FloatArray
    blended: FloatArray
    means: FloatArray
    right: FloatArray
    x: FloatArray
    forms: FloatArray
    weights: FloatArray
    summary: FloatArray


class Slots(NamedTuple):
    """Which source functions live on the faces of a batch.

    Attributes
    ----------
    of : ndarray of int64, shape (n₀,)
        −1 between batches.
    active : ndarray of int64, shape (m,)
    """

    of: IntArray
    active: IntArray


class Bench(NamedTuple):
    """One thread's room to work in."""

    work: Work
    factor: Factor
    slots: Slots


class Gradient(NamedTuple):
    """Sums over faces that the gradient is made of, for the source functions of a chunk of faces; or empty.

    Attributes
    ----------
    line : ndarray of int64, shape (nnz of the chunk,)
        Row below of each function on each face.
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
    sizes = Work(target.tensor.row.size, n, n, n, 2 * n, 2 * n, n, 3 * active, 3)  # type: ignore[arg-type]
    return Bench(
        Work(*(empty_lanes(size) for size in sizes)),  # type: ignore[arg-type]
        Factor(empty_lanes(int(target.panels.start[-1])), empty_lanes(n), empty_lanes(2)),
        Slots(np.full(len(systems.source.coefficients), -1), np.empty(active, dtype=np.int64)),
    )


@kernel(types.int64(SOURCE, INTEGERS, types.int64, FLOATS, SLOTS))
def _gather(source, faces, first, weights, slots):  # type: ignore[no-untyped-def]
    """Functions of a batch of faces, ascending, and their weights; the last face fills spare lanes."""
    count, active = 0, slots.active
    for lane in range(LANES):
        face = faces[min(first + lane, faces.size - 1)]
        for k in range(source.start[face], source.start[face + 1]):
            function = source.function[k]
            if slots.of[function] < 0:
                slots.of[function] = 0
                slot = count
                while slot > 0 and active[slot - 1] > function:
                    active[slot] = active[slot - 1]
                    slot -= 1
                active[slot] = function
                count += 1
    for slot in range(count):
        slots.of[active[slot]] = slot
    for row in range(3 * count):
        store(weights, row, splat(0.0))
    for lane in range(LANES):
        face = faces[min(first + lane, faces.size - 1)]
        for k in range(source.start[face], source.start[face + 1]):
            row = 3 * slots.of[source.function[k]]
            for s in range(3):
                weights[row + s, lane] = source.slope[k, s]
    for slot in range(count):
        slots.of[active[slot]] = -1
    return count


@kernel(types.void(SOURCE, FLOATS, types.float64, types.int64, INTEGERS, WORK))
def _mix(source, integrals, regularisation, count, active, work):  # type: ignore[no-untyped-def]
    """c̃ = (1−ε) Cᵀ mean(β₀) + ε ∫β, u = (1−ε) (CU)ᵀ mean(β₀) + ε ∫β, b_s = (1−ε) (CU)ᵀ g_s, argmax c."""
    keep = splat(1 - regularisation)
    heaviest, most = splat(0.0), splat(-1.0)
    for j in range(integrals.shape[1]):
        c, u, b0, b1 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for k in range(count):
            mean = load(work.weights, 3 * k)
            received = splat(source.received[active[k], j])
            c = add_product(splat(source.coefficients[active[k], j]), mean, c)
            u = add_product(received, mean, u)
            b0 = add_product(received, load(work.weights, 3 * k + 1), b0)
            b1 = add_product(received, load(work.weights, 3 * k + 2), b1)
        heaviest = where_above(c, most, splat(float(j)), heaviest)
        most = where_above(c, most, c, most)
        spread = splat(regularisation * integrals[0, j])
        store(work.blended, j, add_product(keep, c, spread))
        store(work.means, j, add_product(keep, u, spread))
        store(work.right, 2 * j, multiply(keep, b0))
        store(work.right, 2 * j + 1, multiply(keep, b1))
    store(work.summary, HEAVIEST, heaviest)


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


@kernel(types.void(TARGET, WORK))
def _assemble(target, work):  # type: ignore[no-untyped-def]
    """A = Σⱼ c̃ⱼ Wⱼ, its diagonal doubled at the heaviest function."""
    start, function, value, _, _ = target.tensor
    for group in range(start.size - 1):
        a, b, c, d = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for k in range(start[group], start[group + 1]):
            weight = load(work.blended, function[k])
            a = add_product(splat(value[k, 0]), weight, a)
            b = add_product(splat(value[k, 1]), weight, b)
            c = add_product(splat(value[k, 2]), weight, c)
            d = add_product(splat(value[k, 3]), weight, d)
        store(work.matrix, 4 * group, a)
        store(work.matrix, 4 * group + 1, b)
        store(work.matrix, 4 * group + 2, c)
        store(work.matrix, 4 * group + 3, d)
    for k in range(len(work.diagonal)):
        store(work.diagonal, k, load(work.matrix, target.neighbours.diagonal[k]))
    for lane in range(LANES):
        work.diagonal[int(work.summary[HEAVIEST, lane]), lane] *= 2


@kernel(types.void(TARGET, WORK))
def _measure(target, work):  # type: ignore[no-untyped-def]
    """Shift q so that u · q = 0; density Σ_s b_s · q_s and residual ‖Aq−b‖∞ / (‖A‖∞‖q‖∞ + ‖b‖∞)."""
    total, first, second = splat(0.0), splat(0.0), splat(0.0)
    for k in range(len(work.means)):
        u = load(work.means, k)
        total = add(total, u)
        first = add_product(u, load(work.x, 2 * k), first)
        second = add_product(u, load(work.x, 2 * k + 1), second)
    first, second = divide(first, total), divide(second, total)
    one = splat(1.0)
    for k in range(len(work.means)):
        store(work.x, 2 * k, subtract_product(one, first, load(work.x, 2 * k)))
        store(work.x, 2 * k + 1, subtract_product(one, second, load(work.x, 2 * k + 1)))
    density, size, worst = splat(0.0), splat(0.0), splat(0.0)
    q, b, off = splat(0.0), splat(0.0), splat(0.0)
    q1, b1, off1 = splat(0.0), splat(0.0), splat(0.0)
    near = target.neighbours
    for row in range(len(work.means)):
        right, right1 = load(work.right, 2 * row), load(work.right, 2 * row + 1)
        x, x1 = load(work.x, 2 * row), load(work.x, 2 * row + 1)
        density = add_product(right1, x1, add_product(right, x, density))
        q, q1 = larger(q, absolute(x)), larger(q1, absolute(x1))
        b, b1 = larger(b, absolute(right)), larger(b1, absolute(right1))
        line = splat(0.0)
        for k in range(near.start[row], near.start[row + 1]):
            entry = load(work.matrix, near.entry[k])
            column = 2 * near.column[k]
            right = subtract_product(entry, load(work.x, column), right)
            right1 = subtract_product(entry, load(work.x, column + 1), right1)
            line = add(line, absolute(entry))
        size = larger(size, line)
        off, off1 = larger(off, absolute(right)), larger(off1, absolute(right1))
    scale, scale1 = add_product(size, q, b), add_product(size, q1, b1)
    zero = splat(0.0)
    worst = where_above(scale, zero, divide(off, scale), off)
    worst = larger(worst, where_above(scale1, zero, divide(off1, scale1), off1))
    store(work.summary, DENSITY, density)
    store(work.summary, RESIDUAL, worst)


@kernel(types.void(TARGET, WORK))
def _quadratic_forms(target, work):  # type: ignore[no-untyped-def]
    """Σ_s q_sᵀ Wⱼ q_s for every j: the transpose of the assembly, applied to products of q."""
    start, function, value, rows, columns = target.tensor
    for entry in range(rows.size):
        row, column = 2 * rows[entry], 2 * columns[entry]
        product = multiply(load(work.x, row), load(work.x, column))
        product = add_product(load(work.x, row + 1), load(work.x, column + 1), product)
        store(work.matrix, entry, product if row == column else add(product, product))
    for j in range(len(work.forms)):
        store(work.forms, j, splat(0.0))
    for group in range(start.size - 1):
        a, b = load(work.matrix, 4 * group), load(work.matrix, 4 * group + 1)
        c, d = load(work.matrix, 4 * group + 2), load(work.matrix, 4 * group + 3)
        for k in range(start[group], start[group + 1]):
            form = load(work.forms, function[k])
            form = add_product(splat(value[k, 0]), a, form)
            form = add_product(splat(value[k, 1]), b, form)
            form = add_product(splat(value[k, 2]), c, form)
            form = add_product(splat(value[k, 3]), d, form)
            store(work.forms, function[k], form)


@kernel(types.void(SOURCE, WORK, types.int64, types.int64, types.int64, types.float64, GRADIENT))
def _accumulate(source, work, lane, face, at, area, gradient):  # type: ignore[no-untyped-def]
    """Add one face to the sums of the gradient."""
    n = len(work.forms)
    first, second, form = np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        first[k] = area * work.x[2 * k, lane]
        second[k] = area * work.x[2 * k + 1, lane]
        form[k] = area * work.forms[k, lane]
    for k in range(source.start[face], source.start[face + 1]):
        line = gradient.line[at + k - source.start[face]]
        mean, slope, slope1 = source.slope[k, 0], source.slope[k, 1], source.slope[k, 2]
        slopes, forms = gradient.slopes[line], gradient.forms[line]
        for j in range(n):
            slopes[j] += slope * first[j] + slope1 * second[j]
            forms[j] += mean * form[j]


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
    at = 0
    work, factor, slots = bench
    for first in range(0, faces.size, LANES):
        count = _gather(source, faces, first, work.weights, slots)
        _mix(source, target.integrals, regularisation, count, slots.active, work)
        _project(work.means, work.right)
        _assemble(target, work)
        factor_lanes(target.panels, target.entries, work.matrix, work.diagonal, factor)
        for row in range(len(work.x)):
            store(work.x, row, load(work.right, row))
        solve_lanes(target.panels, factor, work.x)
        _measure(target, work)
        if gradient.line.size > 0:
            _quadratic_forms(target, work)
        for lane in range(min(LANES, faces.size - first)):
            k = first + lane
            column = int(factor.failed[0, lane])
            results[k, 0] = work.summary[DENSITY, lane]
            results[k, 1] = work.summary[RESIDUAL, lane]
            results[k, 2] = column
            results[k, 3] = factor.failed[1, lane]
            if column >= 0 and work.diagonal[column, lane] != 0:
                results[k, 3] /= work.diagonal[column, lane]
            if potential.size > 0:
                for j in range(order.size):
                    potential[k, 0, order[j]] = work.x[2 * j, lane]
                    potential[k, 1, order[j]] = work.x[2 * j + 1, lane]
            if gradient.line.size > 0:
                _accumulate(source, work, lane, faces[k], at, gradient.area[0, k], gradient)
                at += source.start[faces[k] + 1] - source.start[faces[k]]
