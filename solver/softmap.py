"""Soft maps: ρ(x, y) = Σ C_ij β₀ᵢ(x) μⱼ(y) (eq. 8), and their makers (§5.2).

A map goes from source to target. Fine densities are projected with lumped masses, and rows sum to 1:
C_ij = ∫β₀ᵢ(x) [∫ρ_fine(x, y) βⱼ(y) dy] dx / ∫β₀ᵢ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse

from solver.basis import Basis
from solver.errors import InvalidDescriptor, InvalidMesh, InvalidSoftMap
from solver.fem import mass
from solver.mesh import FloatArray
from solver.similarity import received_by

#: How far a row of given coefficients may be from summing to 1; ours are within 1e-14.
ROW_SUM_TOLERANCE = 1e-9
#: Descriptors that vary less than this, relative to their size, differ by rounding alone.
SMALLEST_VARIATION = 1e-13


@dataclass(frozen=True, eq=False)
class SoftMap:
    """A soft map between two bases, C ≥ 0 with C1 = 1 (eq. 8).

    Parameters
    ----------
    source, target : Basis
        Bases of the source and of the target; the target's mesh must be connected.
    coefficients : (n₀, n) array_like
        Row i is where source function i goes. Read-only once here.

    Raises
    ------
    InvalidSoftMap
        If the shape does not match, or an entry is not finite or negative, or a row does not sum to 1.
    InvalidMesh
        If the target's mesh is not connected.
    """

    source: Basis
    target: Basis
    coefficients: FloatArray

    def __post_init__(self) -> None:
        coefficients = np.array(self.coefficients, dtype=np.float64, order="C")
        _check_connected(self.target)
        _check_coefficients(coefficients, (self.source.size, self.target.size))
        coefficients.setflags(write=False)
        object.__setattr__(self, "coefficients", coefficients)

    @classmethod
    def from_points(
        cls, source: Basis, target: Basis, targets: npt.ArrayLike, barycentric: npt.ArrayLike | None = None
    ) -> SoftMap:
        """Soft map of a point map: ρ_fine(x, ·) is a Dirac mass at the image of x.

        Parameters
        ----------
        source, target : Basis
        targets : (V₀,) int
            Target vertex of every source vertex, 0-based; or target face, if `barycentric` is given.
        barycentric : (V₀, 3) float, optional
            Weights of the corners of each target face; non-negative, summing to 1.

        Returns
        -------
        SoftMap

        Raises
        ------
        InvalidSoftMap
            If the length does not match, an index is out of range (−1 included) or belongs to no face, or
            weights do not sum to 1; names the index.
        """
        images = _checked_images(source, target, targets, barycentric)
        return cls(source, target, _project(source, images @ target.functions))

    @classmethod
    def from_descriptors(
        cls,
        source: Basis,
        target: Basis,
        source_descriptor: npt.ArrayLike,
        target_descriptor: npt.ArrayLike,
        sigma: float = 0.1,
        threads: int | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> SoftMap:
        """Soft map of two descriptors: ρ_fine(x, y) = exp(−‖f₀(x) − f(y)‖² / s²) / Z(x).

        Parameters
        ----------
        source, target : Basis
        source_descriptor : (V₀, d) float
        target_descriptor : (V, d) float
        sigma : float
            s in units of the root-mean-square descriptor distance over both surfaces.
        threads : int, optional
            Threads that share the rows; one by default. The result does not depend on it.
        progress : callable, optional
            Called with the fraction done.

        Returns
        -------
        SoftMap

        Raises
        ------
        InvalidDescriptor
            If shapes do not match, a value is not finite, or both descriptors are the same constant.
        """
        f0, f = _checked_descriptors(source, target, source_descriptor, target_descriptor)
        if not 0 < sigma < np.inf:
            raise InvalidDescriptor("sigma must be positive and finite", value=float(sigma))
        scale = sigma * root_mean_square_distance(source, target, f0, f)
        size = max(np.abs(f0).max(), np.abs(f).max())
        if not SMALLEST_VARIATION * size < scale < np.inf:
            raise InvalidDescriptor("the descriptors do not vary", value=float(scale))
        coefficients = received_by(source, target, f0 / scale, f / scale, threads, progress)
        return cls(source, target, coefficients / source.integrals[:, None])

    @classmethod
    def uniform(cls, source: Basis, target: Basis) -> SoftMap:
        """Soft map that says nothing: every point goes everywhere, C_ij = ∫βⱼ.

        Parameters
        ----------
        source, target : Basis

        Returns
        -------
        SoftMap

        Raises
        ------
        InvalidMesh
            If the target's mesh is not connected.
        """
        return cls(source, target, np.tile(target.integrals, (source.size, 1)))

    @classmethod
    def mixture(cls, maps: Sequence[SoftMap], weights: npt.ArrayLike) -> SoftMap:
        """Superposition Σₖ wₖ Cₖ of soft maps on the same two bases (Fig. 4a).

        Parameters
        ----------
        maps : sequence of SoftMap
        weights : (len(maps),) float
            Non-negative, summing to 1.

        Returns
        -------
        SoftMap

        Raises
        ------
        InvalidSoftMap
            If there is no map, the bases differ, or the weights are negative or do not sum to 1.
        """
        weights = np.asarray(weights, dtype=np.float64)
        if not maps or weights.shape != (len(maps),):
            raise InvalidSoftMap(
                f"a mixture of {len(maps)} maps needs as many weights", value=str(weights.shape)
            )
        for index, each in enumerate(maps):
            if each.source is not maps[0].source or each.target is not maps[0].target:
                raise InvalidSoftMap("the maps of a mixture must share both bases", index=index)
        _check_rows(weights[None, :], "the weights")
        return cls(
            maps[0].source,
            maps[0].target,
            sum(w * each.coefficients for w, each in zip(weights, maps, strict=True)),
        )


def root_mean_square_distance(
    source: Basis, target: Basis, source_descriptor: FloatArray, target_descriptor: FloatArray
) -> float:
    """Root-mean-square descriptor distance (∬ ‖f₀(x) − f(y)‖² dx dy)^½ between two unit-area surfaces.

    Parameters
    ----------
    source, target : Basis
    source_descriptor : (V₀, d) float64
    target_descriptor : (V, d) float64

    Returns
    -------
    float
    """
    m0, m = mass(source.mesh), mass(target.mesh)
    mean0, mean = m0 @ source_descriptor, m @ target_descriptor
    spread0 = m0 @ ((source_descriptor - mean0) ** 2).sum(axis=1)
    spread = m @ ((target_descriptor - mean) ** 2).sum(axis=1)
    return float(np.sqrt(spread0 + spread + ((mean0 - mean) ** 2).sum()))


def _project(source: Basis, received: sparse.csr_array | FloatArray) -> FloatArray:
    """C_ij = ∫β₀ᵢ(x) r_j(x) dx / ∫β₀ᵢ for r(x) = ∫ρ_fine(x, y) β(y) dy at the source vertices."""
    weighted = (source.functions.T * mass(source.mesh)).tocsr()
    product = weighted @ received
    dense = product.toarray() if sparse.issparse(product) else product
    coefficients: FloatArray = dense / source.integrals[:, None]
    return coefficients


def _checked_images(
    source: Basis, target: Basis, targets: npt.ArrayLike, barycentric: npt.ArrayLike | None
) -> sparse.csr_array:
    """Point map as a (V₀, V) matrix of interpolation weights."""
    indices = np.asarray(targets)
    n_source = source.mesh.n_vertices
    if indices.shape != (n_source,):
        raise InvalidSoftMap(
            f"a map from source to target needs one target for each of the {n_source} source vertices",
            value=str(indices.shape),
        )
    if not np.issubdtype(indices.dtype, np.integer):
        raise InvalidSoftMap("targets must be integers, counted from 0", value=str(indices.dtype))
    of, count = ("vertex", target.mesh.n_vertices) if barycentric is None else ("face", target.mesh.n_faces)
    outside = np.flatnonzero((indices < 0) | (indices >= count))
    if len(outside):
        index = int(outside[0])
        raise InvalidSoftMap(
            f"source vertex {index} goes to target {of} {indices[index]}, not one of 0 … {count - 1}",
            index=index,
            value=float(indices[index]),
        )
    corners = indices[:, None] if barycentric is None else target.mesh.faces[indices]
    weights = np.ones((n_source, 1)) if barycentric is None else np.asarray(barycentric, dtype=np.float64)
    if weights.shape != corners.shape:
        raise InvalidSoftMap(f"barycentric weights must have shape {corners.shape}", value=str(weights.shape))
    _check_rows(weights, "barycentric weights")
    loose = np.flatnonzero(~target.mesh.referenced[corners].all(axis=1))
    if len(loose):
        index = int(loose[0])
        raise InvalidSoftMap(
            f"source vertex {index} goes to target vertex {indices[index]}, which belongs to no face",
            index=index,
            value=float(indices[index]),
        )
    rows = np.repeat(np.arange(n_source), corners.shape[1])
    return sparse.csr_array(
        (weights.ravel(), (rows, corners.ravel())), shape=(n_source, target.mesh.n_vertices)
    )


def _checked_descriptors(
    source: Basis, target: Basis, source_descriptor: npt.ArrayLike, target_descriptor: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    checked = []
    for side, basis, given in (("source", source, source_descriptor), ("target", target, target_descriptor)):
        descriptor = np.asarray(given, dtype=np.float64)
        if descriptor.ndim != 2 or len(descriptor) != basis.mesh.n_vertices or descriptor.shape[1] == 0:
            raise InvalidDescriptor(
                f"the {side} descriptor needs a row for each of the {basis.mesh.n_vertices} {side} vertices",
                value=str(descriptor.shape),
            )
        bad = np.flatnonzero(~np.isfinite(descriptor).all(axis=1))
        if len(bad):
            index = int(bad[0])
            raise InvalidDescriptor(
                f"the {side} descriptor of vertex {index} is not finite",
                index=index,
                value=float(descriptor[index][~np.isfinite(descriptor[index])][0]),
            )
        checked.append(descriptor)
    f0, f = checked
    if f0.shape[1] != f.shape[1]:
        raise InvalidDescriptor(f"descriptors of {f0.shape[1]} and {f.shape[1]} columns", value=f.shape[1])
    return f0, f


def _check_connected(target: Basis) -> None:
    if target.mesh.n_components != 1:
        one = int(np.flatnonzero(target.mesh.components == 0)[0])
        other = int(np.flatnonzero(target.mesh.components > 0)[0])
        raise InvalidMesh(
            f"a target must be connected, but this mesh has {target.mesh.n_components} components; "
            f"vertex {other} is not connected to vertex {one}",
            index=other,
            value=target.mesh.n_components,
        )


def _check_coefficients(coefficients: FloatArray, shape: tuple[int, int]) -> None:
    if coefficients.shape != shape:
        raise InvalidSoftMap(
            f"coefficients need a row for each source and a column for each target function, {shape}",
            value=str(coefficients.shape),
        )
    _check_rows(coefficients, "coefficients")


def _check_rows(rows: FloatArray, what: str) -> None:
    """Refuse rows that are not finite, not non-negative or do not sum to 1."""
    fit = np.isfinite(rows) & (rows >= 0)
    bad = np.flatnonzero(~fit.all(axis=1))
    if bad.size:
        index = int(bad[0])
        value = float(rows[index][~fit[index]][0])
        message = f"{what} must be finite and non-negative; row {index} has {value}"
        raise InvalidSoftMap(message, index=index, value=value)
    sums = rows.sum(axis=1)
    off = np.flatnonzero(np.abs(sums - 1) > ROW_SUM_TOLERANCE)
    if off.size:
        index, value = int(off[0]), float(sums[off[0]])
        message = f"{what} must sum to 1 in each row; row {index} sums to {value}"
        raise InvalidSoftMap(message, index=index, value=value)
