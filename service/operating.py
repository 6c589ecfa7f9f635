"""The commands that run things and look after them: `up`, `api`, `worker` and `jobs`."""

from __future__ import annotations

import os
import sys
from itertools import islice
from typing import Annotated, NoReturn

import typer

from service.answers import Job
from service.console import Screen, errors_in_words, interrupt_on_termination, settings_in_words, table
from service.locating import service_of, stopping
from service.options import Data, Json, Url
from service.stack import LOOK_SECONDS, Stack
from service.supervisor import module


def up(
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Where the API listens; 0: any free port.")
    ] = 8000,
    host: Annotated[str, typer.Option(help="Address that it listens on.")] = "127.0.0.1",
    workers: Annotated[int | None, typer.Option(min=1, help="Workers; one per four cores.")] = None,
    data: Data = None,
    json: Json = False,
) -> None:
    """Run everything on this machine: Redis, the API and workers. Ctrl-C stops it all."""
    screen = Screen(json)
    settings = settings_in_words(screen, data=data)
    interrupt_on_termination()
    with errors_in_words(screen):
        stack = Stack(settings, port=port, host=host, workers=workers, report=screen.say)
        with stopping(stack):
            try:
                stack.start()
                screen.answer({"url": stack.url, "pid": os.getpid(), "data": str(settings.data)})
                screen.show(
                    f"[bold green]softmaps is ready[/] at [bold]{stack.url}[/] (see {stack.url}/docs)",
                    f"{stack.workers} worker(s) with {stack.threads} thread(s) each and one for short tasks; "
                    f"data in {settings.data}",
                    "Ctrl-C stops everything.",
                )
                if not settings.token and host not in {"127.0.0.1", "localhost", "::1"}:
                    screen.say("anybody who reaches this address may use it: SOFTMAPS_TOKEN is not set")
                while True:
                    stack.watch(LOOK_SECONDS)
            except KeyboardInterrupt:
                screen.say("stopping")


def api(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 8000,
) -> None:
    """Run the API alone, for a Redis and workers elsewhere (SOFTMAPS_REDIS_URL, SOFTMAPS_DATA)."""
    _become("service.server", "--host", host, "--port", str(port))


def worker(
    interactive: Annotated[bool, typer.Option("--interactive", help="Take short tasks only.")] = False,
) -> None:
    """Run one worker, for an API and a Redis elsewhere (SOFTMAPS_REDIS_URL, SOFTMAPS_DATA)."""
    _become("worker", *(["--interactive"] if interactive else []))


def _become(name: str, *options: str) -> NoReturn:
    """Go on as another module, in this very process."""
    screen = Screen(machine=False)
    if settings_in_words(screen).redis_url is None:
        screen.fail("SOFTMAPS_REDIS_URL must name a Redis; `softmaps up` runs everything on one machine", 2)
    sys.stdout.flush()
    command = module(name, *options)
    os.execv(command[0], command)


def jobs(
    id: Annotated[str | None, typer.Argument(help="One job; all unless given.")] = None,
    status: Annotated[
        str | None, typer.Option(help="Only accepted, running, successful, failed or dismissed ones.")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Most jobs to list.")] = 20,
    dismiss: Annotated[bool, typer.Option("--dismiss", help="Dismiss the job, for everyone.")] = False,
    url: Url = None,
    data: Data = None,
    json: Json = False,
) -> None:
    """List jobs, the newest first; look at one, or dismiss it."""
    if dismiss and id is None:
        raise typer.BadParameter("name the job to dismiss", param_hint="--dismiss")
    screen = Screen(json)
    settings = settings_in_words(screen, data=data)
    interrupt_on_termination()
    with errors_in_words(screen), service_of(settings, url, screen.say) as client:
        if id is None:
            found = list(islice(client.jobs(status), limit))
        else:
            found = [client.dismiss(id) if dismiss else client.job(id)]
    screen.answer({"jobs": [job.document for job in found]})
    rows = [
        (job.id, _state(job), _took(job.seconds), (job.created_at or "")[5:16].replace("T", " "))
        for job in found
    ]
    screen.show(table("", ("job", "status", "seconds", "asked (UTC)"), rows) if rows else "no jobs")
    if id is not None:
        for job in found:
            screen.show(table("", ("task", "status"), [(task.id, task.status) for task in job.tasks]))
            if job.error is not None:
                screen.show(str(job.error.get("detail")))


def _state(job: Job) -> str:
    return f"{job.status} {job.progress:.0f} %" if job.status == "running" else job.status


def _took(seconds: float | None) -> str:
    return "" if seconds is None else f"{seconds:.1f}"
