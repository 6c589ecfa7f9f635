"""The command `figures`: the paper's figures from computations of our own."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.console import Screen, interrupt_on_termination, table
from service.options import Json

if TYPE_CHECKING:
    from service.figures.drawing import Sheet
    from service.figures.shapes import Shelf

#: What each figure shows, by name; the numbers are the paper's.
FIGURES: Mapping[str, str] = {
    "bases": "1: samples, and three functions of each basis",
    "momenta": "2: momentum of three points that move",
    "paths": "3: paths traced on the target",
    "superposed": "4 a: two maps of the sphere in one",
    "limb": "4 b–e: four points along a limb, and the densities of both energies",
    "spheres": "5: four maps of the sphere and their energies",
    "deformations": "6: reciprocal bijectivity density of four deformations",
    "failure": "7: where wave kernel signatures tear a map",
    "landmarks": "8: optimal maps of the sphere with one landmark and with three",
    "poses": "9: optimal map between two poses with three landmarks",
}
#: Pixels an inch, for print and for web pages; colours of a picture for web pages.
PRINT, WEB, PALETTE = 200, 72, 256


def figures(
    names: Annotated[
        list[str] | None, typer.Argument(help=f"{', '.join(FIGURES)}. [dim]All.[/]", show_default=False)
    ] = None,
    meshes: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="Folder of real meshes, one subfolder a pair. [dim]Else built-in shapes.[/]",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("softmaps-figures"),
    small: Annotated[bool, typer.Option("--small", help="Pictures for web pages, of few bytes.")] = False,
    json: Json = False,
) -> None:
    """Redraw the paper's figures, each in some seconds, without a service."""
    unknown = [name for name in names or () if name not in FIGURES]
    if unknown:
        raise typer.BadParameter(f"{unknown[0]} is none of {', '.join(FIGURES)}")
    from service.figures.shapes import FOLDERS, Shelf  # noqa: PLC0415  (loads the solver)

    if meshes is not None and not any((meshes / folder).is_dir() for folder in FOLDERS):
        raise typer.BadParameter(f"{meshes} holds none of {', '.join(FOLDERS)}", param_hint="--meshes")
    screen, shelf, drawn = Screen(json), Shelf(meshes), {}
    interrupt_on_termination()
    out.mkdir(parents=True, exist_ok=True)
    for name in names or FIGURES:
        begin = time.monotonic()
        with screen.waiting(FIGURES[name]):
            sheet = _sheets()[name](shelf)
            path = _written(sheet, out / f"{name}.png", small)
        drawn[name] = {"file": str(path), "seconds": time.monotonic() - begin, "numbers": sheet.numbers}
        screen.show(
            table(
                f"figure {FIGURES[name]}",
                ("", ""),
                [(key, f"{value:.6g}") for key, value in sheet.numbers.items()],
            ),
            f"wrote {path}",
        )
    screen.answer(drawn)


def _sheets() -> Mapping[str, Callable[[Shelf], Sheet]]:
    """Return what draws each figure; importing it loads the solver."""
    from service.figures.analysis import deformations, failure, limb  # noqa: PLC0415
    from service.figures.fields import bases, momenta  # noqa: PLC0415
    from service.figures.optimal import landmarks, poses  # noqa: PLC0415
    from service.figures.paths import paths  # noqa: PLC0415
    from service.figures.spheres import spheres, superposed  # noqa: PLC0415

    every = (bases, momenta, paths, superposed, limb, spheres, deformations, failure, landmarks, poses)
    return {sheet.__name__: sheet for sheet in every}


def _written(sheet: Sheet, path: Path, small: bool) -> Path:
    import numpy as np  # noqa: PLC0415
    from PIL import Image  # noqa: PLC0415  (see `service.pictures.figure`)

    from service.pictures import figure  # noqa: PLC0415

    drawing = figure(sheet.rows, inches=sheet.inches, dpi=WEB if small else PRINT)
    if not small:
        drawing.savefig(path)
        return path
    buffer = BytesIO()
    drawing.savefig(buffer, format="png")
    picture = Image.open(buffer).convert("RGB")
    # This way to choose colours, of all there are, keeps those of small marks; paper must stay white.
    colours = picture.quantize(PALETTE, Image.Quantize.MAXCOVERAGE, kmeans=3)
    entries = np.array(colours.getpalette()).reshape(-1, 3)
    entries[entries.sum(axis=1).argmax()] = 255
    colours.putpalette(entries.ravel().tolist())
    picture.quantize(palette=colours, dither=Image.Dither.FLOYDSTEINBERG).save(path, optimize=True)
    return path
