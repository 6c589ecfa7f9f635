"""How far long tasks came: arrays that a later run goes on from, and that people may look at meanwhile."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.fields import kind_of
from worker.objects import Objects

#: Checkpoints of a task that stay: whoever saw the last but one may still be about to read it.
_KEPT = 2
_VALUES = "values.json"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """How far a task came.

    Attributes
    ----------
    number : int
        Counts a task's checkpoints.
    values : mapping
        As JSON holds them.
    arrays : mapping of ndarray
    """

    number: int
    values: Mapping[str, Any]
    arrays: Mapping[str, npt.NDArray[Any]]


class Checkpoints:
    """The checkpoints of a store, whole or absent, each under ``checkpoints/{id}.{number}``.

    Parameters
    ----------
    objects : Objects
        Where they are kept.
    """

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def write(self, id_: str, values: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Write how far a task came; of two that write at once, one is believed."""
        if kind_of(id_) is None:
            raise ValueError(f"{id_!r} is no id")
        body = io.BytesIO()
        said = np.frombuffer(json.dumps(values, allow_nan=False).encode(), dtype=np.uint8)
        np.savez(body, allow_pickle=False, **{_VALUES: said}, **arrays)
        content = body.getvalue()
        names = self._names(id_)
        number = _number(names[-1]) + 1 if names else 0
        digest = hashlib.sha256(content).hexdigest().encode()
        self._objects.create(f"checkpoints/{id_}.{number:08d}", digest + b"\n" + content)
        for name in names[: 1 - _KEPT]:
            self._objects.delete(f"checkpoints/{name}")

    def read(self, id_: str) -> Checkpoint | None:
        """The newest checkpoint of a task that is as it was written, or None."""
        for name in reversed(self._names(id_)):
            content = self._objects.read(f"checkpoints/{name}")
            digest, _, body = (content or b"").partition(b"\n")
            if hashlib.sha256(body).hexdigest().encode() != digest:
                continue  # deleted meanwhile, or damaged
            with np.load(io.BytesIO(body), allow_pickle=False) as arrays:
                found = {key: arrays[key] for key in arrays.files}
            return Checkpoint(_number(name), json.loads(found.pop(_VALUES).tobytes()), found)
        return None

    def delete(self, id_: str) -> None:
        """Delete a task's checkpoints."""
        for name in self._names(id_):
            self._objects.delete(f"checkpoints/{name}")

    def discard(self, older_than: float, needed: Callable[[str], bool]) -> int:
        """Delete checkpoints of that age, in seconds, that nobody needs; returns how many."""
        old = [one.name for one in self._objects.listing("checkpoints") if one.age >= older_than]
        idle = [name for name in old if not needed(name.partition(".")[0])]
        return sum(self._objects.delete(f"checkpoints/{name}") for name in idle)

    def _names(self, id_: str) -> list[str]:
        return self._objects.names("checkpoints", prefix=f"{id_}.") if kind_of(id_) else []


def _number(name: str) -> int:
    return int(name.rpartition(".")[2])
