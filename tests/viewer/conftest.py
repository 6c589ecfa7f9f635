"""The page in a real browser, on a real stack; one of each for all tests."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import NDArray

from service.client import Client
from service.stack import Stack
from service.viewer import DIST, bundle
from tests.service.conftest import sphere
from worker.settings import Settings

pytest.importorskip("playwright", reason="playwright drives the browser: pip install '.[test]'")
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
#: Software drawing, and not a request of the browser's own.
QUIET = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SIZE = 80
SECONDS = 60.0


@dataclass(frozen=True, eq=False)
class View:
    """The page as a person uses it, and a few questions to it."""

    page: Page
    url: str

    def open(self, link: str = "") -> None:
        """Load the page anew."""
        self.page.goto("about:blank")
        self.page.goto(f"{self.url}/{link}")
        self.until("() => window.softmaps !== undefined")

    def ask(self, script: str, argument: Any = None) -> Any:
        return self.page.evaluate(script, argument)

    def until(self, script: str, argument: Any = None) -> Any:
        """What a function of the page returns as soon as it is true."""
        deadline = time.monotonic() + SECONDS
        while not (found := self.ask(script, argument)):
            assert time.monotonic() < deadline, f"in vain: {script}\n{self.page.inner_text('main')}"
            self.page.wait_for_timeout(30)
        return found

    def show(self, softmap: str, rest: str = "") -> None:
        self.open(f"#softmap={softmap}{rest}")
        self.until("() => softmaps.softmap !== null && softmaps.stage.frames.length > 0")

    def place(self, side: str, vertex: int) -> tuple[float, float]:
        """Where a vertex is on the screen."""
        at = self.ask("([side, vertex]) => softmaps.stage[side].seen(vertex)", [side, vertex])
        box = self.page.locator(f"#canvas-{side}").bounding_box()
        assert box is not None
        return box["x"] + at["x"], box["y"] + at["y"]

    def nearest(self, side: str) -> int:
        """The vertex of a ball that faces the camera most."""
        return int(
            self.ask(
                """(side) => {
                  const { rig, surface, aspect } = softmaps.stage[side];
                  const eye = rig.camera(aspect).matrixWorld.elements.slice(8, 11);
                  let best = 0;
                  const facing = (v) => surface.point(v).reduce((sum, x, k) => sum + x * eye[k], 0);
                  for (let v = 1; v < surface.nVertices; v++) if (facing(v) > facing(best)) best = v;
                  return best;
                }""",
                side,
            )
        )

    def point(self, side: str, vertex: int) -> None:
        self.page.mouse.move(*self.place(side, vertex))

    def click(self, side: str, vertex: int) -> None:
        self.page.mouse.click(*self.place(side, vertex))

    def pixels(self, side: str) -> NDArray[np.float64]:
        """What a view shows once all is still, (height, width, 3) in 0…1."""
        self.ask("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.until("() => softmaps.stage.resting")
        picture = self.page.locator(f"#canvas-{side}").screenshot()
        found: NDArray[np.float64] = imread(io.BytesIO(picture), format="png")[..., :3].astype(np.float64)
        return found

    def around(self, side: str, vertex: int, picture: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean colour of the pixels of a picture around a vertex."""
        at = self.ask("([side, vertex]) => softmaps.stage[side].seen(vertex)", [side, vertex])
        x, y = round(at["x"]), round(at["y"])
        colour: NDArray[np.float64] = picture[y - 2 : y + 3, x - 2 : x + 3].mean(axis=(0, 1))
        return colour

    def pixel(self, side: str, vertex: int) -> NDArray[np.float64]:
        """Mean colour of what is shown around a vertex."""
        return self.around(side, vertex, self.pixels(side))

    def front(self, side: str, least: float = 0.5) -> list[int]:
        """The vertices of a ball whose normals have at least that cosine with the direction to the camera."""
        found: list[int] = self.ask(
            """([side, least]) => {
              const { rig, surface, aspect } = softmaps.stage[side];
              const eye = rig.camera(aspect).matrixWorld.elements.slice(8, 11);
              const facing = (v) => eye.reduce((sum, x, k) => sum + x * surface.normals[3 * v + k], 0);
              return Array.from({ length: surface.nVertices }, (_, v) => v).filter((v) => facing(v) > least);
            }""",
            [side, least],
        )
        return found

    def job(self, title: str, status: str) -> str:
        """Id of the job with a title once it has a status."""
        row = self.page.locator(f"li[data-job][data-status={status}]", has_text=title).first
        row.wait_for(timeout=SECONDS * 1000)
        return str(row.get_attribute("data-job"))


@pytest.fixture(scope="session")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")
    try:
        bundle.build()
    except bundle.ViewerNotBuilt as reason:
        if not (DIST / "index.html").is_file():
            pytest.skip(f"the page cannot be built here: {reason}")
    settings = Settings(data=tmp_path_factory.mktemp("viewer"), redis_url=None, threads=1)
    with Stack(settings, public=False) as running:
        yield running


@pytest.fixture(scope="session")
def client(stack: Stack) -> Iterator[Client]:
    with Client(stack.url) as running:
        yield running


@pytest.fixture(scope="session")
def ball_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of 258 vertices, as a file."""
    path = tmp_path_factory.mktemp("files") / "ball.off"
    path.write_text(sphere(3))
    return path


@pytest.fixture(scope="session")
def identity(client: Client, ball_file: Path) -> str:
    """Id of the soft map of a ball to itself that sends every vertex to itself."""
    ball = client.upload_mesh(ball_file)
    targets = client.upload_array(np.arange(ball.n_vertices), name="identity")
    basis = {"kind": "basis", "mesh": ball.id, "size": SIZE}
    spec = {"kind": "softmap", "source": basis, "target": basis}
    return client.wait(client.submit(spec | {"map": {"type": "points", "targets": targets.id}}).id).id


# Not for the session: Playwright's loop runs in this thread, and other tests start loops of their own.
@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=QUIET)
        yield running
        running.close()


@pytest.fixture
def view(stack: Stack, browser: Browser) -> Iterator[View]:
    """The page at 1280 × 720; fails if it throws, or asks another host for anything."""
    context = browser.new_context(viewport={"width": 1280, "height": 720}, accept_downloads=True)
    page = context.new_page()
    page.set_default_timeout(SECONDS * 1000)
    thrown: list[str] = []
    asked: list[str] = []
    page.on("pageerror", lambda error: thrown.append(str(error)))
    page.on("console", lambda message: thrown.append(message.text) if message.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    yield View(page, stack.url)
    context.close()
    assert [error for error in thrown if "Failed to load resource" not in error] == []
    assert [
        address for address in asked if not address.startswith((stack.url, "about:", "data:", "blob:"))
    ] == []
