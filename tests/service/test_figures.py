"""Figures: every one has a name and a sheet, and what they show is where it should be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from service.cli import app
from service.figures import command
from service.figures.drawing import RED, blues, density_at, field, way
from service.figures.shapes import Shape, Shelf, deformations, sphere
from service.figures.spheres import MAPS, located, superposed
from service.rasteriser import View
from solver import SoftMap, maxent_basis


@pytest.fixture(scope="module")
def ball() -> Shape:
    return Shape(sphere(600), View(), {"pole": (0.0, 0.0, 0.3)})


def test_every_figure_has_a_sheet() -> None:
    assert list(command._sheets()) and set(command._sheets()) == set(command.FIGURES)


def test_a_figure_from_the_command_line(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["figures", "bases", "--small", "--json", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "bases.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "bases.png").stat().st_size < 60_000
    wrong = CliRunner().invoke(app, ["figures", "portraits", "--out", str(tmp_path)])
    assert wrong.exit_code == 2
    assert "portraits is none of" in wrong.output
    empty = CliRunner().invoke(app, ["figures", "bases", "--meshes", str(tmp_path), "--out", str(tmp_path)])
    assert empty.exit_code == 2
    assert "--meshes" in empty.output


def test_built_in_shapes_stand_in_for_meshes_that_are_not_there(tmp_path: Path) -> None:
    shelf = Shelf(tmp_path)
    assert shelf.wolves is shelf.ants is shelf.arms is shelf.creatures
    pair = shelf.creatures
    left, right = pair.source.mesh.vertices[pair.twins], pair.source.mesh.vertices
    np.testing.assert_allclose(left, right * (-1.0, 1.0, 1.0), atol=1e-9)
    assert len({pair.source.vertex(place) for place in pair.source.places}) == len(pair.source.places)


def test_real_meshes_are_taken_where_they_are(data: Path) -> None:
    shelf = Shelf(data / "pairs")
    assert [pair.name for pair in (shelf.wolves, shelf.ants, shelf.hands, shelf.arms)] == [
        "wolf", "ant", "hand", "arm",
    ]  # fmt: skip
    for pair in (shelf.wolves, shelf.ants, shelf.hands, shelf.arms):
        assert len(pair.truth) == pair.source.mesh.n_vertices
        assert len({pair.source.vertex(place) for place in pair.limb}) == 4


def test_deformations_keep_their_faces() -> None:
    (_, faces), *others = deformations()
    for vertices, same in others:
        np.testing.assert_array_equal(faces, same)
        assert np.isfinite(vertices).all()


def test_rays_meet_the_sphere_where_they_point(ball: Shape, rng: np.random.Generator) -> None:
    directions = rng.normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    faces, weights = located(ball.mesh, directions)
    points = np.einsum("kc,kcx->kx", weights, ball.mesh.vertices[ball.mesh.faces[faces]])
    np.testing.assert_allclose(points / np.linalg.norm(points, axis=1, keepdims=True), directions, atol=1e-9)


@pytest.mark.parametrize("name", MAPS)
def test_textures_are_carried_by_the_inverse(name: str, rng: np.random.Generator) -> None:
    forwards, backwards = MAPS[name]
    points = rng.normal(size=(50, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(backwards(forwards(points)), points, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(forwards(points), axis=1), 1.0)


def test_mass_of_a_point_integrates_to_one(ball: Shape) -> None:
    basis = maxent_basis(ball.mesh, 40)
    identity = SoftMap.from_points(basis, basis, np.arange(ball.mesh.n_vertices))
    vertex = ball.vertex("pole")
    density = density_at(identity, vertex)
    mean = density[ball.mesh.faces].mean(axis=1)
    assert ball.mesh.face_areas @ mean == pytest.approx(1.0)
    assert ball.mesh.vertices[density.argmax()] @ ball.mesh.vertices[vertex] > 0.95
    assert (np.diff(blues(np.linspace(0, 1, 20)).sum(axis=1)) < 0).all()


def test_arrows_follow_the_field(ball: Shape) -> None:
    turning = np.cross([0.0, 0.0, 1.0], ball.mesh.vertices[ball.mesh.faces].mean(axis=1))
    mark = field(ball, turning)
    assert mark.colour == RED
    shapes = mark.vertices.reshape(-1, 40, 3)
    tails, heads = shapes[:, 0], shapes[:, -1]
    along = np.cross([0.0, 0.0, 1.0], (tails + heads) / 2)
    assert (np.einsum("kx,kx->k", heads - tails, along) > 0).all()


def test_the_way_to_a_neighbour_is_straight(ball: Shape) -> None:
    a, b = ball.mesh.edges[100]
    _, direction = way(ball, [int(a), int(b)])
    edge = ball.mesh.vertices[b] - ball.mesh.vertices[a]
    np.testing.assert_allclose(direction, edge / np.linalg.norm(edge), atol=1e-9)


@pytest.mark.slow
def test_a_superposition_costs_no_more_than_its_parts() -> None:
    sheet = superposed(Shelf())
    energies = sheet.numbers
    assert energies["both"] <= (energies["identity"] + energies["reflection"]) / 2
    assert [len(row) for row in sheet.rows] == [3]
