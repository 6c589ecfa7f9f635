"""Which service a command talks to: the one named, the one running on this machine, or one started for it."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from service.client import Client
from service.stack import Stack, StackError, running
from worker.settings import Settings

#: Longest to wait for another command's stack on the same data folder, in seconds.
PATIENCE_SECONDS = 60.0


@contextmanager
def service_of(settings: Settings, url: str | None, report: Callable[[str], None]) -> Iterator[Client]:
    """Client of a service that is there until the end of the block.

    Parameters
    ----------
    settings : Settings
        Name the service (`url`), or the data folder and everything else of a stack.
    url : str or None
        Names the service before all else.
    report : callable
        Told in words what happens meanwhile.

    Yields
    ------
    Client
        Of ``url``, of ``SOFTMAPS_URL``, of the stack that runs on the data folder, or of one that starts now
        and ends with the block.

    Raises
    ------
    StackError
        If no stack can be started.
    Unusable
        If the address is none.
    """
    token = settings.token.get_secret_value() if settings.token else None
    named = url or settings.url or running(settings.data)
    if named is not None:
        with Client(named, token) as client:
            yield client
        return
    report("no service is running here: starting one for this command")
    stack = _own_stack(settings, report)
    if isinstance(stack, str):
        with Client(stack, token) as client:
            yield client
        return
    with stopping(stack):
        stack.start()
        with Client(stack.url, token) as client:
            yield client


def _own_stack(settings: Settings, report: Callable[[str], None]) -> Stack | str:
    """A stack on the data folder; or the address of somebody else's that came up meanwhile."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while True:
        try:
            return Stack(settings, public=False, report=report)
        except StackError:
            if time.monotonic() > deadline:
                raise
        report("another command uses the data folder: waiting for it")
        time.sleep(0.5)
        if (url := running(settings.data)) is not None:
            return url


@contextmanager
def stopping(stack: Stack) -> Iterator[None]:
    """Stop a stack at the end of the block, whatever a user in a hurry presses meanwhile."""
    try:
        yield
    finally:
        held = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            stack.stop()
        finally:
            for number, handler in held.items():
                signal.signal(number, handler)
