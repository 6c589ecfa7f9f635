"""Tasks that make what energies are asked about: bases, spectra, descriptors and soft maps.

The solver is imported inside functions: whoever only plans tasks must not load it.
"""

from __future__ import annotations

import numpy as np

from worker import specs
from worker.bench import Bench, Made, Report, rest
from worker.optimum import make_optimal


def make_basis(spec: specs.Basis, bench: Bench) -> Made:
    """Partition of unity, by the method that the spec names."""
    from solver import maxent_basis, poisson_basis  # noqa: PLC0415  (see the module)
    from solver.basis import SAMPLING_SHARE  # noqa: PLC0415
    from solver.maxent import LOGARITHM_SHARE  # noqa: PLC0415
    from solver.maxent import SAMPLING_SHARE as CHOOSING_SHARE  # noqa: PLC0415

    mesh, first = bench.read.mesh(spec.mesh), list(spec.first)
    if isinstance(spec, specs.MaxentBasis):
        logarithms = f"logarithms around {spec.size:,} samples"
        progress = _in_parts(
            bench, (0.0, "geodesic samples"), (CHOOSING_SHARE, logarithms), (LOGARITHM_SHARE, "weights")
        )
        found = maxent_basis(mesh, spec.size, spec.sharpness, first, progress)
    else:
        assert isinstance(spec, specs.PoissonBasis)
        solving = f"solving for {spec.size:,} functions"
        progress = _in_parts(bench, (0.0, "geodesic samples"), (SAMPLING_SHARE, solving))
        found = poisson_basis(mesh, spec.size, spec.cutoff, first, progress)
    arrays = {
        "functions_data": np.asarray(found.functions.data, dtype=np.float64),
        "functions_indices": np.asarray(found.functions.indices, dtype=np.int64),
        "functions_indptr": np.asarray(found.functions.indptr, dtype=np.int64),
        "samples": np.asarray(found.samples, dtype=np.int64),
        "cells": np.asarray(found.cells, dtype=np.int64),
    }
    return Made({"n_functions": found.size}, arrays, f"{mesh.n_vertices:,} vertices, {found.size} functions")


def _in_parts(bench: Bench, *parts: tuple[float, str]) -> Report:
    """Report of a whole that says, as it comes to each part from some fraction on, what happens there."""
    waiting = list(parts)
    report: Report = bench.step(waiting.pop(0)[1], 0.0, 1.0)

    def progress(done: float) -> None:
        nonlocal report
        while waiting and done >= waiting[0][0]:
            start, words = waiting.pop(0)
            report = rest(bench.step(words, start, 1.0), start)
        report(done)

    return progress


def make_spectrum(spec: specs.Spectrum, bench: Bench) -> Made:
    """Eigenpairs of a mesh."""
    from solver.descriptors import spectrum  # noqa: PLC0415  (see the module)

    mesh = bench.read.mesh(spec.mesh)
    bench.step(f"solving for {spec.eigenpairs} eigenpairs", 0.0, 1.0)
    found = spectrum(mesh, spec.eigenpairs, bench.threads)
    arrays = {"eigenvalues": found.values, "eigenfunctions": found.functions}
    return Made({}, arrays, f"{mesh.n_vertices:,} vertices, {len(found.values)} eigenpairs")


def make_descriptor(spec: specs.Descriptor, bench: Bench) -> Made:
    """HKS or WKS from the spectra of one mesh or two."""
    from solver.descriptors import hks_of, wks_of  # noqa: PLC0415  (see the module)

    own = bench.read.spectrum(spec.mesh, spec.eigenpairs)
    partner = None if spec.partner is None else bench.read.spectrum(spec.partner, spec.eigenpairs)
    bench.step(f"{spec.count} values a vertex", 0.0, 1.0)
    made = (wks_of if spec.type == "wks" else hks_of)(own, partner, spec.count)
    arrays = {"descriptor": made, "eigenvalues": own.values}
    return Made({}, arrays, f"{made.shape[0]:,} vertices, {spec.count} values")


def make_softmap(spec: specs.SoftMap, bench: Bench) -> Made:
    """Coefficients of a soft map between two bases."""
    from solver import SoftMap  # noqa: PLC0415  (see the module)

    if isinstance(spec.map, specs.Optimal):
        return make_optimal(spec, bench)
    read = bench.read
    source, target = read.basis(spec.source), read.basis(spec.target)
    target.require_independent()
    chosen = spec.map
    if isinstance(chosen, specs.Points):
        bench.step(f"projecting {source.mesh.n_vertices:,} targets", 0.0, 1.0)
        barycentric = None if chosen.barycentric is None else read.array(chosen.barycentric)
        made = SoftMap.from_points(source, target, read.array(chosen.targets), barycentric)
    elif isinstance(chosen, specs.Descriptors):
        report = bench.step("comparing descriptors", 0.0, 1.0)
        f0, f = read.descriptor(chosen.source), read.descriptor(chosen.target)
        made = SoftMap.from_descriptors(
            source, target, f0, f, sigma=chosen.sigma, threads=bench.threads, progress=report
        )
    elif isinstance(chosen, specs.Matrix):
        made = SoftMap(source, target, read.array(chosen.coefficients))
    elif isinstance(chosen, specs.Mixture):
        bench.step(f"mixing {len(chosen.maps)} soft maps", 0.0, 1.0)
        made = SoftMap.mixture([read.softmap(id_) for id_ in chosen.maps], chosen.weights)
    else:
        made = SoftMap.uniform(source, target)
    return Made(
        {}, {"coefficients": np.asarray(made.coefficients)}, f"{source.size} × {target.size} functions"
    )
