"""What the page costs: bytes, evaluation of the brush in JavaScript, and frames drawn by software.

    python -m benchmarks.viewer                          # tori of 10,000 and 50,000 vertices
    python -m benchmarks.viewer wolf0.off wolf1.off      # a pair of meshes

Needs Debian's chromium, and playwright from the test extra. A software renderer draws here (SwiftShader);
with a graphics processor a frame is the evaluation and little else.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

from service.client import Client
from service.session import MeshLike
from service.stack import Stack
from worker.settings import Settings

#: Rings and vertices a ring.
TORI = ((100, 100), (250, 200))
FUNCTIONS = 300
#: Frames before those that count, and those.
WARM, FRAMES = 10, 60
CHROMIUM = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

#: Each frame moves the brush to another vertex, picking on its way; milliseconds a frame.
BRUSHED = """async ([warm, frames, draws]) => {
  const { brush, stage, softmap } = softmaps;
  const { nVertices } = softmap.source.surface;
  const { width, height } = stage.source;
  const tick = () => new Promise((next) => requestAnimationFrame(next));
  const times = [];
  for (let k = 0, last = performance.now(); k < warm + frames; k++) {
    if (draws) {
      const [x, y] = [width * (0.3 + (0.4 * (k % 37)) / 37), height * (0.4 + (0.2 * (k % 11)) / 11)];
      stage.pointer = { pane: stage.source, x, y };
      brush.moveTo((k * 7919) % nVertices);
      stage.wake();
    }
    await tick();
    const now = performance.now();
    if (k >= warm) times.push(now - last);
    last = now;
  }
  return times;
}"""
#: From a click to a new colour of every vertex, in ms: pick, evaluate μ_x, mix the tints of four pins.
CLICKED = """(count) => {
  const { brush, stage, softmap } = softmaps;
  const { surface } = stage.source;
  const [picks, evaluations, pins] = [[], [], []];
  const timed = (times, act) => {
    const began = performance.now();
    act();
    times.push(performance.now() - began);
  };
  for (let k = 0; k < count; k++) {
    const vertex = (k * 7919) % surface.nVertices;
    const [x, y] = [stage.source.width / 2, stage.source.height / 2];
    timed(picks, () => { for (let n = 0; n < 20; n++) stage.source.pick(x + n, y); });
    timed(evaluations, () => { brush.moveTo(vertex); });
    if (brush.pins.length >= 4) brush.pins.shift();
    timed(pins, () => { brush.pin(vertex); });
  }
  const median = (times) => times.sort((a, b) => a - b)[times.length >> 1];
  brush.clearPins();
  return { pick: median(picks) / 20, evaluate: median(evaluations), pin: median(pins) };
}"""
LOADED = """() => performance.getEntriesByType("resource").reduce((sums, one) => {
  sums[one.name.includes("/v1/") ? "numbers" : "page"] += one.encodedBodySize;
  return sums;
}, { numbers: 0, page: 0 })"""


def torus(rings: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """A torus that bulges, so that no two points of it are alike."""
    u, v = np.meshgrid(np.arange(rings) / rings, np.arange(around) / around, indexing="ij")
    tube = 0.35 + 0.1 * np.sin(2 * np.pi * u) + 0.04 * np.cos(6 * np.pi * v)
    radius = 1 + tube * np.cos(2 * np.pi * v)
    vertices = np.stack(
        [radius * np.cos(2 * np.pi * u), radius * np.sin(2 * np.pi * u), tube * np.sin(2 * np.pi * v)],
        axis=-1,
    )
    i, j = (k.ravel() for k in np.meshgrid(np.arange(rings), np.arange(around), indexing="ij"))
    a, b = i * around + j, (i + 1) % rings * around + j
    c, d = (i + 1) % rings * around + (j + 1) % around, i * around + (j + 1) % around
    return vertices.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def pairs(arguments: argparse.Namespace) -> Iterator[tuple[MeshLike, MeshLike]]:
    if arguments.target:
        yield arguments.source, arguments.target
    else:
        for rings, around in TORI:
            yield torus(rings, around), torus(rings, around)


def softmap(client: Client, source: MeshLike, target: MeshLike) -> str:
    """Id of a map by wave kernel signatures, or of the identity where both meshes are the same."""
    meshes = [client.upload_mesh(mesh) for mesh in (source, target)]
    bases = [{"kind": "basis", "mesh": mesh.id, "size": FUNCTIONS} for mesh in meshes]
    how: dict[str, object] = {"type": "descriptors", "descriptor": "wks"}
    if meshes[0].id == meshes[1].id:
        how = {"type": "points", "targets": client.upload_array(np.arange(meshes[0].n_vertices)).id}
    spec = {"kind": "softmap", "source": bases[0], "target": bases[1], "map": how}
    return client.wait(client.submit(spec).id).id


def measure(page: Page, address: str) -> None:
    page.goto("about:blank")
    page.goto(address)
    while not page.evaluate("() => window.softmaps?.softmap && softmaps.stage.frames.length > 0"):
        page.wait_for_timeout(50)
    page.wait_for_timeout(1000)
    vertices = page.evaluate("() => softmaps.softmap.target.surface.nVertices")
    loaded = page.evaluate(LOADED)
    clicked = page.evaluate(CLICKED, 100)
    idle = np.median(page.evaluate(BRUSHED, [WARM, FRAMES, False]))
    frames = np.array(page.evaluate(BRUSHED, [WARM, FRAMES, True]))
    print(f"{vertices:,} vertices, {FUNCTIONS} functions")
    print(f"  loaded: {loaded['numbers']:,} bytes of numbers, {loaded['page']:,} of the page")
    times = (
        f"pick {clicked['pick']:.3f}, evaluate {clicked['evaluate']:.2f}, tint four pins {clicked['pin']:.2f}"
    )
    print(f"  JavaScript, ms: {times}")
    drawn = f"median {np.median(frames):.1f}, 90 % within {np.percentile(frames, 90):.1f}"
    print(f"  frames by software, ms: {drawn} (nothing to draw: {idle:.1f})")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", nargs="?", type=Path)
    parser.add_argument("target", nargs="?", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as data, sync_playwright() as playwright:
        settings = Settings(data=Path(data))
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=CHROMIUM)
        with Stack(settings, public=False) as stack, Client(stack.url) as client:
            for source, target in pairs(arguments):
                id_ = softmap(client, source, target)
                page = browser.new_page(viewport={"width": 1280, "height": 720})
                measure(page, f"{stack.url}/#softmap={id_}")
                page.close()
        browser.close()


if __name__ == "__main__":
    main()
