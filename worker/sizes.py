"""How large a question is, and what answering it costs in seconds and bytes.

Sizes come from specs and manifests alone, so they are known before anything is computed. Coefficients were
measured on one core and are meant to be right within a factor of two or three.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from worker import specs
from worker.specs import Spec
from worker.store import Manifest, Store

#: Blocks of this many source faces are one shard; the solver's sums go by the same blocks.
FACE_BLOCK: Final = 4096
_FLOAT: Final = 8


@dataclass(frozen=True)
class Cost:
    """What a task is expected to take: `seconds` on one machine, `bytes` of memory beyond the bare worker."""

    seconds: float
    bytes: int


@dataclass(frozen=True)
class MeshSize:
    """Counts of a mesh."""

    n_vertices: int
    n_faces: int
    n_components: int


@dataclass(frozen=True)
class BasisSize:
    """A mesh's counts, the number of functions on it, and their overlap beside that of a poisson basis."""

    mesh: MeshSize
    n_functions: int
    overlap: float = 1.0


@dataclass(frozen=True)
class MapSize:
    """Both ends of a soft map."""

    source: BasisSize
    target: BasisSize


@dataclass(frozen=True, eq=False)
class Sizes:
    """Sizes of what ids name, without computing anything.

    Parameters
    ----------
    store : Store
        Knows the meshes and arrays.
    spec_of : callable
        Spec of a computed id.

    Raises
    ------
    LookupError
        By every method, if something on the way is unknown.
    """

    store: Store
    spec_of: Callable[[str], Spec | None]
    _manifests: dict[str, Manifest] = field(default_factory=dict)

    def manifest(self, id_: str) -> Manifest:
        """Manifest of an upload."""
        if id_ not in self._manifests:
            manifest = self.store.manifest(id_)
            if manifest is None:
                raise LookupError(id_)
            self._manifests[id_] = manifest
        return self._manifests[id_]

    def mesh(self, id_: str) -> MeshSize:
        """Size of a mesh."""
        manifest = self.manifest(id_)
        return MeshSize(
            n_vertices=manifest.arrays["vertices"].shape[0],
            n_faces=manifest.arrays["faces"].shape[0],
            n_components=int(manifest.values["n_components"]),
        )

    def array(self, id_: str) -> tuple[tuple[int, ...], str]:
        """Shape and type of an array."""
        stored = self.manifest(id_).arrays["array"]
        return stored.shape, stored.dtype

    def basis(self, id_: str) -> BasisSize:
        """Size of a basis."""
        spec = self.spec_of(id_)
        if not isinstance(spec, specs.Basis):
            raise LookupError(id_)
        # Of γ alone, measured: how far functions reach, and so what factoring takes.
        overlap = max(0.5, (2 / spec.sharpness) ** 0.75) if isinstance(spec, specs.MaxentBasis) else 1.0
        return BasisSize(self.mesh(spec.mesh), spec.size, overlap)

    def descriptor(self, id_: str) -> tuple[int, int]:
        """Rows and columns of a descriptor or of an array in its place."""
        spec = self.spec_of(id_)
        if isinstance(spec, specs.Descriptor):
            return self.mesh(spec.mesh).n_vertices, spec.count
        shape, _ = self.array(id_)
        return shape[0], shape[1]

    def softmap(self, id_: str) -> MapSize:
        """Size of a soft map."""
        spec = self.spec_of(id_)
        if not isinstance(spec, specs.SoftMap):
            raise LookupError(id_)
        return MapSize(self.basis(spec.source), self.basis(spec.target))


def basis_cost(spec: specs.Basis, sizes: Sizes) -> Cost:
    """Samples by fast marching, then a sparse solve a function on its share of the mesh, or logarithms."""
    n_vertices = sizes.mesh(spec.mesh).n_vertices
    seconds = 0.03 + 1.5e-5 * n_vertices + 4e-4 * spec.size
    memory = 3_000 * n_vertices + 20_000 * spec.size
    if isinstance(spec, specs.MaxentBasis):
        # Discs around samples have 2.4 h for radius, or more where functions are blunt.
        discs = max(1.0, 3 / spec.sharpness)
        return Cost(seconds + 4e-5 * n_vertices * discs, memory + round(2_500 * n_vertices * discs))
    # A cell and its ring are seven cells; few functions mean large systems.
    patch = min(n_vertices, 7 * n_vertices / spec.size)
    return Cost(seconds + 2.4e-8 * spec.size * patch**1.75, memory)


