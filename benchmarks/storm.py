"""Two hundred energy jobs from eight clients at once, a worker killed and, if asked, Redis emptied meanwhile.

    python -m benchmarks.storm [--flush]

Long solves keep both workers busy; then one worker is ended with ``kill -9`` and its task must come back, on
its replacement, while the other worker is inside its own solve. Every artifact is then read back, verified.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import redis
import trimesh

from service.client import Client
from service.creature import creature
from service.stack import Stack
from worker.settings import Settings

CLIENTS, JOBS_EACH = 8, 25
#: Long solves: enough for two workers to be inside one each when one of them is killed.
LONG = 4


def children(pid: int) -> list[int]:
    """Pids of the children of a process."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(status.parent.name))
    return found


def plain_workers() -> list[int]:
    """Workers of this process' stack that take everything."""
    commands = {pid: Path(f"/proc/{pid}/cmdline").read_text().split("\0") for pid in children(os.getpid())}
    return [pid for pid, words in commands.items() if "worker" in words and "--interactive" not in words]


def energy(source: str, target: str, size: int, regularisation: float) -> dict[str, Any]:
    """Spec of an energy of the uniform-blended point map of two meshes."""
    basis = {"kind": "basis", "size": size}
    softmap = {
        "kind": "softmap",
        "source": basis | {"mesh": source},
        "target": basis | {"mesh": target},
        "map": {"type": "descriptors", "descriptor": "hks"},
    }
    return {"kind": "energy", "softmap": softmap, "regularisation": regularisation, "gradient": True}


def main() -> None:
    """Run the storm and print what became of it."""
    with tempfile.TemporaryDirectory(prefix="softmaps-storm-") as data:
        stack = Stack(Settings(data=Path(data), threads=1), workers=2, public=False)
        with stack, Client(stack.url) as client:
            storm(stack, client, flush="--flush" in sys.argv)


def storm(stack: Stack, client: Client, *, flush: bool) -> None:
    """Submit, kill, wait, read back."""
    poses = [client.upload_mesh(creature(pose)).id for pose in ("standing", "trotting")]
    ball = trimesh.creation.icosphere(subdivisions=5)
    sphere = client.upload_mesh((ball.vertices, ball.faces)).id
    specs = [energy(sphere, sphere, 600, 1e-5 * (k + 1)) for k in range(LONG)]
    client.wait(client.submit(specs[0]["softmap"]).id, timeout=600)
    long = [client.submit(spec).id for spec in specs]

    def submit(number: int) -> list[str]:
        with Client(stack.url) as mine:
            numbers = range(1 + number * JOBS_EACH, 1 + (number + 1) * JOBS_EACH)
            return [mine.submit(energy(*poses, 40, 1e-4 * k)).id for k in numbers]

    began = time.monotonic()
    with ThreadPoolExecutor(CLIENTS) as pool:
        storming = [pool.submit(submit, number) for number in range(CLIENTS)]
        victim, survivor = busy_workers()
        running = [id_ for id_ in long if client.job(id_).status == "running"]
        killed = time.monotonic()
        for pid in (victim, *children(victim)):
            os.kill(pid, signal.SIGKILL)
        print(f"killed worker {victim} inside a solve after {killed - began:.1f} s; {survivor} goes on")
        if flush:
            emptied(survivor)
        threading.Thread(target=narrate, args=(stack.url, running, killed), daemon=True).start()
        ids = [id_ for each in storming for id_ in each.result()] + long
    print(f"{len(ids) - LONG} jobs submitted by {CLIENTS} clients in {time.monotonic() - began:.1f} s")
    ended = {id_: client.wait(id_, timeout=900).status for id_ in ids}
    seconds = time.monotonic() - began
    whole = sum(bool(client.arrays(id_)) for id_ in ids)
    states = {state: list(ended.values()).count(state) for state in sorted(set(ended.values()))}
    print(f"{len(set(ids))} jobs after {seconds:.1f} s: {states}; {whole} artifacts read back whole")


def busy_workers() -> tuple[int, int]:
    """Two workers that both have been inside a task for a second, the younger task's first."""
    since: dict[int, float] = {}
    while True:
        horses = {worker: children(worker) for worker in plain_workers()}
        moment = time.monotonic()
        since = {h[0]: since.get(h[0], moment) for h in horses.values() if h}
        both = len(horses) == 2 and all(horses.values())
        if both and all(moment - since[h[0]] > 1.0 for h in horses.values()):
            victim, survivor = sorted(horses, key=lambda worker: -since[horses[worker][0]])
            return victim, survivor
        time.sleep(0.02)


def emptied(worker: int) -> None:
    """Empty the Redis that a worker is connected to."""
    words = Path(f"/proc/{worker}/environ").read_text().split("\0")
    url = next(word.partition("=")[2] for word in words if word.startswith("SOFTMAPS_REDIS_URL="))
    with redis.Redis.from_url(url) as connection:
        connection.flushall()
    print("Redis emptied")


def narrate(url: str, ids: list[str], killed: float) -> None:
    """Print every change of the jobs that were running when the worker was killed."""
    said: dict[str, str] = {}
    with Client(url) as client:
        while len(said) < len(ids) or not all("successful" in words for words in said.values()):
            for id_ in ids:
                job = client.job(id_)
                state = next((task.status for task in job.tasks if task.id == id_), "none")
                words = f"{job.status}, task {state}"
                if said.get(id_) != words:
                    said[id_] = words
                    print(f"  {time.monotonic() - killed:6.1f} s after: {id_[:15]} {words}", flush=True)
            time.sleep(0.1)


if __name__ == "__main__":
    main()
