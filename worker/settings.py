"""The only configuration: environment variables that begin with ``SOFTMAPS_``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict


def _default_data() -> Path:
    """Folder where a machine keeps an application's data (the XDG convention)."""
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "softmaps"


def _absolute(path: Path) -> Path:
    """Resolve ``~`` and relative folders once, so that children with another working folder agree."""
    return path.expanduser().absolute()


def usable_cores() -> int:
    """Cores that this process may use, which is what unset threads mean."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Settings(BaseSettings):
    """Everything that can be configured; read from the environment when it is made, then frozen.

    A variable is the field's name in capitals after ``SOFTMAPS_``; an empty variable counts as unset.

    Raises
    ------
    pydantic.ValidationError
        If a variable holds something that its field does not allow.
    """

    model_config = SettingsConfigDict(
        env_prefix="SOFTMAPS_", env_file=None, env_ignore_empty=True, frozen=True, extra="forbid"
    )

    redis_url: str | None = Field(
        default=None,
        description="Redis that carries the queues, as a URL. Unset: `softmaps up` starts its own.",
    )
    data: Annotated[Path, AfterValidator(_absolute)] = Field(
        default_factory=_default_data,
        validate_default=True,
        description="Folder of everything that is kept: `store/` (artifacts and job records) and `redis/`.",
    )
    url: str | None = Field(
        default=None,
        description="Address of the service that the command line asks. Unset: the stack on this machine.",
    )
    token: SecretStr | None = Field(
        default=None,
        min_length=1,
        description="Bearer token that every request must carry. Unset: no request needs one.",
    )
    threads: int | None = Field(
        default=None, ge=1, le=1024, description="Threads of one task. Unset: the cores this process may use."
    )
    max_upload_bytes: int = Field(default=200_000_000, ge=1, description="Largest mesh file, in bytes.")
    max_array_bytes: int = Field(default=400_000_000, ge=1, description="Largest uploaded array, in bytes.")
    max_json_bytes: int = Field(default=2_000_000, ge=1, description="Largest JSON body, in bytes.")
    max_vertices: int = Field(default=1_000_000, ge=1, description="Most vertices of a mesh.")
    max_faces: int = Field(default=2_000_000, ge=1, description="Most faces of a mesh.")
    max_functions: int = Field(default=2_000, ge=1, description="Most functions of a basis.")
    max_cost_seconds: float = Field(
        default=3_600.0,
        gt=0,
        allow_inf_nan=False,
        description="Largest estimate of one job, in seconds of one task.",
    )
    task_memory_bytes: int = Field(
        default=8_000_000_000,
        ge=1,
        description="Most memory that one task may take, in bytes; a question that needs more is refused.",
    )
    shard_seconds: float = Field(
        default=10.0,
        gt=0,
        allow_inf_nan=False,
        description="Estimate above which an energy or a potential is split among workers, in seconds.",
    )
    max_queued: int = Field(
        default=1_000, ge=1, description="Tasks that may wait at once; above, a new job is answered 429."
    )
    store_max_bytes: int | None = Field(
        default=None,
        ge=0,
        description="Size above which the least recently read results are forgotten, in bytes. Unset: never.",
    )
    upload_seconds: float = Field(
        default=30.0,
        gt=0,
        allow_inf_nan=False,
        description="Longest an uploaded mesh may take to parse, in seconds.",
    )
    upload_memory_bytes: int = Field(
        default=2_000_000_000,
        ge=1,
        description="Most memory the process that parses an upload may take, in bytes.",
    )

    @property
    def store_folder(self) -> Path:
        """Folder of the store: ``{data}/store``."""
        return self.data / "store"

    @property
    def redis_folder(self) -> Path:
        """Folder of the embedded Redis: ``{data}/redis``."""
        return self.data / "redis"
