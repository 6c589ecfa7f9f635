"""Small meshes whose geometry is known exactly, for every test of the solver."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

from solver.mesh import Mesh


def triangle() -> Mesh:
    """Right triangle with legs 2 and 1: area 1, so it is its own unit mesh up to translation."""
    return Mesh([[0, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2]])


def tetrahedron() -> Mesh:
    """Regular tetrahedron, oriented outwards."""
    corners = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
    return Mesh(corners, [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


def icosphere(subdivisions: int = 3) -> Mesh:
    """Unit sphere with 10·4^s + 2 vertices (42, 162, 642, 2562, … for s = 1, 2, 3, 4, …)."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return Mesh(sphere.vertices, sphere.faces)


def fibonacci_sphere(size: int) -> Mesh:
    """Unit sphere with `size` vertices on a spiral, joined by their convex hull: no two faces are alike."""
    heights = 1 - (2 * np.arange(size) + 1) / size
    angles = np.pi * (1 + 5**0.5) * np.arange(size)
    rings = np.sqrt(1 - heights**2)
    points = np.column_stack([rings * np.cos(angles), rings * np.sin(angles), heights])
    faces = ConvexHull(points).simplices
    a, b, c = (points[faces[:, k]] for k in range(3))
    inwards = np.einsum("fx,fx->f", np.cross(b - a, c - a), a) < 0
    return Mesh(points, np.where(inwards[:, None], faces[:, ::-1], faces))


def grid(rows: int = 8, columns: int = 8, width: float = 1.0, height: float = 1.0) -> Mesh:
    """Flat rectangle of rows × columns squares in the plane z = 0, each cut along one diagonal."""
    x, y = np.meshgrid(np.linspace(0, width, columns + 1), np.linspace(0, height, rows + 1))
    a = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    b, c, d = a + 1, a + columns + 2, a + columns + 1
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Mesh(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), faces)


def torus(around: int = 24, across: int = 12, major: float = 1.0, minor: float = 0.4) -> Mesh:
    """Torus of revolution: genus 1, closed."""
    u, v = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    s, t = 2 * np.pi * u.ravel() / around, 2 * np.pi * v.ravel() / across
    ring = major + minor * np.cos(t)
    points = np.column_stack([ring * np.cos(s), ring * np.sin(s), minor * np.sin(t)])
    index = u * across + v
    a, b = index.ravel(), np.roll(index, -1, axis=0).ravel()
    d = np.roll(index, -1, axis=1).ravel()
    c = np.roll(np.roll(index, -1, axis=0), -1, axis=1).ravel()
    return Mesh(points, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))


def moebius(around: int = 30, across: int = 4) -> Mesh:
    """Möbius strip: one boundary loop, and no consistent orientation."""
    points, faces = [], []
    for i in range(around):
        angle = 2 * np.pi * i / around
        for j in range(across + 1):
            offset = j / across - 0.5
            ring = 1 + offset * np.cos(angle / 2)
            points.append([ring * np.cos(angle), ring * np.sin(angle), offset * np.sin(angle / 2)])

    def index(i: int, j: int) -> int:
        return i * (across + 1) + j if i < around else across - j

    for i in range(around):
        for j in range(across):
            a, b, c, d = index(i, j), index(i + 1, j), index(i + 1, j + 1), index(i, j + 1)
            faces += [[a, b, c], [a, c, d]]
    return Mesh(points, faces)


def hourglass() -> Mesh:
    """Two triangles that touch at vertex 0 only: one component, two boundary loops."""
    return Mesh([[0, 0, 0], [1, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]], [[0, 1, 2], [0, 4, 3]])


def book() -> Mesh:
    """Three triangles on the edge 0–1, which is non-manifold."""
    corners = [[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0], [0.5, 0, 1]]
    return Mesh(corners, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])


def together(*meshes: Mesh, gap: float = 3.0) -> Mesh:
    """Several meshes as the components of one, side by side along x."""
    vertices, faces, count = [], [], 0
    for k, mesh in enumerate(meshes):
        vertices.append(mesh.vertices + np.array([gap * k, 0, 0]))
        faces.append(mesh.faces + count)
        count += mesh.n_vertices
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


def load(path: Path) -> Mesh:
    """Read a mesh file with its vertices in the file's order."""
    loaded = trimesh.load(path, process=False, maintain_order=True, skip_materials=True, force="mesh")
    return Mesh(loaded.vertices, loaded.faces)


def moved(mesh: Mesh, rng: np.random.Generator, scale: float = 1.0) -> Mesh:
    """The same mesh after a random rotation and translation, and a scaling."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    q[:, 0] *= np.sign(np.linalg.det(q))
    return Mesh(scale * (mesh.vertices @ q.T + rng.normal(size=3)), mesh.faces)


def relabelled(mesh: Mesh, order: np.ndarray) -> Mesh:
    """The same mesh with its vertices renumbered: vertex k of the result is vertex order[k]."""
    place = np.empty(mesh.n_vertices, dtype=np.int64)
    place[order] = np.arange(mesh.n_vertices)
    return Mesh(mesh.vertices[order], place[mesh.faces])
