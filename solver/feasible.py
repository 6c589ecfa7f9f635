"""Which soft maps are allowed: landmarks hold rows, linear constraints Σᵢ aᵢ Cᵢ = t mix them (section 5.3).

A landmark (v₀, v) holds the row of the source function largest at v₀ at the target function largest at v.
A linear constraint says where the mass of a point or a region goes; whether any soft map satisfies all of
them is a linear programme, and so is which entries may be positive at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import optimize, sparse

from solver.basis import Basis
from solver.errors import InvalidSoftMap
from solver.fem import mass
from solver.mesh import BoolArray, FloatArray, IntArray, Mesh

#: How far Σᵢ aᵢ may be from Σⱼ tⱼ: rows sum to 1, so they are equal whenever the constraint can hold.
BALANCE_TOLERANCE = 1e-9
#: Entries that the linear programme leaves below this share of what it could give them are zero.
POSITIVE = 1e-6


@dataclass(frozen=True, eq=False)
class LinearConstraint:
    """What a weighted sum of rows must be: Σᵢ aᵢ Cᵢ = t.

    Parameters
    ----------
    weights : (n₀,) array_like of float
        a.
    values : (n,) array_like of float
        t.

    Raises
    ------
    InvalidSoftMap
        If a number is not finite, or Σ a differs from Σ t, which no soft map can satisfy.
    """

    weights: FloatArray
    values: FloatArray

    def __post_init__(self) -> None:
        for name in ("weights", "values"):
            given = np.array(getattr(self, name), dtype=np.float64)
            bad = np.flatnonzero(~np.isfinite(given.ravel()))
            if given.ndim != 1 or bad.size:
                message = f"{name} of a constraint must be a list of finite numbers, not shape {given.shape}"
                raise InvalidSoftMap(message, index=int(bad[0]) if bad.size else None)
            given.setflags(write=False)
            object.__setattr__(self, name, given)
        excess = float(self.weights.sum() - self.values.sum())
        if abs(excess) > BALANCE_TOLERANCE * max(1.0, float(np.abs(self.weights).sum())):
            message = (
                f"no soft map satisfies a constraint whose weights sum to {excess:.3g} more than its values"
            )
            raise InvalidSoftMap(message, value=excess)

    @classmethod
    def at_point(cls, source: Basis, target: Basis, vertex0: int, vertex: int) -> LinearConstraint:
        """Constrain the value at a point: the mass of source vertex v₀ is β(v), what lies at target vertex v.

        Parameters
        ----------
        source, target : Basis
        vertex0, vertex : int
            0-based vertices of source and target.

        Returns
        -------
        LinearConstraint

        Raises
        ------
        InvalidSoftMap
            If a vertex does not exist or belongs to no face.
        """
        return cls(_values_at(source, vertex0, "source"), _values_at(target, vertex, "target"))

    @classmethod
    def on_region(
        cls, source: Basis, target: Basis, vertices0: npt.ArrayLike, vertices: npt.ArrayLike
    ) -> LinearConstraint:
        """Constrain the mean over a region: mass of source vertices spreads evenly over target vertices.

        Parameters
        ----------
        source, target : Basis
        vertices0, vertices : (·,) array_like of int
            0-based vertices of both regions, weighted by their areas.

        Returns
        -------
        LinearConstraint

        Raises
        ------
        InvalidSoftMap
            If a region is empty, has no area, or a vertex does not exist.
        """
        return cls(_mean_over(source, vertices0, "source"), _mean_over(target, vertices, "target"))


@dataclass(frozen=True, eq=False)
class Feasible:
    """The soft maps to choose from.

    Attributes
    ----------
    allowed : ndarray of bool, shape (n₀, n)
        Entries that are positive in some feasible map; a row with a single one is held there.
    interior : ndarray of float64, shape (n₀, n)
        A feasible map that is positive wherever that is allowed.
    weights : ndarray of float64, shape (L, n₀)
    values : ndarray of float64, shape (L, n)
        The linear constraints.
    """

    allowed: BoolArray
    interior: FloatArray
    weights: FloatArray
    values: FloatArray

    @property
    def rows(self) -> IntArray:
        """Rows that are not held, int64 (m,)."""
        return np.flatnonzero(self.allowed.sum(axis=1) > 1)

    def bound(self, value: float, plane: FloatArray) -> float:
        """Minimum of value + ⟨plane, C⟩ over the rows' simplices, with held entries at zero.

        Parameters
        ----------
        value : float
        plane : (n₀, n) float64

        Returns
        -------
        float
        """
        return value + float(np.where(self.allowed, plane, np.inf).min(axis=1).sum())


def feasible(
    source: Basis,
    target: Basis,
    landmarks: Sequence[tuple[int, int]],
    constraints: Sequence[LinearConstraint] = (),
) -> Feasible:
    """Gather landmarks and linear constraints, and find a soft map that satisfies all of them.

    Parameters
    ----------
    source, target : Basis
    landmarks : sequence of (int, int)
        Pairs of a source and a target vertex, 0-based.
    constraints : sequence of LinearConstraint

    Returns
    -------
    Feasible

    Raises
    ------
    InvalidSoftMap
        If a vertex does not exist, two landmarks hold one row at different columns, a constraint has the
        wrong length, or no soft map satisfies the landmarks and constraints; names the first culprit.
    """
    allowed = np.ones((source.size, target.size), dtype=bool)
    for row, column in _held(source, target, landmarks).items():
        allowed[row] = False
        allowed[row, column] = True
    interior = np.where(allowed, target.integrals, 0.0)
    interior /= interior.sum(axis=1, keepdims=True)
    weights, values = np.zeros((len(constraints), source.size)), np.zeros((len(constraints), target.size))
    for k, constraint in enumerate(constraints):
        if constraint.weights.size != source.size or constraint.values.size != target.size:
            sizes = (constraint.weights.size, constraint.values.size)
            message = f"constraint {k} is for bases of {sizes[0]} and {sizes[1]} functions"
            raise InvalidSoftMap(message, index=k, value=str(sizes))
        weights[k], values[k] = constraint.weights, constraint.values
    if not constraints:
        return Feasible(allowed, interior, weights, values)
    touched = np.flatnonzero((weights != 0).any(axis=0))
    positive = _most_positive(allowed[touched], weights[:, touched], values)
    if positive is None:
        k = _contradicting(allowed, weights, values)
        message = (
            f"no soft map satisfies constraint {k} together with the landmarks and the constraints before"
        )
        raise InvalidSoftMap(message, index=k)
    allowed[touched] = positive > 0
    interior[touched] = _exactly(positive, weights[:, touched], values)
    return Feasible(allowed, interior, weights, values)


def _held(source: Basis, target: Basis, landmarks: Sequence[tuple[int, int]]) -> dict[int, int]:
    """Column at which each held row is held."""
    held: dict[int, int] = {}
    by: dict[int, int] = {}
    for index, pair in enumerate(landmarks):
        if len(pair) != 2:
            message = f"landmark {index} must be a pair of a source and a target vertex"
            raise InvalidSoftMap(message, index=index, value=str(pair)[:80])
        row = _largest_at(source, pair[0], f"landmark {index}: source")
        column = _largest_at(target, pair[1], f"landmark {index}: target")
        by.setdefault(row, index)
        if held.setdefault(row, column) != column:
            message = (
                f"landmarks {by[row]} and {index} contradict each other: both source vertices have function "
                f"{row}, but the target vertices have functions {held[row]} and {column}"
            )
            raise InvalidSoftMap(message, index=index, value=row)
    return held


def _largest_at(basis: Basis, vertex: int, what: str) -> int:
    """Return the function that is largest at a vertex, the lowest of equals."""
    _check_vertex(basis.mesh, vertex, what)
    here = basis.functions[[int(vertex)]].toarray()[0]
    return int(here.argmax())


def _check_vertex(mesh: Mesh, vertex: int, what: str) -> None:
    if isinstance(vertex, bool) or not isinstance(vertex, int | np.integer):
        raise InvalidSoftMap(f"{what} vertex must be an integer, not {vertex!r}", value=str(vertex)[:80])
    if not 0 <= vertex < mesh.n_vertices:
        message = f"{what} vertex {vertex} is not one of 0 … {mesh.n_vertices - 1}"
        raise InvalidSoftMap(message, index=int(vertex), value=int(vertex))
    if not mesh.referenced[vertex]:
        raise InvalidSoftMap(
            f"{what} vertex {vertex} belongs to no face", index=int(vertex), value=int(vertex)
        )


def _values_at(basis: Basis, vertex: int, what: str) -> FloatArray:
    _check_vertex(basis.mesh, vertex, what)
    here: FloatArray = basis.functions[[int(vertex)]].toarray()[0]
    return here


def _mean_over(basis: Basis, vertices: npt.ArrayLike, what: str) -> FloatArray:
    chosen = np.unique(np.asarray(vertices))
    if not np.issubdtype(chosen.dtype, np.integer) or not chosen.size:
        raise InvalidSoftMap(f"a {what} region must be a list of vertices, counted from 0")
    outside = chosen[(chosen < 0) | (chosen >= basis.mesh.n_vertices)]
    if outside.size:
        message = f"{what} vertex {outside[0]} is not one of 0 … {basis.mesh.n_vertices - 1}"
        raise InvalidSoftMap(message, index=int(outside[0]), value=int(outside[0]))
    areas = mass(basis.mesh)[chosen]
    if not areas.sum() > 0:
        raise InvalidSoftMap(f"the {what} region has no area", index=int(chosen[0]))
    mean: FloatArray = basis.functions[chosen].T @ (areas / areas.sum())
    return mean


def _most_positive(allowed: BoolArray, weights: FloatArray, values: FloatArray) -> FloatArray | None:
    """Rows that satisfy the constraints with as many positive entries as can be; None if there are none.

    Freund, Roundy and Todd (1985): maximise Σ min(x, 1) over the cone {x = τ C, τ ≥ 1}. The feasible set is
    convex, so all entries that can be positive can be so at once, and far enough along the cone all reach 1.
    """
    m, n = allowed.shape
    caps = np.where(allowed, _caps(weights, values), 0.0).ravel()
    where = np.flatnonzero(caps)
    size = where.size
    row, column = np.divmod(where, n)
    # Entries in units of their caps, equations in units of their largest coefficient: values of a constraint
    # span many orders of magnitude.
    entry = np.arange(size)
    sums = sparse.csr_array((caps[where], (row, entry)), shape=(m, size))
    mixes = (
        sparse.csr_array((caps[where] * line[row], (column, entry)), shape=(n, size)) for line in weights
    )
    system, aim = sparse.vstack([sums, *mixes]), np.concatenate([np.ones(m), values.ravel()])
    largest = abs(system).max(axis=1).toarray()
    if (aim[largest == 0] != 0).any():
        return None
    kept = np.flatnonzero(largest)
    scaling = 1 / largest[kept]
    system = sparse.diags_array(scaling) @ system.tocsr()[kept]
    equalities = sparse.hstack([system, sparse.csr_array(system.shape), -(scaling * aim[kept])[:, None]])
    eye = sparse.eye_array(size)
    below = sparse.hstack([-eye, eye, sparse.csr_array((size, 1))])
    solution = optimize.linprog(
        np.concatenate([np.zeros(size), -np.ones(size), [0.0]]),
        below.tocsr(),
        np.zeros(size),
        equalities.tocsr(),
        np.zeros(equalities.shape[0]),
        [(0.0, None)] * size + [(0.0, 1.0)] * size + [(1.0, None)],
        "highs",
        # Presolve ends in "solve error" on some constraints that contradict each other.
        options={"presolve": False},
    )
    if solution.status == 2:
        return None
    if solution.status != 0:
        raise InvalidSoftMap(f"the linear constraints could not be examined: {solution.message}")
    entries = np.zeros(m * n)
    entries[where] = np.where(solution.x[size:-1] > POSITIVE, caps[where] * solution.x[:size], 0.0)
    rows: FloatArray = entries.reshape(m, n) / solution.x[-1]
    return rows


def _caps(weights: FloatArray, values: FloatArray) -> FloatArray:
    """Bounds Cᵢⱼ ≤ min(1, t_lj / a_li) of constraints whose weights are not negative, (m, n)."""
    caps = np.ones((weights.shape[1], values.shape[1]))
    for line, value in zip(weights, values, strict=True):
        if (line >= 0).all():
            given = line > 0
            caps[given] = np.minimum(caps[given], np.maximum(value, 0.0) / line[given][:, None])
    return caps


def _exactly(rows: FloatArray, weights: FloatArray, values: FloatArray) -> FloatArray:
    """Remove what the linear programme's tolerance left of the constraints, by least relative change."""
    m, n = rows.shape
    unit = sparse.eye_array(n)
    system = sparse.vstack(
        [
            sparse.kron(sparse.eye_array(m), np.ones((1, n))),
            *(sparse.kron(line[None, :], unit) for line in weights),
        ]
    ).tocsr()
    aim = np.concatenate([np.ones(m), values.ravel()])
    exact = rows.ravel()
    for _ in range(3):
        scaled = sparse.csr_array(system @ sparse.diags_array(exact))
        off = aim - system @ exact
        exact = exact + exact * (scaled.T @ np.linalg.lstsq((scaled @ scaled.T).toarray(), off)[0])
    return np.maximum(exact, 0.0).reshape(m, n)


def _contradicting(allowed: BoolArray, weights: FloatArray, values: FloatArray) -> int:
    """First constraint that contradicts the landmarks and the constraints before it."""
    last = len(weights) - 1
    for k in range(last):
        upto = slice(k + 1)
        touched = np.flatnonzero((weights[upto] != 0).any(axis=0))
        if _most_positive(allowed[touched], weights[upto, touched], values[upto]) is None:
            return k
    return last
