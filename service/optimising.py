"""The command `optimise`: the soft map of least energy that keeps landmarks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.answering import asking, finish
from service.asking import BasisOptions, optimal_softmap
from service.commands import answered, landmarks_option, regions_option
from service.console import Screen
from service.options import (
    Cutoff,
    Data,
    Json,
    Method,
    Out,
    Regularisation,
    Sharpness,
    Source,
    Target,
    Url,
)


def optimise(
    source: Source,
    target: Target,
    landmark: Annotated[
        list[str] | None,
        typer.Option(callback=landmarks_option, help="Source and target vertex, such as 0:17. Repeat it."),
    ] = None,
    region: Annotated[
        list[str] | None,
        typer.Option(
            callback=regions_option,
            help="Source and target vertices whose mass goes there evenly, such as 0,1,2:17,18. Repeat it.",
        ),
    ] = None,
    size: Annotated[int, typer.Option(min=1, help="Functions of each basis.")] = 60,
    method: Method = None,
    cutoff: Cutoff = None,
    sharpness: Sharpness = None,
    bijectivity_weight: Annotated[float | None, typer.Option(help="λ of E_D + λE_b; 1.")] = None,
    tolerance: Annotated[float | None, typer.Option(help="Gap over energy to stop at; 0.001.")] = None,
    max_iterations: Annotated[int | None, typer.Option(min=0, help="Most iterations; 500.")] = None,
    optimiser: Annotated[str | None, typer.Option(help="interior, or the paper's softmax.")] = None,
    attachment: Annotated[
        float | None, typer.Option(help="Weight of equal distances to the landmarks, which sharpens; 0.")
    ] = None,
    start: Annotated[
        str | None, typer.Option(help="Id of a soft map to start from, such as a coarser optimal one.")
    ] = None,
    regularisation: Regularisation = 1e-5,
    url: Url = None,
    data: Data = None,
    out: Out = None,
    json: Json = False,
) -> None:
    """Soft map of least energy from SOURCE to TARGET that keeps landmarks, with a proof of how good it is."""
    screen = Screen(json)
    bases = BasisOptions(size, method, cutoff, sharpness)
    with asking(screen, url, data) as client:
        regions = [pair.split(":") for pair in region or []]
        spec = optimal_softmap(
            bases,
            client.mesh(source).id,
            client.mesh(target).id,
            [(int(v0), int(v)) for v0, v in (pair.split(":") for pair in landmark or [])],
            bijectivity_weight=bijectivity_weight,
            tolerance=tolerance,
            max_iterations=max_iterations,
            optimiser=optimiser,
            attachment=attachment,
            start=start,
            constraints=[{"source": _vertices(one), "target": _vertices(other)} for one, other in regions],
            regularisation=regularisation,
        )
        title = f"optimal map: {Path(source).name} → {Path(target).name}"
        finish(client, screen, answered(client, screen, spec, title), out)


def _vertices(text: str) -> list[int]:
    return [int(vertex) for vertex in text.split(",")]
