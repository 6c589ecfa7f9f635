"""Run one worker: ``python -m worker [--interactive]``; settings come from the environment."""

from __future__ import annotations

import argparse
import logging
import os
import sys


def main() -> None:
    """Run a worker until SIGTERM."""
    # Before numpy is imported: a BLAS that never starts threads is one that may be forked.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = "1"
    from worker.horse import work  # noqa: PLC0415
    from worker.tasks import workplace  # noqa: PLC0415

    parser = argparse.ArgumentParser(prog="python -m worker", description="Run one softmaps worker.")
    parser.add_argument(
        "--interactive", action="store_true", help="take only tasks estimated below two seconds"
    )
    arguments = parser.parse_args()
    logging.basicConfig(
        level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr
    )
    logging.getLogger("rq").setLevel(logging.WARNING)
    place = workplace()
    place.prepare()
    work(place, interactive=arguments.interactive)


if __name__ == "__main__":
    main()
