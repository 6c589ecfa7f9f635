"""Tasks that solve for all source faces: energies and potentials, whole, in shards, or gathered from them.

The solver is imported inside functions: whoever only plans tasks must not load it.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from worker import sizes, specs
from worker.bench import Bench, Made
from worker.sizes import Sizes
from worker.store import BorrowedBlocks


def _faces(count: int) -> str:
    return f"solving {count:,} faces"


def make_potential(spec: specs.Potential, bench: Bench) -> Made:
    """Potentials of all source faces; gathered where they were solved in shards."""
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


def make_potential_block(spec: specs.PotentialBlock, bench: Bench) -> Made:
    """Potentials of one block of faces."""
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


def make_energy(spec: specs.Energy, bench: Bench) -> Made:
    """Both energies and their densities; gathered where they were solved in shards."""
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


def make_energy_block(spec: specs.EnergyBlock, bench: Bench) -> Made:
    """Dirichlet energy of one block of faces."""
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


def energy_shards(spec: specs.Energy, sizes_: Sizes) -> tuple[specs.Spec, ...]:
    """Blocks of faces that an energy can be split into."""
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


def potential_shards(spec: specs.Potential, sizes_: Sizes) -> tuple[specs.Spec, ...]:
    """Blocks of faces that a potential can be split into."""
    n_faces = sizes_.softmap(spec.softmap).source.mesh.n_faces
    return tuple(
        specs.PotentialBlock(softmap=spec.softmap, regularisation=spec.regularisation, start=start, stop=stop)
        for start, stop in sizes.blocks(n_faces)
    )
