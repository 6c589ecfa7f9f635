"""The poller: one look for all who wait, steady through failures, and quiet when nobody waits."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from dataclasses import replace

import pytest

from service.watch import Watch
from worker.jobs import Job

JOB = Job(
    id="energy-" + "0" * 32,
    kind="energy",
    status="accepted",
    progress=0.0,
    phase="waiting for a worker",
    created_at="2026-01-01T00:00:00+00:00",
    started_at=None,
    finished_at=None,
    error=None,
    values={},
    tasks=(),
    asked=True,
)
RUNNING = replace(JOB, status="running", progress=50.0)
DONE = replace(JOB, status="successful", progress=100.0)


class Script:
    """What successive looks find; the last one for ever. An exception is raised."""

    def __init__(self, *found: Job | Exception | None) -> None:
        self.found = list(found)
        self.looks: Counter[str] = Counter()

    def __call__(self, id_: str) -> Job | None:
        self.looks[id_] += 1
        found = self.found.pop(0) if len(self.found) > 1 else self.found[0]
        if isinstance(found, Exception):
            raise found
        return found


async def changes(watch: Watch, job: Job) -> list[Job]:
    return [found async for found in watch.changes(job)]


def test_every_change_is_told_once_and_the_last_is_final() -> None:
    async def story() -> list[Job]:
        watch = Watch(Script(JOB, JOB, RUNNING, RUNNING, DONE))
        told = await changes(watch, JOB)
        assert watch.waiting == 0
        await watch.stop()
        return told

    assert asyncio.run(story()) == [JOB, RUNNING, DONE]


def test_a_finished_job_is_not_looked_at() -> None:
    async def story() -> Script:
        script = Script(DONE)
        watch = Watch(script)
        assert await changes(watch, DONE) == [DONE]
        assert await watch.finished(DONE, 10) == DONE
        await watch.stop()
        return script

    assert asyncio.run(story()).looks.total() == 0


def test_many_who_wait_cost_as_much_as_one() -> None:
    async def story() -> int:
        script = Script(JOB, RUNNING, DONE)
        watch = Watch(script)
        told = await asyncio.gather(*(watch.finished(JOB, 10) for _ in range(200)))
        await watch.stop()
        assert all(each == DONE for each in told)
        return script.looks.total()

    assert asyncio.run(story()) <= 5


def test_failures_are_outlived_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    async def story() -> Job:
        watch = Watch(Script(OSError("away"), OSError("away"), OSError("away"), DONE))
        found = await watch.finished(JOB, 10)
        await watch.stop()
        return found

    with caplog.at_level(logging.INFO, "service.watch"):
        assert asyncio.run(story()) == DONE
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_job_that_is_forgotten_ends_the_wait() -> None:
    async def story() -> list[Job]:
        watch = Watch(Script(RUNNING, None))
        told = await changes(watch, JOB)
        await watch.stop()
        return told

    assert asyncio.run(story()) == [JOB, RUNNING]


def test_a_wait_in_vain_returns_what_is_known_and_the_poller_rests() -> None:
    async def story() -> None:
        script = Script(RUNNING)
        watch = Watch(script)
        assert await watch.finished(JOB, 0.3) == RUNNING
        assert watch.waiting == 0
        await asyncio.sleep(0.3)
        looks = script.looks.total()
        await asyncio.sleep(0.3)
        assert script.looks.total() == looks
        # And it wakes up again.
        assert await watch.finished(JOB, 0.3) == RUNNING
        await watch.stop()

    asyncio.run(story())


def test_a_job_that_runs_again_is_not_taken_for_what_it_was() -> None:
    failed = replace(JOB, status="failed")

    async def story() -> Job:
        release = asyncio.Event()
        loop = asyncio.get_running_loop()
        looks: list[str] = []

        def look(_: str) -> Job:
            looks.append("look")
            if len(looks) == 1:  # begun before the job was asked for again, and slow
                asyncio.run_coroutine_threadsafe(release.wait(), loop).result()
                return failed
            return DONE

        watch = Watch(look)
        first = asyncio.create_task(watch.finished(JOB, 10))
        while not looks:
            await asyncio.sleep(0.01)
        again = asyncio.create_task(watch.finished(JOB, 10))
        await asyncio.sleep(0.05)
        release.set()
        assert await first == failed
        found = await again
        await watch.stop()
        return found

    assert asyncio.run(story()) == DONE
