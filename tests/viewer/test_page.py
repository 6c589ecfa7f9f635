"""What a person does with the page, in a real browser against a real stack."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from numpy.typing import NDArray
from scipy.sparse import csr_array

from service.client import Client
from tests.viewer.conftest import SIZE, View

#: Whether the source shows numbers or colours.
SOMETHING_ELSE = """() => softmaps.layers.source.field !== null
  || softmaps.stage.source.paint.material.uniforms.tinted.value"""


def distribution(client: Client, softmap: str, vertex: int) -> NDArray[np.float64]:
    """μ_x at the target's vertices, from the service's arrays by the definition."""
    spec = client.artifact(softmap).spec
    assert spec is not None
    coefficients = client.array(softmap, "coefficients")
    mesh = client.artifact(spec["source"]).spec["mesh"]  # type: ignore[index]
    vertices, faces = client.array(mesh, "vertices"), client.array(mesh, "faces")
    functions = []
    for basis in (spec["source"], spec["target"]):
        parts = [client.array(basis, f"functions_{part}") for part in ("data", "indices", "indptr")]
        functions.append(csr_array(tuple(parts), shape=(len(vertices), coefficients.shape[1])))
    corners = vertices[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    masses = np.bincount(faces.ravel(), np.repeat(areas / areas.sum() / 3, 3), len(vertices))
    row = functions[0][[vertex]].toarray()[0] @ coefficients
    mu: NDArray[np.float64] = functions[1] @ (row / (functions[1].T @ masses))
    return mu


# The brush --------------------------------------------------------------------------------------------------


def test_the_brush_paints_where_the_array_says(view: View, client: Client, identity: str) -> None:
    view.show(identity)
    bare = view.pixels("target")
    vertex = view.nearest("source")
    view.point("source", vertex)
    view.until("(v) => softmaps.brush.vertex === v", vertex)
    mu = distribution(client, identity, vertex)
    peak = int(mu.argmax())
    assert view.ask("() => softmaps.brush.peak") == peak
    assert view.ask("() => softmaps.brush.peakDensity") == pytest.approx(mu.max(), rel=1e-6)
    shown = np.array(view.ask("() => [...softmaps.stage.target.paint.numbers]"))[: len(mu)]
    np.testing.assert_allclose(shown, mu, rtol=1e-5, atol=1e-6)
    assert f"source vertex {vertex} → peak at target vertex {peak}" in view.page.inner_text("#status")
    # The peak has the bright end of the colour map, where blue is what lacks.
    red, green, blue = view.pixel("target", peak)
    assert min(red, green) > blue + 0.2
    painted = view.pixels("target")
    share = mu / mu.max()
    front = [v for v in view.front("target", 0.2) if share[v] > 0.2 or share[v] < 0.004]
    for v in front:
        changed = np.abs(view.around("target", v, painted) - view.around("target", v, bare)).max() > 0.02
        assert changed == (share[v] > 0.2), v
    assert {bool(share[v] > 0.2) for v in front} == {True, False}


def test_the_picture_changes_with_the_vertex(view: View, client: Client, identity: str) -> None:
    view.show(identity, "&vertex=0")
    first = view.pixels("target")
    view.page.get_by_label("Source vertex of the brush").fill("4")
    view.until("() => softmaps.brush.vertex === 4")
    assert view.ask("() => softmaps.brush.peak") == distribution(client, identity, 4).argmax()
    assert (np.abs(view.pixels("target") - first).max(axis=2) > 0.05).mean() > 0.01


def test_every_vertex_is_picked_as_the_file_counts(view: View, identity: str) -> None:
    view.show(identity)
    front = view.front("source")
    picked = view.ask(
        """(vertices) => vertices.map((v) => { const pane = softmaps.stage.source;
             const { x, y } = pane.seen(v); return pane.surface.vertexOf(pane.pick(x, y)); })""",
        front,
    )
    assert len(front) > 40
    assert picked == front


def test_pins_keep_distributions_in_colours_of_their_own(view: View, identity: str) -> None:
    view.show(identity)
    vertex = view.nearest("source")
    view.click("source", vertex)
    view.page.mouse.move(5, 400)
    assert view.ask("() => softmaps.brush.pins.map((pin) => pin.vertex)") == [vertex]
    red, green, blue = view.pixel("target", vertex)
    assert red > green > blue, "the first pin is orange"
    view.ask("() => softmaps.brush.pin(softmaps.softmap.source.surface.faces[0])")
    assert view.page.locator("li[data-pin]").count() == 2
    view.page.get_by_label(f"Remove the pin at vertex {vertex}").click()
    assert view.page.locator("li[data-pin]").count() == 1


# Looking ----------------------------------------------------------------------------------------------------


def test_cameras_are_linked_or_free_and_turned_by_mouse_and_keys(view: View, identity: str) -> None:
    view.show(identity)
    view.page.mouse.move(60, 500)
    view.page.mouse.down()
    view.page.mouse.move(160, 520, steps=3)
    view.page.mouse.up()
    source, target = view.ask("() => softmaps.stage.panes.map((pane) => pane.rig.azimuth)")
    assert source == target < 0.5
    view.page.keyboard.press("k")
    view.page.keyboard.press("ArrowRight")
    source, target = view.ask("() => softmaps.stage.panes.map((pane) => pane.rig.azimuth)")
    assert source != target
    for key, pressed in (("o", "orthographic"), ("w", "wireframe")):
        view.page.keyboard.press(key)
        button = view.page.get_by_role("button", name=pressed)
        assert button.get_attribute("aria-pressed") == "true"


def test_light_and_dark(view: View, identity: str) -> None:
    view.show(identity, "&look=light")
    assert view.pixels("source")[5, -5].mean() > 0.9
    view.page.keyboard.press("t")
    assert view.pixels("source")[5, -5].mean() < 0.2


def test_a_link_shows_the_view_again(view: View, identity: str) -> None:
    view.show(identity)
    view.click("source", view.nearest("source"))
    view.page.get_by_label("What the source shows").select_option("function")
    view.page.get_by_label("Index").first.fill("7")
    view.page.keyboard.press("Escape")
    view.page.locator("#canvas-target").press("ArrowLeft")
    view.page.mouse.move(5, 500)
    view.ask("() => document.activeElement.blur()")
    view.until("() => location.hash.includes('left=function:7') && location.hash.includes('pins=')")
    view.page.wait_for_timeout(350)
    pictures = [view.pixels(side) for side in ("source", "target")]
    link = view.page.url.partition("#")[2]
    view.open(f"#{link}")
    view.until("() => softmaps.layers.source.field !== null && softmaps.brush.pins.length === 1")
    for side, picture in zip(("source", "target"), pictures, strict=True):
        assert np.abs(view.pixels(side) - picture).mean() < 1e-3


# Asking -----------------------------------------------------------------------------------------------------


def test_two_files_become_a_soft_map(view: View, ball_file: Path, tmp_path: Path) -> None:
    view.open()
    other = tmp_path / "stretched.off"
    mesh = trimesh.load(ball_file, process=False)
    mesh.apply_scale([1.0, 1.0, 1.6])
    mesh.export(other)
    targets = tmp_path / "targets.txt"
    targets.write_text("\n".join(str(k) for k in range(len(mesh.vertices))))
    view.page.locator("input[data-upload=source]").set_input_files(ball_file)
    view.until("() => softmaps.stage.source.surface !== null")
    view.page.locator("input[data-upload=target]").set_input_files(other)
    view.until("() => softmaps.stage.target.surface !== null")
    view.page.get_by_label("How points are compared").select_option("points")
    view.page.locator("input[type=file][accept*=txt]").set_input_files(targets)
    view.page.get_by_label("Functions of each basis").fill("30")
    view.page.get_by_role("button", name="Compute the soft map").click()
    view.until("() => softmaps.softmap !== null")
    view.job("soft map", "successful")
    assert view.ask("() => [softmaps.softmap.target.surface.name, softmaps.softmap.source.size]") == [
        "stretched.off",
        30,
    ]


def test_what_is_wrong_is_said_in_words(view: View, ball_file: Path, tmp_path: Path) -> None:
    view.open()
    broken = tmp_path / "broken.off"
    broken.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")
    view.page.locator("input[data-upload=source]").set_input_files(broken)
    complaint = view.page.locator("[role=alert]:visible").first
    complaint.wait_for()
    assert "7" in complaint.inner_text()
    view.page.get_by_role("button", name="Compute the soft map").click()
    view.until(
        "() => document.querySelector('[role=alert]:not([hidden])').textContent.includes('Choose a source')"
    )


def test_a_failed_job_says_why(view: View, client: Client, ball_file: Path) -> None:
    # Zero rows sum to 0, which only the values tell: the job is accepted and fails.
    ball = client.upload_mesh(ball_file)
    zeros = client.upload_array(np.zeros((SIZE, SIZE)))
    basis = {"kind": "basis", "mesh": ball.id, "size": SIZE}
    spec = {"kind": "softmap", "source": basis, "target": basis}
    spec["map"] = {"type": "matrix", "coefficients": zeros.id}
    view.open()
    refused = view.ask(
        "(spec) => softmaps.jobs.run(spec, 'zeros').then(() => '', (error) => error.message)", spec
    )
    assert refused.startswith("zeros failed: ")
    view.job("zeros", "failed")
    assert view.page.locator("li[data-status=failed] [role=alert]").inner_text() in refused


def test_a_running_job_shows_progress_and_can_be_cancelled(view: View) -> None:
    view.open()
    view.page.get_by_role("button", name="Built-in pair").click()
    view.until("() => softmaps.stage.target.surface !== null")
    view.page.get_by_label("Functions of each basis").fill("300")
    view.page.get_by_role("button", name="Compute the soft map").click()
    view.page.get_by_label("Cancel soft map").click()
    view.job("soft map", "dismissed")
    assert view.page.locator("[role=alert]:visible").first.inner_text() == "soft map was cancelled."


# Colours ----------------------------------------------------------------------------------------------------


def test_densities_are_shown_with_their_energies(view: View, client: Client, identity: str) -> None:
    view.show(identity)
    for side, key in (("source", "dirichlet"), ("target", "bijectivity")):
        view.page.get_by_label(f"What the {side} shows").select_option(key)
        view.until("(side) => softmaps.layers[side].field?.domain === 'face'", side)
    energy = client.artifact(view.job("energies", "successful"))
    shown = view.ask("() => [...softmaps.layers.source.field.values]")
    np.testing.assert_array_equal(shown, client.array(energy.id, "dirichlet_density"))
    caption = view.page.locator("#over-source figcaption").inner_text()
    assert f"{energy.values['dirichlet']:.4g}"[:5] in caption
    low, high = view.ask("() => Object.values(softmaps.layers.source.range())")
    np.testing.assert_allclose([low, high], np.percentile(shown, [2, 98]), rtol=1e-9)
    assert "log" in caption


def test_basis_functions_cells_descriptors_and_arrays_are_shown(
    view: View, client: Client, identity: str
) -> None:
    client.upload_array(np.linspace(-1.0, 2.0, 258), name="heights")
    view.show(identity)
    source = view.page.get_by_label("What the source shows")
    bare = view.pixels("source")
    for key in ("function", "cells", "coordinates", "hks"):
        source.select_option(key)
        view.until(SOMETHING_ELSE)
        view.page.wait_for_timeout(100)
        assert (np.abs(view.pixels("source") - bare).max(axis=2) > 0.05).mean() > 0.002, key
    view.until(
        "() => [...document.querySelectorAll('option')].some((one) => one.textContent.includes('heights'))"
    )
    source.select_option(label="array: heights (258)")
    view.until("() => softmaps.layers.source.field?.title === 'heights'")
    assert view.ask("() => Object.values(softmaps.layers.source.range())") == [-2, 2], (
        "signed: symmetric about 0"
    )


# Motion and optimal maps ------------------------------------------------------------------------------------


def test_a_dragged_direction_shows_the_momentum(view: View, client: Client, identity: str) -> None:
    view.show(identity)
    x, y = view.place("source", view.nearest("source"))
    view.page.keyboard.press("d")
    view.page.mouse.move(x, y)
    view.page.mouse.down()
    view.page.mouse.move(x + 60, y, steps=4)
    view.page.mouse.up()
    job = view.job("momentum", "successful")
    view.until("() => softmaps.stage.target.arrows.children.length === 1")
    momentum = client.array(job, "momentum")
    strongest = int(np.linalg.norm(momentum, axis=1).argmax())
    along = view.ask("() => softmaps.stage.target.rig.camera(1).matrixWorld.elements.slice(0, 3)")
    # The identity carries mass the way the point goes: to the right.
    assert momentum[strongest] @ along > 0.5 * np.linalg.norm(momentum[strongest])


def test_a_drawn_path_is_followed_on_the_target(view: View, client: Client, identity: str) -> None:
    view.show(identity)
    start = view.nearest("source")
    x, y = view.place("source", start)
    view.page.keyboard.press("p")
    view.page.mouse.move(x, y)
    view.page.mouse.down()
    view.page.mouse.move(x + 70, y + 10, steps=8)
    view.page.mouse.up()
    view.click("target", start)
    job = view.job("path", "successful")
    spec = client.artifact(job).spec
    assert spec is not None
    assert spec["start"] == start == spec["source_path"][0]
    view.until("() => softmaps.stage.target.curves.children.length === 1")
    assert (
        f"{len(client.array(job, 'points'))} points"
        in view.page.locator("details", has_text="Momentum and paths").text_content()
    )


def test_landmarks_are_clicked_and_the_optimal_map_keeps_them(
    view: View, client: Client, identity: str
) -> None:
    view.show(identity)
    view.page.keyboard.press("l")
    start = view.nearest("source")
    side = view.front("source")[-1]
    pairs = [(start, start), (side, side)]
    for v0, v in pairs:
        view.click("source", v0)
        view.click("target", v)
    assert view.page.locator("li[data-landmark]").count() == 2
    view.page.get_by_text("Optimal map", exact=True).click()
    view.page.get_by_label("Functions of an optimal map").fill("30")
    view.page.get_by_role("button", name="Optimise").click()
    job = view.job("optimal map", "successful")
    view.until("(id) => softmaps.softmap.id === id", job)
    found = client.artifact(job)
    assert found.spec is not None
    assert found.spec["map"]["landmarks"] == [list(pair) for pair in pairs]
    assert found.values["converged"]
    note = view.page.locator("details", has_text="Optimal map").locator("[role=status]").inner_text()
    assert f"{found.values['iterations']} iterations" in note
    view.ask("(v) => softmaps.brush.moveTo(v)", start)
    peak = view.ask("() => softmaps.brush.peak")
    assert peak == distribution(client, job, start).argmax() == start


# Taking away ------------------------------------------------------------------------------------------------


def test_pictures_and_painted_meshes_can_be_taken_away(
    view: View, client: Client, identity: str, tmp_path: Path
) -> None:
    view.show(identity, "&vertex=0")
    view.page.get_by_text("Take away").click()
    files = {}
    for name in ("screenshot", "target .ply", ".npz"):
        with view.page.expect_download() as download:
            view.page.get_by_role("button", name=name, exact=True).click()
        files[name] = tmp_path / download.value.suggested_filename
        download.value.save_as(files[name])
    assert imread(files["screenshot"]).shape[:2] == (661, 963)
    mesh = trimesh.load(files["target .ply"], process=False)
    mu = distribution(client, identity, 0)
    brightness = mesh.visual.vertex_colors[:, :3].astype(float) @ [1.0, 1.0, -1.0]
    assert brightness.argmax() == mu.argmax()
    with np.load(files[".npz"]) as arrays:
        np.testing.assert_array_equal(arrays["coefficients"], client.array(identity, "coefficients"))


def test_the_python_to_copy_asks_the_same(view: View, client: Client, identity: str) -> None:
    view.show(identity, "&left=dirichlet:0")
    view.job("energies", "successful")
    view.page.get_by_text("Take away").click()
    view.page.get_by_label("Question to copy").select_option("energies")
    view.page.get_by_label("Language to copy it in").select_option("python")
    code = view.page.get_by_label("Code that asks the same").input_value()
    names: dict[str, object] = {}
    exec(code, names)
    assert names["values"] == client.artifact(view.job("energies", "successful")).values
    view.page.get_by_label("Language to copy it in").select_option("curl")
    assert f"{view.url}/v1/jobs -d" in view.page.get_by_label("Code that asks the same").input_value()
