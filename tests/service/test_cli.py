"""The command line as a shell sees it: exit codes, output for people and machines, errors in words."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.cli import COMMANDS
from service.client import Client
from service.off import off
from service.stack import Stack
from tests.service.processes import of_folder
from worker.settings import Settings

DONE, FAILED, USAGE = 0, 1, 2


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with Stack(Settings(data=tmp_path_factory.mktemp("stack"), threads=1), workers=1) as running_stack:
        yield running_stack


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mesh file of an uneven ball with 162 vertices."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2)
    path = tmp_path_factory.mktemp("meshes") / "sphere.off"
    path.write_bytes(off(np.asarray(ball.vertices) * (1.0, 1.13, 1.29), np.asarray(ball.faces)))
    return path


def softmaps(
    *arguments: object, folder: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run the command in an empty environment of its own."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SOFTMAPS_")}
    return subprocess.run(
        [sys.executable, "-m", "service", *map(str, arguments)],
        cwd=folder,
        env=kept | environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def spoken(done: subprocess.CompletedProcess[str]) -> str:
    """Words of a failure, unwrapped; there is never a traceback."""
    assert "Traceback" not in done.stderr, done.stderr
    # Usage errors come in a box.
    return " ".join(done.stderr.replace("│", " ").split())


def test_help_names_every_command() -> None:
    done = softmaps("--help")
    assert done.returncode == DONE
    for command in COMMANDS:
        assert f" {command} " in done.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fly"], "No such command"),
        (["energy", "SPHERE"], "Missing argument"),
        (["energy", "SPHERE", "nowhere.off"], "there is no file nowhere.off"),
        (["energy", "SPHERE", "SPHERE", "--map", "sks"], "sks is neither wks, hks, uniform nor a file"),
        (["energy", "SPHERE", "SPHERE", "--size", "many"], "valid integer"),
        (["energy", "SPHERE", "SPHERE", "--up", "w"], "is x, y or z"),
        (["path", "SPHERE", "SPHERE", "--start", "0", "--source-path", "0-4"], "no list of vertices"),
        (["optimise", "SPHERE", "SPHERE", "--landmark", "0,1:2"], "no pair of vertices"),
        (["optimise", "SPHERE", "SPHERE", "--region", "0,1"], "no list of vertices"),
        (["jobs", "--dismiss"], "name the job to dismiss"),
        (["worker"], "SOFTMAPS_REDIS_URL must name a Redis"),
        (["api"], "SOFTMAPS_REDIS_URL must name a Redis"),
    ],
)
def test_usage_errors(arguments: list[str], words: str, sphere: Path) -> None:
    done = softmaps(*(str(sphere) if word == "SPHERE" else word for word in arguments))
    assert done.returncode == USAGE
    assert words in spoken(done)


def test_a_wrong_setting_is_named(sphere: Path) -> None:
    done = softmaps("basis", sphere, SOFTMAPS_THREADS="none")
    assert done.returncode == USAGE
    assert "SOFTMAPS_THREADS" in spoken(done)


def test_energy_for_machines(stack: Stack, sphere: Path, tmp_path: Path) -> None:
    out = tmp_path / "results"
    options = ("--size", 10, "--map", "wks", "--gradient", "--out", out, "--json", "--url", stack.url)
    done = softmaps("energy", sphere, sphere, *options)
    assert done.returncode == DONE, done.stderr
    assert done.stderr == ""
    answer = json.loads(done.stdout)
    assert answer["dirichlet"] > 0
    assert answer["bijectivity"] > 0.9
    kinds = [one["id"].partition("-")[0] for one in answer["made"]]
    assert kinds == ["basis", "spectrum", "descriptor", "softmap", "energy"]
    with np.load(out / "energy.npz") as arrays:
        assert arrays["dirichlet_density"].shape == (320,)
        assert arrays["dirichlet_gradient"].shape == (10, 10)
    assert (out / "densities.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(Path(path).name for path in answer["files"]) == ["densities.png", "energy.npz"]


def test_energy_for_people(stack: Stack, sphere: Path) -> None:
    options = ("--size", 10, "--map", "uniform", "--method", "maxent", "--sharpness", 2)
    done = softmaps("energy", sphere, sphere, *options, SOFTMAPS_URL=stack.url)
    assert done.returncode == DONE, done.stderr
    assert "Dirichlet energy" in done.stdout
    assert "bijectivity energy E_b 1" in " ".join(done.stdout.split())
    assert "all jobs" in done.stdout
    refused = softmaps("basis", sphere, "--method", "poisson", "--sharpness", 2, "--url", stack.url)
    assert refused.returncode == FAILED
    assert "/sharpness: This field belongs to the method 'maxent'" in spoken(refused)


def test_the_running_stack_is_found(stack: Stack, sphere: Path) -> None:
    with Client(stack.url) as client:
        before = len(list(client.jobs()))
        done = softmaps("basis", sphere, "--size", 11, "--json", SOFTMAPS_DATA=str(stack.settings.data))
        assert done.returncode == DONE, done.stderr
        assert len(list(client.jobs())) == before + 1
    answer = json.loads(done.stdout)
    assert answer["values"] == {"n_functions": 11}
    assert answer["arrays"]["samples"] == [11]


def test_maps_from_files(stack: Stack, sphere: Path, tmp_path: Path) -> None:
    def mapped(path: Path, *options: object) -> subprocess.CompletedProcess[str]:
        return softmaps("map", sphere, sphere, "--map", path, *options, "--json", "--url", stack.url)

    points, matrix = tmp_path / "points.txt", tmp_path / "matrix.npy"
    points.write_text("\n".join(map(str, range(162))))
    done = mapped(points, "--size", 9, "--out", tmp_path)
    assert done.returncode == DONE, done.stderr
    with np.load(tmp_path / "softmap.npz") as arrays:
        coefficients = arrays["coefficients"]
    assert coefficients.shape == (9, 9)
    # A matrix says itself how many functions the bases have.
    np.save(matrix, coefficients[:7] @ np.ones((9, 8)) / 8)
    done = mapped(matrix)
    assert done.returncode == DONE, done.stderr
    assert json.loads(done.stdout)["arrays"] == {"coefficients": [7, 8]}
    refused = mapped(matrix, "--size", 9)
    assert refused.returncode == FAILED
    assert "/map" in spoken(refused)


def test_maps_that_are_refused(stack: Stack, sphere: Path, tmp_path: Path) -> None:
    counted_from_one = tmp_path / "one.txt"
    counted_from_one.write_text("\n".join(map(str, range(1, 163))))
    done = softmaps("map", sphere, sphere, "--map", counted_from_one, "--url", stack.url)
    assert done.returncode == FAILED
    assert "seems to count from 1" in spoken(done)
    # What is no map at all is not worth a service.
    nonsense = tmp_path / "map.vts"
    nonsense.write_text("1\n2\n")
    done = softmaps("map", sphere, sphere, "--map", nonsense, SOFTMAPS_DATA=str(tmp_path / "data"))
    assert done.returncode == FAILED
    assert "maps are read from .txt and .npy" in spoken(done)
    assert not (tmp_path / "data").exists()


def test_momentum_and_paths(stack: Stack, sphere: Path, tmp_path: Path) -> None:
    def asked(*arguments: object) -> dict[str, object]:
        common = ("--map", "hks", "--size", 10, "--out", tmp_path, "--json", "--url", stack.url)
        done = softmaps(*arguments, *common)
        assert done.returncode == DONE, done.stderr
        answer: dict[str, object] = json.loads(done.stdout)
        return answer

    asked("momentum", sphere, sphere, "--face", 3, "--direction", -1, 0, 0.5)
    with np.load(tmp_path / "momentum.npz") as arrays:
        assert arrays["velocity"].shape == arrays["momentum"].shape == (320, 3)
    found = asked("path", sphere, sphere, "--source-path", "0,40,100", "--start", 7)
    with np.load(tmp_path / "path.npz") as arrays:
        assert found["arrays"]["points"] == list(arrays["points"].shape)
    assert found["values"]["stopped"] == "end"
    asked("pointmap", sphere, sphere, "--by", "barycentre")
    with np.load(tmp_path / "pointmap.npz") as arrays:
        assert arrays["targets"].shape == arrays["confidence"].shape == (162,)


def test_optimise(stack: Stack, sphere: Path, tmp_path: Path) -> None:
    landmarks = ("--landmark", "0:0", "--landmark", "40:40", "--region", "60,61:60,61")
    options = ("--size", 12, "--method", "maxent", "--tolerance", 0.01, "--out", tmp_path)
    done = softmaps("optimise", sphere, sphere, *landmarks, *options, "--json", "--url", stack.url)
    assert done.returncode == DONE, done.stderr
    values = json.loads(done.stdout)["values"]
    assert values["converged"]
    assert values["gap"] <= 0.01 * values["energy"]
    with np.load(tmp_path / "softmap.npz") as arrays:
        assert arrays["coefficients"].shape == (12, 12)
        assert len(arrays["history_energy"]) == values["iterations"] + 1


def test_failures_are_said_in_words_and_in_json(stack: Stack, sphere: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken.off"
    broken.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n")
    done = softmaps("basis", broken, "--json", "--url", stack.url)
    assert done.returncode == FAILED
    assert "the service refused (422)" in spoken(done)
    assert "422" in json.loads(done.stdout)["error"]
    done = softmaps("basis", sphere, "--url", "http://127.0.0.1:9")
    assert done.returncode == FAILED
    assert "no answer from http://127.0.0.1:9" in spoken(done)
    assert softmaps("basis", sphere, "--url", "somewhere").returncode == FAILED


def test_jobs(stack: Stack, sphere: Path) -> None:
    made = json.loads(softmaps("basis", sphere, "--size", 13, "--json", "--url", stack.url).stdout)
    listed = json.loads(softmaps("jobs", "--json", "--url", stack.url).stdout)["jobs"]
    assert made["id"] in [job["id"] for job in listed]
    one = softmaps("jobs", made["id"], "--url", stack.url)
    assert made["id"] in one.stdout
    assert "successful" in one.stdout
    again = softmaps("jobs", made["id"], "--dismiss", "--url", stack.url)
    assert again.returncode == FAILED
    assert "409" in spoken(again)


def test_without_a_service_one_is_started_for_the_command(sphere: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    done = softmaps(
        "potential", sphere, sphere, "--map", "hks", "--size", 12, "--json", SOFTMAPS_DATA=str(data)
    )
    assert done.returncode == DONE, done.stderr
    answer = json.loads(done.stdout)
    assert answer["arrays"]["potential"] == [320, 2, 12]
    assert answer["values"]["max_residual"] < 1e-10
    assert of_folder(data) == {}
    assert not (data / "endpoint").exists()


@pytest.mark.slow
def test_the_demo_from_any_folder(tmp_path: Path) -> None:
    done = softmaps("demo", "--size", 30, "--json", folder=tmp_path)
    assert done.returncode == DONE, done.stderr
    answer = json.loads(done.stdout)
    assert answer["energies"]["true"]["dirichlet"] < answer["energies"]["wks"]["dirichlet"]
    assert {Path(path).name for path in answer["files"]} == {"wks.png", "true.png", "densities.npz"}
    for path in answer["files"]:
        assert (tmp_path / path).stat().st_size > 10_000
    with np.load(tmp_path / "softmaps-demo" / "densities.npz") as arrays:
        assert arrays["wks_dirichlet_density"].shape == arrays["true_dirichlet_density"].shape
