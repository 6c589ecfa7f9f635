"""What a task works with, and what it makes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy.typing as npt

from worker.readers import Reader
from worker.store import BorrowedBlocks

#: Reports a fraction done, from 0 to 1.
Report = Callable[[float], None]


def rest(report: Report, start: float) -> Report:
    """Report of a whole, given the report of its part from a fraction on."""
    return lambda done: report((done - start) / (1 - start) if start < 1 else 1.0)


class Say(Protocol):
    """Says what happens from now on; see `Bench`."""

    def __call__(
        self, words: str, start: float, stop: float, values: Mapping[str, Any] | None = None
    ) -> Report:
        """Say it."""
        ...


@dataclass(frozen=True, eq=False)
class Made:
    """What a stage made.

    Attributes
    ----------
    values : mapping
        Numbers for the manifest.
    arrays : mapping
        Arrays for the store.
    sizes : str
        How large it was, in words, for the log.
    residual : float
        Largest relative residual of the systems solved; 0 where none was.
    adopts : tuple of str
        Shards that this artifact takes over.
    seconds : float
        Time that its shards took.
    """

    values: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any] | BorrowedBlocks]
    sizes: str
    residual: float = 0.0
    adopts: tuple[str, ...] = ()
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class Bench:
    """What a stage works with.

    Attributes
    ----------
    read : Reader
        Reads parents.
    threads : int
        Threads that kernels may use.
    step : callable
        ``step(words, start, stop)`` says what happens from now on and returns the report of that share; with
        ``values``, also what is known so far.
    task : str
        Id of the artifact that is being made.
    shards : tuple of str
        Ids of the shards that were planned for this task, in order; they stand.
    """

    read: Reader
    threads: int
    step: Say
    task: str
    shards: tuple[str, ...] = ()
