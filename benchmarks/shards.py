"""One sharded energy through the queue: one worker of one thread, then two.

    python -m benchmarks.shards

A creature of 35,584 faces, 300 functions: nine shards. Bases and soft map stand before the clock starts;
it ends when the client has the answer. Every repetition is another question, since answers are kept.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from service.client import Client
from service.creature import creature
from service.stack import Stack
from worker.settings import Settings

SUBDIVISIONS, SIZE, REPEATS = 3, 300, 3


def seconds(workers: int) -> list[float]:
    """Wall seconds of a few energies, one after another."""
    with tempfile.TemporaryDirectory(prefix="softmaps-shards-") as data:
        settings = Settings(data=Path(data), threads=1, shard_seconds=1.0)
        with Stack(settings, workers=workers, public=False) as stack, Client(stack.url) as client:
            poses = ("standing", "trotting")
            source, target = (client.upload_mesh(creature(pose, SUBDIVISIONS)).id for pose in poses)
            basis = {"kind": "basis", "method": "poisson", "size": SIZE}
            asked = {
                "kind": "softmap",
                "source": basis | {"mesh": source},
                "target": basis | {"mesh": target},
                "map": {"type": "uniform"},
            }
            softmap = client.wait(client.submit(asked).id, timeout=300).id
            taken = []
            for k in range(REPEATS):
                begun = time.perf_counter()
                spec = {"kind": "energy", "softmap": softmap, "regularisation": 1e-5 * (k + 1)}
                job = client.wait(client.submit(spec).id, timeout=300)
                taken.append(time.perf_counter() - begun)
                assert job.status == "successful"
            return taken


def main() -> None:
    one, two = seconds(1), seconds(2)
    for workers, taken in ((1, one), (2, two)):
        print(f"{workers} worker(s) of one thread: " + ", ".join(f"{each:.2f} s" for each in taken))
    print(f"two workers are {min(one) / min(two):.2f} times as fast as one")


if __name__ == "__main__":
    main()
