"""The door of the service: `create_app(settings)`."""

from __future__ import annotations

import asyncio
import importlib.metadata
import logging
import secrets
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import redis
from fastapi import FastAPI
from redis.backoff import NoBackoff
from redis.retry import Retry
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import artifacts, routes, viewer
from service.errors import NotReady, problem, register
from service.metrics import MEDIA_TYPE, RequestMetrics, gauges
from service.openapi import completed, problems
from service.pages import docs_page
from service.replies import Health, Readiness
from service.rooms import Rooms
from service.uploads import Nursery, Uploads
from service.watch import Watch
from worker.queue import Dispatcher
from worker.settings import Settings
from worker.store import Store

#: Seconds between two passes of the loop that recovers lost work.
RECONCILE_SECONDS = 3.0
#: Redis answers within this many seconds or counts as away.
REDIS_SECONDS = 5.0
#: What anybody may ask without a token: whether the service lives.
_OPEN_PATHS = frozenset({"/healthz", "/readyz"})
_DESCRIPTION = (
    "Dirichlet and bijectivity energies of soft maps between triangle meshes. Upload meshes, POST a spec to "
    "/v1/jobs, read its artifact. Every error is application/problem+json."
)

log = logging.getLogger(__name__)


def create_app(settings: Settings) -> FastAPI:
    """HTTP service over one store and one Redis.

    Parameters
    ----------
    settings : Settings
        `redis_url` must be set; `softmaps up` sets it to the Redis it starts.

    Returns
    -------
    FastAPI
        Starts its processes and threads with its lifespan and ends them with it.

    Raises
    ------
    ValueError
        If no Redis is named.
    """
    if settings.redis_url is None:
        raise ValueError("SOFTMAPS_REDIS_URL must name a Redis; `softmaps up` starts one of its own")
    app = FastAPI(
        title="softmaps",
        version=importlib.metadata.version("softmaps"),
        description=_DESCRIPTION,
        lifespan=_lifespan,
        docs_url=None,
        redoc_url=None,
    )
    connection = _connection(settings.redis_url)
    store = Store(settings.store_folder)
    dispatcher = Dispatcher(settings, store, connection)
    nursery = Nursery()
    app.state.connection, app.state.nursery = connection, nursery
    app.state.metrics = RequestMetrics()
    app.state.rooms = Rooms(settings, store, dispatcher, Uploads(settings, nursery), Watch(dispatcher.job))
    register(app)
    app.include_router(routes.router)
    app.include_router(artifacts.router)
    app.include_router(viewer.router)
    _add_pages(app)
    _add_health(app)
    token = settings.token.get_secret_value() if settings.token else None
    app.add_middleware(_Gate, metrics=app.state.metrics, token=token)
    return app


def _connection(url: str) -> redis.Redis:
    # One retry at once: it replaces a connection that a restarted Redis closed. Waiting is for the client.
    retry = Retry(NoBackoff(), 1)
    patience = {"socket_timeout": REDIS_SECONDS, "socket_connect_timeout": REDIS_SECONDS}
    return redis.Redis.from_url(url, retry=retry, **patience)


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    rooms: Rooms = app.state.rooms
    await app.state.nursery.start()
    stop = threading.Event()
    work = (rooms.dispatcher, stop)
    reconciler = threading.Thread(target=_reconcile, args=work, name="reconcile", daemon=True)
    reconciler.start()
    try:
        yield
    finally:
        stop.set()
        await rooms.watch.stop()
        await app.state.nursery.stop()
        await asyncio.to_thread(reconciler.join, 2 * REDIS_SECONDS)
        app.state.connection.close()


def _reconcile(dispatcher: Dispatcher, stop: threading.Event) -> None:
    while not stop.wait(RECONCILE_SECONDS):
        try:
            dispatcher.reconcile()
        except redis.exceptions.RedisError as error:
            log.warning("Redis is away, nothing is recovered: %s", error)
        except Exception:
            log.exception("recovering lost work failed; trying again in %g s", RECONCILE_SECONDS)


def _add_pages(app: FastAPI) -> None:
    described = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            app.openapi_schema = completed(described())
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        policy = {"Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'"}
        return HTMLResponse(docs_page(app.openapi()), headers=policy)


def _add_health(app: FastAPI) -> None:
    rooms: Rooms = app.state.rooms

    @app.get("/healthz", tags=["health"], summary="Whether the process answers", response_model=Health)
    async def healthz() -> Health:
        """Answer at once, whatever else goes on."""
        return Health(status="ok", version=app.version)

    @app.get(
        "/readyz",
        tags=["health"],
        summary="Whether work can be done",
        response_model=Readiness,
        responses=problems(503),
    )
    async def readyz() -> Readiness:
        """Check that the store and Redis can be reached and that workers are present."""
        return await run_in_threadpool(_readiness, rooms)

    @app.get("/metrics", tags=["health"], summary="Numbers for Prometheus", response_class=Response)
    async def metrics() -> Response:
        """Requests of this process, jobs, queues, workers and the store."""
        lines = await run_in_threadpool(_metric_lines, app)
        return Response("\n".join(lines) + "\n", media_type=MEDIA_TYPE)


def _readiness(rooms: Rooms) -> Readiness:
    try:
        identity = rooms.store.identity
        rooms.store.manifest(f"mesh-{identity * 2}")
    except OSError as error:
        raise NotReady(f"the store cannot be read ({error.strerror})") from None
    workers = rooms.dispatcher.workers()
    if workers == 0:
        raise NotReady("no worker is running")
    return Readiness(status="ready", workers=workers, queued=rooms.dispatcher.queued())


def _metric_lines(app: FastAPI) -> list[str]:
    rooms: Rooms = app.state.rooms
    lines: list[str] = app.state.metrics.lines()
    usage = rooms.store.usage()
    lines += gauges({"store_bytes": usage.bytes, "store_artifacts": usage.artifacts})
    lines += gauges({"waiting_requests": rooms.watch.waiting})
    try:
        lines += gauges({"redis_up": 1, **rooms.dispatcher.metrics()})
    except redis.exceptions.RedisError:
        lines += gauges({"redis_up": 0})
    return lines


class _Gate:
    """The outermost layer: the token, HEAD for every GET, and the count of requests."""

    def __init__(self, app: ASGIApp, metrics: RequestMetrics, token: str | None) -> None:
        self._app, self._metrics = app, metrics
        self._token = token.encode() if token else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        method = scope["method"]
        inner = {**scope, "method": "GET", "head": True} if method == "HEAD" else scope
        status = 500
        began = time.monotonic()

        async def sending(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            elif method == "HEAD":
                message = {**message, "body": b""}
            await send(message)

        try:
            if self._allowed(scope):
                await self._app(inner, receive, sending)
            else:
                await self._refusal()(inner, receive, sending)
        finally:
            route = getattr(inner.get("route"), "path_format", None) or "other"
            known = method if method in {"GET", "HEAD", "POST", "DELETE"} else "other"
            self._metrics.observe(known, route, status, time.monotonic() - began)

    def _allowed(self, scope: Scope) -> bool:
        if self._token is None or scope["path"] in _OPEN_PATHS or viewer.open_to_all(scope):
            return True
        scheme, _, given = Headers(scope=scope).get("authorization", "").partition(" ")
        right = secrets.compare_digest(given.strip().encode("latin-1"), self._token)
        return right and scheme.lower() == "bearer"

    @staticmethod
    def _refusal() -> Response:
        detail = "Send the token of this service as Authorization: Bearer …"
        return problem(401, detail, headers={"WWW-Authenticate": "Bearer"})
