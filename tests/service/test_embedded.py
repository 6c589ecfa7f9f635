"""Redis and whole stacks on one machine: they come up, replace what dies, and leave nothing behind."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import redis

import service.leash
from service.client import Client
from service.creature import creature
from service.embedded import EmbeddedRedis
from service.stack import Stack, StackError, running
from tests.service.processes import like, of_folder, socket_folders, until
from worker.settings import Settings

HOPEFULLY_NOBODY = "unix:///tmp/softmaps-nobody-listens-here.sock"


# Redis


def test_redis_ends_and_its_socket_folder_with_it(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server:
        folder = Path(server.url.removeprefix("unix://")).parent
        assert folder.is_dir()
        assert folder.stat().st_mode & 0o077 == 0
        assert of_folder(tmp_path)
    assert not folder.exists()
    assert of_folder(tmp_path) == {}
    server.stop()


def test_redis_refuses_a_folder_in_use(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path), pytest.raises(RuntimeError, match="another softmaps stack is using"):
        EmbeddedRedis(tmp_path)


def test_a_killed_redis_comes_back_with_every_acknowledged_write(tmp_path: Path) -> None:
    with EmbeddedRedis(tmp_path) as server:
        with redis.Redis.from_url(server.url) as client:
            for k in range(200):
                client.set(f"key-{k}", k)
        for pid in of_folder(tmp_path):
            os.kill(pid, signal.SIGKILL)
        server.process.wait()
        assert not server.alive
        server.revive()
        with redis.Redis.from_url(server.url) as client:
            assert [int(value) for value in client.mget([f"key-{k}" for k in range(200)])] == list(range(200))


# Leash


def leashed(*command: str, folder: str = "-", parent: int | None = None) -> list[str]:
    script = str(service.leash.__file__)
    return [sys.executable, "-I", "-S", script, str(parent or os.getpid()), folder, *command]


def test_the_leash_becomes_the_command() -> None:
    done = subprocess.run(
        leashed("/bin/sh", "-c", "echo $$; exit 3"), capture_output=True, text=True, check=False
    )
    assert done.returncode == 3
    assert done.stdout.strip().isdecimal()


def test_the_leash_ends_a_command_whose_supervisor_is_gone_already() -> None:
    done = subprocess.run(leashed("/bin/sleep", "60", parent=1), timeout=20, check=False)
    assert done.returncode == -signal.SIGKILL


def test_the_leash_removes_its_folder_only_when_told_to_end(tmp_path: Path) -> None:
    folder = tmp_path / "sockets"
    folder.mkdir()
    died = subprocess.run(leashed("/bin/sh", "-c", "exit 3", folder=str(folder)), timeout=20, check=False)
    assert died.returncode == 3
    assert folder.is_dir()
    process = subprocess.Popen(leashed("/bin/sleep", "60", folder=str(folder)))
    until(lambda: like(of_folder(folder), "leash.py"))
    # The command runs once the leash has a child.
    until(lambda: Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text())
    process.terminate()
    assert process.wait(20) == signal.SIGTERM
    assert not folder.exists()


def test_a_killed_supervisor_takes_command_and_folder_along(tmp_path: Path) -> None:
    folder, mark = tmp_path / "sockets", "61.0625"
    folder.mkdir()
    script = (
        "import os, subprocess, sys, time\n"
        f"subprocess.Popen({leashed('/bin/sleep', mark, folder=str(folder), parent=7)!r}[:4]"
        f" + [str(os.getpid()), {str(folder)!r}, '/bin/sleep', {mark!r}], start_new_session=True)\n"
        "print('started', flush=True)\n"
        "time.sleep(60)\n"
    )
    supervisor = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    assert supervisor.stdout is not None
    supervisor.stdout.readline()

    def sleeping() -> list[int]:
        return like(of_folder(folder), "leash.py")

    until(sleeping)
    supervisor.kill()
    supervisor.wait()
    supervisor.stdout.close()
    until(lambda: not sleeping())
    until(lambda: not folder.exists())


# Stacks


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    folder = tmp_path_factory.mktemp("stack")
    with Stack(Settings(data=folder, threads=1), workers=1) as running_stack:
        yield running_stack
    assert of_folder(folder) == {}
    assert not (folder / "endpoint").exists()
    assert running(folder) is None


def folder_of(stack: Stack) -> Path:
    return stack.settings.data


def workers_of(stack: Stack) -> list[int]:
    return like(of_folder(folder_of(stack)), "-m worker")


def test_a_stack_is_found_by_its_endpoint(stack: Stack) -> None:
    assert running(folder_of(stack)) == stack.url
    assert httpx.get(f"{stack.url}/readyz", trust_env=False).status_code == 200
    assert len(workers_of(stack)) >= 2


def test_a_second_stack_on_the_folder_is_refused(stack: Stack) -> None:
    with pytest.raises(StackError, match=f"another softmaps stack at {stack.url} is using"):
        Stack(Settings(data=folder_of(stack)))


def test_a_port_in_use_is_refused_at_once(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(
            StackError, match=f"cannot listen on 127.0.0.1:{port}: .*choose another with --port"
        ):
            Stack(Settings(data=tmp_path), port=port)
    # The folder is free again.
    Stack(Settings(data=tmp_path)).stop()


def test_a_redis_that_is_not_there_is_named(tmp_path: Path) -> None:
    stack = Stack(Settings(data=tmp_path, redis_url=HOPEFULLY_NOBODY))
    with pytest.raises(StackError, match="SOFTMAPS_REDIS_URL"):
        stack.start()
    assert of_folder(tmp_path) == {}


def test_a_killed_worker_is_replaced(stack: Stack) -> None:
    before = set(workers_of(stack))
    for pid in before:
        os.kill(pid, signal.SIGKILL)
    until(lambda: len(set(workers_of(stack)) - before) >= 2)
    with Client(stack.url) as client:
        vertices, faces = creature()
        mesh = client.upload_mesh((vertices, faces))
        job = client.submit({"kind": "basis", "mesh": mesh.id, "size": 5})
        assert client.wait(job.id, timeout=60).status == "successful"


def test_a_killed_api_is_replaced_on_the_same_port(stack: Stack) -> None:
    (api,) = like(of_folder(folder_of(stack)), "-m service.server")
    os.kill(api, signal.SIGKILL)
    # The listening socket never closes: a request waits for the new process.
    with Client(stack.url, patience=60.0) as client:
        assert isinstance(list(client.jobs()), list)
    assert like(of_folder(folder_of(stack)), "-m service.server") != [api]


def test_a_killed_redis_is_replaced_and_jobs_go_on(stack: Stack) -> None:
    with Client(stack.url, patience=60.0) as client:
        vertices, faces = creature()
        mesh = client.upload_mesh((vertices, faces))
        for pid in like(of_folder(folder_of(stack)), "valkey"):
            os.kill(pid, signal.SIGKILL)
        job = client.submit({"kind": "basis", "mesh": mesh.id, "size": 6})
        assert client.wait(job.id, timeout=60).status == "successful"


# The command


@pytest.fixture
def up(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], dict[int, str], Path]]:
    """`softmaps up`, ready, all its processes, and its data folder."""
    folder = tmp_path / "data"
    command = [sys.executable, "-m", "service", "up", "--port", "0", "--data", str(folder), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as process:
        try:
            assert process.stdout is not None
            document = b""
            while not document.rstrip().endswith(b"}"):
                line = process.stdout.readline()
                assert line, "it ended before it was ready"
                document += line
            assert json.loads(document)["url"].startswith("http://127.0.0.1:"), document
            until(lambda: len(like(of_folder(folder), "-m worker")) >= 2)
            yield process, of_folder(folder), folder
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            until(lambda: of_folder(folder) == {})


def assert_nothing_is_left(processes: dict[int, str], folder: Path) -> None:
    assert like(processes, "valkey")
    (sockets,) = socket_folders(processes)
    until(lambda: of_folder(folder) == {})
    until(lambda: not sockets.exists())
    assert running(folder) is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_everything(
    up: tuple[subprocess.Popen[bytes], dict[int, str], Path], number: signal.Signals
) -> None:
    process, processes, folder = up
    process.send_signal(number)
    # Who is in a hurry presses it again; that must not leave anything either.
    process.send_signal(signal.SIGINT)
    assert process.wait(40) == 0
    assert of_folder(folder) == {}
    assert not (folder / "endpoint").exists()
    assert_nothing_is_left(processes, folder)


def test_kill_9_of_the_supervisor_ends_everything(
    up: tuple[subprocess.Popen[bytes], dict[int, str], Path],
) -> None:
    process, processes, folder = up
    process.kill()
    process.wait()
    assert_nothing_is_left(processes, folder)
