"""The house keeps its shape: imports run one way, the door is light, every setting is written down."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from worker.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("solver", "worker", "service")
MODULES = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
SCRIPTS = sorted((ROOT / "service" / "viewer" / "src").glob("*.js"))
#: What a room may import of the others.
BELOW = {"solver": {"solver"}, "worker": {"solver", "worker"}, "service": set(ROOMS)}
#: Longer than this, and a file is two rooms.
LONGEST_MODULE = 400


def imported_packages(path: Path) -> set[str]:
    tree = ast.parse(path.read_text())
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    return {name.split(".")[0] for name in names}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_from_service_through_worker_to_solver(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    assert imported_packages(path) & set(ROOMS) <= BELOW[room]


@pytest.mark.parametrize("path", sorted((ROOT / "solver").rglob("*.py")), ids=lambda path: path.name)
def test_the_solver_has_never_heard_of_files_json_or_redis(path: Path) -> None:
    assert not imported_packages(path) & {"json", "pathlib", "redis", "rq", "pydantic", "fastapi", "trimesh"}


@pytest.mark.parametrize("path", [*MODULES, *SCRIPTS], ids=lambda path: str(path.relative_to(ROOT)))
def test_no_module_is_two_rooms(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= LONGEST_MODULE


def test_only_attempts_and_the_processes_that_run_them_speak_rq() -> None:
    speakers = {str(path.relative_to(ROOT)) for path in MODULES if "rq" in imported_packages(path)}
    assert speakers <= {"worker/attempts.py", "worker/horse.py", "worker/tasks.py"}


def test_importing_the_service_loads_nothing_heavy() -> None:
    script = (
        "import sys, service.app\n"
        "heavy = {'scipy', 'numba', 'trimesh', 'solver', 'potpourri3d', 'matplotlib'}\n"
        "print(sorted(heavy & {name.split('.')[0] for name in sys.modules}))"
    )
    answer = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize("field", sorted(Settings.model_fields))
def test_every_setting_stands_in_the_readme(field: str) -> None:
    assert f"`SOFTMAPS_{field.upper()}`" in (ROOT / "README.md").read_text()
