"""What manifests decide about a question, before it is computed: existence, kinds, shapes, sizes.

What only values decide (a point map that leaves the target, rows that do not sum to 1) is a failed job.
"""

from __future__ import annotations

from collections.abc import Iterator

from worker import specs
from worker.fields import kind_of
from worker.settings import Settings
from worker.sizes import BasisSize, Sizes

#: Where below a spec something is wrong, and what.
Flaw = tuple[str, str]


def missing_uploads(spec: specs.Spec, sizes: Sizes) -> Iterator[Flaw]:
    """Meshes and arrays that a spec names and the store does not hold."""
    for path, id_ in specs.references(spec):
        if kind_of(id_) in specs.UPLOADED_KINDS and not sizes.store.has(id_):
            again = ": upload it again" if sizes.store.gone(id_) else ""
            yield f"/{path}", f"There is no such {kind_of(id_)}{again}"


def basis(spec: specs.Basis, sizes: Sizes, settings: Settings) -> Iterator[Flaw]:
    """The size fits the mesh, and the first samples are vertices."""
    mesh = sizes.mesh(spec.mesh)
    if spec.size > settings.max_functions:
        yield "/size", f"A basis may have at most {settings.max_functions} functions here"
    elif spec.size > mesh.n_vertices:
        yield "/size", f"There are {mesh.n_vertices} vertices, too few for {spec.size} functions"
    elif spec.size < mesh.n_components:
        yield "/size", f"Each of the {mesh.n_components} components needs a function of its own"
    for k, vertex in enumerate(spec.first):
        yield from _vertex("/first" if len(spec.first) == 1 else f"/first/{k}", vertex, mesh.n_vertices)


def spectrum(spec: specs.Spectrum, sizes: Sizes, settings: Settings) -> Iterator[Flaw]:
    """Nothing beyond the mesh: fewer vertices than eigenpairs give fewer eigenpairs."""
    sizes.mesh(spec.mesh)
    yield from ()


def descriptor(spec: specs.Descriptor, sizes: Sizes, settings: Settings) -> Iterator[Flaw]:
    """Nothing beyond the meshes."""
    sizes.mesh(spec.mesh)
    yield from ()


def softmap(spec: specs.SoftMap, sizes: Sizes, settings: Settings) -> Iterator[Flaw]:
    """The target is connected, and what the map is made from fits both ends."""
    source, target = sizes.basis(spec.source), sizes.basis(spec.target)
    if target.mesh.n_components != 1:
        yield "/target", f"A target must be connected; its mesh has {target.mesh.n_components} components"
    match spec.map:
        case specs.Points():
            yield from _points(spec.map, source, sizes)
        case specs.Descriptors():
            yield from _descriptors(spec, (spec.map.source, spec.map.target), source, target, sizes)
        case specs.Optimal():
            yield from _optimal(spec.map, source, target)
            if spec.map.source is not None and spec.map.target is not None:
                yield from _descriptors(spec, (spec.map.source, spec.map.target), source, target, sizes)
            if spec.map.start is not None:
                yield from _start(spec, spec.map.start, sizes)
        case specs.Matrix():
            shape, _ = sizes.array(spec.map.coefficients)
            wanted = (source.n_functions, target.n_functions)
            if shape != wanted:
                yield (
                    "/map/coefficients",
                    f"The shape is {_text(shape)}, but should be {_text(wanted)}: (n₀, n)",
                )


def _optimal(chosen: specs.Optimal, source: BasisSize, target: BasisSize) -> Iterator[Flaw]:
    counts = (source.mesh.n_vertices, target.mesh.n_vertices)
    for k, pair in enumerate(chosen.landmarks):
        for end in (0, 1):
            yield from _vertex(f"/map/landmarks/{k}/{end}", pair[end], counts[end])
    for k, constraint in enumerate(chosen.constraints):
        for side, region, count in zip(
            ("source", "target"), (constraint.source, constraint.target), counts, strict=True
        ):
            if max(region) >= count:
                yield from _vertex(f"/map/constraints/{k}/{side}", max(region), count)


