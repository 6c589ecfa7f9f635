"""The command `demo`: the main job on the built-in pair, from uploads to pictures, through a real stack."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from service.answers import Energies
from service.asking import BasisOptions, softmap
from service.client import Client
from service.commands import USUAL_SIZE, answered
from service.console import (
    Screen,
    Timing,
    errors_in_words,
    interrupt_on_termination,
    settings_in_words,
    table,
    timing_table,
    timings,
)
from service.creature import creature
from service.locating import stopping
from service.options import Json
from service.stack import Stack

EXPLANATION = (
    "The wave kernel signature cannot tell one leg from another: it spreads a shin over all four, and where "
    "the shares change, mass has to cross surface that carries none: there the Dirichlet density is high. "
    "The true map is a point map, whose density is about 2 where it is an isometry."
)
#: The two maps: what they are called in files and in words.
MAPS = {"wks": "WKS soft map", "true": "true point map"}


def demo(
    out: Annotated[Path, typer.Option(help="Folder for pictures and arrays.")] = Path("softmaps-demo"),
    size: Annotated[int, typer.Option(min=1, help="Functions of each basis.")] = USUAL_SIZE,
    json: Json = False,
) -> None:
    """Run the main job on a built-in creature in two poses: real Redis, API and workers, in a fresh store."""
    began = time.monotonic()
    screen = Screen(json)
    interrupt_on_termination()
    with errors_in_words(screen), tempfile.TemporaryDirectory(prefix="softmaps-demo-") as store:
        out.mkdir(parents=True, exist_ok=True)
        settings = settings_in_words(screen, data=Path(store))
        stack = Stack(settings, public=False, report=screen.say)
        with stopping(stack):
            with screen.waiting("starting Redis, the API and workers (the first time, kernels are compiled)"):
                stack.start()
            ready = time.monotonic() - began
            token = settings.token.get_secret_value() if settings.token else None
            with Client(stack.url, token) as client:
                screen.say(f"a stack is ready at {stack.url} after {ready:.1f} s")
                results, made = _computed(client, screen, size)
                files = _written(client, results, out)
        seconds = time.monotonic() - began
    _report(screen, results, made, files, {"ready": ready, "total": seconds})


def _computed(client: Client, screen: Screen, size: int) -> tuple[dict[str, Energies], list[Timing]]:
    """Energies of both maps, and the seconds that each job took."""
    (standing, faces), (trotting, _) = creature("standing"), creature("trotting")
    source = client.upload_mesh((standing, faces), name="standing")
    target = client.upload_mesh((trotting, faces), name="trotting")
    screen.say(f"uploaded two poses of a creature: {len(standing):,} vertices, {len(faces):,} faces each")
    options = BasisOptions(size)
    names = {source.id: "standing", target.id: "trotting"}
    results: dict[str, Energies] = {}
    made: dict[str, Timing] = {}
    # Every vertex of one pose is the same point of the creature in the other: the true map is the identity.
    maps: dict[str, str | NDArray[Any]] = {"wks": "wks", "true": np.arange(len(standing))}
    for name, numbers in maps.items():
        spec = client.map_spec(numbers, source, target)
        asked = softmap(options.spec(source.id), options.spec(target.id), spec)
        answer = answered(client, screen, {"kind": "energy", "softmap": asked}, MAPS[name])
        results[name] = client.energies(answer.id, source.id, target.id)
        lineage = client.lineage(answer.id)
        own = {one.id: MAPS[name] for one in lineage if one.kind in {"softmap", "energy"}}
        made |= {timing.id: timing for timing in timings(lineage, own | names)}
    return results, list(made.values())


def _written(client: Client, results: Mapping[str, Energies], out: Path) -> list[Path]:
    """Write a picture of both densities for each map, and all arrays as one file."""
    from service.pictures import bijectivity_panel, dirichlet_panel, write  # noqa: PLC0415  (loads matplotlib)

    first = next(iter(results.values()))
    arrays = {
        "vertices_standing": client.array(first.source, "vertices"),
        "vertices_trotting": client.array(first.target, "vertices"),
        "faces": client.array(first.source, "faces"),
    }
    files = []
    for name, found in results.items():
        arrays[f"{name}_dirichlet_density"] = found.dirichlet_density
        arrays[f"{name}_bijectivity_density"] = found.bijectivity_density
        arrays[f"{name}_energies"] = np.array([found.dirichlet, found.bijectivity])
        source = (arrays["vertices_standing"], arrays["faces"])
        target = (arrays["vertices_trotting"], arrays["faces"])
        files.append(out / f"{name}.png")
        panels = [
            dirichlet_panel(*source, found.dirichlet_density, found.dirichlet, MAPS[name]),
            bijectivity_panel(*target, found.bijectivity_density, found.bijectivity, MAPS[name]),
        ]
        write(files[-1], [panels])
    files.append(out / "densities.npz")
    np.savez_compressed(files[-1], **arrays)  # type: ignore[arg-type]
    return files


def _report(
    screen: Screen,
    results: Mapping[str, Energies],
    made: Sequence[Timing],
    files: Sequence[Path],
    seconds: Mapping[str, float],
) -> None:
    energies = {
        name: {"dirichlet": found.dirichlet, "bijectivity": found.bijectivity}
        for name, found in results.items()
    }
    screen.answer(
        {
            "energies": energies,
            "made": [asdict(timing) for timing in made],
            "seconds": dict(seconds),
            "files": [str(path) for path in files],
        }
    )
    rows = [(MAPS[name], f"{e['dirichlet']:.6f}", f"{e['bijectivity']:.6f}") for name, e in energies.items()]
    screen.show(
        table("standing → trotting", ("map", "E_D", "E_b"), rows),
        f"[dim]{EXPLANATION}[/]",
        timing_table(made),
        f"ready after {seconds['ready']:.1f} s, done and everything stopped after {seconds['total']:.1f} s",
        *(f"wrote {path}" for path in files),
    )
