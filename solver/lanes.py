"""Several faces side by side in one register: a numba type for a vector of float64, and its arithmetic.

All systems A_f share one sparsity pattern, so the same instruction serves ``LANES`` faces at once. An array
of lanes is a float64 array of shape (m, LANES): row k holds entry k of every face. Left to itself LLVM keeps
sums of such rows in memory; with a vector type of its own they stay in registers, where a Cholesky
factorisation runs at the speed of the machine. Nothing here is fast-math: a NaN stays a NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import extending
from numba.core import types
from numba.core.registry import cpu_target
from numba.extending import models, register_model

from solver.mesh import FloatArray

#: Numba's decorator gives what only compiled code can call.
intrinsic: Any = extending.intrinsic

_WIDE = "+avx512f" in cpu_target.target_context.codegen().magic_tuple()[2]

#: Faces side by side: as many float64 as one vector register of this machine's compiler target holds.
LANES = 8 if _WIDE else 4
#: Rows and columns of a tile whose sums stay in registers: 24 of the 32 that AVX-512 has, 8 of 16 elsewhere.
TILE_ROWS, TILE_COLUMNS = (6, 4) if _WIDE else (4, 2)
#: Columns that are factored at once, and rows of a tile of that width.
STRIP = 4
STRIP_ROWS = 6 if _WIDE else 2

_VECTOR = ir.VectorType(ir.DoubleType(), LANES)
_INT64 = ir.IntType(64)
_BYTES = 8 * LANES


class Lanes(types.Type):
    """The numba type of one entry of ``LANES`` faces."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes({LANES})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    """A vector register."""

    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)  # type: ignore[no-untyped-call]


lanes = Lanes()


def empty_lanes(size: int) -> FloatArray:
    """Uninitialised array of lanes whose rows do not straddle cache lines, float64 (size, LANES).

    Parameters
    ----------
    size : int
        Number of rows.

    Returns
    -------
    ndarray of float64, shape (size, LANES)

    Raises
    ------
    MemoryError
        If there is no room.
    """
    raw = np.empty(size * LANES + LANES)
    start = -(raw.ctypes.data // 8) % LANES
    return raw[start : start + size * LANES].reshape(size, LANES)


def _rows(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Pointer to the first row of an array of lanes."""
    return builder.bitcast(context.make_array(kind)(context, builder, array).data, _VECTOR.as_pointer())


def _row(builder: Any, rows: Any, index: Any) -> Any:
    return builder.gep(rows, [index], inbounds=True)


def _instruction(builder: Any, name: str, args: list[Any]) -> Any:
    """Call the LLVM intrinsic of that name for vectors."""
    full = f"llvm.{name}.v{LANES}f64"
    function = builder.module.globals.get(full)
    if function is None:
        function = ir.Function(builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * len(args)), full)
    return builder.call(function, args)


