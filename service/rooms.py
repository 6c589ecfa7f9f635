"""What every endpoint works with, and the parameters that several share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from anyio import CapacityLimiter
from fastapi import Depends, Path, Query, Request

from service.errors import NotFound
from service.representations import CACHE_PRIVATE, CACHE_PUBLIC
from service.uploads import Uploads
from service.watch import Watch
from worker.fields import kind_of
from worker.queue import Dispatcher
from worker.settings import Settings
from worker.store import Store


@dataclass(frozen=True)
class Rooms:
    """What the endpoints work with; one per app."""

    settings: Settings
    store: Store
    dispatcher: Dispatcher
    uploads: Uploads
    watch: Watch
    #: Threads for what may wait for others' plans or for work to end, so that readers always find one.
    patient: CapacityLimiter = field(default_factory=lambda: CapacityLimiter(16))

    @property
    def cache(self) -> str:
        """Cache-Control of content that never changes."""
        return CACHE_PRIVATE if self.settings.token else CACHE_PUBLIC


def rooms_of(request: Request) -> Rooms:
    """Rooms of the app that answers a request."""
    rooms: Rooms = request.app.state.rooms
    return rooms


InRooms = Annotated[Rooms, Depends(rooms_of)]
Id = Annotated[str, Path(description="Id of a job or artifact.")]
Name = Annotated[str | None, Query(max_length=200, description="A label, kept with the upload.")]
Wait = Annotated[float, Query(ge=0, description="Seconds to wait for the job to finish, at most 60.")]
Limit = Annotated[int, Query(ge=1, le=200, description="Most items on the page.")]
Cursor = Annotated[str | None, Query(max_length=200, description="`next` of the page before.")]


def check_id(id_: str) -> None:
    """Answer 404 to what is no id at all."""
    if kind_of(id_) is None:
        raise NotFound("ids look like energy-0123456789abcdef0123456789abcdef")
