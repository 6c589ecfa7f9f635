"""One API process: ``python -m service.server [--host HOST] [--port PORT | --fd NUMBER]``."""

from __future__ import annotations

import argparse
import logging
import socket
import sys

#: Seconds that open event streams may hold up the end.
GRACE_SECONDS = 3


def main() -> None:
    """Serve until SIGTERM."""
    import uvicorn  # noqa: PLC0415

    from service.app import create_app  # noqa: PLC0415
    from worker.settings import Settings  # noqa: PLC0415

    parser = argparse.ArgumentParser(prog="python -m service.server", description="Serve the softmaps API.")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on")
    parser.add_argument("--port", type=int, default=8000, help="port to listen on")
    parser.add_argument("--fd", type=int, help="a listening socket that was inherited, instead")
    arguments = parser.parse_args()
    logging.basicConfig(
        level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr
    )
    config = uvicorn.Config(
        create_app(Settings()),
        host=arguments.host,
        port=arguments.port,
        access_log=False,
        timeout_graceful_shutdown=GRACE_SECONDS,
        server_header=False,
        log_config=None,
    )
    inherited = None if arguments.fd is None else [socket.socket(fileno=arguments.fd)]
    uvicorn.Server(config).run(sockets=inherited)


if __name__ == "__main__":
    main()
