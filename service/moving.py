"""The commands that follow mass: `momentum`, `path` and `pointmap`."""

from __future__ import annotations

from typing import Annotated

import typer

from service.answering import finish_of
from service.asking import BasisOptions
from service.commands import Pair, vertices_option
from service.console import Screen
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


def momentum(
    source: Source,
    target: Target,
    face: Annotated[int, typer.Option(min=0, help="Source face, counted from 0.")],
    direction: Annotated[
        tuple[float, float, float], typer.Option(help="Where the source point moves: three numbers.")
    ],
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
    """How mass moves on TARGET as a point of SOURCE moves; --out writes velocity and momentum (F×3)."""
    bases = BasisOptions(method=method, cutoff=cutoff, sharpness=sharpness)
    pair = Pair(source, target, map, size, bases, sigma)
    question = {
        "kind": "momentum",
        "face": face,
        "direction": list(direction),
        "regularisation": regularisation,
    }
    finish_of(pair, question, Screen(json), url, data, out)


def path(
    source: Source,
    target: Target,
    source_path: Annotated[
        str,
        typer.Option(callback=vertices_option, help="Source vertices that the path passes, such as 0,17,42."),
    ],
    start: Annotated[int, typer.Option(min=0, help="Target vertex that the first of them corresponds to.")],
    step: Annotated[float, typer.Option(help="Longest step, in √area of the source.")] = 0.01,
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
    """Path on TARGET that follows a path on SOURCE; --out writes its points (k×3) and where they are."""
    bases = BasisOptions(method=method, cutoff=cutoff, sharpness=sharpness)
    pair = Pair(source, target, map, size, bases, sigma)
    question = {
        "kind": "path",
        "source_path": [int(vertex) for vertex in source_path.split(",")],
        "start": start,
        "step": step,
        "regularisation": regularisation,
    }
    finish_of(pair, question, Screen(json), url, data, out)


def pointmap(
    source: Source,
    target: Target,
    by: Annotated[
        str, typer.Option(help="peak: where mass is densest; barycentre: where on the surface it balances.")
    ] = "peak",
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
    """Target vertex of every vertex of SOURCE; --out writes them with their confidence (V₀)."""
    bases = BasisOptions(method=method, cutoff=cutoff, sharpness=sharpness)
    pair = Pair(source, target, map, size, bases, sigma)
    finish_of(pair, {"kind": "pointmap", "method": by}, Screen(json), url, data, out)
