"""A process that forks a guarded child for every uploaded mesh, with all readers imported already.

`multiprocessing`'s fork server would run the caller's main module again in every child and leaves its
processes to private functions; this one has one socket to its owner and ends with it. The owner sends a frame
with two open files (the upload, and an empty one for the result); the answer is a frame with what became of
the child. The files have no names, so nothing is left behind however this ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import importlib.util
import json
import logging
import os
import resource
import select
import signal
import socket
import struct
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.parsing import FORMATS

#: Length of a frame's JSON, before it.
FRAME = struct.Struct("<I")
#: The result begins with the length of its JSON; arrays begin at a multiple of 64 bytes.
RESULT = struct.Struct("<Q")
ALIGNMENT = 64
#: Seconds of computing beyond the deadline after which the kernel itself ends a child.
GRACE_SECONDS = 5
_PR_SET_PDEATHSIG = 1

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Order:
    """What the owner asks for: a file in one of `service.parsing.FORMATS`, and its bounds."""

    number: int
    file_format: str
    seconds: float
    memory_bytes: int
    max_vertices: int
    max_faces: int


@dataclass
class _Child:
    number: int
    deadline: float
    late: bool = False


def send(channel: socket.socket, frame: dict[str, Any], files: tuple[int, ...] = ()) -> None:
    """Send a frame and the files that go with it."""
    text = json.dumps(frame).encode()
    socket.send_fds(channel, [FRAME.pack(len(text)) + text], files)


def main() -> None:
    """Serve the owner, whose socket has the descriptor in the first argument, until it hangs up."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner hangs up when it is told to stop
    _bypass_door("solver")
    # All imports that a child needs are made once, here.
    for module in ("trimesh", "solver.mesh", *(f"service.parsing.{name}" for name in FORMATS)):
        importlib.import_module(module)
    _serve(channel)


def _bypass_door(package: str) -> None:
    """Let modules of a package be imported without its door.

    Only the mesh is wanted of the solver; its door would load all kernels, and compile them on a first run.
    """
    found = importlib.util.find_spec(package)
    assert found is not None, "it is part of this project"
    sys.modules.setdefault(package, importlib.util.module_from_spec(found))


def _serve(channel: socket.socket) -> None:
    wake, waker = os.pipe()
    os.set_blocking(wake, False)
    os.set_blocking(waker, False)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    children: dict[int, _Child] = {}
    try:
        while True:
            now = time.monotonic()
            deadlines = [child.deadline for child in children.values() if not child.late]
            patience = max(0.0, min(deadlines) - now) if deadlines else None
            ready, _, _ = select.select([channel.fileno(), wake], [], [], patience)
            if wake in ready:
                os.read(wake, 4096)
            if channel.fileno() in ready and not _take(channel, children):
                return
            for pid, child in children.items():
                if not child.late and time.monotonic() >= child.deadline:
                    child.late = True
                    os.kill(pid, signal.SIGKILL)
            _reap(channel, children)
    except (BrokenPipeError, ConnectionResetError):
        return  # the owner is gone
    finally:
        for pid in children:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)


def _take(channel: socket.socket, children: dict[int, _Child]) -> bool:
    """Take one order and fork its child; False once the owner hung up."""
    head, files, _, _ = socket.recv_fds(channel, FRAME.size, 2)
    if len(head) < FRAME.size:
        return False
    (length,) = FRAME.unpack(head)
    order = Order(**json.loads(channel.recv(length, socket.MSG_WAITALL)))
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            _guard(order)
            channel.close()
            _read(order, *files)
            status = 0
        except BaseException:
            log.exception("an upload's child failed")
        finally:
            os._exit(status)
    for file in files:
        os.close(file)
    children[pid] = _Child(order.number, time.monotonic() + order.seconds)
    return True


def _reap(channel: socket.socket, children: dict[int, _Child]) -> None:
    while children:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid == 0:
            return
        child = children.pop(pid)
        code = os.waitstatus_to_exitcode(status)
        late = child.late or code == -signal.SIGXCPU
        send(
            channel, {"number": child.number, "outcome": "late" if late else "read" if code == 0 else "died"}
        )


def _guard(order: Order) -> None:
    """Bind this process: memory, computing time, no core dump, and no life without its parent."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        # What the interpreter and its libraries have mapped already is not the upload's doing.
        mapped = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _limit(resource.RLIMIT_AS, mapped + order.memory_bytes)
    _limit(resource.RLIMIT_CPU, int(order.seconds) + GRACE_SECONDS)
    _limit(resource.RLIMIT_CORE, 0)


def _limit(what: int, value: int) -> None:
    hard = resource.getrlimit(what)[1]
    value = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(what, (value, value))


def _read(order: Order, upload: int, result: int) -> None:
    """Read the upload and write facts and arrays, or the refusal, into the result."""
    from service.parsing import InvalidFile, Limits, TooLarge, read_mesh  # noqa: PLC0415
    from solver.errors import InvalidMesh  # noqa: PLC0415
    from solver.mesh import Mesh  # noqa: PLC0415

    facts: dict[str, Any]
    arrays = []
    try:
        with os.fdopen(upload, "rb") as file:
            content = file.read()
        parsed = read_mesh(content, order.file_format, Limits(order.max_vertices, order.max_faces))
        mesh = Mesh(parsed.vertices, parsed.faces)
        arrays = [mesh.vertices, mesh.faces]
        facts = {
            "n_vertices": mesh.n_vertices,
            "n_faces": mesh.n_faces,
            "area": float(mesh.area),
            "n_components": int(mesh.n_components),
            "euler_characteristic": int(mesh.euler_characteristic),
            "n_boundary_loops": int(mesh.n_boundary_loops),
            "warnings": [*parsed.warnings, *mesh.warnings],
        }
    except TooLarge as error:
        facts = {"refused": "too large", "detail": str(error)}
    except InvalidFile as error:
        facts = {"refused": "invalid", "detail": str(error)}
    except InvalidMesh as error:
        facts = {"refused": "invalid", "detail": str(error)}
    except MemoryError:
        facts = {
            "refused": "invalid",
            "detail": f"reading the file takes more than {order.memory_bytes:,} bytes of memory",
        }
    except Exception as error:
        # A reader of somebody else's may raise anything; a traceback of ours must be seen.
        log.warning("a %s file was refused by an unforeseen error", order.file_format, exc_info=True)
        facts = {"refused": "invalid", "detail": f"the file cannot be read ({type(error).__name__})"}
    text = json.dumps(facts).encode()
    padding = -(RESULT.size + len(text)) % ALIGNMENT
    with os.fdopen(result, "wb") as out:
        out.write(RESULT.pack(len(text)) + text + bytes(padding))
        for array in arrays:
            out.write(array.tobytes())


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s %(message)s")
    main()
