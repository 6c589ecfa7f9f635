"""Descriptors of points: eigenpairs of the Laplacian, heat and wave kernel signatures.

The soft maps of §5.2 compare such descriptors between two meshes, so a pair shares times, energies, scales:
each is the mean over both spectra (geometric for eigenvalues), symmetric and idle for a single mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from solver.eigenpairs import smallest_eigenpairs
from solver.errors import InvalidDescriptor
from solver.fem import mass, stiffness
from solver.mesh import FloatArray, Mesh

#: Eigenvalues below this fraction of the largest are those of constants on components.
ZERO_EIGENVALUE = 1e-8
#: Below 28 energies the range log λ₂ + 2σ … log λ_max − 2σ with σ = 7(e_max − e_min)/count runs backwards.
FEWEST_ENERGIES = 28


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Smallest eigenpairs of the Laplacian of the unit-area mesh, K φ = λ M φ.

    Parameters
    ----------
    values : (k,) float64
        Eigenvalues, ascending, in 1/area.
    functions : (V, k) float64
        Eigenfunctions, orthonormal for the lumped mass; zero at unreferenced vertices.
    """

    values: FloatArray
    functions: FloatArray

    @cached_property
    def first_positive(self) -> int:
        """Index of the first eigenvalue that is not of a constant (one constant a component)."""
        positive = np.flatnonzero(self.values > ZERO_EIGENVALUE * self.values[-1])
        if self.values[-1] <= 0 or len(positive) < 2:
            raise InvalidDescriptor(
                f"only {len(positive)} of {len(self.values)} eigenvalues are positive: ask for more",
                value=float(self.values[-1]),
            )
        return int(positive[0])


def spectrum(mesh: Mesh, eigenpairs: int = 200, threads: int | None = None) -> Spectrum:
    """Smallest eigenpairs K φ = λ M φ of the cotangent Laplacian with lumped mass, on the unit-area mesh.

    Parameters
    ----------
    mesh : Mesh
    eigenpairs : int
        How many; at most as many as there are referenced vertices.
    threads : int, optional
        Threads that share the work, one by default. The result does not depend on it.

    Returns
    -------
    Spectrum

    Raises
    ------
    InvalidDescriptor
        If fewer than two eigenpairs are asked for, or the eigensolver does not converge.
    """
    if eigenpairs < 2:
        raise InvalidDescriptor("a spectrum needs at least 2 eigenpairs", value=eigenpairs)
    vertices = np.flatnonzero(mesh.referenced)
    weights = mass(mesh)[vertices]
    laplacian = stiffness(mesh)[vertices][:, vertices]
    count = min(eigenpairs, len(vertices))
    values, functions = smallest_eigenpairs(laplacian, weights, count, threads)
    whole = np.zeros((mesh.n_vertices, count))
    whole[vertices] = functions
    return Spectrum(np.maximum(values, 0.0), whole)


def hks(mesh: Mesh, count: int = 100, eigenpairs: int = 200, partner: Mesh | None = None) -> FloatArray:
    """Heat kernel signature HKS(x, t) = Σₖ exp(−λₖt) φₖ(x)² / Σₖ exp(−λₖt) (Sun, Ovsjanikov, Guibas 2009).

    Parameters
    ----------
    mesh : Mesh
    count : int
        Number of times, geometrically spaced from 4 ln10 / λ_max to 4 ln10 / λ₂.
    eigenpairs : int
        Number of eigenpairs; at most as many as there are vertices.
    partner : Mesh, optional
        The mesh it will be compared with: both then share times and scales.

    Returns
    -------
    (V, count) float64

    Raises
    ------
    InvalidDescriptor
        If the count or the number of eigenpairs is too small.
    """
    own, other = _spectra(mesh, partner, eigenpairs)
    return hks_of(own, other, count)


