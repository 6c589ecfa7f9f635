"""One table: each kind of question, the solver call that answers it, its cost and how it splits into shards.

The solver is imported inside functions: whoever only plans tasks must not load it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from worker import checks, sizes, specs
from worker.readers import Reader
from worker.settings import Settings
from worker.sizes import Cost, Sizes
from worker.store import BorrowedBlocks

#: Reports a fraction done, from 0 to 1.
Report = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Made:
    """What a stage made.

    Attributes
    ----------
    values : mapping
        Numbers for the manifest.
    arrays : mapping
        Arrays for the store.
    sizes : str
        How large it was, in words, for the log.
    residual : float
        Largest relative residual of the systems solved; 0 where none was.
    adopts : tuple of str
        Shards that this artifact takes over.
    seconds : float
        Time that its shards took.
    """

    values: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any] | BorrowedBlocks]
    sizes: str
    residual: float = 0.0
    adopts: tuple[str, ...] = ()
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Bench:
    """What a stage works with.

    Attributes
    ----------
    read : Reader
        Reads parents.
    threads : int
        Threads that kernels may use.
    step : callable
        ``step(words, start, stop)`` says what happens from now on and returns the report of that share.
    shards : tuple of str
        Ids of the shards that were planned for this task, in order; they stand.
    """

    read: Reader
    threads: int
    step: Callable[[str, float, float], Report]
    shards: tuple[str, ...] = ()


def _no_shards(spec: Any, sizes_: Sizes) -> tuple[specs.Spec, ...]:
    return ()


@dataclass(frozen=True)
class Stage:
    """How one kind is answered.

    Attributes
    ----------
    make : callable
        ``make(spec, bench) -> Made``; raises `SolverError` or `StoreError`.
    cost : callable
        ``cost(spec, sizes) -> Cost``.
    check : callable
        ``check(spec, sizes, settings)`` yields what manifests say is wrong.
    shards : callable
        ``shards(spec, sizes)`` gives the specs that it can be split into, none or one meaning never.
    """

    make: Callable[[Any, Bench], Made]
    cost: Callable[[Any, Sizes], Cost]
    check: Callable[[Any, Sizes, Settings], Iterator[checks.Flaw]] = field(default=checks.of_softmap)
    shards: Callable[[Any, Sizes], tuple[specs.Spec, ...]] = field(default=_no_shards)


def _basis(spec: specs.Basis, bench: Bench) -> Made:
    from solver import poisson_basis  # noqa: PLC0415  (see the module)
    from solver.basis import SAMPLING_SHARE  # noqa: PLC0415

    mesh = bench.read.mesh(spec.mesh)
    sampling = bench.step("geodesic samples", 0.0, SAMPLING_SHARE)
    solving: list[Report] = []

    def progress(done: float) -> None:
        if done < SAMPLING_SHARE:
            sampling(done / SAMPLING_SHARE)
            return
        if not solving:
            solving.append(bench.step(f"solving for {spec.size:,} functions", SAMPLING_SHARE, 1.0))
        solving[0]((done - SAMPLING_SHARE) / (1 - SAMPLING_SHARE))

    basis = poisson_basis(mesh, spec.size, spec.cutoff, list(spec.first), progress=progress)
    arrays = {
        "functions_data": np.asarray(basis.functions.data, dtype=np.float64),
        "functions_indices": np.asarray(basis.functions.indices, dtype=np.int64),
        "functions_indptr": np.asarray(basis.functions.indptr, dtype=np.int64),
        "samples": np.asarray(basis.samples, dtype=np.int64),
        "cells": np.asarray(basis.cells, dtype=np.int64),
    }
    return Made({"n_functions": basis.size}, arrays, f"{mesh.n_vertices:,} vertices, {basis.size} functions")


def _spectrum(spec: specs.Spectrum, bench: Bench) -> Made:
    from solver.descriptors import spectrum  # noqa: PLC0415  (see the module)

    mesh = bench.read.mesh(spec.mesh)
    bench.step(f"solving for {spec.eigenpairs} eigenpairs", 0.0, 1.0)
    found = spectrum(mesh, spec.eigenpairs)
    arrays = {"eigenvalues": found.values, "eigenfunctions": found.functions}
    return Made({}, arrays, f"{mesh.n_vertices:,} vertices, {len(found.values)} eigenpairs")


def _descriptor(spec: specs.Descriptor, bench: Bench) -> Made:
    from solver.descriptors import hks_of, wks_of  # noqa: PLC0415  (see the module)

    own = bench.read.spectrum(spec.mesh, spec.eigenpairs)
    partner = None if spec.partner is None else bench.read.spectrum(spec.partner, spec.eigenpairs)
    bench.step(f"{spec.count} values a vertex", 0.0, 1.0)
    made = (wks_of if spec.type == "wks" else hks_of)(own, partner, spec.count)
    arrays = {"descriptor": made, "eigenvalues": own.values}
    return Made({}, arrays, f"{made.shape[0]:,} vertices, {spec.count} values")


def _softmap(spec: specs.SoftMap, bench: Bench) -> Made:
    from solver import SoftMap  # noqa: PLC0415  (see the module)

    read = bench.read
    source, target = read.basis(spec.source), read.basis(spec.target)
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


def _faces(count: int) -> str:
    return f"solving {count:,} faces"


def _potential(spec: specs.Potential, bench: Bench) -> Made:
    if bench.shards:
        return _gathered_potential(bench)
    from solver.potential import potential_block  # noqa: PLC0415  (see the module)

    softmap = bench.read.softmap(spec.softmap)
    mesh = softmap.source.mesh
    report = bench.step(_faces(mesh.n_faces), 0.0, 0.95)
    found = np.empty((mesh.n_faces, 2, softmap.target.size))
    frames = np.empty((mesh.n_faces, 2, 3))
    residual = 0.0
    # Block by block, as shards are: so that both make the same bits.
    for start, stop in sizes.blocks(mesh.n_faces):

        def part(done: float, start: int = start, stop: int = stop) -> None:
            report((start + done * (stop - start)) / mesh.n_faces)

        block = potential_block(softmap, start, stop, spec.regularisation, bench.threads, part)
        found[start:stop], frames[start:stop] = block.potential, block.frames
        residual = max(residual, block.residual)
    bench.step("writing", 0.95, 1.0)
    words = f"{mesh.n_faces:,} faces, {softmap.target.size} functions"
    return Made({"max_residual": residual}, {"potential": found, "frames": frames}, words, residual)


def _potential_block(spec: specs.PotentialBlock, bench: Bench) -> Made:
    from solver.potential import potential_block  # noqa: PLC0415  (see the module)

    softmap = bench.read.softmap(spec.softmap)
    report = bench.step(_faces(spec.stop - spec.start), 0.0, 1.0)
    block = potential_block(softmap, spec.start, spec.stop, spec.regularisation, bench.threads, report)
    arrays = {"potential": block.potential, "frames": block.frames}
    words = f"faces {spec.start:,} to {spec.stop:,}, {softmap.target.size} functions"
    return Made({"max_residual": block.residual}, arrays, words, block.residual)


def _gathered_potential(bench: Bench) -> Made:
    """One manifest over the blocks of all shards; nothing is copied."""
    bench.step(f"gathering {len(bench.shards)} blocks", 0.0, 1.0)
    manifests = [bench.read.manifest(shard) for shard in bench.shards]
    arrays = {
        name: BorrowedBlocks(tuple((shard, name) for shard in bench.shards))
        for name in ("potential", "frames")
    }
    residual = max(float(manifest.values["max_residual"]) for manifest in manifests)
    seconds = sum(float(manifest.made["seconds"]) for manifest in manifests)
    words = f"{len(bench.shards)} blocks"
    return Made({"max_residual": residual}, arrays, words, residual, bench.shards, seconds)


def _energy(spec: specs.Energy, bench: Bench) -> Made:
    from solver import bijectivity, dirichlet  # noqa: PLC0415  (see the module)
    from solver.energy import Dirichlet, gather_dirichlet  # noqa: PLC0415

    softmap = bench.read.softmap(spec.softmap)
    seconds = 0.0
    if bench.shards:
        report = bench.step(f"adding up {len(bench.shards)} blocks", 0.0, 0.95)
        store = bench.read.store

        def blocks() -> Iterator[Dirichlet]:
            nonlocal seconds
            for k, shard in enumerate(bench.shards):
                manifest = bench.read.manifest(shard)
                seconds += float(manifest.made["seconds"])
                yield Dirichlet(
                    energy=float(manifest.values["dirichlet"]),
                    density=store.array(manifest, "dirichlet_density"),
                    gradient=store.array(manifest, "dirichlet_gradient") if spec.gradient else None,
                    residual=float(manifest.values["max_residual"]),
                )
                report((k + 1) / len(bench.shards))

        found = gather_dirichlet(blocks())
    else:
        report = bench.step(_faces(softmap.source.mesh.n_faces), 0.0, 0.95)
        found = dirichlet(softmap, spec.regularisation, spec.gradient, bench.threads, report)
    bench.step("bijectivity", 0.95, 1.0)
    returned = bijectivity(softmap)
    arrays = {"dirichlet_density": found.density, "bijectivity_density": returned.density}
    if found.gradient is not None:
        arrays |= {"dirichlet_gradient": found.gradient, "bijectivity_gradient": returned.gradient}
    values = {"dirichlet": found.energy, "bijectivity": returned.energy, "max_residual": found.residual}
    words = f"{softmap.source.mesh.n_faces:,} faces, {softmap.target.size} functions"
    return Made(values, arrays, words, found.residual, bench.shards, seconds)


def _energy_block(spec: specs.EnergyBlock, bench: Bench) -> Made:
    from solver.energy import dirichlet_block  # noqa: PLC0415  (see the module)

    softmap = bench.read.softmap(spec.softmap)
    report = bench.step(_faces(spec.stop - spec.start), 0.0, 1.0)
    found = dirichlet_block(
        softmap, spec.start, spec.stop, spec.regularisation, spec.gradient, bench.threads, report
    )
    arrays = {"dirichlet_density": found.density}
    if found.gradient is not None:
        arrays["dirichlet_gradient"] = found.gradient
    values = {"dirichlet": found.energy, "max_residual": found.residual}
    words = f"faces {spec.start:,} to {spec.stop:,}, {softmap.target.size} functions"
    return Made(values, arrays, words, found.residual)


def _energy_shards(spec: specs.Energy, sizes_: Sizes) -> tuple[specs.Spec, ...]:
    n_faces = sizes_.softmap(spec.softmap).source.mesh.n_faces
    return tuple(
        specs.EnergyBlock(
            softmap=spec.softmap,
            regularisation=spec.regularisation,
            gradient=spec.gradient,
            start=start,
            stop=stop,
        )
        for start, stop in sizes.blocks(n_faces)
    )


def _potential_shards(spec: specs.Potential, sizes_: Sizes) -> tuple[specs.Spec, ...]:
    n_faces = sizes_.softmap(spec.softmap).source.mesh.n_faces
    return tuple(
        specs.PotentialBlock(softmap=spec.softmap, regularisation=spec.regularisation, start=start, stop=stop)
        for start, stop in sizes.blocks(n_faces)
    )


STAGES: Final[Mapping[type[specs.Spec], Stage]] = {
    specs.Basis: Stage(_basis, sizes.basis_cost, checks.basis),
    specs.Spectrum: Stage(_spectrum, sizes.spectrum_cost, checks.spectrum),
    specs.Descriptor: Stage(_descriptor, sizes.descriptor_cost, checks.descriptor),
    specs.SoftMap: Stage(_softmap, sizes.softmap_cost, checks.softmap),
    specs.Potential: Stage(_potential, sizes.potential_cost, shards=_potential_shards),
    specs.PotentialBlock: Stage(_potential_block, sizes.potential_block_cost),
    specs.Energy: Stage(_energy, sizes.energy_cost, shards=_energy_shards),
    specs.EnergyBlock: Stage(_energy_block, sizes.energy_block_cost),
}


def stage(spec: specs.Spec) -> Stage:
    """How a question is answered."""
    return STAGES[type(spec)]


def flaws(spec: specs.Spec, sizes_: Sizes, settings: Settings) -> list[checks.Flaw]:
    """What manifests say is wrong with a question, as (place below it, what).

    Parameters
    ----------
    spec : Spec
    sizes_ : Sizes
    settings : Settings

    Returns
    -------
    list of (str, str)
        Empty if it may be computed.
    """
    missing = list(checks.missing_uploads(spec, sizes_))
    return missing or list(stage(spec).check(spec, sizes_, settings))
