"""Two meshes of 100,000 faces each: time and peak memory of every stage, alone and through the service.

    python -m benchmarks.big [SOURCE TARGET] [--size 500] [--threads 2] [--service]

Every stage runs in a process of its own, so that its peak memory is its own; the bare libraries' 240 MB are
part of it. With --service the same energy is asked of a real stack instead: two workers of one thread each,
over which its shards spread. Without meshes it is the skull with itself, or a creature of 142,000 faces.
"""

from __future__ import annotations

import argparse
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from service.bench import Shape, mesh_of
from service.client import Client
from service.creature import creature
from service.stack import Stack
from tests.conftest import DATA
from worker.settings import Settings

SKULL = DATA / "robust/big/skull_100k.ply"
#: Catmull-Clark steps of the creature that stands in: 71,170 vertices.
SUBDIVISIONS = 4
#: Energies of the wave kernel signature.
COUNT = 100


def shapes(arguments: argparse.Namespace) -> tuple[Shape, Shape]:
    if arguments.meshes:
        source, target = map(mesh_of, arguments.meshes)
        return source, target
    if SKULL.exists():
        return mesh_of(SKULL), mesh_of(SKULL)
    return creature("standing", SUBDIVISIONS), creature("trotting", SUBDIVISIONS)


def stages(size: int, threads: int) -> dict[str, Callable[..., Any]]:
    """Every stage: its name, and what it makes of the results of those named by its parameters."""
    from solver import Mesh, SoftMap, bijectivity, dirichlet, poisson_basis, spectrum, wks_of  # noqa: PLC0415

    def energy(softmap: Any) -> tuple[float, float, float]:
        found = dirichlet(softmap, threads=threads)
        return found.energy, bijectivity(softmap).energy, found.residual

    def softmap(basis_source: Any, basis_target: Any, wks_source: Any, wks_target: Any) -> Any:
        return SoftMap.from_descriptors(basis_source, basis_target, wks_source, wks_target, threads=threads)

    return {
        "mesh_source": lambda shape_source: Mesh(*shape_source),
        "mesh_target": lambda shape_target: Mesh(*shape_target),
        "basis_source": lambda mesh_source: poisson_basis(mesh_source, size),
        "basis_target": lambda mesh_target: poisson_basis(mesh_target, size),
        "spectrum_source": lambda mesh_source: spectrum(mesh_source, threads=threads),
        "spectrum_target": lambda mesh_target: spectrum(mesh_target, threads=threads),
        "wks_source": lambda spectrum_source, spectrum_target: wks_of(
            spectrum_source, spectrum_target, COUNT
        ),
        "wks_target": lambda spectrum_source, spectrum_target: wks_of(
            spectrum_target, spectrum_source, COUNT
        ),
        "softmap": softmap,
        "energy": energy,
    }


def run_stage(name: str, folder: Path, size: int, threads: int) -> None:
    """One stage, from files to a file; prints its seconds, without those of reading and writing."""
    from worker.tasks import blas_pools  # noqa: PLC0415

    make = stages(size, threads)[name]
    parents = make.__code__.co_varnames[: make.__code__.co_argcount]
    given = [pickle.loads((folder / parent).read_bytes()) for parent in parents]
    begun = time.perf_counter()
    with blas_pools().limit(limits=1):
        made = make(*given)
    print(time.perf_counter() - begun)
    (folder / name).write_bytes(pickle.dumps(made))


def through_the_solver(source: Shape, target: Shape, size: int, threads: int) -> None:
    total = 0.0
    print(f"{'stage':18}{'s':>9}{'peak MB':>10}")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, shape in (("shape_source", source), ("shape_target", target)):
            (folder / name).write_bytes(pickle.dumps(shape))
        for name in stages(size, threads):
            command = [sys.executable, "-m", "benchmarks.big", "--stage", name, "--folder", place]
            process = subprocess.Popen(
                [*command, "--size", str(size), "--threads", str(threads)], stdout=subprocess.PIPE, text=True
            )
            assert process.stdout is not None
            said = process.stdout.read()
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = status
            assert status == 0, name
            total += float(said)
            print(f"{name:18}{float(said):9.2f}{usage.ru_maxrss / 1000:10.0f}", flush=True)
        dirichlet, bijectivity, residual = pickle.loads((folder / "energy").read_bytes())
    print(f"{'together':18}{total:9.2f}")
    print(f"E_D = {dirichlet:.9g}, E_b = {bijectivity:.9g}, residual {residual:.1e}", flush=True)


def through_the_service(source: Shape, target: Shape, size: int) -> None:
    basis = {"kind": "basis", "method": "poisson", "size": size}
    with tempfile.TemporaryDirectory(prefix="softmaps-big-") as data:
        stack = Stack(Settings(data=Path(data), threads=1), workers=2, public=False)
        with stack, Client(stack.url) as client, horses(os.getpid()) as peaks:
            ids = [client.upload_mesh(shape).id for shape in (source, target)]
            wks = {"type": "descriptors", "descriptor": "wks"}
            ends = {end: basis | {"mesh": id_} for end, id_ in zip(("source", "target"), ids, strict=True)}
            begun = time.perf_counter()
            job = client.submit({"kind": "energy", "softmap": {"kind": "softmap", "map": wks, **ends}})
            status = client.wait(job.id, timeout=1800).status
            wall = time.perf_counter() - begun
            print(f"\nthrough the service, two workers of one thread: {status} after {wall:.1f} s")
            print(f"{'artifact':18}{'s':>9}")
            for artifact in client.lineage(job.id):
                if artifact.spec is not None:
                    print(f"{artifact.kind:18}{artifact.seconds:9.2f}")
            values = client.artifact(job.id).values
        print(f"most memory of a task {max(peaks.values()) / 1000:.0f} MB, of {len(peaks)} tasks")
        print(f"E_D = {values['dirichlet']:.9g}, E_b = {values['bijectivity']:.9g}")


@contextmanager
def horses(stack: int) -> Iterator[dict[int, int]]:
    """Peak memory in kB of every process that a worker of this stack forks, by pid."""
    peaks: dict[int, int] = {}
    done = threading.Event()

    def children(pid: int) -> list[int]:
        try:
            return [
                int(child)
                for task in Path(f"/proc/{pid}/task").iterdir()
                for child in (task / "children").read_text().split()
            ]
        except OSError:
            return []

    def look() -> None:
        while not done.wait(0.02):
            for worker in children(stack):
                for horse in children(worker):
                    try:
                        status = Path(f"/proc/{horse}/status").read_text()
                        words = Path(f"/proc/{worker}/cmdline").read_text()
                    except OSError:
                        continue
                    if "worker" in words and "VmHWM:" in status:
                        peaks[horse] = int(status.partition("VmHWM:")[2].split()[0])

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield peaks
    finally:
        done.set()
        watcher.join()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--size", type=int, default=500)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--service", action="store_true", help="through the service alone")
    parser.add_argument("--stage", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.stage:
        run_stage(arguments.stage, arguments.folder, arguments.size, arguments.threads)
        return
    source, target = shapes(arguments)
    print(f"{len(source[1]):,} faces → {len(target[0]):,} vertices, {arguments.size} functions")
    if arguments.service:
        through_the_service(source, target, arguments.size)
    else:
        through_the_solver(source, target, arguments.size, arguments.threads)


if __name__ == "__main__":
    main()
