"""The page where soft maps are looked at: how it is served. `bundle.py` makes it from `src`."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import get_args

from fastapi import APIRouter, Request
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.types import Scope

from service.errors import NotFound
from service.representations import chosen

DIST = Path(__file__).parent / "dist"
#: Nothing but this host is asked for anything; styles of elements are set by the page's own script.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: Names of bundles hold their content's hash.
CACHE_BUNDLE = "public, max-age=31536000, immutable"
_MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css"}
_LINKS = {"docs": "/docs", "openapi": "/openapi.json", "meshes": "/v1/meshes", "jobs": "/v1/jobs"}
_NOT_BUILT = (
    "<!doctype html><html lang=en><meta charset=utf-8><title>softmaps</title><h1>softmaps</h1>"
    "<p>Everything works but this page, which needs npm once: install again where npm's registry "
    "can be reached (<code>pip install --force-reinstall --no-deps .</code>), or run "
    "<code>python service/viewer/bundle.py</code> in a checkout.</p>"
    "<p>The API is described at <a href=/docs>/docs</a>.</p>"
)

router = APIRouter(include_in_schema=False)


@router.get("/")
async def door(request: Request) -> Response:
    """The page for those who read HTML, links for everybody else."""
    if _wants_page(request.headers):
        page = DIST / "index.html"
        headers = {"Content-Security-Policy": POLICY, "Cache-Control": "no-cache", "Vary": "Accept"}
        if not page.is_file():
            return HTMLResponse(_NOT_BUILT, headers=headers)
        return FileResponse(page, media_type="text/html", headers=headers)
    document = {"service": "softmaps", "version": version("softmaps"), "links": _LINKS}
    return JSONResponse(document, headers={"Vary": "Accept"})


@router.get("/viewer/{name}")
async def part(name: str) -> Response:
    """A bundle of the page."""
    path = DIST / name
    media_type = _MEDIA_TYPES.get(path.suffix)
    if media_type is None or path.parent != DIST or not path.is_file():
        raise NotFound("the page has no such part; load it again")
    return FileResponse(path, media_type=media_type, headers={"Cache-Control": CACHE_BUNDLE})


@router.get("/viewer/creature/{pose}.off")
async def built_in(pose: str) -> Response:
    """The built-in creature in one pose, as a file to upload."""
    from service.creature import Pose, creature  # noqa: PLC0415  (only when somebody asks for it)
    from service.off import off  # noqa: PLC0415

    for known in get_args(Pose):
        if pose == known:
            vertices, faces = await run_in_threadpool(creature, known)
            return Response(off(vertices, faces), media_type="text/plain")
    raise NotFound(f"the creature's poses are {', '.join(get_args(Pose))}")


def open_to_all(scope: Scope) -> bool:
    """Whether a request is for the page itself, which holds nobody's results and asks for the token."""
    path: str = scope["path"]
    return path.startswith("/viewer/") or (path == "/" and _wants_page(Headers(scope=scope)))


def _wants_page(headers: Headers) -> bool:
    accept = headers.get("accept", "")
    return "text/html" in accept and chosen(accept, ("application/json", "text/html")) == "text/html"
