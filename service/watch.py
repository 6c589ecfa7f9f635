"""Waiting for jobs: one poller a process looks at all that anybody waits for, and tells of changes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import AsyncGenerator, Callable
from concurrent.futures import ThreadPoolExecutor

from worker.jobs import Job

#: Seconds between two looks, and the most that looking may take of a thread's time.
INTERVAL_SECONDS = 0.1
SHARE = 0.25
#: Statuses after which a job changes no more.
FINISHED = frozenset({"successful", "failed", "dismissed"})

log = logging.getLogger(__name__)


class Watch:
    """Tells any number of waiters about jobs, at the cost of one.

    Parameters
    ----------
    look : callable
        Job of an id, or None; may block, and may fail for a while.
    """

    def __init__(self, look: Callable[[str], Job | None]) -> None:
        self._look = look
        # Its own thread: waiters take none from those who serve requests.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="watch")
        self._watchers: Counter[str] = Counter()
        self._seen: dict[str, Job | None] = {}
        self._seen_at = 0.0
        self._looked = asyncio.Condition()
        self._poller: asyncio.Task[None] | None = None
        self._blind = False

    @property
    def waiting(self) -> int:
        """How many wait."""
        return self._watchers.total()

    async def stop(self) -> None:
        """End the poller; who still waits is left to be cancelled."""
        if self._poller is not None:
            self._poller.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._poller
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def finished(self, job: Job, seconds: float) -> Job:
        """The job when it is finished, or as it stands after some seconds."""
        latest = job
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                async for changed in self.changes(job):
                    latest = changed
        return latest

    async def changes(self, job: Job) -> AsyncGenerator[Job]:
        """Yield the job now and after each change, up to its final state; ends early if it is forgotten."""
        yield job
        if job.status in FINISHED:
            return
        since = time.monotonic()
        self._watchers[job.id] += 1
        if self._poller is None or self._poller.done():
            self._poller = asyncio.create_task(self._poll())
        latest = job
        try:
            while True:
                async with self._looked:
                    await self._looked.wait()
                # A look that began before this job was seen may show what it was before.
                found = self._seen.get(latest.id, latest) if self._seen_at >= since else latest
                if found is None:
                    return
                if found != latest:
                    latest = found
                    yield latest
                if latest.status in FINISHED:
                    return
        finally:
            self._watchers[job.id] -= 1
            if self._watchers[job.id] <= 0:
                del self._watchers[job.id]

    async def _poll(self) -> None:
        loop = asyncio.get_running_loop()
        while self._watchers:
            began = time.monotonic()
            try:
                watched = tuple(self._watchers)
                self._seen = await loop.run_in_executor(self._thread, self._look_at, watched)
                self._seen_at, self._blind = began, False
            except Exception as error:
                # Redis may be away for a while: who waits goes on waiting, and the log hears of it once.
                log.log(
                    logging.DEBUG if self._blind else logging.WARNING, "jobs cannot be looked at: %s", error
                )
                self._blind = True
            async with self._looked:
                self._looked.notify_all()
            await asyncio.sleep(max(INTERVAL_SECONDS, (time.monotonic() - began) / SHARE))
        self._seen = {}

    def _look_at(self, ids: tuple[str, ...]) -> dict[str, Job | None]:
        return {id_: self._look(id_) for id_ in ids}
