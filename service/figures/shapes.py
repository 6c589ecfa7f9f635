"""The surfaces of the figures: real meshes from a folder that has them, built-in ones otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from service.creature import creature
from service.marks import Floats, Ints
from service.parsing import FORMATS, Limits, read_mesh
from service.rasteriser import View
from solver import Mesh

#: Meshes of figures have a few thousand vertices.
LIMITS = Limits(200_000, 400_000)

Place = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh, where it is seen from, and places on it.

    Attributes
    ----------
    mesh : Mesh
    view : View
    places : mapping of str to (float, float, float)
        Near vertices, in coordinates of the unit mesh.
    """

    mesh: Mesh
    view: View
    places: Mapping[str, Place] = field(default_factory=dict)

    def vertex(self, place: str) -> int:
        """Vertex nearest to a place.

        Raises
        ------
        KeyError
            If it has no such place.
        """
        return int(np.linalg.norm(self.mesh.unit_vertices - self.places[place], axis=1).argmin())


@dataclass(frozen=True, eq=False)
class Pair:
    """Two shapes, what is known of their correspondence, and places for points and paths.

    Attributes
    ----------
    name : str
        What they are called.
    source, target : Shape
    truth : ndarray of int64, shape (V₀,)
        Target vertex of each source vertex, −1 where it is not known.
    twins : ndarray of int64, shape (V₀,)
        The same with left and right exchanged; as ``truth`` where that is not known.
    limb : tuple of str
        Four places along a limb.
    ways : tuple of (str, str)
        Three places with another towards which the point moves.
    landmarks : tuple of str
        Three places.
    ahead : View, optional
        Camera that sees both legs of a pair.
    """

    name: str
    source: Shape
    target: Shape
    truth: Ints
    twins: Ints
    limb: tuple[str, str, str, str]
    ways: tuple[tuple[str, str], ...] = ()
    landmarks: tuple[str, ...] = ()
    ahead: View | None = None


WOLF = {
    "foot": (0.10, -0.25, -0.35), "shin": (0.09, -0.32, -0.29), "knee": (0.09, -0.32, -0.20),
    "shoulder": (0.09, -0.34, -0.05), "side": (0.12, 0.10, 0.03), "nose": (0.0, -0.56, 0.12),
    "tail": (0.0, 0.60, 0.12),
}  # fmt: skip
CREATURE = {
    "foot": (0.12, 0.16, -0.36), "shin": (0.08, 0.17, -0.30), "knee": (0.08, 0.17, -0.24),
    "shoulder": (0.08, 0.19, -0.11), "side": (0.12, -0.05, 0.03), "nose": (0.0, 0.60, 0.25),
    "tail": (0.0, -0.54, -0.12), "ear": (0.07, 0.39, 0.40),
}  # fmt: skip
ANT = {
    "leg": (0.25, -0.20, 0.10), "leg tip": (0.44, -0.24, -0.15), "feeler": (0.15, -0.42, 0.10),
    "feeler tip": (0.22, -0.49, 0.19), "tail": (0.05, 0.40, 0.22), "waist": (0.0, 0.14, 0.02),
}  # fmt: skip
HAND = {
    "tip": (0.46, 0.04, 0.13), "finger": (0.27, 0.06, 0.10), "knuckle": (0.08, 0.10, 0.07),
    "wrist": (-0.35, 0.12, 0.0),
}  # fmt: skip
ARM = {
    "hand": (0.62, 0.05, 0.03), "wrist": (0.42, 0.06, 0.05), "forearm": (0.20, 0.08, 0.08),
    "upper arm": (-0.40, 0.10, 0.10),
}  # fmt: skip


#: Subfolders that real meshes are looked for in.
WOLVES, ANTS, HANDS, ARMS, SERIES = FOLDERS = (
    "academic_tosca_wolf0_wolf1",
    "academic_shrec07_ant_88_90",
    "free_hand_woman_man",
    "free_arm_woman_man",
    "repo_series_cheburashka",
)


