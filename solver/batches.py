"""A batch of faces from mixing to energy, a face in each lane; nothing larger than a batch ever exists.

Each kernel is one line of the mathematics (eqs. 10–13, prop. 7). What is summed over faces is summed face by
face in order, so that results do not depend on which faces share a batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from solver.assembly import SOURCE, TARGET, Systems
from solver.cholesky import FACTOR, FLOATS, INTEGERS, Factor, kernel, solve_lanes, types
from solver.forms import (
    DENSITY,
    FIRST,
    HEAVIEST,
    RESIDUAL,
    SECOND,
    SUMMARY,
    assemble,
    measure,
    pair_products,
    quadratic_forms,
)
from solver.lanes import (
    LANES,
    add,
    add_product,
    divide,
    empty_lanes,
    item,
    load,
    load_splat,
    multiply,
    splat,
    store,
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
    weights : (GROUPS · 3 m, LANES)
        mean_f(β₀ᵢ), g_f1[i], g_f2[i] of each of at most m source functions that live on a group's faces.
    summary : (GROUPS · SUMMARY, LANES)
        What is known of each group's faces, as `solver.forms` lists it.
    """

    matrix: FloatArray
    blended: FloatArray
    forms: FloatArray
    means: FloatArray
    right: FloatArray
    x: FloatArray
    diagonal: FloatArray
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
            weights=empty_lanes(GROUPS * 3 * active),
            summary=empty_lanes(GROUPS * SUMMARY),
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
    """c̃ = (1−ε) Cᵀ mean(β₀) + ε ∫β and argmax c, u = (1−ε) (CU)ᵀ mean(β₀) + ε ∫β, b_s = (1−ε) (CU)ᵀ g_s."""
    n = integrals.shape[1]
    keep = splat(1 - regularisation)
    heaviest, most = splat(0.0), splat(-1.0)
    total, first, second = splat(0.0), splat(0.0), splat(0.0)
    for j in range(0, n, 2):
        c, u, b0, b1 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        d, v, e0, e1 = splat(0.0), splat(0.0), splat(0.0), splat(0.0)
        for k in range(active.size):
            mean, slope, slope1 = load(weights, 3 * k), load(weights, 3 * k + 1), load(weights, 3 * k + 2)
            at = item(active, k) * n + j
            c = add_product(load_splat(source.coefficients, at), mean, c)
            d = add_product(load_splat(source.coefficients, at + 1), mean, d)
            weight = load_splat(source.received, at)
            u = add_product(weight, mean, u)
            b0, b1 = add_product(weight, slope, b0), add_product(weight, slope1, b1)
            weight = load_splat(source.received, at + 1)
            v = add_product(weight, mean, v)
            e0, e1 = add_product(weight, slope, e0), add_product(weight, slope1, e1)
        heaviest = where_above(c, most, splat(float(j)), heaviest)
        most = where_above(c, most, c, most)
        heaviest = where_above(d, most, splat(float(j + 1)), heaviest)
        most = where_above(d, most, d, most)
        row = group * n + j
        spread = multiply(splat(regularisation), load_splat(integrals, j))
        u, b0, b1 = add_product(keep, u, spread), multiply(keep, b0), multiply(keep, b1)
        store(work.blended, GROUPS * j + group, add_product(keep, c, spread))
        store(work.means, row, u)
        store(work.right, 2 * row, b0)
        store(work.right, 2 * row + 1, b1)
        spread = multiply(splat(regularisation), load_splat(integrals, j + 1))
        v, e0, e1 = add_product(keep, v, spread), multiply(keep, e0), multiply(keep, e1)
        store(work.blended, GROUPS * (j + 1) + group, add_product(keep, d, spread))
        store(work.means, row + 1, v)
        store(work.right, 2 * row + 2, e0)
        store(work.right, 2 * row + 3, e1)
        total, first, second = add(add(total, u), v), add(add(first, b0), e0), add(add(second, b1), e1)
    store(work.summary, SUMMARY * group + HEAVIEST, heaviest)
    store(work.summary, SUMMARY * group + FIRST, divide(first, total))
    store(work.summary, SUMMARY * group + SECOND, divide(second, total))


@kernel(types.void(FLOATS, FLOATS, FLOATS, FLOATS))
def _project(summary, means, right, x):  # type: ignore[no-untyped-def]
    """Make constants orthogonal to b, b ← b − (1ᵀb) u / (1ᵀu), and put it where q will be."""
    # Twice: where rows agree, b is u times a rounding error, and once leaves it no more orthogonal.
    first, second = load(summary, FIRST), load(summary, SECOND)
    total, third, fourth = splat(0.0), splat(0.0), splat(0.0)
    for k in range(len(means)):
        u = load(means, k)
        total, third = add(total, u), add(third, subtract_product(u, first, load(right, 2 * k)))
        fourth = add(fourth, subtract_product(u, second, load(right, 2 * k + 1)))
    third, fourth = divide(third, total), divide(fourth, total)
    for k in range(len(means)):
        u = load(means, k)
        b0 = subtract_product(u, third, subtract_product(u, first, load(right, 2 * k)))
        b1 = subtract_product(u, fourth, subtract_product(u, second, load(right, 2 * k + 1)))
        store(right, 2 * k, b0)
        store(right, 2 * k + 1, b1)
        store(x, 2 * k, b0)
        store(x, 2 * k + 1, b1)


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
        assemble(target.tensor, work.blended, work.matrix)
        for group in range(GROUPS):
            first = begin + group * LANES
            if first >= faces.size:
                break
            count = min(LANES, faces.size - first)
            matrix = work.matrix[group * n_entries : (group + 1) * n_entries]
            means = work.means[group * n : (group + 1) * n]
            right = work.right[group * 2 * n : (group + 1) * 2 * n]
            x = work.x[group * 2 * n : (group + 1) * 2 * n]
            summary = work.summary[SUMMARY * group : SUMMARY * (group + 1)]
            _ground(summary, matrix, target.tensor.diagonal, work.diagonal)
            _project(summary, means, right, x)
            solve_lanes(target.panels, target.entries, matrix, work.diagonal, factor, x)
            _shift(means, x)
            measure(target.rows, matrix, right, x, summary)
            _report(summary, factor.failed, work.diagonal, first, count, results)
            if gradient.line.size > 0:
                pair_products(target.tensor, x, matrix)
            if potential.size > 0:
                for lane in range(count):
                    for j in range(order.size):
                        potential[first + lane, 0, order[j]] = x[2 * j, lane]
                        potential[first + lane, 1, order[j]] = x[2 * j + 1, lane]
        if gradient.line.size == 0:
            continue
        quadratic_forms(target.tensor, work.matrix, work.forms)
        for k in range(begin, min(begin + GROUPS * LANES, faces.size)):
            group, lane = divmod(k - begin, LANES)
            weights = work.weights[3 * most * group : 3 * most * (group + 1)]
            active = slots.active[most * group : most * group + slots.counts[group]]
            x = work.x[group * 2 * n : (group + 1) * 2 * n]
            _accumulate(weights, active, x, work.forms[group:], lane, gradient.area[0, k], gradient)
