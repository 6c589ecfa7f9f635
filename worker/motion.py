"""Tasks that follow the mass of a soft map: momentum at source points, paths, and where vertices go.

The solver is imported inside functions: whoever only plans tasks must not load it.
"""

from __future__ import annotations

from worker import specs
from worker.bench import Bench, Made


def make_momentum(spec: specs.Momentum, bench: Bench) -> Made:
    """Velocity and momentum in every target face; only the source faces that were asked for are solved."""
    from solver import mass_density, velocity  # noqa: PLC0415  (see the module)

    softmap = bench.read.softmap(spec.softmap)
    count = 1 if isinstance(spec.face, int) else len(spec.face)
    bench.step(f"solving {count:,} {'face' if count == 1 else 'faces'}", 0.0, 1.0)
    moving = velocity(softmap, spec.face, spec.direction, spec.regularisation)
    density = mass_density(softmap, spec.face, spec.regularisation)
    arrays = {"velocity": moving, "momentum": density[..., None] * moving}
    return Made({}, arrays, f"{count:,} source points, {softmap.target.mesh.n_faces:,} target faces")


def make_path(spec: specs.Path, bench: Bench) -> Made:
    """Path on the target, and where the source path was meanwhile."""
    from solver import trace  # noqa: PLC0415  (see the module)

    softmap = bench.read.softmap(spec.softmap)
    report = bench.step(f"following a path through {len(spec.source_path):,} vertices", 0.0, 1.0)
    found = trace(softmap, list(spec.source_path), spec.start, spec.step, spec.regularisation, report)
    arrays = {
        "points": found.points,
        "faces": found.faces,
        "barycentric": found.barycentric,
        "source_points": found.source_points,
        "source_faces": found.source_faces,
        "source_barycentric": found.source_barycentric,
    }
    return Made({"length": found.length, "stopped": found.stopped}, arrays, f"{len(found.faces):,} points")


def make_pointmap(spec: specs.PointMap, bench: Bench) -> Made:
    """A target vertex for every source vertex, and how sure it is."""
    from solver import pointmap  # noqa: PLC0415  (see the module)

    softmap = bench.read.softmap(spec.softmap)
    n_vertices = softmap.source.mesh.n_vertices
    report = bench.step(f"finding targets of {n_vertices:,} vertices", 0.0, 1.0)
    found = pointmap(softmap, spec.method, report)
    arrays = {"targets": found.targets, "confidence": found.confidence}
    return Made({}, arrays, f"{n_vertices:,} vertices")