@dataclass(frozen=True)
class Shelf:
    """Where shapes are taken from.

    Attributes
    ----------
    folder : Path or None
        Its subfolders, `FOLDERS`, hold pairs of meshes, ``source__*``, ``target__*`` and ``gt.txt``, or a
        series ``pose*``. Built-in shapes stand in for those that are not there.
    """

    folder: Path | None = None

    def _has(self, name: str) -> bool:
        return self.folder is not None and (self.folder / name).is_dir()

    @cached_property
    def creatures(self) -> Pair:
        """The built-in creature, standing and trotting."""
        (vertices, faces), (moved, _) = creature("standing"), creature("trotting")
        _, mirrored = cKDTree(vertices).query(vertices * (-1.0, 1.0, 1.0))
        return Pair(
            "creature",
            Shape(Mesh(vertices, faces), View(32.0, 14.0), CREATURE),
            Shape(Mesh(moved, faces), View(20.0, 12.0)),
            np.arange(len(vertices)),
            mirrored.astype(np.int64),
            limb=("shin", "knee", "shoulder", "side"),
            ways=(("knee", "foot"), ("side", "shoulder"), ("ear", "nose")),
            landmarks=("nose", "tail", "foot"),
            ahead=View(72.0, 8.0),
        )

    @cached_property
    def wolves(self) -> Pair:
        """A wolf, standing and rearing; else the creature."""
        if not self._has(WOLVES):
            return self.creatures
        limb = ("shin", "knee", "shoulder", "side")
        found = self._pair(WOLVES, "wolf", View(-20, 10), WOLF, limb)
        return replace(found, landmarks=("nose", "tail", "foot"), ahead=View(-68.0, 5.0))

    @cached_property
    def ants(self) -> Pair:
        """Two ants; else the creature."""
        if not self._has(ANTS):
            return self.creatures
        ways = (("leg", "leg tip"), ("feeler", "feeler tip"), ("tail", "waist"))
        return replace(
            self._pair(ANTS, "ant", View(60, 50), ANT, ("leg tip", "leg", "waist", "tail")), ways=ways
        )

    @cached_property
    def hands(self) -> Pair:
        """The hands of a woman and a man; else the creature."""
        if not self._has(HANDS):
            return self.creatures
        return self._pair(HANDS, "hand", View(-30, 60, 1), HAND, ("tip", "finger", "knuckle", "wrist"))

    @cached_property
    def arms(self) -> Pair:
        """The arms of a woman and a man; else the creature."""
        if not self._has(ARMS):
            return self.creatures
        return self._pair(ARMS, "arm", View(-20, 40, 1), ARM, ("hand", "wrist", "forearm", "upper arm"))

    @cached_property
    def series(self) -> tuple[Shape, ...]:
        """One shape and four deformations of it, vertex for vertex."""
        if self.folder is not None and self._has(SERIES):
            meshes = [_mesh(path) for path in sorted((self.folder / SERIES).glob("pose*"))]
            return tuple(Shape(mesh, View(25, 10, 1)) for mesh in meshes)
        return tuple(Shape(Mesh(*deformed), View(32, 14)) for deformed in deformations())

    def _pair(
        self, name: str, called: str, view: View, places: Mapping[str, Place], limb: tuple[str, str, str, str]
    ) -> Pair:
        assert self.folder is not None
        folder = self.folder / name
        source, target = (_mesh(next(folder.glob(f"{role}__*"))) for role in ("source", "target"))
        truth = np.loadtxt(folder / "gt.txt", dtype=np.int64)
        twins = folder / "gt_sym.txt"
        return Pair(
            called,
            Shape(source, view, places),
            Shape(target, view),
            truth,
            np.loadtxt(twins, dtype=np.int64) if twins.exists() else truth,
            limb,
        )


def deformations() -> list[tuple[Floats, Ints]]:
    """The creature at rest, trotting, twisted, with a swollen neck, and on short legs.

    Returns
    -------
    list of (vertices, faces)
        All with the same faces; vertex k is the same point of each.

    Raises
    ------
    ValueError
        Never.
    """
    rest, faces = creature("standing")
    x, y, z = rest.T
    turn = 0.45 * (y - 0.2)
    twisted = np.column_stack(
        [np.cos(turn) * x - np.sin(turn) * (z - 1.4), y, 1.4 + np.sin(turn) * x + np.cos(turn) * (z - 1.4)]
    )
    centre = np.array([0.0, 1.3, 1.9])
    away = np.linalg.norm(rest - centre, axis=1, keepdims=True)
    swollen = centre + (rest - centre) * (1 + 0.9 * np.exp(-((away / 0.55) ** 2)))
    short = np.column_stack([x, y, np.where(z < 1.0, 1.0 + 0.45 * (z - 1.0), z)])
    return [(shape, faces) for shape in (rest, creature("trotting")[0], twisted, swollen, short)]


def sphere(size: int) -> Mesh:
    """Unit sphere with vertices on a spiral.

    Parameters
    ----------
    size : int
        Number of vertices.

    Returns
    -------
    Mesh
        Their convex hull, oriented outwards.

    Raises
    ------
    InvalidMesh
        Never: every such hull is a mesh.
    """
    heights = 1 - (2 * np.arange(size) + 1) / size
    angles = np.pi * (1 + 5**0.5) * np.arange(size)
    rings = np.sqrt(1 - heights**2)
    points = np.column_stack([rings * np.cos(angles), rings * np.sin(angles), heights])
    faces = ConvexHull(points).simplices
    a, b, c = (points[faces[:, k]] for k in range(3))
    inwards = np.einsum("fx,fx->f", np.cross(b - a, c - a), a) < 0
    return Mesh(points, np.where(inwards[:, None], faces[:, ::-1], faces))


def _mesh(path: Path) -> Mesh:
    parsed = read_mesh(path.read_bytes(), FORMATS[FORMATS.index(path.suffix[1:])], LIMITS)
    return Mesh(parsed.vertices, parsed.faces)