def spectrum_cost(spec: specs.Spectrum, sizes: Sizes) -> Cost:
    """A Lanczos basis of 3.3 vectors for each pair on a sparse factorisation; all pairs of small meshes."""
    n_vertices = sizes.mesh(spec.mesh).n_vertices
    pairs = min(spec.eigenpairs, n_vertices)
    if n_vertices <= max(600, 4 * pairs):
        return Cost(0.02 + 5e-10 * n_vertices**3, _FLOAT * n_vertices * (3 * n_vertices + 2 * pairs + 250))
    vectors = 3.3 * pairs + 50
    orthogonalising = (3e-10 * n_vertices + 1.5e-9 * vectors) * vectors**2
    seconds = 0.03 + 1e-7 * n_vertices * vectors + 1e-7 * n_vertices**1.5 + orthogonalising
    return Cost(seconds, round(_FLOAT * (n_vertices * (6.5 * pairs + 450) + 4 * (8 * pairs + 512) ** 2)))


def descriptor_cost(spec: specs.Descriptor, sizes: Sizes) -> Cost:
    """One product of squared eigenfunctions with filters."""
    n_vertices = sizes.mesh(spec.mesh).n_vertices
    pairs = min(spec.eigenpairs, n_vertices)
    seconds = 0.02 + 2e-9 * n_vertices * pairs * spec.count
    return Cost(seconds, _FLOAT * n_vertices * (2 * pairs + 2 * spec.count))


def softmap_cost(spec: specs.SoftMap, sizes: Sizes) -> Cost:
    """Projections are sparse; comparing descriptors visits every pair of vertices."""
    source, target = sizes.basis(spec.source), sizes.basis(spec.target)
    entries = source.n_functions * target.n_functions
    seconds = 0.05 + 4e-9 * entries
    memory = 4 * _FLOAT * entries + 2_000 * (source.mesh.n_vertices + target.mesh.n_vertices)
    if isinstance(spec.map, specs.Descriptors):
        _, columns = sizes.descriptor(spec.map.source)
        # Each pair of vertices costs an exponential, and a multiplication for each function on its tile.
        nearby = min(target.n_functions, 40 + 3_000 * target.n_functions / target.mesh.n_vertices)
        seconds += (8e-9 + 6e-11 * nearby) * source.mesh.n_vertices * target.mesh.n_vertices
        # Descriptors scaled, centred and turned, and 3 MB a thread, for sixteen threads.
        memory += 4 * _FLOAT * columns * (source.mesh.n_vertices + target.mesh.n_vertices) + 50_000_000
        memory += 16 * 4 * _FLOAT * 256 * target.n_functions
    if isinstance(spec.map, specs.Optimal):
        return _optimal_cost(spec.map, MapSize(source, target))
    if isinstance(spec.map, specs.Mixture):
        seconds += 4e-9 * entries * len(spec.map.maps)
        memory += _FLOAT * entries * len(spec.map.maps)
    return Cost(seconds, memory)


def solve_seconds(size: MapSize, n_faces: int) -> float:
    """Time of the solve for some source faces: assembly, a factorisation and two substitutions each."""
    n = size.target.n_functions
    setup = 0.02 + 1e-5 * (size.source.mesh.n_faces + size.target.mesh.n_faces) + 6e-4 * n
    return setup + n_faces * (1.4e-7 * n + 1.2e-9 * size.target.overlap * n**2)


def solve_bytes(size: MapSize, n_faces: int) -> int:
    """Memory of that solve, but for what it returns: gradients, the tensor W, factors for some threads."""
    n_source, n_target = size.source.mesh.n_faces, size.target.mesh.n_faces
    return 3_000 * (n_source + n_target) + 100_000 * size.target.n_functions + 64 * n_faces


def energy_block_cost(spec: specs.EnergyBlock, sizes: Sizes) -> Cost:
    """One block of faces."""
    return _energy(sizes.softmap(spec.softmap), spec.stop - spec.start, spec.gradient)


def energy_cost(spec: specs.Energy, sizes: Sizes) -> Cost:
    """All faces, and the bijectivity energy."""
    size = sizes.softmap(spec.softmap)
    return _energy(size, size.source.mesh.n_faces, spec.gradient)


def _energy(size: MapSize, n_faces: int, gradient: bool) -> Cost:
    entries = size.source.n_functions * size.target.n_functions
    memory = solve_bytes(size, n_faces) + _FLOAT * entries * (5 if gradient else 2)
    seconds = solve_seconds(size, n_faces)
    if gradient:
        seconds += n_faces * 1.5e-7 * size.target.n_functions
    return Cost(seconds, memory)


def potential_block_cost(spec: specs.PotentialBlock, sizes: Sizes) -> Cost:
    """One block of faces."""
    return _potential(sizes.softmap(spec.softmap), spec.stop - spec.start)