def wks(mesh: Mesh, count: int = 100, eigenpairs: int = 200, partner: Mesh | None = None) -> FloatArray:
    """Wave kernel signature WKS(x, e) = Σₖ g(e − log λₖ) φₖ(x)² / Σₖ g(e − log λₖ) (Aubry et al. 2011).

    Parameters
    ----------
    mesh : Mesh
    count : int
        Number of energies, evenly spaced from log λ₂ + 2σ to log λ_max − 2σ; at least 28. The Gaussian g has
        width σ = 7 (log λ_max − log λ₂) / count.
    eigenpairs : int
        Number of eigenpairs; at most as many as there are vertices.
    partner : Mesh, optional
        The mesh it will be compared with: both then share energies and scales.

    Returns
    -------
    (V, count) float64

    Raises
    ------
    InvalidDescriptor
        If the count or the number of eigenpairs is too small.
    """
    own, other = _spectra(mesh, partner, eigenpairs)
    return wks_of(own, other, count)


def hks_of(own: Spectrum, partner: Spectrum | None, count: int = 100) -> FloatArray:
    """Heat kernel signature of eigenpairs; see `hks`.

    Parameters
    ----------
    own, partner : Spectrum
        The mesh's own eigenpairs and those of the mesh it will be compared with, if any.
    count : int

    Returns
    -------
    (V, count) float64

    Raises
    ------
    InvalidDescriptor
        If the count is not positive or there are too few eigenpairs.
    """
    if count < 1:
        raise InvalidDescriptor("a descriptor needs at least 1 time", value=count)
    smallest, largest = _shared_range(own, partner)
    times = np.geomspace(4 * np.log(10) / largest, 4 * np.log(10) / smallest, count)
    pair = [own] if partner is None else [own, partner]
    filters: list[FloatArray] = [np.exp(-np.outer(each.values, times)) for each in pair]
    signature: FloatArray = (own.functions**2 @ filters[0]) / _shared_scale(filters)
    return signature


def wks_of(own: Spectrum, partner: Spectrum | None, count: int = 100) -> FloatArray:
    """Wave kernel signature of eigenpairs; see `wks`.

    Parameters
    ----------
    own, partner : Spectrum
        The mesh's own eigenpairs and those of the mesh it will be compared with, if any.
    count : int
        At least 28.

    Returns
    -------
    (V, count) float64

    Raises
    ------
    InvalidDescriptor
        If the count is below 28 or there are too few eigenpairs.
    """
    if count < FEWEST_ENERGIES:
        raise InvalidDescriptor(
            f"a wave kernel signature needs {FEWEST_ENERGIES} energies or more", value=count
        )
    low, high = np.log(_shared_range(own, partner))
    sigma = 7 * (high - low) / count
    energies = np.linspace(low + 2 * sigma, high - 2 * sigma, count)
    pair = [own] if partner is None else [own, partner]
    filters: list[FloatArray] = [
        np.exp(-((energies - np.log(each.values[each.first_positive :, None])) ** 2) / (2 * sigma**2))
        for each in pair
    ]
    signature: FloatArray = (own.functions[:, own.first_positive :] ** 2 @ filters[0]) / _shared_scale(
        filters
    )
    return signature


def _spectra(mesh: Mesh, partner: Mesh | None, eigenpairs: int) -> tuple[Spectrum, Spectrum | None]:
    return spectrum(mesh, eigenpairs), None if partner is None else spectrum(partner, eigenpairs)


def _shared_range(own: Spectrum, partner: Spectrum | None) -> tuple[float, float]:
    """Smallest positive and largest eigenvalue: those of one spectrum, or the geometric means over two."""
    pair = [own] if partner is None else [own, partner]
    smallest = np.exp(np.mean([np.log(each.values[each.first_positive]) for each in pair]))
    largest = np.exp(np.mean([np.log(each.values[-1]) for each in pair]))
    return float(smallest), float(largest)


def _shared_scale(filters: list[FloatArray]) -> FloatArray:
    """Trace of each filter, averaged over the meshes that share it."""
    scale: FloatArray = np.mean([each.sum(axis=0) for each in filters], axis=0)
    return scale
