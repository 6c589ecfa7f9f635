"""A command that ends when its supervisor ends, however that happens: ``leash.py PARENT FOLDER COMMAND…``.

Run as a script by its path, with nothing but the standard library, so that it is up in a few milliseconds.
Without a folder (``-``) it becomes the command, and the kernel kills that when the supervisor is gone. With a
folder it stays as the command's parent, lets it end in peace, and removes the folder, which nobody else could
do after ``kill -9`` of the supervisor.
"""

import contextlib
import ctypes
import os
import shutil
import signal
import sys
from types import FrameType

#: prctl: send this process a signal when the thread that started it ends (Linux).
_PR_SET_PDEATHSIG = 1
#: Seconds between two looks whether the parent is still there, for kernels that do not tell.
_LOOK_SECONDS = 2.0


def hold(parent: int, number: signal.Signals) -> None:
    """Have the kernel send this process a signal when its parent ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)
    if os.getppid() != parent:  # it ended before the kernel was told
        os.kill(os.getpid(), number)


def keep(parent: int, folder: str, command: list[str]) -> int:
    """Run a command, end it when told or when the parent ends, and remove a folder."""
    blocked = {signal.SIGTERM, signal.SIGINT, signal.SIGHUP}
    signal.pthread_sigmask(signal.SIG_BLOCK, blocked)
    keeper = os.getpid()
    child = os.fork()
    if child == 0:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, blocked)
        hold(keeper, signal.SIGKILL)
        os.execv(command[0], command)

    told = False

    def forward(number: int, frame: FrameType | None) -> None:
        nonlocal told
        told = True
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGTERM)

    def look(number: int, frame: FrameType | None) -> None:
        if os.getppid() != parent:
            forward(number, frame)

    for number in blocked:
        signal.signal(number, forward)
    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, _LOOK_SECONDS, _LOOK_SECONDS)
    hold(parent, signal.SIGTERM)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, blocked)
    _, status = os.waitpid(child, 0)
    # A command that died by itself may be started again with the same folder.
    if told or os.getppid() != parent:
        shutil.rmtree(folder, ignore_errors=True)
    return os.waitstatus_to_exitcode(status)


def main() -> None:
    """Read the command line and run what it says."""
    parent, folder, command = int(sys.argv[1]), sys.argv[2], sys.argv[3:]
    if folder != "-":
        sys.exit(abs(keep(parent, folder, command)))
    hold(parent, signal.SIGKILL)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
