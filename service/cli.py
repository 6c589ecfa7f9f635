"""The command `softmaps`: every command's name, and what it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import typer

from service.answering import basis, energy, potential, softmap
from service.bench import bench
from service.demo import demo
from service.figures.command import figures
from service.moving import momentum, path, pointmap
from service.operating import api, jobs, up, worker
from service.optimising import optimise

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Soft maps between triangle meshes: their Dirichlet and bijectivity energies, as a service.",
)
COMMANDS: Mapping[str, Callable[..., None]] = {
    "up": up,
    "demo": demo,
    "figures": figures,
    "energy": energy,
    "basis": basis,
    "map": softmap,
    "potential": potential,
    "momentum": momentum,
    "path": path,
    "pointmap": pointmap,
    "optimise": optimise,
    "jobs": jobs,
    "worker": worker,
    "api": api,
    "bench": bench,
}
for name, command in COMMANDS.items():
    app.command(name)(command)


def main() -> None:
    """Run the command line; what ``softmaps`` and ``python -m service`` call."""
    app(prog_name="softmaps")
