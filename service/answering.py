"""The commands that ask one question each: `energy`, `basis`, `map` and `potential`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from service.answers import Artifact
from service.asking import BasisOptions
from service.client import Client
from service.commands import Pair, answered, mesh_argument, save_arrays
from service.console import (
    Screen,
    errors_in_words,
    interrupt_on_termination,
    settings_in_words,
    table,
    timing_table,
    timings,
)
from service.locating import service_of
from service.options import (
    Cutoff,
    Data,
    Json,
    MapOption,
    Method,
    Out,
    Regularisation,
    Sharpness,
    Sigma,
    Size,
    Source,
    Target,
    Url,
)


def energy(
    source: Source,
    target: Target,
    map: MapOption = "wks",
    size: Size = None,
    method: Method = None,
    cutoff: Cutoff = None,
    sharpness: Sharpness = None,
    sigma: Sigma = None,
    regularisation: Regularisation = 1e-5,
    gradient: Annotated[bool, typer.Option("--gradient", help="Gradients too (written by --out).")] = False,
    up_axis: Annotated[str, typer.Option("--up", help="Upward axis of the pictures: x, y or z.")] = "y",
    url: Url = None,
    data: Data = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Energies of a soft map from SOURCE to TARGET; --out also writes densities and a picture."""
    from service.pictures import bijectivity_panel, dirichlet_panel, write  # noqa: PLC0415
    from service.rasteriser import View  # noqa: PLC0415

    if up_axis not in {"x", "y", "z"}:
        raise typer.BadParameter("is x, y or z", param_hint="--up")
    screen = Screen(json)
    bases = BasisOptions(method=method, cutoff=cutoff, sharpness=sharpness)
    pair = Pair(source, target, map, size, bases, sigma)
    with asking(screen, url, data, pair) as client:
        asked, names = pair.softmap(client)
        spec = {"kind": "energy", "softmap": asked, "regularisation": regularisation, "gradient": gradient}
        answer = answered(client, screen, spec, "energy")
        made = timings(client.lineage(answer.id), names)
        files = []
        if out is not None:
            files.append(save_arrays(client, answer, out, "energy"))
            first, second = asked["source"]["mesh"], asked["target"]["mesh"]
            panels = [
                make(
                    client.array(mesh, "vertices"),
                    client.array(mesh, "faces"),
                    client.array(answer.id, f"{kind}_density"),
                    answer.values[kind],
                    Path(map).name,
                )
                for make, mesh, kind in (
                    (dirichlet_panel, first, "dirichlet"),
                    (bijectivity_panel, second, "bijectivity"),
                )
            ]
            files.append(out / "densities.png")
            write(files[-1], [panels], View(up="xyz".index(up_axis)))
    values = {"dirichlet": answer.values["dirichlet"], "bijectivity": answer.values["bijectivity"]}
    screen.answer(
        {
            "id": answer.id,
            **values,
            "made": [asdict(one) for one in made],
            "files": [str(path) for path in files],
        }
    )
    screen.show(
        table(
            f"{Path(source).name} → {Path(target).name}, {Path(map).name}",
            ("", ""),
            [
                ("Dirichlet energy E_D", f"{values['dirichlet']:.6g}"),
                ("bijectivity energy E_b", f"{values['bijectivity']:.6g}"),
            ],
        ),
        timing_table(made),
        answer.id,
        *(f"wrote {path}" for path in files),
    )


def basis(
    mesh: Annotated[str, typer.Argument(callback=mesh_argument, help="Mesh: a file or an id.")],
    size: Annotated[int, typer.Option(min=1, help="Functions.")] = 300,
    method: Method = None,
    cutoff: Cutoff = None,
    sharpness: Sharpness = None,
    url: Url = None,
    data: Data = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Partition of unity on MESH; --out writes its functions as a sparse matrix (CSR)."""
    screen = Screen(json)
    with asking(screen, url, data) as client:
        uploaded = client.mesh(mesh)
        spec = BasisOptions(size, method, cutoff, sharpness).spec(uploaded.id)
        answer = answered(client, screen, spec, "basis")
        finish(client, screen, answer, out)


def softmap(
    source: Source,
    target: Target,
    map: MapOption = "wks",
    size: Size = None,
    method: Method = None,
    cutoff: Cutoff = None,
    sharpness: Sharpness = None,
    sigma: Sigma = None,
    url: Url = None,
    data: Data = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Soft map from SOURCE to TARGET; --out writes its coefficients (n₀×n)."""
    screen = Screen(json)
    bases = BasisOptions(method=method, cutoff=cutoff, sharpness=sharpness)
    pair = Pair(source, target, map, size, bases, sigma)
    with asking(screen, url, data, pair) as client:
        asked, _ = pair.softmap(client)
        finish(client, screen, answered(client, screen, asked, "map"), out)


def potential(
    source: Source,
    target: Target,
    map: MapOption = "wks",
    size: Size = None,
    method: Method = None,
    cutoff: Cutoff = None,
    sharpness: Sharpness = None,
    sigma: Sigma = None,
    regularisation: Regularisation = 1e-5,
    url: Url = None,
    data: Data = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Transportation potentials of all source faces; --out writes them (F₀×2×n) with their frames."""
    bases = BasisOptions(method=method, cutoff=cutoff, sharpness=sharpness)
    pair = Pair(source, target, map, size, bases, sigma)
    finish_of(pair, {"kind": "potential", "regularisation": regularisation}, Screen(json), url, data, out)


@contextmanager
def asking(screen: Screen, url: str | None, data: Path | None, pair: Pair | None = None) -> Iterator[Client]:
    """Client of the service that the options mean; what goes wrong in the block ends the command in words."""
    settings = settings_in_words(screen, data=data)
    interrupt_on_termination()
    with errors_in_words(screen):
        if pair is not None:
            pair.numbers()  # a file that holds no map is not worth starting a service for
        with service_of(settings, url, screen.say) as client:
            yield client


def finish_of(
    pair: Pair, question: dict[str, Any], screen: Screen, url: str | None, data: Path | None, out: Path | None
) -> None:
    """Ask a question of the soft map of a pair, to its end."""
    with asking(screen, url, data, pair) as client:
        asked, _ = pair.softmap(client)
        spec = {**question, "softmap": asked}
        finish(client, screen, answered(client, screen, spec, question["kind"]), out)


def finish(client: Client, screen: Screen, answer: Artifact, out: Path | None) -> None:
    """Show an artifact and write its arrays."""
    files = [] if out is None else [save_arrays(client, answer, out, answer.kind)]
    shapes = {name: list(array["shape"]) for name, array in answer.arrays.items()}
    screen.answer(
        {
            "id": answer.id,
            "values": dict(answer.values),
            "arrays": shapes,
            "seconds": answer.seconds,
            "files": [str(path) for path in files],
        }
    )
    rows = [(name, _said(value)) for name, value in answer.values.items()]
    rows += [(name, " × ".join(map(str, shape))) for name, shape in shapes.items()]
    screen.show(
        table(f"{answer.kind}, made in {answer.seconds:.2f} s", ("", ""), rows),
        answer.id,
        *(f"wrote {path}" for path in files),
    )


def _said(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
