"""Keeping the store small: what dead writers left goes, and what nobody reads once there is too much."""

from __future__ import annotations

import logging

from worker.library import Library, planned_shards, spec_named
from worker.settings import Settings
from worker.store import Store

_log = logging.getLogger("softmaps.upkeep")


def tidy(store: Store, settings: Settings) -> tuple[str, ...]:
    """Remove what dead writers left and, above ``store_max_bytes``, forget what was least recently read.

    Uploads stay, and so does everything that an unfinished job reads. What is forgotten answers 410 with the
    spec that makes it again.

    Parameters
    ----------
    store : Store
    settings : Settings

    Returns
    -------
    tuple of str
        Ids of what was forgotten.

    Raises
    ------
    OSError
        If the store cannot be read or written.
    """
    swept = store.sweep()
    if swept.blobs or swept.files:
        _log.info("removed %d blobs and %d files of writers that died", swept.blobs, swept.files)
    if settings.store_max_bytes is None:
        return ()
    known = Library(store)
    live: set[str] = set()
    for record in store.open_jobs():
        spec = spec_named(record.id, record.spec)
        if spec is not None:
            live.update(known.needs(spec) + planned_shards(record))
    forgotten = store.evict(settings.store_max_bytes, live)
    if forgotten:
        _log.info("forgot %d artifacts that were least recently read", len(forgotten))
    return forgotten
