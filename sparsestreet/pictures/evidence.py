"""What effects are decided from, for a person to judge: images, gains and motion that were measured."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from sparsestreet.atomic import atomic_file
from sparsestreet.pictures.panels import Dots, Marked, Panel, Places

COLUMNS = 2
_MARK = np.array([230.0, 40.0, 40.0])


def draw_evidence(path: Path, title: str, panels: Sequence[Panel]) -> None:
    """Writes a PNG with a cell for each panel. Raises ValueError without any."""
    if not panels:
        raise ValueError("a picture of evidence needs a panel, and no effect has one")
    lines = -(-len(panels) // COLUMNS)
    figure = Figure(figsize=(12.0, 0.5 + 3.3 * lines), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    cells = figure.subplots(lines, COLUMNS, squeeze=False).flat
    for axes, panel in zip(cells, panels, strict=False):
        axes.set_title(panel.title, fontsize=9)
        _draw(axes, panel)
    for axes in list(figure.axes)[len(panels) : lines * COLUMNS]:
        axes.set_axis_off()
    figure.suptitle(title, fontsize=11)
    with atomic_file(path) as file:
        figure.savefig(file, format="png")


def _draw(axes: Axes, panel: Panel) -> None:
    match panel:
        case Dots():
            _dots(axes, panel)
        case Marked(_, image, mask):
            axes.imshow(np.where(mask[..., None], 0.4 * image + 0.6 * _MARK, image).astype(np.uint8))
            axes.set_axis_off()
        case Places(_, image, pixels, values, unit):
            axes.imshow(image, alpha=0.5)
            drawn = axes.scatter(pixels[:, 0], pixels[:, 1], c=values, s=6, cmap="viridis", vmin=0.0)
            axes.figure.colorbar(drawn, ax=axes, label=unit, shrink=0.8)
            axes.set_axis_off()


def _dots(axes: Axes, panel: Dots) -> None:
    for name, (x, y) in panel.groups.items():
        axes.plot(x, y, ".-" if panel.joined else ".", markersize=4, linewidth=0.8, label=name)
    if panel.diagonal:
        axes.axline((0.0, 0.0), slope=1.0, color="0.6", linewidth=0.8, zorder=0)
    axes.axhline(0.0, color="0.8", linewidth=0.8, zorder=0)
    axes.set_xlabel(panel.x, fontsize=8)
    axes.set_ylabel(panel.y, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)
