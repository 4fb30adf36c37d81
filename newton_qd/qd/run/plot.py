"""Pictures of an archive: nested heat maps for grids, scatter plots otherwise."""

from __future__ import annotations

import io
import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.extras import require_extra
from newton_qd.qd.run.archive import Archive

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from newton_qd.qd.scoring.task import Task

_NESTED_DIMENSIONS = 4
_EMPTY = "0.88"


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
    best = f"{archive.fitnesses.max():.1f}" if archive.filled.any() else "none"
    title = (
        f"{config.env_name}: MAP-Elites after {iteration} generations, "
        f"seed {config.seed}\n{archive.filled.sum()} of {len(archive.filled)} cells, "
        f"best fitness {best}"
    )
    figure = plot_archive(
        archive,
        grid=config.grid,
        limits=task.limits,
        labels=task.labels,
        title=title,
        fitness_label=f"fitness: return over {config.episode_length} control steps",
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()


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

    A grid of up to four dimensions becomes one heat map. Dimensions 1 and 2 select a
    block, and dimensions 3 and 4 select a cell inside the block. All other archives
    become one scatter plot for each pair of dimensions.

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
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    figure.suptitle(title)
    if grid is not None and len(grid) <= _NESTED_DIMENSIONS:
        axes = [figure.add_subplot()]
        mappable = _draw_nested(axes[0], archive, grid, limits, labels)
    else:
        axes, mappable = _draw_pairs(figure, archive, limits, labels)
    figure.colorbar(mappable, ax=axes, label=fitness_label, shrink=0.85, pad=0.03)
    return figure


def _draw_nested(
    axes: Axes,
    archive: Archive,
    grid: tuple[int, ...],
    limits: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, ...],
) -> Any:
    """Draws a grid; odd dimensions run along x, even ones along y."""
    from matplotlib import colormaps

    columns, rows = tuple(range(len(grid)))[0::2], tuple(range(len(grid)))[1::2]
    cells = _grid_indices(archive.centroids, grid, limits)
    width = math.prod(grid[d] for d in columns)
    height = math.prod(grid[d] for d in rows)
    image = np.full((height, width), np.nan)
    x, y = _nest(cells, columns, grid), _nest(cells, rows, grid)
    image[y, x] = np.where(archive.filled, archive.fitnesses, np.nan)
    mappable = axes.imshow(
        np.ma.masked_invalid(image),
        origin="lower",
        extent=(0, width, 0, height),
        aspect="auto" if height == 1 else width / height,
        interpolation="nearest",
        cmap=colormaps["viridis"].with_extremes(bad=_EMPTY),
    )
    if not archive.filled.any():
        mappable.set_clim(0.0, 1.0)
    for name, dimensions in (("x", columns), ("y", rows)):
        if dimensions:
            _label_nested(axes, name, dimensions, grid, limits, labels)
        else:
            axes.set_yticks([])
    return mappable


def _grid_indices(
    centroids: np.ndarray, grid: tuple[int, ...], limits: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Returns the grid indices (cells, D) of cells in any order."""
    low, high = limits
    counts = np.asarray(grid)
    return np.rint((centroids - low) / (high - low) * counts - 0.5).astype(int)


def _nest(
    cells: np.ndarray, dimensions: tuple[int, ...], grid: tuple[int, ...]
) -> np.ndarray:
    """Returns positions (cells,) on an axis on which later dimensions vary faster."""
    place = np.zeros(len(cells), int)
    for dimension in dimensions:
        place = place * grid[dimension] + cells[:, dimension]
    return place


def _label_nested(
    axes: Axes,
    name: str,
    dimensions: tuple[int, ...],
    grid: tuple[int, ...],
    limits: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, ...],
) -> None:
    """Labels the outer dimension on one side and the inner dimension on the other."""
    low, high = limits
    outer = dimensions[0]
    inner = dimensions[1] if len(dimensions) > 1 else None
    block = 1 if inner is None else grid[inner]
    edges = np.arange(grid[outer] + 1)
    values = low[outer] + edges / grid[outer] * (high[outer] - low[outer])
    every = max(1, len(edges) // 8)
    axis = axes.xaxis if name == "x" else axes.yaxis
    axis.set_ticks(
        (edges * block)[::every], [f"{value:.3g}" for value in values[::every]]
    )
    if inner is None:
        axis.set_label_text(labels[outer])
        return
    axis.set_label_text(f"{labels[outer]} (choice of block)")
    draw_line = axes.axvline if name == "x" else axes.axhline
    for edge in edges[1:-1] * block:
        draw_line(edge, color="white", linewidth=3.0)
    twin = axes.secondary_xaxis("top") if name == "x" else axes.secondary_yaxis("right")
    twin_axis = twin.xaxis if name == "x" else twin.yaxis
    span = f"{low[inner]:.3g} \N{RIGHTWARDS ARROW} {high[inner]:.3g}"
    centres = (edges[:-1] + 0.5) * block
    twin_axis.set_ticks(centres, [span] * len(centres), fontsize=8)
    twin_axis.set_tick_params(length=0, labelrotation=0 if name == "x" else 90)
    for label in twin_axis.get_ticklabels():
        label.set_verticalalignment("center" if name == "y" else "bottom")
    twin_axis.set_label_text(f"{labels[inner]} (inside each block)")


def _draw_pairs(
    figure: Figure,
    archive: Archive,
    limits: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, ...],
) -> tuple[list[Axes], Any]:
    """Draws the descriptors of all individuals, one panel per pair of dimensions."""
    low, high = limits
    points = archive.descriptors[archive.filled]
    fitnesses = archive.fitnesses[archive.filled]
    if len(labels) == 1:
        points = np.column_stack([points, fitnesses])
        labels = (*labels, "fitness")
        span = (fitnesses.min(), fitnesses.max()) if len(fitnesses) else (0.0, 1.0)
        low, high = np.append(low, span[0]), np.append(high, span[1])
    pairs = list(itertools.combinations(range(len(labels)), 2))
    columns = math.ceil(math.sqrt(len(pairs)))
    panels = []
    mappable = None
    # The best individuals are on top, because they are the most interesting.
    order = np.argsort(fitnesses)
    for index, (a, b) in enumerate(pairs):
        axes = figure.add_subplot(math.ceil(len(pairs) / columns), columns, index + 1)
        mappable = axes.scatter(
            points[order, a], points[order, b], c=fitnesses[order], s=12
        )
        margin_a, margin_b = 0.03 * (high[a] - low[a]), 0.03 * (high[b] - low[b])
        axes.set_xlim(low[a] - margin_a, high[a] + margin_a)
        axes.set_ylim(low[b] - margin_b, high[b] + margin_b or None)
        axes.set_xlabel(labels[a])
        axes.set_ylabel(labels[b])
        panels.append(axes)
    return panels, mappable
