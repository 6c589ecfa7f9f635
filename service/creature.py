"""The built-in pair: one four-legged creature, standing and trotting, with the same vertices and faces.

A coarse cage of quadrilaterals is swept along the limbs; a pose turns its sections about the joints, and
Catmull-Clark subdivision smooths it. Between joints a limb moves rigidly, so the pair is near isometric
everywhere else, and vertex k of one pose corresponds to vertex k of the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Pose = Literal["standing", "trotting"]

#: Catmull-Clark steps from the cage to the surface; each multiplies the faces by four.
SUBDIVISIONS = 2
#: Diagonals of a quadrilateral count as equal within this factor: rounding must not break the symmetry.
TIE = 1.0 + 1e-6


class Section(NamedTuple):
    """One ring of a limb: its centre, half-width, half-depth and how far it leans (degrees about x)."""

    x: float
    y: float
    z: float
    width: float
    depth: float
    lean: float


#: From rump to nose; x points to the creature's right, y forward, z up.
SPINE = (
    Section(0, -1.12, 1.46, 0.17, 0.20, 0),
    Section(0, -0.97, 1.41, 0.34, 0.36, 0),
    Section(0, -0.58, 1.39, 0.39, 0.38, 0),
    Section(0, -0.20, 1.40, 0.33, 0.33, 0),
    Section(0, 0.18, 1.37, 0.36, 0.39, 0),
    Section(0, 0.54, 1.36, 0.39, 0.46, 0),
    Section(0, 0.92, 1.45, 0.34, 0.45, 18),
    Section(0, 1.15, 1.68, 0.26, 0.36, 40),
    Section(0, 1.32, 1.93, 0.22, 0.28, 50),
    Section(0, 1.45, 2.17, 0.23, 0.27, 38),
    Section(0, 1.58, 2.34, 0.30, 0.30, 6),
    Section(0, 1.84, 2.34, 0.29, 0.28, -10),
    Section(0, 2.02, 2.25, 0.17, 0.17, -12),
    Section(0, 2.19, 2.20, 0.125, 0.125, -8),
    Section(0, 2.35, 2.17, 0.09, 0.09, -4),
)
#: Corners of a spine section: (right, up), clockwise as seen from behind, starting at the top right.
OCTAGON = ((0.4, 1), (1, 0.45), (1, -0.45), (0.4, -1), (-0.4, -1), (-1, -0.45), (-1, 0.45), (-0.4, 1))

#: The right-hand limbs (the left-hand ones are their mirror images) and the tail; depth is forward, or up.
HIND_LEG = (
    Section(0.27, -0.79, 0.84, 0.15, 0.24, -10),
    Section(0.27, -0.71, 0.57, 0.13, 0.18, -18),
    Section(0.27, -0.85, 0.33, 0.10, 0.125, -22),
    Section(0.27, -0.96, 0.17, 0.09, 0.105, 5),
    Section(0.27, -0.93, -0.04, 0.08, 0.09, 5),
    Section(0.27, -0.87, -0.15, 0.115, 0.16, 0),
    Section(0.27, -0.84, -0.24, 0.12, 0.18, 0),
)
FORE_LEG = (
    Section(0.27, 0.73, 0.84, 0.14, 0.20, 0),
    Section(0.27, 0.70, 0.59, 0.12, 0.15, 5),
    Section(0.27, 0.72, 0.36, 0.095, 0.11, 5),
    Section(0.27, 0.74, 0.17, 0.095, 0.105, 0),
    Section(0.27, 0.74, -0.04, 0.08, 0.09, 0),
    Section(0.27, 0.80, -0.15, 0.115, 0.16, 0),
    Section(0.27, 0.83, -0.24, 0.12, 0.18, 0),
)
EAR = (
    Section(0.20, 1.69, 2.70, 0.14, 0.12, 0),
    Section(0.25, 1.67, 2.86, 0.12, 0.09, 0),
    Section(0.28, 1.66, 3.02, 0.045, 0.045, 0),
)
TAIL = (
    Section(0, -1.27, 1.53, 0.10, 0.10, 20),
    Section(0, -1.42, 1.44, 0.115, 0.115, 40),
    Section(0, -1.56, 1.26, 0.14, 0.14, 55),
    Section(0, -1.66, 1.04, 0.16, 0.16, 65),
    Section(0, -1.74, 0.82, 0.14, 0.14, 72),
    Section(0, -1.79, 0.64, 0.08, 0.08, 75),
)
#: Corners of a limb's section in the order of the panel it grows from: (width, depth).
LEG_CORNERS = ((1, -1), (-1, -1), (-1, 1), (1, 1))
EAR_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
TAIL_CORNERS = ((-1, 1), (-1, -1), (1, -1), (1, 1))


class Turn(NamedTuple):
    """How far a segment is turned from rest, in degrees: nose-up about x, then about the vertical."""

    pitch: float
    yaw: float = 0.0


@dataclass(frozen=True)
class Limb:
    """A chain of sections that grows from a panel of the torso (the spine grows from nothing)."""

    name: str
    sections: tuple[Section, ...]
    corners: tuple[tuple[float, float], ...]
    panel: tuple[int, int, int, int] | None
    mirrored: bool = False

    def ring(self, k: int) -> Floats:
        """Corners of section k at rest, (m, 3)."""
        s = self.sections[k]
        sin, cos = np.sin(np.radians(s.lean)), np.cos(np.radians(s.lean))
        # The spine and the tail lie along y, their depth is upwards; legs and ears stand, theirs is forwards.
        along = (0.0, -sin, cos) if self.name in {"spine", "tail"} else (0.0, cos, sin)
        corners = np.array(self.corners) * (s.width, s.depth)
        points: Floats = (s.x, s.y, s.z) + corners @ np.array([(1.0, 0.0, 0.0), along])
        # Mirroring turns a ring inside out; exchanging its right and left corners turns it back.
        return points[[1, 0, 3, 2]] * (-1.0, 1.0, 1.0) if self.mirrored else points


def _spine(section: int, corner: int) -> int:
    return section * len(OCTAGON) + corner


def _panel(section: int, corner: int) -> tuple[int, int, int, int]:
    following = (corner + 1) % len(OCTAGON)
    return (
        _spine(section, corner),
        _spine(section, following),
        _spine(section + 1, following),
        _spine(section + 1, corner),
    )


LIMBS = (
    Limb("spine", SPINE, OCTAGON, None),
    Limb("right hind leg", HIND_LEG, LEG_CORNERS, _panel(1, 2)),
    Limb("left hind leg", HIND_LEG, LEG_CORNERS, _panel(1, 4), mirrored=True),
    Limb("right fore leg", FORE_LEG, LEG_CORNERS, _panel(5, 2)),
    Limb("left fore leg", FORE_LEG, LEG_CORNERS, _panel(5, 4), mirrored=True),
    Limb("right ear", EAR, EAR_CORNERS, _panel(10, 0)),
    Limb("left ear", EAR, EAR_CORNERS, _panel(10, 6), mirrored=True),
    Limb("tail", TAIL, TAIL_CORNERS, (7, 6, 1, 0)),
)

#: Turns of every segment from rest; a limb's first joins it to its panel, the spine's joins sections 0 and 1.
POSES: Mapping[Pose, Mapping[str, Sequence[Turn]]] = {
    "standing": {},
    "trotting": {
        "spine": [Turn(0)] * 6
        + [Turn(-14, 8), Turn(-24, 14), Turn(-30, 20), Turn(-24, 26), Turn(-14, 30)]
        + [Turn(-12, 30)] * 3,
        "right hind leg": [Turn(12), Turn(28), Turn(24), Turn(12), Turn(6), Turn(0), Turn(0)],
        "left hind leg": [Turn(-8), Turn(-26), Turn(-38), Turn(-38), Turn(-50), Turn(-56), Turn(-56)],
        "right fore leg": [Turn(-2), Turn(-20), Turn(-25), Turn(-25), Turn(-32), Turn(-36), Turn(-36)],
        "left fore leg": [Turn(12), Turn(44), Turn(40), Turn(-6), Turn(-40), Turn(-50), Turn(-50)],
        "right ear": [Turn(-12, 20), Turn(-16, 20), Turn(-16, 20)],
        "left ear": [Turn(-12, 20), Turn(-16, 20), Turn(-16, 20)],
        "tail": [Turn(-20), Turn(-45, -8), Turn(-75, -16), Turn(-95, -24), Turn(-105, -30), Turn(-110, -34)],
    },
}


def creature(pose: Pose = "standing", subdivisions: int = SUBDIVISIONS) -> tuple[Floats, Ints]:
    """Surface of the creature in one pose.

    Parameters
    ----------
    pose : {"standing", "trotting"}
        The first is mirror symmetric in x.
    subdivisions : int
        Catmull-Clark steps; each multiplies the faces by four.

    Returns
    -------
    vertices : ndarray, (V, 3) float64
        Positions; x to the creature's right, y forward, z up. Vertex k is the same point in every pose.
    faces : ndarray, (F, 3) int64
        Triangles, anticlockwise seen from outside, the same in every pose: watertight, manifold, of genus 0.

    Raises
    ------
    KeyError
        If there is no such pose.
    """
    quads = _cage_quads()
    rest = _pose_cage(POSES["standing"])
    vertices = _pose_cage(POSES[pose])
    for _ in range(subdivisions):
        rest, _finer = _catmull_clark(rest, quads)
        vertices, quads = _catmull_clark(vertices, quads)
    return vertices, _triangles(rest, quads)


def _cage_quads() -> Ints:
    """Quadrilaterals of the cage, numbered limb by limb, section by section."""
    quads: list[tuple[int, ...]] = [_panel(i, c) for i in range(len(SPINE) - 1) for c in range(len(OCTAGON))]
    nose = _spine(len(SPINE) - 1, 0)
    for a, b, c, d in ((0, 1, 6, 7), (1, 2, 5, 6), (2, 3, 4, 5)):
        quads += [(d, c, b, a), (nose + a, nose + b, nose + c, nose + d)]
    start = len(SPINE) * len(OCTAGON)
    for limb in LIMBS[1:]:
        assert limb.panel is not None
        quads.remove(limb.panel)
        corners = range(start, start + 4 * len(limb.sections))
        rings = [limb.panel, *(tuple(corners[k : k + 4]) for k in range(0, len(corners), 4))]
        for lower, upper in pairwise(rings):
            quads += [(lower[j], lower[(j + 1) % 4], upper[(j + 1) % 4], upper[j]) for j in range(4)]
        quads.append(rings[-1])
        start += 4 * len(limb.sections)
    return np.array(quads, dtype=np.int64)


def _pose_cage(turns: Mapping[str, Sequence[Turn]]) -> Floats:
    """Corners of the cage in a pose; a section at a joint turns half way between the segments it joins."""
    rest: list[Floats] = []
    posed: list[Floats] = []
    for limb in LIMBS:
        rings = [limb.ring(k) for k in range(len(limb.sections))]
        if limb.panel is None:
            base = moved = rings[0].mean(axis=0)
            segments = turns.get(limb.name, [Turn(0)] * (len(rings) - 1))
            segments = [segments[0], *segments]
        else:
            panel = list(limb.panel)
            base, moved = rest[0][panel].mean(axis=0), posed[0][panel].mean(axis=0)
            segments = turns.get(limb.name, [Turn(0)] * len(rings))
        centres = np.array([base, *(ring.mean(axis=0) for ring in rings)])
        out: list[Floats] = []
        for k, ring in enumerate(rings):
            moved = moved + (centres[k + 1] - centres[k]) @ _rotation(segments[k]).T
            following = segments[min(k + 1, len(rings) - 1)]
            half = Turn((segments[k].pitch + following.pitch) / 2, (segments[k].yaw + following.yaw) / 2)
            out.append(moved + (ring - centres[k + 1]) @ _rotation(half).T)
        rest.append(np.concatenate(rings))
        posed.append(np.concatenate(out))
    return np.concatenate(posed)


def _rotation(turn: Turn) -> Floats:
    p, y = np.radians(turn.pitch), np.radians(turn.yaw)
    about_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    about_z = np.array([[np.cos(y), -np.sin(y), 0], [np.sin(y), np.cos(y), 0], [0, 0, 1]])
    rotation: Floats = about_z @ about_x
    return rotation


def _catmull_clark(vertices: Floats, quads: Ints) -> tuple[Floats, Ints]:
    """One Catmull-Clark step of a closed surface of quadrilaterals; children start at the old corner."""
    n_vertices, n_quads = len(vertices), len(quads)
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1)
    edges, edge_of = np.unique(np.sort(ends.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(n_quads, 4)
    centres = vertices[quads].mean(axis=1)
    middles = vertices[edges].mean(axis=1)
    beside = np.zeros_like(middles)
    np.add.at(beside, edge_of, centres[:, None, :])
    # Old corner of valence m: (mean of centres + 2 mean of middles + (m − 3) itself) / m.
    valence = np.bincount(edges.ravel(), minlength=n_vertices)[:, None]
    around_faces, around_edges = np.zeros_like(vertices), np.zeros_like(vertices)
    np.add.at(around_faces, quads, centres[:, None, :])
    np.add.at(around_edges, edges, middles[:, None, :])
    corners = ((around_faces + 2 * around_edges) / valence + (valence - 3) * vertices) / valence
    centre = n_vertices + len(edges) + np.arange(n_quads)
    children = [
        np.stack([quads[:, j], n_vertices + edge_of[:, j], centre, n_vertices + edge_of[:, j - 1]], axis=1)
        for j in range(4)
    ]
    return np.concatenate([corners, (middles + beside / 2) / 2, centres]), np.concatenate(children)


def _triangles(vertices: Floats, quads: Ints) -> Ints:
    """Each quadrilateral split along its shorter diagonal."""
    a, b, c, d = (vertices[quads[:, j]] for j in range(4))
    first = np.linalg.norm(c - a, axis=1) <= TIE * np.linalg.norm(d - b, axis=1)
    split = np.where(first[:, None, None], [[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]])
    return np.take_along_axis(quads[:, None, :], split, axis=2).reshape(-1, 3)
