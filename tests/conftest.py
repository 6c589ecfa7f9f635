"""Fixtures that every test may ask for: real meshes, a real Redis, seeded randomness."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import redis
from threadpoolctl import threadpool_limits

from service.embedded import EmbeddedRedis

#: Real meshes with ground truth, kept beside a checkout; tests that need them skip where they are missing.
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread() -> Iterator[None]:
    """Pin BLAS as workers do: two test processes with a pool each would spin against one another."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    if not DATA.is_dir():
        pytest.skip("no folder of real meshes beside this checkout")
    return DATA


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20130703)


@pytest.fixture(scope="session")
def redis_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedRedis]:
    with EmbeddedRedis(tmp_path_factory.mktemp("redis")) as server:
        yield server


@pytest.fixture
def connection(redis_server: EmbeddedRedis) -> Iterator[redis.Redis]:
    """Yield a connection to a Redis that is empty before and after."""
    client = redis.Redis.from_url(redis_server.url)
    client.flushall()
    yield client
    client.flushall()
    client.close()
