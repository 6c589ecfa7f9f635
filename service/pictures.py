"""Pictures of values on meshes with what a reader must know about them, drawn without a display.

The Dirichlet density is shown on a logarithmic scale (it spans decades), the bijectivity density by its
reciprocal, as in the paper's figures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from service.marks import Floats, Ints, Mark
from service.rasteriser import View, render

if TYPE_CHECKING:
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

#: Percentiles of a density that its colours span: a few extreme faces must not flatten the rest.
LOWEST, HIGHEST = 4.0, 99.0
#: A scale is at least this wide, or the rounding of a constant density would look like structure.
LEAST_RATIO = 1.01
#: Decades of a logarithmic scale at most; below them a density is as good as zero.
DECADES = 5.0
#: A number from which on digits behind the point are left out.
LARGE = 1e4
#: Labels of a logarithmic scale at most.
MOST_TICKS = 5
#: Ratio of its ends from which a logarithmic scale has a label a decade.
WIDE = 100.0
#: Width and height of a panel, how much of the height title and colour bar take, and the longest bar: inches.
PANEL_INCHES = (5.2, 4.4)
TITLE_INCHES, BAR_INCHES, LONGEST_BAR = 0.3, 0.55, 4.5
DPI = 120


@dataclass(frozen=True, eq=False)
class Panel:
    """One mesh with one value or colour per face or vertex, and what a reader must know about it.

    Attributes
    ----------
    vertices, faces : ndarray, (V, 3) float and (F, 3) int
        The mesh.
    values : ndarray, (F,), (V,), (F, 3) or (V, 3) float
        Values for a scale of colours; or red, green and blue in [0, 1].
    title : str
        Above the mesh.
    label : str
        What the values are, for the colour bar; "" if there is none.
    logarithmic : bool
        Whether the scale of colours is.
    colours : str
        What matplotlib calls the colours.
    limits : (float, float), optional
        Ends of the scale; else most of the values lie between them. Neighbours with the same limits and label
        share a colour bar.
    marks : tuple of Mark
        Drawn with the mesh.
    view : View, optional
        Camera; else that of the figure.
    """

    vertices: Floats
    faces: Ints
    values: Floats
    title: str
    label: str = ""
    logarithmic: bool = False
    colours: str = "viridis"
    limits: tuple[float, float] | None = None
    marks: tuple[Mark, ...] = ()
    view: View | None = None


def dirichlet_panel(vertices: Floats, faces: Ints, density: Floats, energy: float, name: str) -> Panel:
    """Dirichlet energy density on the source mesh, logarithmic.

    Parameters
    ----------
    vertices, faces : ndarray, (V, 3) float and (F, 3) int
        The source mesh.
    density : ndarray, (F,) float
        Energy per unit source area.
    energy : float
        Its integral over the unit-area mesh, E_D.
    name : str
        What the map is called.

    Returns
    -------
    Panel
        Ready for `figure`.
    """
    title = f"{name}:  $E_D$ = {_number(energy)}"
    return Panel(vertices, faces, density, title, "Dirichlet energy per unit source area", True, "plasma")


def bijectivity_panel(vertices: Floats, faces: Ints, density: Floats, energy: float, name: str) -> Panel:
    """Reciprocal of the bijectivity density on the target mesh.

    Parameters
    ----------
    vertices, faces : ndarray, (V, 3) float and (F, 3) int
        The target mesh.
    density : ndarray, (F,) float
        Mass received per unit target area; 1 everywhere for a measure-preserving map.
    energy : float
        Integral of its square over the unit-area mesh, E_b.
    name : str
        What the map is called.

    Returns
    -------
    Panel
        Ready for `figure`.
    """
    # No mass at all is an infinite reciprocal: the top of the scale, whatever it is.
    reciprocal = 1.0 / np.maximum(density, np.finfo(np.float64).tiny)
    title = f"{name}:  $E_b$ = {_number(energy)}"
    return Panel(vertices, faces, reciprocal, title, "1 / bijectivity density: target area per unit mass")


def figure(
    rows: Sequence[Sequence[Panel]],
    view: View | None = None,
    inches: tuple[float, float] = PANEL_INCHES,
    dpi: float = DPI,
) -> Figure:
    """Meshes side by side, with their colour bars.

    Parameters
    ----------
    rows : sequence of sequences of Panel
        The grid of panels; all rows are equally long.
    view : View, optional
        Camera of panels that have none of their own; a three-quarter view with z up unless given.
    inches : (float, float)
        Width and height of a panel with its title and colour bar.
    dpi : float
        Pixels an inch.

    Returns
    -------
    matplotlib.figure.Figure
        Not yet drawn; ``savefig`` writes it.

    Raises
    ------
    ValueError
        If a panel has neither a value per face nor one per vertex.
    """
    # Importing matplotlib takes half a second, which commands without pictures need not wait for.
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    width, row_height = inches
    drawing = Figure(figsize=(width * len(rows[0]), row_height * len(rows)), dpi=dpi)
    total = width * len(rows[0]), row_height * len(rows)

    def area(left: float, bottom: float, across: float, up: float) -> Any:
        return drawing.add_axes((left / total[0], bottom / total[1], across / total[0], up / total[1]))

    for k, row in enumerate(rows):
        bottom = row_height * (len(rows) - 1 - k)
        below = BAR_INCHES if any(panel.label for panel in row) else 0.0
        above = TITLE_INCHES if any(panel.title for panel in row) else 0.0
        height = row_height - above - below
        line = [area(j * width, bottom + below, width, height) for j in range(len(row))]
        for axes, panel in zip(line, row, strict=True):
            pixels = round(width * dpi), round(height * dpi)
            axes.imshow(_drawn(panel, panel.view or view or View(), pixels), aspect="auto")
            axes.set_axis_off()
            axes.set_title(panel.title, fontsize=11)
        for panel, sharing in _sharing(row):
            scale = ScalarMappable(_scale(panel), panel.colours)
            middle = width * (sharing[0] + sharing[-1] + 1) / 2
            long = min(0.7 * width * len(sharing), LONGEST_BAR)
            slot = area(middle - long / 2, bottom + below - 0.1, long, 0.09)
            bar = drawing.colorbar(scale, cax=slot, orientation="horizontal", extend="both")
            _label(bar, panel, scale.get_clim())
    return drawing


def _sharing(row: Sequence[Panel]) -> Iterator[tuple[Panel, list[int]]]:
    """Panels that have a colour bar, each with the positions of those that share it."""
    keys = [(k if panel.limits is None else -1, panel.limits, panel.label) for k, panel in enumerate(row)]
    for _, group in groupby(range(len(row)), keys.__getitem__):
        members = list(group)
        if row[members[0]].label:
            yield row[members[0]], members


def _label(bar: Any, panel: Panel, limits: tuple[float, float]) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator  # noqa: PLC0415  (see `figure`)

    bar.set_label(panel.label, fontsize=9)
    if panel.logarithmic:
        low, high = limits
        # One label a decade or less often, or three where there are few decades.
        bar.locator = LogLocator(subs=(1.0,) if high > WIDE * low else (1.0, 2.0, 5.0), numticks=MOST_TICKS)
        bar.formatter = FuncFormatter(_tick)
        bar.minorticks_off()
        bar.update_ticks()
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)


def _drawn(panel: Panel, view: View, size: tuple[int, int]) -> Any:
    """Rendered mesh with its marks."""
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415  (see `figure`)

    colours = panel.values
    if colours.ndim == 1:
        colours = ScalarMappable(_scale(panel), panel.colours).to_rgba(colours)[:, :3]
    flat = len(colours) == len(panel.faces)
    if not flat and len(colours) != len(panel.vertices):
        # Marks would hide the mismatch.
        return render(panel.vertices, panel.faces, colours, view, size)
    vertices, faces, paint = [panel.vertices], [panel.faces], [colours]
    offset = len(panel.vertices)
    for mark in panel.marks:
        vertices.append(mark.vertices)
        faces.append(mark.faces + offset)
        paint.append(np.tile(mark.colour, (len(mark.faces if flat else mark.vertices), 1)))
        offset += len(mark.vertices)
    return render(np.concatenate(vertices), np.concatenate(faces), np.concatenate(paint), view, size)


def write(path: Path, rows: Sequence[Sequence[Panel]], view: View | None = None) -> None:
    """Write a figure as a picture.

    Parameters
    ----------
    path : Path
        Where to; the suffix decides the format.
    rows : sequence of sequences of Panel
        As for `figure`.
    view : View, optional
        Camera.

    Raises
    ------
    ValueError
        If a panel's values fit neither its faces nor its vertices, or the format is unknown.
    OSError
        If the file cannot be written.
    """
    figure(rows, view).savefig(path)


def _tick(value: float, _position: int) -> str:
    """A number, or the power of ten that it is if it is long."""
    return f"$10^{{{np.log10(value):.0f}}}$" if value >= LARGE else f"{value:g}"


def _number(value: float) -> str:
    """Four digits, and no powers of ten."""
    return f"{value:,.0f}" if value >= LARGE else f"{value:.4g}"


def _scale(panel: Panel) -> Normalize:
    from matplotlib.colors import LogNorm, Normalize  # noqa: PLC0415  (see `figure`)

    if panel.limits is not None:
        return LogNorm(*panel.limits) if panel.logarithmic else Normalize(*panel.limits)
    values = panel.values[np.isfinite(panel.values)]
    if panel.logarithmic:
        values = values[values > 0.0]
    if len(values) == 0:
        return LogNorm(1e-3, 1.0) if panel.logarithmic else Normalize(0.0, 1.0)
    low, high = np.percentile(values, [LOWEST, HIGHEST])
    if panel.logarithmic:
        return LogNorm(max(low, high * 10.0**-DECADES), max(high, low * LEAST_RATIO))
    return Normalize(low, max(high, low * LEAST_RATIO, low + np.finfo(np.float64).tiny))
