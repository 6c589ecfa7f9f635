"""What is running, read from /proc: whose processes belong to a stack, and which are left."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

Found = TypeVar("Found")


def until(look: Callable[[], Found], seconds: float = 30.0) -> Found:
    """What `look` returns as soon as it is true."""
    deadline = time.monotonic() + seconds
    while not (found := look()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)
    return found


def of_folder(folder: Path) -> dict[int, str]:
    """Command lines of the processes that were given a data folder, by environment or by option."""
    return {
        pid: command
        for pid, command, environment in _processes()
        if str(folder) in command or f"SOFTMAPS_DATA={folder}" in environment
    }


def like(processes: dict[int, str], words: str) -> list[int]:
    """Those whose command line has some words."""
    return [pid for pid, command in processes.items() if words in command]


def socket_folders(processes: dict[int, str]) -> list[Path]:
    """Folders of the sockets that Redis servers among some processes listen on."""
    sockets = {
        word for command in processes.values() for word in command.split() if word.endswith("redis.sock")
    }
    return [Path(socket).parent for socket in sorted(sockets)]


def _processes() -> list[tuple[int, str, str]]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                command = (
                    (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
                )
                environment = (entry / "environ").read_bytes().decode(errors="replace")
            except (OSError, ProcessLookupError):
                continue
            # A process that has ended but was not waited for has no command line.
            if command:
                found.append((int(entry.name), command, environment))
    return found