def _start(spec: specs.SoftMap, start: str, sizes: Sizes) -> Iterator[Flaw]:
    earlier = sizes.spec_of(start)
    assert isinstance(earlier, specs.SoftMap)
    ends = zip((spec.source, spec.target), (earlier.source, earlier.target), strict=True)
    if any(_mesh_of(own, sizes) != _mesh_of(other, sizes) for own, other in ends):
        yield "/map/start", "An optimal map can start from maps between the same two meshes only"


def _mesh_of(basis_id: str, sizes: Sizes) -> str | None:
    spec = sizes.spec_of(basis_id)
    return spec.mesh if isinstance(spec, specs.Basis) else None


def _points(points: specs.Points, source: BasisSize, sizes: Sizes) -> Iterator[Flaw]:
    n_vertices = source.mesh.n_vertices
    shape, dtype = sizes.array(points.targets)
    if shape != (n_vertices,):
        detail = (
            f"The shape is {_text(shape)}, but should be {_text((n_vertices,))}: a target per source vertex"
        )
        yield "/map/targets", detail
    if dtype != "int64":
        yield "/map/targets", f"Targets should be integers, counted from 0, not {dtype}"
    if points.barycentric is not None:
        shape, _ = sizes.array(points.barycentric)
        if shape != (n_vertices, 3):
            yield "/map/barycentric", f"The shape is {_text(shape)}, but should be {_text((n_vertices, 3))}"


def _descriptors(
    spec: specs.SoftMap, pair: tuple[str, str], source: BasisSize, target: BasisSize, sizes: Sizes
) -> Iterator[Flaw]:
    columns = []
    for side, basis_id, id_, end in (
        ("source", spec.source, pair[0], source),
        ("target", spec.target, pair[1], target),
    ):
        place = f"/map/{side}"
        made, basis_spec = sizes.spec_of(id_), sizes.spec_of(basis_id)
        if isinstance(made, specs.Descriptor) and isinstance(basis_spec, specs.Basis):
            if made.mesh != basis_spec.mesh:
                yield place, f"This descriptor is of another mesh than the {side} basis"
                continue
        elif len(sizes.array(id_)[0]) != 2:
            yield place, "A descriptor has a row per vertex and a column per value: two axes"
            continue
        rows, width = sizes.descriptor(id_)
        if rows != end.mesh.n_vertices:
            yield place, f"There are {rows} rows for {end.mesh.n_vertices} {side} vertices"
        columns.append(width)
    if len(columns) == 2 and columns[0] != columns[1]:
        yield "/map/target", f"Descriptors of {columns[0]} and {columns[1]} columns cannot be compared"


def momentum(spec: specs.Momentum, sizes: Sizes, settings: Settings) -> Iterator[Flaw]:
    """The faces are faces of the source."""
    n_faces = sizes.softmap(spec.softmap).source.mesh.n_faces
    one = isinstance(spec.face, int)
    for k, face in enumerate((spec.face,) if isinstance(spec.face, int) else spec.face):
        if face >= n_faces:
            yield "/face" if one else f"/face/{k}", f"There is no face {face}, only 0 … {n_faces - 1}"


def path(spec: specs.Path, sizes: Sizes, settings: Settings) -> Iterator[Flaw]:
    """The path passes vertices of the source, and starts at one of the target."""
    ends = sizes.softmap(spec.softmap)
    for k, vertex in enumerate(spec.source_path):
        yield from _vertex(f"/source_path/{k}", vertex, ends.source.mesh.n_vertices)
    yield from _vertex("/start", spec.start, ends.target.mesh.n_vertices)


def _vertex(place: str, vertex: int, n_vertices: int) -> Iterator[Flaw]:
    if vertex >= n_vertices:
        yield place, f"There is no vertex {vertex}, only 0 … {n_vertices - 1}"


def of_softmap(spec: specs.Spec, sizes: Sizes, settings: Settings) -> Iterator[Flaw]:
    """Nothing beyond the soft map, which has been checked itself."""
    yield from ()


def _text(shape: tuple[int, ...]) -> str:
    return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
