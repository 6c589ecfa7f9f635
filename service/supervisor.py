"""Children of a stack: started in sessions of their own, started again when they die, ended one and all."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import service.leash

#: Pause before a child that died is started again: doubled each time, forgotten once it lived for a while.
FIRST_PAUSE, LONGEST_PAUSE, LONG_LIFE = 0.2, 30.0, 60.0
#: A log that is longer than this when a stack starts begins anew.
MAX_LOG_BYTES = 10_000_000
#: Lines of a log that are worth repeating when a child does not come up.
LAST_LINES = 8


def leashed(command: Sequence[str], folder: Path | None = None) -> list[str]:
    """Command that runs another one until this process ends.

    Parameters
    ----------
    command : sequence of str
        Its program by an absolute path.
    folder : Path, optional
        Removed if this process ends without having done so.

    Returns
    -------
    list of str
        See `service.leash`. The thread that starts it must live as long as it: the kernel watches the thread.
    """
    leash = [sys.executable, "-I", "-S", str(service.leash.__file__), str(os.getpid()), str(folder or "-")]
    return [*leash, *command]


def module(name: str, *options: str) -> list[str]:
    """Command that runs a module of this installation, whatever lies in the working folder."""
    return [sys.executable, "-P", "-m", name, *options]


def end_by(process: subprocess.Popen[bytes], deadline: float) -> None:
    """Wait for the end of a process that leads its group until a moment, then kill all of its group.

    Parameters
    ----------
    process : Popen
        Has been told to end.
    deadline : float
        Of the monotonic clock.
    """
    try:
        process.wait(max(0.0, deadline - time.monotonic()))
    except subprocess.TimeoutExpired:
        # Only now: the number of a process that was waited for may be somebody else's.
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@dataclass(frozen=True)
class Plan:
    """What a child is.

    Attributes
    ----------
    name : str
        In messages, and of its log.
    command : tuple of str
        What it runs.
    sockets : tuple of int
        File descriptors that it inherits.
    """

    name: str
    command: tuple[str, ...]
    sockets: tuple[int, ...] = ()


class Child:
    """A process of a stack, replaced whenever it dies.

    Parameters
    ----------
    plan : Plan
        What it is.
    environment : mapping
        Of the process.
    logs : Path
        Folder of its log.
    """

    def __init__(self, plan: Plan, environment: Mapping[str, str], logs: Path) -> None:
        self.name = plan.name
        self.log = logs / f"{plan.name}.log"
        self.deaths = 0
        self._plan, self._environment = plan, environment
        self._pause, self._due = FIRST_PAUSE, 0.0
        if self.log.exists() and self.log.stat().st_size > MAX_LOG_BYTES:
            self.log.unlink()
        self.process = self._start()

    def _start(self) -> subprocess.Popen[bytes]:
        self._since = time.monotonic()
        with self.log.open("ab") as log:
            return subprocess.Popen(
                leashed(self._plan.command),
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=self._plan.sockets,
                # The supervisor alone decides what Ctrl-C means.
                start_new_session=True,
            )

    @property
    def alive(self) -> bool:
        """Whether it runs now."""
        return self.process.poll() is None

    def look_after(self) -> None:
        """Start it again if it died and has paused long enough."""
        now = time.monotonic()
        if self.alive:
            return
        if not self._due:
            self.deaths += 1
            self._pause = (
                FIRST_PAUSE if now - self._since > LONG_LIFE else min(2 * self._pause, LONGEST_PAUSE)
            )
            self._due = now + self._pause
        elif now >= self._due:
            self._due = 0.0
            self.process = self._start()

    def ask_to_end(self) -> None:
        """Send SIGTERM, if it runs."""
        if self.alive:
            self.process.terminate()

    def end(self, deadline: float) -> None:
        """Wait for its end until a moment, then kill what is left of it."""
        end_by(self.process, deadline)

    def last_words(self) -> str:
        """End of its log, for a message."""
        with contextlib.suppress(OSError):
            return "\n".join(self.log.read_text(errors="replace").splitlines()[-LAST_LINES:])
        return ""