def potential_cost(spec: specs.Potential, sizes: Sizes) -> Cost:
    """All faces."""
    size = sizes.softmap(spec.softmap)
    return _potential(size, size.source.mesh.n_faces)


def _potential(size: MapSize, n_faces: int) -> Cost:
    row = 2 * size.target.n_functions + 6
    # Solved, then written block by block: 30 ns a number covers hashing and the disk.
    seconds = solve_seconds(size, n_faces) + 3e-8 * row * n_faces
    return Cost(seconds, solve_bytes(size, n_faces) + 2 * _FLOAT * row * n_faces)


def _optimal_cost(chosen: specs.Optimal, size: MapSize) -> Cost:
    """An energy with its gradient for every iteration, and what choosing the next step takes."""
    n_source, n = size.source.n_functions, size.target.n_functions
    each = _energy(size, size.source.mesh.n_faces, gradient=True)
    if chosen.method == "softmax":
        memory = each.bytes + 200 * _FLOAT * n_source * n
        return Cost(min(300, 1 + chosen.max_iterations) * each.seconds, memory)
    # Gaps fall by a tenth every few iterations; a model of all rows is factored in each.
    usual = 20 + 6 * max(0.0, math.log10(1e-3 / chosen.tolerance))
    seconds = each.seconds + 2e-7 * n_source * n**2
    memory = each.bytes + 3 * _FLOAT * n_source * n**2
    return Cost(min(usual, 1 + chosen.max_iterations) * seconds, memory)


def pointmap_cost(spec: specs.PointMap, sizes: Sizes) -> Cost:
    """A score for every pair of vertices; barycentres also take distances from every sample."""
    size = sizes.softmap(spec.softmap)
    pairs = size.source.mesh.n_vertices * size.target.mesh.n_vertices
    n, n_target = size.target.n_functions, size.target.mesh.n_vertices
    entries = size.source.mesh.n_vertices * n
    memory = 400_000_000 + 3 * _FLOAT * (entries + n_target * n)
    if spec.method == "peak":
        return Cost(0.1 + 2e-8 * pairs + 1e-8 * entries, memory)
    return Cost(0.1 + (1e-8 + 3e-10 * n) * pairs + 1e-8 * entries + 2e-6 * n * n_target, memory)


def momentum_cost(spec: specs.Momentum, sizes: Sizes) -> Cost:
    """A solve of the faces that are asked for, and two vectors a target face for each."""
    size = sizes.softmap(spec.softmap)
    n_points = 1 if isinstance(spec.face, int) else len(spec.face)
    n_faces = size.target.mesh.n_faces
    seconds = solve_seconds(size, n_points) + 2e-7 * n_points * n_faces
    return Cost(seconds, solve_bytes(size, n_points) + n_faces * (1_000 + 16 * _FLOAT * n_points))


def path_cost(spec: specs.Path, sizes: Sizes) -> Cost:
    """A shortest path to each next vertex, a solve of the faces it crosses, and a walk for each step."""
    size = sizes.softmap(spec.softmap)
    # A path of many vertices is taken for a smooth one: most are as near to the next as an edge is long.
    n_stops = len(spec.source_path)
    n_far = min(n_stops, 20)
    across = size.source.mesh.n_faces**0.5
    seconds = n_far * (1.2e-3 * across + 2e-6 * size.source.mesh.n_faces + 1e-4 / spec.step) + 2e-3 * n_stops
    crossed = round(0.8 * across * n_far) + n_stops
    row = 2 * size.target.n_functions + 6
    memory = solve_bytes(size, crossed) + 4 * _FLOAT * row * crossed + 2_000 * round(n_far / spec.step)
    return Cost(solve_seconds(size, crossed) + seconds, memory + 3_000 * size.source.mesh.n_faces)


def gathering_cost(size: MapSize, n_faces: int, gradient: bool) -> Cost:
    """Adding up the shards of an energy, or naming those of a potential."""
    entries = size.source.n_functions * size.target.n_functions
    n_blocks = -(-n_faces // FACE_BLOCK)
    memory = 5 * _FLOAT * entries + 3_000 * (n_faces + size.target.mesh.n_faces)
    return Cost(0.2 + n_blocks * (0.01 + (1e-8 * entries if gradient else 0)), memory)


def blocks(n_faces: int) -> list[tuple[int, int]]:
    """Blocks [start, stop) that the faces fall into, in order."""
    return [(start, min(start + FACE_BLOCK, n_faces)) for start in range(0, n_faces, FACE_BLOCK)]
