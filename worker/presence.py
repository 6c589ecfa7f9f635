"""Who is there: workers announce themselves in expiring keys, and say what they run.

RQ's own list of workers does not survive a FLUSHALL, and its heartbeats go by the clocks of many machines.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Final

import redis

#: A worker announces itself every second or three; silent for this long, it counts as dead.
ANNOUNCED_SECONDS: Final = 8


@dataclass(frozen=True)
class Worker:
    """What a worker announces.

    Attributes
    ----------
    name, host : str
    pid : int
    interactive : bool
        Whether it takes short tasks only.
    attempt : str
        RQ id of what it runs, empty when idle.
    """

    name: str
    host: str
    pid: int
    interactive: bool
    attempt: str


class Presence:
    """The workers of one store.

    Parameters
    ----------
    connection : redis.Redis
    prefix : str
        What all keys of the store begin with.
    """

    def __init__(self, connection: redis.Redis, prefix: str) -> None:
        self._connection = connection
        self._names = f"{prefix}:workers"
        self._worker = f"{prefix}:worker:"

    def announce(self, worker: Worker) -> None:
        """Say that a worker is there, and what it runs, for the next eight seconds."""
        pipeline = self._connection.pipeline()
        pipeline.sadd(self._names, worker.name)
        pipeline.set(self._worker + worker.name, json.dumps(asdict(worker)), ex=ANNOUNCED_SECONDS)
        pipeline.execute()

    def withdraw(self, name: str) -> None:
        """Forget a worker."""
        pipeline = self._connection.pipeline()
        pipeline.srem(self._names, name)
        pipeline.delete(self._worker + name)
        pipeline.execute()

    def workers(self) -> list[Worker]:
        """Workers that announced themselves lately."""
        pipeline = self._connection.pipeline(transaction=False)
        self.ask(pipeline)
        return read(pipeline.execute()[0])

    def ask(self, pipeline: redis.client.Pipeline) -> None:
        """Ask for all workers, among other questions; `read` understands the answer."""
        # SORT … GET reads the names and what they announced in one step, so none can slip between.
        pipeline.sort(self._names, by="nosort", get=[self._worker + "*"])

    def prune(self) -> None:
        """Forget the names of workers that fell silent."""
        for said in self._connection.smembers(self._names):
            name = said.decode() if isinstance(said, bytes) else said
            if not self._connection.exists(self._worker + name):
                self._connection.srem(self._names, name)


def read(answer: Iterable[bytes | None]) -> list[Worker]:
    """Workers in the answer to `Presence.ask`."""
    return [Worker(**json.loads(said)) for said in answer if said]
