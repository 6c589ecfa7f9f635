"""Upload every file of a folder of difficult meshes over HTTP and print what the service said.

    python benchmarks/robust.py [FOLDER] [--url URL]

Without --url a service of its own is started, and the peak memory of its processes is printed as well.
"""

from __future__ import annotations

import argparse
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx

from service.embedded import EmbeddedRedis
from service.parsing import FORMATS

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT.parent / "shared" / "data" / "robust"
SERVE = """
import sys, uvicorn
from service.app import create_app
from worker.settings import Settings
uvicorn.run(create_app(Settings()), port=int(sys.argv[1]), log_level="warning", timeout_graceful_shutdown=1)
"""


@contextmanager
def own_service() -> Iterator[tuple[str, int]]:
    """Address and process id of a service that lives as long as the benchmark."""
    with tempfile.TemporaryDirectory() as folder, EmbeddedRedis(Path(folder) / "redis") as server:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        environment = os.environ | {"SOFTMAPS_DATA": folder, "SOFTMAPS_REDIS_URL": server.url}
        process = subprocess.Popen([sys.executable, "-c", SERVE, str(port)], cwd=ROOT, env=environment)
        try:
            url = f"http://127.0.0.1:{port}"
            while not answers(url):
                assert process.poll() is None, "the service does not start"
                time.sleep(0.05)
            yield url, process.pid
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


def answers(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz", timeout=1).status_code == 200
    except httpx.TransportError:
        return False


def peak_megabytes(pid: int) -> float:
    """Most memory that a process has had in RAM."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1000


def below(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def said(answer: httpx.Response) -> str:
    body = answer.json()
    if answer.status_code >= 400:
        return str(body["detail"])
    counts = f"{body['n_vertices']} v, {body['n_faces']} f, {body['n_components']} comp."
    return "; ".join([counts, *body["warnings"]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    parser.add_argument("--url")
    arguments = parser.parse_args()
    files = [path for path in sorted(arguments.folder.rglob("*")) if path.suffix[1:].lower() in FORMATS]
    if arguments.url:
        upload_all(arguments.url, arguments.folder, files)
        return
    with own_service() as (url, pid):
        upload_all(url, arguments.folder, files)
        print(f"peak memory: API {peak_megabytes(pid):.0f} MB", end="")
        print("".join(f", nursery {peak_megabytes(child):.0f} MB" for child in below(pid)))


def upload_all(url: str, folder: Path, files: list[Path]) -> None:
    statuses: Counter[int] = Counter()
    slowest = (0.0, "")
    print("| file | status | what was said | s |\n| --- | --- | --- | --- |")
    with httpx.Client(base_url=url, timeout=120) as http:
        for path in files:
            query = {"format": path.suffix[1:].lower(), "name": path.name}
            began = time.monotonic()
            answer = http.post("/v1/meshes", params=query, content=path.read_bytes())
            seconds = time.monotonic() - began
            statuses[answer.status_code] += 1
            slowest = max(slowest, (seconds, path.name))
            row = [
                str(path.relative_to(folder)),
                str(answer.status_code),
                said(answer)[:150],
                f"{seconds:.2f}",
            ]
            print(f"| {' | '.join(row)} |")
    summary = ", ".join(f"{count} × {status}" for status, count in sorted(statuses.items()))
    print(f"\n{sum(statuses.values())} files: {summary}; the slowest, {slowest[1]}, took {slowest[0]:.2f} s")


if __name__ == "__main__":
    main()
