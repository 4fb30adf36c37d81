"""Pictures of an archive: heat maps, bars, tessellations and scatter plots."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from newton_qd.errors import require_extra
from newton_qd.qd.algorithms import ALGORITHMS, algorithm_named
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.plot_cells import draw_intervals, draw_pairs, draw_tessellation
from newton_qd.qd.run.plot_grid import draw_line, draw_nested

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from newton_qd.qd.scoring.task import Task

_NESTED_DIMENSIONS = 4


def archive_png(
    archive: Archive, config: EvolveConfig, task: Task, iteration: int
) -> bytes:
    """Draws the archive of a run.

    Args:
        archive: Archive to draw.
        config: Settings of the run, with a grid or a number of centroids.
        task: Task of the run, with limits and labels for the picture.
        iteration: Generations that are finished.

    Returns:
        A PNG file.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    buffer = io.BytesIO()
    figure = archive_figure(archive, config, task, iteration)
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


def archive_figure(
    archive: Archive, config: EvolveConfig, task: Task, iteration: int
) -> Figure:
    """Draws the archive of a run, as ``archive_png``; returns matplotlib's figure.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    best = f"{archive.fitnesses.max():.1f}" if archive.filled.any() else "none"
    title = (
        f"{config.env_name}: {config.algorithm}, seed {config.seed}, "
        f"{iteration} generations\n{archive.filled.sum()} of "
        f"{len(archive.filled)} cells, best fitness {best}"
    )
    return plot_archive(
        archive,
        grid=config.grid,
        limits=task.limits,
        labels=task.labels,
        title=title,
        fitness_label=_fitness_label(config),
    )


def _fitness_label(config: EvolveConfig) -> str:
    """Says what the fitness of a run is."""
    spec = algorithm_named(config.algorithm)
    if spec.scoring is not None and spec not in ALGORITHMS:
        return "fitness"  # a user's own
    label = f"fitness: return over {config.episode_length} control steps"
    return f"{label}, lowered by scatter" if config.scatter else label


def plot_archive(
    archive: Archive,
    *,
    grid: tuple[int, ...] | None,
    limits: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, ...],
    title: str = "",
    fitness_label: str = "fitness",
) -> Figure:
    """Draws an archive.

    Cells of one dimension become bars, as high as the fitness. A grid of two to four
    dimensions becomes one heat map: dimensions 1 and 2 select a block, and dimensions 3
    and 4 select a cell inside the block. A tessellation of two dimensions is drawn with
    its cells. All other archives become one scatter plot for each pair of dimensions.

    Args:
        archive: Archive to draw.
        grid: Cells along each dimension; ``None`` if the cells are not a grid.
        limits: Lowest and highest descriptor, (D,) each.
        labels: D names of the descriptor's components.
        title: Title of the picture.
        fitness_label: Label of the colour bar.

    Returns:
        A matplotlib figure without a window.

    Raises:
        MissingExtra: matplotlib is not installed.
    """
    require_extra("matplotlib", "viz")
    from newton_qd.figure import NotebookFigure

    figure = NotebookFigure(figsize=(9.0, 8.0), layout="constrained")
    figure.suptitle(title)
    axes, mappable = _draw(figure, archive, grid, limits, labels, fitness_label)
    figure.colorbar(mappable, ax=axes, label=fitness_label, shrink=0.85, pad=0.03)
    return figure


def _draw(
    figure: Figure,
    archive: Archive,
    grid: tuple[int, ...] | None,
    limits: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, ...],
    fitness_label: str,
) -> tuple[list[Axes], Any]:
    """Draws the cells; returns the axes, and the colours for a colour bar."""
    count = len(labels)
    if count > 2 and (grid is None or count > _NESTED_DIMENSIONS):
        return draw_pairs(figure, archive, limits, labels)
    axes = figure.add_subplot()
    if grid is not None and count == 1:
        found = draw_line(axes, archive, grid, limits, labels, fitness_label)
    elif grid is not None:
        found = draw_nested(axes, archive, grid, limits, labels)
    elif count == 1:
        found = draw_intervals(axes, archive, limits, labels, fitness_label)
    else:
        found = draw_tessellation(axes, archive, limits, labels)
    return [axes], found
