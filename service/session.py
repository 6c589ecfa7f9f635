"""The API as Python: uploads, jobs and results, one method a request; `Client` adds whole questions."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Iterator, Mapping
from os import PathLike
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from service.answers import Artifact, Job, Upload
from service.off import off
from service.refusals import JobDismissed, JobFailed, Silence, Unreachable, WaitedTooLong
from service.transport import Transport

#: A mesh: its file, the file's bytes, vertices and faces, or the id of one that was uploaded.
MeshLike = str | PathLike[str] | bytes | tuple[ArrayLike, ArrayLike]
#: Longest the service is asked to hold back one answer while a job runs; it allows 60 seconds.
_WAIT_SECONDS = 25.0
#: Seconds without an event after which the client looks for itself.
_EVENT_SECONDS = 20.0


class Session:
    """A connection to a softmaps service.

    Parameters
    ----------
    url : str
        Where it is, such as ``http://127.0.0.1:8000``.
    token : str, optional
        Bearer token, if the service wants one.
    patience : float
        Seconds for which requests are repeated while the service is full or away.

    Raises
    ------
    Unusable
        If the address is none.
    """

    def __init__(self, url: str, token: str | None = None, patience: float = 30.0) -> None:
        self._transport = Transport(url, token, patience)
        self.url = self._transport.url

    def close(self) -> None:
        """Close the connections."""
        self._transport.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # Uploads

    def upload_mesh(self, mesh: MeshLike, format: str | None = None, name: str | None = None) -> Upload:
        """Upload a triangle mesh; the order of its vertices is kept.

        Parameters
        ----------
        mesh : path, bytes, or (vertices, faces)
            A file, what a file holds, or arrays (V, 3) float and (F, 3) int.
        format : {"off", "obj", "ply", "stl", "glb"}, optional
            Of the bytes; a path's ending tells it.
        name : str, optional
            A label to know it by; the file's name unless given.

        Returns
        -------
        Upload
            Its id and facts.

        Raises
        ------
        ClientError
            `Invalid` says what is wrong with the mesh.
        OSError
            If the file cannot be read.
        ValueError
            If arrays have other shapes.
        """
        if isinstance(mesh, bytes):
            content = mesh
        elif isinstance(mesh, tuple):
            content, format = off(*mesh), "off"
        else:
            path = Path(mesh)
            content, name = path.read_bytes(), name or path.name
            format = format or path.suffix.lower().removeprefix(".") or None
        query = {key: value for key, value in (("format", format), ("name", name)) if value is not None}
        headers = {"Content-Type": "application/octet-stream"}
        reply = self._transport.ask("POST", "/v1/meshes", params=query, headers=headers, content=content)
        return Upload(reply["id"], reply)

    def upload_array(self, array: ArrayLike, name: str | None = None) -> Upload:
        """Upload an array of integers or real numbers.

        Parameters
        ----------
        array : array_like
            Kept as int64 or float64.
        name : str, optional
            A label to know it by.

        Returns
        -------
        Upload
            Its id, shape and dtype.

        Raises
        ------
        ClientError
            `Invalid` says what is wrong with the array.
        """
        body = io.BytesIO()
        np.save(body, np.ascontiguousarray(array), allow_pickle=False)
        query = {} if name is None else {"name": name}
        headers = {"Content-Type": "application/x-npy"}
        reply = self._transport.ask(
            "POST", "/v1/arrays", params=query, headers=headers, content=body.getvalue()
        )
        return Upload(reply["id"], reply)

    # Jobs

    def submit(self, spec: Mapping[str, Any], wait: float = 0.0) -> Job:
        """Ask a question; the same question is the same job.

        Parameters
        ----------
        spec : mapping
            As the API takes it; parents are ids or specs.
        wait : float
            Seconds to wait for the answer, at most 60.

        Returns
        -------
        Job
            Finished or not; see `wait`.

        Raises
        ------
        ClientError
            `Invalid` says what is wrong with the spec, with pointers into it.
        """
        body = json.dumps(spec, allow_nan=False).encode()
        headers = {"Content-Type": "application/json"}
        if wait > 0:
            headers["Prefer"] = f"wait={wait:g}"
        return Job.of(self._transport.ask("POST", "/v1/jobs", headers=headers, content=body))

    def job(self, id: str) -> Job:
        """Job of an id, as it stands.

        Raises
        ------
        ClientError
            `NotFound` if there is none.
        """
        return Job.of(self._transport.ask("GET", f"/v1/jobs/{id}"))

    def wait(
        self, id: str, progress: Callable[[Job], None] | None = None, timeout: float | None = None
    ) -> Job:
        """Wait until a job is successful.

        Parameters
        ----------
        id : str
            Of the job.
        progress : callable, optional
            Called with the job now and after each change.
        timeout : float, optional
            Seconds to wait at most.

        Returns
        -------
        Job
            Successful.

        Raises
        ------
        JobFailed, JobDismissed
            If it ends otherwise; both carry the job.
        WaitedTooLong
            If the timeout passes; the job goes on.
        ClientError
            If the service is away for longer than the client's patience.
        """
        deadline = time.monotonic() + timeout if timeout is not None else float("inf")
        job = self.job(id)
        while not job.finished:
            if progress is not None:
                job = self._follow(job, progress, deadline)
            else:
                seconds = max(0.1, min(_WAIT_SECONDS, deadline - time.monotonic()))
                job = Job.of(self._transport.ask("GET", f"/v1/jobs/{id}", params={"wait": f"{seconds:g}"}))
            if not job.finished and time.monotonic() >= deadline:
                raise WaitedTooLong(job)
        if progress is not None:
            progress(job)
        if job.status == "dismissed":
            raise JobDismissed(job)
        if job.status == "failed":
            raise JobFailed(job)
        return job

    def dismiss(self, id: str) -> Job:
        """Dismiss a job, for everyone who asked it.

        Raises
        ------
        ClientError
            `Conflict` if it is finished already, `NotFound` if there is none.
        """
        return Job.of(self._transport.ask("DELETE", f"/v1/jobs/{id}"))

    def snapshot(self, id: str) -> NDArray[np.float64]:
        """Coefficients (n₀, n) of the best soft map so far, while a job optimises one.

        Raises
        ------
        ClientError
            `NotFound` before the first iteration, and once the artifact is there.
        """
        return self._array(f"/v1/jobs/{id}/snapshot")

    def jobs(self, status: str | None = None) -> Iterator[Job]:
        """All jobs that were asked for, the newest first, page by page.

        Parameters
        ----------
        status : str, optional
            Only those with this status.

        Raises
        ------
        ClientError
            If the service refuses or is away.
        """
        query = {} if status is None else {"status": status}
        while True:
            page = self._transport.ask("GET", "/v1/jobs", params=query)
            yield from (Job.of(item) for item in page["items"])
            if page["next"] is None:
                return
            query["cursor"] = page["next"]

    # Results

    def artifact(self, id: str) -> Artifact:
        """Values of a result or an upload, its parents and the shapes of its arrays.

        Raises
        ------
        ClientError
            `NotFound`, `Conflict` (its job runs) or `Gone`.
        """
        return Artifact.of(self._transport.ask("GET", f"/v1/artifacts/{id}"))

    def array(self, id: str, name: str, rows: tuple[int, int] | None = None) -> NDArray[Any]:
        """Numbers of one array.

        Parameters
        ----------
        id, name : str
            Of the artifact and of its array.
        rows : (int, int), optional
            Only rows from the first to before the second.

        Returns
        -------
        ndarray
            Own memory, writable.

        Raises
        ------
        ClientError
            `NotFound` if there is no such array.
        """
        query = {} if rows is None else {"rows": f"{rows[0]}:{rows[1]}"}
        return self._array(f"/v1/artifacts/{id}/arrays/{name}", query)

    def arrays(self, id: str) -> dict[str, NDArray[Any]]:
        """All arrays of an artifact by name.

        Raises
        ------
        ClientError
            As `artifact`.
        """
        return {name: self.array(id, name) for name in self.artifact(id).arrays}

    def ready(self) -> bool:
        """Whether the service, its Redis, its store and a worker are there. Asks once and never fails."""
        return self._transport.answers("/readyz")

    def _follow(self, job: Job, progress: Callable[[Job], None], deadline: float) -> Job:
        """Hand on a job's events until it is finished, the deadline passes or the stream ends."""
        silence = max(0.1, min(_EVENT_SECONDS, deadline - time.monotonic()))
        try:
            with self._transport.stream("GET", f"/v1/jobs/{job.id}/events", silence=silence) as response:
                for line in response.iter_lines():
                    if line.startswith("data:"):
                        job = Job.of(json.loads(line.removeprefix("data:")))
                        if job.finished:
                            return job
                        progress(job)
                    if time.monotonic() >= deadline:
                        return job
        except Silence:
            pass
        return self.job(job.id)

    def _array(self, address: str, query: Mapping[str, str] = MappingProxyType({})) -> NDArray[Any]:
        """Numbers at an address, into memory of their own."""
        accept = {"Accept": "application/octet-stream"}
        with self._transport.stream("GET", address, params=query, headers=accept) as response:
            shape = tuple(int(length) for length in response.headers["array-shape"].split(",") if length)
            array = np.empty(shape, np.dtype(response.headers["array-dtype"]).newbyteorder("<"))
            filled, view = 0, array.reshape(-1).view(np.uint8).data if array.size else memoryview(b"")
            for chunk in response.iter_bytes():
                if filled + len(chunk) > array.nbytes:
                    raise Unreachable(f"{address} came with more bytes than announced")
                view[filled : filled + len(chunk)] = chunk
                filled += len(chunk)
        if filled != array.nbytes:
            raise Unreachable(f"{address} broke off after {filled:,} of {array.nbytes:,} bytes")
        return array.astype(array.dtype.newbyteorder("="), copy=False)
