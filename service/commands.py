"""What the commands about a pair of meshes do: from files and options to an artifact."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer
from numpy.typing import NDArray

from service.answers import Artifact
from service.asking import NAMED_MAPS, BasisOptions, read_map, softmap
from service.client import Client
from service.console import Bars, Screen

#: Functions of each basis, unless an option or a matrix says otherwise.
USUAL_SIZE = 300
_MESH_ID = re.compile(r"mesh-[0-9a-f]{32}")


def mesh_argument(value: str) -> str:
    """Check that an argument is a file or the id of an uploaded mesh.

    Raises
    ------
    typer.BadParameter
        If it is neither.
    """
    if not _MESH_ID.fullmatch(value) and not Path(value).is_file():
        raise typer.BadParameter(f"there is no file {value}")
    return value


def map_option(value: str) -> str:
    """Check that an option is the name of a map or a file.

    Raises
    ------
    typer.BadParameter
        If it is neither.
    """
    if value not in NAMED_MAPS and not Path(value).is_file():
        raise typer.BadParameter(f"{value} is neither {', '.join(NAMED_MAPS)} nor a file")
    return value


def vertices_option(value: str) -> str:
    """Check that an option is a list of vertices, joined by commas.

    Raises
    ------
    typer.BadParameter
        If it is none.
    """
    if not re.fullmatch(r"[0-9]+(,[0-9]+)*", value, re.ASCII):
        raise typer.BadParameter(f"{value} is no list of vertices such as 0,17,42")
    return value


def landmarks_option(values: list[str] | None) -> list[str] | None:
    """Check that options are pairs of vertices, joined by a colon.

    Raises
    ------
    typer.BadParameter
        If one is none.
    """
    for value in values or []:
        if not re.fullmatch(r"[0-9]+:[0-9]+", value, re.ASCII):
            raise typer.BadParameter(f"{value} is no pair of vertices such as 0:17")
    return values


def regions_option(values: list[str] | None) -> list[str] | None:
    """Check that options are pairs of lists of vertices, joined by a colon.

    Raises
    ------
    typer.BadParameter
        If one is none.
    """
    for value in values or []:
        for region in value.split(":", 1) if ":" in value else [""]:
            vertices_option(region)
    return values


@dataclass(frozen=True)
class Pair:
    """Two meshes, a map between them, and bases: what the options say.

    Attributes
    ----------
    source, target : str
        Files or ids.
    map : str
        A name, or a file.
    size : int or None
        Functions of each basis; None: as a matrix of coefficients says, else 300.
    bases : BasisOptions
        How bases are made; its size is not used.
    sigma : float or None
        Of descriptors; None: the service's default.
    """

    source: str
    target: str
    map: str
    size: int | None
    bases: BasisOptions
    sigma: float | None

    def numbers(self) -> str | NDArray[Any]:
        """The map: its name, or what its file holds.

        Raises
        ------
        Unusable
            If the file holds no map.
        """
        return self.map if self.map in NAMED_MAPS else read_map(Path(self.map))

    def softmap(self, client: Client) -> tuple[dict[str, Any], dict[str, str]]:
        """Upload the meshes and the map.

        Parameters
        ----------
        client : Client
            Of the service.

        Returns
        -------
        spec : dict
            Of the soft map, bases inline.
        names : dict
            What the meshes are called, by id; the source first.

        Raises
        ------
        ClientError
            If the service refuses, or the map fits neither vertices nor bases.
        """
        numbers = self.numbers()
        source, target = client.mesh(self.source), client.mesh(self.target)
        spec = client.map_spec(numbers, source, target, self.sigma)
        rows = columns = self.size or USUAL_SIZE
        if spec["type"] == "matrix" and self.size is None and not isinstance(numbers, str):
            rows, columns = numbers.shape
        names = {source.id: Path(self.source).name}
        names.setdefault(target.id, Path(self.target).name)
        return softmap(self.bases.spec(source.id, rows), self.bases.spec(target.id, columns), spec), names


def answered(client: Client, screen: Screen, spec: Mapping[str, Any], title: str) -> Artifact:
    """Ask a question and wait for its answer, showing progress.

    Parameters
    ----------
    client : Client
        Of the service.
    screen : Screen
        Where progress is shown.
    spec : mapping
        The question.
    title : str
        What it is called.

    Returns
    -------
    Artifact
        The answer.

    Raises
    ------
    ClientError
        If the service refuses or the job fails.
    """
    with screen.waiting() as progress:
        job = client.wait(
            client.submit(spec).id, None if progress.disable else Bars(progress, title, client.job)
        )
    return client.artifact(job.id)


def save_arrays(client: Client, artifact: Artifact, folder: Path, name: str) -> Path:
    """Write all arrays of an artifact as one ``.npz``.

    Parameters
    ----------
    client : Client
        Of the service.
    artifact : Artifact
        Whose arrays.
    folder : Path
        Made if it does not exist.
    name : str
        Of the file, without ending.

    Returns
    -------
    Path
        Of the file.

    Raises
    ------
    ClientError, OSError
        If an array cannot be read, or the file not written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.npz"
    np.savez_compressed(path, **client.arrays(artifact.id))  # type: ignore[arg-type]
    return path
