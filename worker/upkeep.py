"""Keeping the store within its bounds: what is forgotten, what is cleared away, and how often."""

from __future__ import annotations

import logging
from typing import Final

from worker.attempts import Attempts
from worker.library import Library, needs_of
from worker.plan import planning
from worker.settings import Settings
from worker.store import Store

_log = logging.getLogger("softmaps.queue")

#: Seconds between two looks at the size of the store, and between two sweeps of what dead writers left.
EVICT_SECONDS: Final = 60
SWEEP_SECONDS: Final = 3600


def keep_house(settings: Settings, store: Store, attempts: Attempts) -> None:
    """Forget what the store has no room for, and sweep it, each when it is time; one process at a time.

    What open jobs read is never forgotten, nor are uploads.

    Parameters
    ----------
    settings : Settings
    store : Store
    attempts : Attempts
    """
    if settings.store_max_bytes is not None and attempts.due("evict", EVICT_SECONDS):
        # Under the lock: nobody may plan with what is being forgotten.
        with planning(attempts, 0.0) as held:
            if held:
                forgotten = store.evict(settings.store_max_bytes, _needed(store))
                if forgotten:
                    _log.info(
                        "forgot %d results to stay within %d bytes", len(forgotten), settings.store_max_bytes
                    )
    if attempts.due("sweep", SWEEP_SECONDS):
        swept = store.sweep()
        _log.info("swept %d blobs, %d files, %d jobs", swept.blobs, swept.files, swept.jobs)


def _needed(store: Store) -> frozenset[str]:
    """Ids that open jobs read."""
    known = Library(store)
    return frozenset().union(*(needs_of(record, known) for record in store.open_jobs()))
