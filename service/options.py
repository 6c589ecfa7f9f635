"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.commands import map_option, mesh_argument

Source = Annotated[str, typer.Argument(callback=mesh_argument, help="Source mesh: a file or an id.")]
Target = Annotated[str, typer.Argument(callback=mesh_argument, help="Target mesh: a file or an id.")]
MapOption = Annotated[
    str,
    typer.Option(
        "--map",
        callback=map_option,
        help="wks, hks, uniform, or a .txt or .npy FILE: the target vertex of every source vertex, counted "
        "from 0, or an n₀×n matrix of coefficients.",
    ),
]
Size = Annotated[int | None, typer.Option(min=1, help="Functions of each basis; 300, or as a matrix says.")]
Method = Annotated[
    str | None,
    typer.Option(help="How bases are made: maxent, or poisson as in the paper."),
]
Cutoff = Annotated[float | None, typer.Option(help="Cutoff of the poisson basis, in (0, 1).")]
Sharpness = Annotated[float | None, typer.Option(help="Sharpness of the maxent basis, from 0.5 to 50.")]
Sigma = Annotated[float | None, typer.Option(help="Reach of descriptors, in units of their rms distance.")]
Regularisation = Annotated[float, typer.Option(help="ε, the uniform part of every mass distribution.")]
Url = Annotated[
    str | None, typer.Option(help="Service to ask. [dim]SOFTMAPS_URL; else the one on this machine.[/]")
]
Data = Annotated[Path | None, typer.Option(help="Folder of everything that is kept. [dim]SOFTMAPS_DATA[/]")]
Out = Annotated[Path | None, typer.Option(help="Folder for arrays and pictures.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON document instead of tables and progress.")]
