"""The built-in creature: a good closed surface in both poses, symmetric at rest, rigid between its joints."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from service.creature import LIMBS, Pose, creature

POSES: tuple[Pose, ...] = ("standing", "trotting")
#: Acceptable triangles: the cotangents of their angles stay below 4.
LEAST_ANGLE = np.radians(14.0)


def angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    out = []
    for k in range(3):
        u, v = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        out.append(np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1)))
    return np.stack(out, axis=1)


@pytest.mark.parametrize("pose", POSES)
def test_closed_oriented_sphere(pose: Pose) -> None:
    vertices, faces = creature(pose)
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    keys = directed[:, 0] * len(vertices) + directed[:, 1]
    assert len(np.unique(keys)) == len(keys), "an edge is used twice in one direction"
    assert set(keys.tolist()) == set((directed[:, 1] * len(vertices) + directed[:, 0]).tolist()), (
        "an edge is open"
    )
    assert len(vertices) - len(keys) // 2 + len(faces) == 2
    assert 3000 <= len(vertices) <= 5000
    assert len(np.unique(faces)) == len(vertices)


@pytest.mark.parametrize("pose", POSES)
def test_outward(pose: Pose) -> None:
    vertices, faces = creature(pose)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6
    # The torso alone, a cylinder about 0.3 thick and 1.8 long, holds half a unit.
    assert volume > 0.5


@pytest.mark.parametrize("pose", POSES)
def test_no_bad_triangles(pose: Pose) -> None:
    assert angles(*creature(pose)).min() > LEAST_ANGLE


def test_mirror_symmetric_at_rest() -> None:
    vertices, faces = creature()
    mirrored = vertices * (-1.0, 1.0, 1.0)
    distances, partner = cKDTree(vertices).query(mirrored)
    assert distances.max() < 1e-12
    assert np.array_equal(np.sort(partner), np.arange(len(vertices)))
    triangles = {tuple(sorted(face)) for face in faces.tolist()}
    assert {tuple(sorted(face)) for face in partner[faces].tolist()} == triangles


def test_same_faces_and_near_isometric() -> None:
    standing, faces = creature("standing")
    trotting, again = creature("trotting")
    assert np.array_equal(faces, again)

    def edges(vertices: np.ndarray) -> np.ndarray:
        return np.linalg.norm(vertices[faces] - vertices[np.roll(faces, -1, axis=1)], axis=2)

    stretch = edges(trotting) / edges(standing)
    assert np.abs(trotting - standing).max() > 0.5, "the poses hardly differ"
    # Bent at the joints, rigid between them.
    assert 0.4 < stretch.min() < stretch.max() < 2.0
    assert (np.abs(stretch - 1.0) < 0.02).mean() > 0.4


def test_same_numbers_again() -> None:
    first, second = creature("trotting"), creature("trotting")
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1].tobytes() == second[1].tobytes()


def test_every_limb_has_a_panel_of_its_own() -> None:
    panels = [limb.panel for limb in LIMBS if limb.panel is not None]
    assert len(set(panels)) == len(LIMBS) - 1
