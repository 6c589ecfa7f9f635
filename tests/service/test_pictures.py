"""Pictures: the rasteriser hits what the camera sees, colours say what the numbers say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service.creature import creature
from service.marks import balls
from service.pictures import (
    DECADES,
    Panel,
    bijectivity_panel,
    dirichlet_panel,
    figure,
    write,
)
from service.rasteriser import View, render

#: Seen along −x: y to the right, z up, no perspective.
FRONT = View(azimuth=0.0, elevation=0.0)
RED, BLUE = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def square(x: float, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[x, -1.0, -1.0], [x, 1.0, -1.0], [x, 1.0, 1.0], [x, -1.0, 1.0]])
    return corners * (1.0, size, size), np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("backwards", [False, True])
def test_a_square_fills_its_pixels_on_both_sides(backwards: bool) -> None:
    vertices, faces = square(0.0)
    picture = render(
        vertices, faces[:, ::-1] if backwards else faces, np.tile(RED, (2, 1)), FRONT, (100, 100)
    )
    assert (picture[3:97, 3:97, 3] == 255).all()
    assert (picture[0, :, 3] == 0).all()
    assert (picture[..., 1] == 0).all()
    assert picture[50, 50, 0] > 200


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_nearer_face_is_seen_whatever_the_order(order: list[int]) -> None:
    near, far = square(1.0, 0.5), square(0.0)
    vertices = np.concatenate([near[0], far[0]])
    halves = [near[1], far[1] + 4]
    colours = [np.tile(RED, (2, 1)), np.tile(BLUE, (2, 1))]
    faces = np.concatenate([halves[k] for k in order])
    picture = render(vertices, faces, np.concatenate([colours[k] for k in order]), FRONT, (80, 80))
    assert picture[40, 40, 0] > 0
    assert picture[40, 40, 2] == 0
    assert picture[8, 8, 2] > 0
    assert picture[8, 8, 0] == 0


def test_vertex_colours_are_interpolated() -> None:
    vertices, faces = square(0.0)
    colours = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]])
    middle = render(vertices, faces, colours, FRONT, (100, 100))[50, 5:95, 0].astype(int)
    assert (np.diff(middle) >= 0).all()
    assert middle[-1] > 8 * middle[0]


def test_up_is_up() -> None:
    vertices = np.array([[0.0, -1, 0], [0.0, 1, 0], [0.0, 0, 1], [0.0, 0, 3]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    for up in range(3):
        turned = np.roll(vertices, up - 2, axis=1)
        picture = render(turned, faces, np.tile(RED, (2, 1)), View(0.0, 0.0, up), (60, 60))
        top, bottom = picture[:15, :, 3].sum(), picture[45:, :, 3].sum()
        assert 0 < top < bottom


def test_the_creature_is_in_the_middle_and_not_see_through() -> None:
    vertices, faces = creature()
    picture = render(vertices, faces, np.ones((len(faces), 3)), View(), (310, 240))
    covered = picture[..., 3] == 255
    assert 0.15 < covered.mean() < 0.6
    # Lit from above: the back is brighter than the belly.
    column = picture[:, 140, 0][covered[:, 140]]
    assert column[: len(column) // 4].mean() > column[-len(column) // 4 :].mean()


def test_degenerate_and_edge_on_faces_do_no_harm() -> None:
    vertices = np.array([[0.0, 0, 0], [0.0, 1, 0], [0.0, 2, 0], [1.0, 0, 0], [0.0, 0, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 1, 4]])
    picture = render(vertices, faces, np.tile(RED, (3, 1)), FRONT, (50, 50))
    assert picture[..., 3].max() == 255


def test_values_must_fit() -> None:
    vertices, faces = creature()
    with pytest.raises(ValueError, match="7 values fit neither 8896 faces nor 4450 vertices"):
        render(vertices, faces, np.ones((7, 3)), View())


def test_the_bijectivity_density_is_shown_by_its_reciprocal() -> None:
    vertices, faces = square(0.0)
    panel = bijectivity_panel(vertices, faces, np.array([0.5, 0.0]), 1.25, "a map")
    assert panel.values[0] == 2.0
    assert np.isfinite(panel.values).all()
    assert "1.25" in panel.title


@pytest.mark.parametrize(
    "density",
    [np.geomspace(1e-12, 10.0, 8896), np.full(8896, 2.0), np.zeros(8896), np.full(8896, np.nan)],
    ids=["eleven decades", "constant", "zero", "nothing"],
)
def test_any_density_makes_a_picture(density: np.ndarray, tmp_path: Path) -> None:
    vertices, faces = creature()
    panels = [
        dirichlet_panel(vertices, faces, density, 1.5, "a map"),
        bijectivity_panel(vertices, faces, density, 1.0, "a map"),
    ]
    write(tmp_path / "picture.png", [panels])
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")


def test_a_logarithmic_scale_spans_few_decades() -> None:
    vertices, faces = creature()
    panel = Panel(vertices, faces, np.geomspace(1e-12, 10.0, len(faces)), "", "density", logarithmic=True)
    bar = figure([[panel]]).axes[1]
    low, high = bar.get_xlim()
    assert np.log10(high / low) <= DECADES + 1e-9
    assert 5.0 < high <= 10.0


def test_neighbours_with_the_same_limits_share_a_colour_bar() -> None:
    vertices, faces = square(0.0)
    panels = [
        Panel(vertices, faces, np.zeros(2), "", label, limits=(0.0, 1.0)) for label in ("a", "a", "b", "")
    ]
    drawing = figure([panels])
    assert len(drawing.axes) == 4 + 2


def test_colours_are_drawn_as_they_are_and_marks_with_them() -> None:
    vertices, faces = square(0.0)
    mark = balls(np.array([[1.0, 0.0, 0.0]]), 0.3, (0.0, 0.0, 1.0))
    for n in (2, 4):
        panel = Panel(vertices, faces, np.tile(RED, (n, 1)), "", marks=(mark,))
        drawn = figure([[panel]], FRONT, inches=(1.0, 1.0), dpi=80).axes[0].images[0].get_array()
        assert drawn.shape == (80, 80, 4)
        assert drawn[40, 40, 2] > 0 == drawn[40, 40, 0]
        assert drawn[8, 8, 0] > 0 == drawn[8, 8, 2]