def _fused(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Emit a·b + c, rounded once where the machine can."""
    return _instruction(builder, "fmuladd", [a, b, c])


def _splat(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.IntType(32)(0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, zeros)


@intrinsic
def load(_: Any, array: Any, index: Any) -> Any:
    """Row `index` of an array of lanes."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = _rows(context, builder, signature.args[0], args[0])
        return builder.load(_row(builder, rows, args[1]), align=8)

    return lanes(array, types.int64), emit


@intrinsic
def store(_: Any, array: Any, index: Any, value: Any) -> Any:
    """Set row `index` of an array of lanes."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = _rows(context, builder, signature.args[0], args[0])
        builder.store(args[2], _row(builder, rows, args[1]), align=8)
        return context.get_dummy_value()

    return types.void(array, types.int64, lanes), emit


@intrinsic
def load_four(_: Any, array: Any, index: Any) -> Any:
    """Four rows of an array of lanes from `index` on."""
    kind = types.UniTuple(lanes, 4)  # type: ignore[no-untyped-call]

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = _rows(context, builder, signature.args[0], args[0])
        places = [_row(builder, rows, builder.add(args[1], _INT64(k))) for k in range(4)]
        return context.make_tuple(builder, kind, [builder.load(place, align=8) for place in places])

    return kind(array, types.int64), emit


@intrinsic
def store_four(_: Any, array: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Set four rows of an array of lanes from `index` on."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        rows = _rows(context, builder, signature.args[0], args[0])
        for k in range(4):
            builder.store(args[2 + k], _row(builder, rows, builder.add(args[1], _INT64(k))), align=8)
        return context.get_dummy_value()

    return types.void(array, types.int64, *[lanes] * 4), emit


@intrinsic
def item(_: Any, array: Any, index: Any) -> Any:
    """Item `index` ≥ 0 of an array of integers, without Python's rule for negative ones."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        numbers = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.load(_row(builder, numbers, args[1]))

    return types.int64(array, types.int64), emit


@intrinsic
def load_splat(_: Any, array: Any, index: Any) -> Any:
    """Number `index` of a C-contiguous array, counted through its rows, in every lane."""

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        numbers = context.make_array(signature.args[0])(context, builder, args[0]).data
        return _splat(builder, builder.load(_row(builder, numbers, args[1])))

    return lanes(array, types.int64), emit


@intrinsic
def splat(_: Any, scalar: Any) -> Any:
    """One number in every lane."""

    def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return lanes(types.float64), emit


def _elementwise(arity: int, build: Callable[..., Any]) -> Any:
    """Intrinsic on lanes from what it emits for its arguments."""

    def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return build(builder, *args)

    if arity == 1:
        return intrinsic(lambda _, a: (lanes(lanes), emit))
    if arity == 2:
        return intrinsic(lambda _, a, b: (lanes(lanes, lanes), emit))
    return intrinsic(lambda _, a, b, c: (lanes(lanes, lanes, lanes), emit))


def _larger(builder: Any, a: Any, b: Any) -> Any:
    """Emit max(a, b) in which a NaN of either wins."""
    b_wins = builder.or_(builder.fcmp_ordered("<", a, b), builder.fcmp_unordered("uno", b, b))
    return builder.select(b_wins, b, a)


#: a + b, a − b, a · b, a / b of lanes.
add = _elementwise(2, lambda builder, a, b: builder.fadd(a, b))
subtract = _elementwise(2, lambda builder, a, b: builder.fsub(a, b))
multiply = _elementwise(2, lambda builder, a, b: builder.fmul(a, b))
divide = _elementwise(2, lambda builder, a, b: builder.fdiv(a, b))
#: a · b + c and c − a · b, fused.
add_product = _elementwise(3, _fused)
subtract_product = _elementwise(3, lambda builder, a, b, c: _fused(builder, builder.fneg(a), b, c))
#: max(a, b), NaN if either is.
larger = _elementwise(2, _larger)
#: √a and |a|.
square_root = _elementwise(1, lambda builder, a: _instruction(builder, "sqrt", [a]))
absolute = _elementwise(1, lambda builder, a: _instruction(builder, "fabs", [a]))


@intrinsic
def where_above(_: Any, a: Any, limit: Any, then: Any, otherwise: Any) -> Any:
    """Lanes of `then` where a > limit, of `otherwise` elsewhere, NaN included."""

    def emit(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return lanes(lanes, lanes, lanes, lanes), emit


def _lines(builder: Any, base: Any, start: Any, count: int, stride: Any) -> list[Any]:
    """Pointers to the first rows of `count` lines."""
    starts = [builder.add(start, builder.mul(_INT64(k), stride)) for k in range(count)]
    return [_row(builder, base, begin) for begin in starts]


def _emit_sums(builder: Any, a_lines: list[Any], b_lines: list[Any], depth: Any) -> list[Any]:
    """Emit Σ_k A[i, k] B[j, k] of a tile of fixed size, a loop over its terms with sums in registers."""
    zero = ir.Constant(_VECTOR, [0.0] * LANES)
    before = builder.block
    loop, after = builder.append_basic_block("terms"), builder.append_basic_block("write")
    builder.cbranch(builder.icmp_signed(">", depth, _INT64(0)), loop, after)

    builder.position_at_end(loop)
    term = builder.phi(_INT64)
    sums = [builder.phi(_VECTOR) for _ in range(len(a_lines) * len(b_lines))]
    b_terms = [builder.load(_row(builder, line, term), align=8) for line in b_lines]
    fused: list[Any] = []
    for line in a_lines:
        a_term = builder.load(_row(builder, line, term), align=8)
        fused += [_fused(builder, a_term, b_term, sums[len(fused) + k]) for k, b_term in enumerate(b_terms)]
    following = builder.add(term, _INT64(1))
    builder.cbranch(builder.icmp_signed("<", following, depth), loop, after)
    term.add_incoming(_INT64(0), before)
    term.add_incoming(following, loop)
    for start, end in zip(sums, fused, strict=True):
        start.add_incoming(zero, before)
        start.add_incoming(end, loop)

    builder.position_at_end(after)
    total = [builder.phi(_VECTOR) for _ in sums]
    for found, end in zip(total, fused, strict=True):
        found.add_incoming(zero, before)
        found.add_incoming(end, loop)
    return total


def _emit_tile(builder: Any, base: Any, place: Any, shape: tuple[int, int], numbers: list[Any]) -> None:
    """Emit one tile of fixed size: its sums, then the subtractions."""
    rows, columns = shape
    a, b, stride, depth, i, j, target, width = numbers
    a_lines, b_lines = _lines(builder, base, a, rows, stride), _lines(builder, base, b, columns, stride)
    sums = _emit_sums(builder, a_lines, b_lines, depth)
    column = [builder.load(builder.gep(place, [builder.add(j, _INT64(k))])) for k in range(columns)]
    for k in range(rows):
        row = builder.load(builder.gep(place, [builder.add(i, _INT64(k))]))
        line = _row(builder, base, builder.add(target, builder.mul(row, width)))
        for m in range(columns):
            cell = _row(builder, line, column[m])
            builder.store(builder.fsub(builder.load(cell, align=8), sums[k * columns + m]), cell, align=8)


@intrinsic
def update_tile(
    _: Any, values: Any, places: Any, a: Any, b: Any, stride: Any, depth: Any, i: Any, j: Any, target: Any,
    width: Any, rows: Any, columns: Any,
) -> Any:  # fmt: skip
    """X[r_i, c_j] −= Σ_k A[i, k] B[j, k] for one tile of at most TILE_ROWS × TILE_COLUMNS.

    A and B start at rows `a` and `b` of `values`, an array of lanes, with `stride` from one line to the
    next and `depth` > 0 terms; X starts at `target` with lines of `width`; r and c are ``places[i:]`` and
    ``places[j:]``.
    """

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base = _rows(context, builder, signature.args[0], args[0])
        place = context.make_array(signature.args[1])(context, builder, args[1]).data
        end = builder.append_basic_block("end")
        key = builder.add(builder.mul(args[10], _INT64(TILE_COLUMNS + 1)), args[11])
        choose = builder.switch(key, end)
        for shape in np.ndindex(TILE_ROWS, TILE_COLUMNS):
            n_rows, n_columns = shape[0] + 1, shape[1] + 1
            block = builder.append_basic_block(f"tile_{n_rows}_{n_columns}")
            choose.add_case(_INT64(n_rows * (TILE_COLUMNS + 1) + n_columns), block)
            builder.position_at_end(block)
            _emit_tile(builder, base, place, (n_rows, n_columns), list(args[2:10]))
            builder.branch(end)
        builder.position_at_end(end)
        return context.get_dummy_value()

    return types.void(values, places, *[types.int64] * 10), emit


def _emit_strip(builder: Any, base: Any, inverse: Any, rows: int, numbers: list[Any]) -> None:
    """Emit some lines of a strip: sums over the columns before it, then x Lᵀ = line in registers."""
    first, line, width, depth = numbers
    triangle = _lines(builder, base, first, STRIP, width)
    lines = _lines(builder, base, line, rows, width)
    sums = _emit_sums(builder, lines, triangle, depth)
    for k, start in enumerate(lines):
        own = _row(builder, start, depth)
        x: list[Any] = []
        for j in range(STRIP):
            cell = builder.load(_row(builder, own, _INT64(j)), align=8)
            value = builder.fsub(cell, sums[k * STRIP + j])
            for m, earlier in enumerate(x):
                entry = builder.load(_row(builder, triangle[j], builder.add(depth, _INT64(m))), align=8)
                value = _fused(builder, builder.fneg(earlier), entry, value)
            scale = builder.load(_row(builder, inverse, _INT64(j)), align=8)
            x.append(builder.fmul(value, scale))
        for j in range(STRIP):
            builder.store(x[j], _row(builder, own, _INT64(j)), align=8)


@intrinsic
def finish_strip(
    _: Any, values: Any, inverse: Any, column: Any, first: Any, line: Any, width: Any, depth: Any, rows: Any
) -> Any:
    """X ← (X − A Bᵀ) L⁻ᵀ for at most STRIP_ROWS lines of a panel and STRIP of its columns.

    The panel has lines of `width`. X stands `depth` places into its lines from row `line` of `values` on, A
    before it. B and then L, whose factorisation is finished, stand likewise in STRIP lines from `first` on;
    1 / L_kk are the rows of `inverse` from `column` on.
    """

    def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        base = _rows(context, builder, signature.args[0], args[0])
        scales = _row(builder, _rows(context, builder, signature.args[1], args[1]), args[2])
        end = builder.append_basic_block("end")
        choose = builder.switch(args[7], end)
        for count in range(1, STRIP_ROWS + 1):
            block = builder.append_basic_block(f"strip_{count}")
            choose.add_case(_INT64(count), block)
            builder.position_at_end(block)
            _emit_strip(builder, base, scales, count, list(args[3:7]))
            builder.branch(end)
        builder.position_at_end(end)
        return context.get_dummy_value()

    return types.void(values, inverse, *[types.int64] * 6), emit
