"""Pictures of archives whose cells are a grid: bars, and nested heat maps."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.plot_colours import EMPTY, draw_bars, fitness_colours, round_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Limits = tuple[np.ndarray, np.ndarray]


def grid_indices(
    centroids: np.ndarray, grid: tuple[int, ...], limits: Limits
) -> np.ndarray:
    """Returns the grid indices (cells, D) of cells in any order."""
    low, high = limits
    counts = np.asarray(grid)
    return np.rint((centroids - low) / (high - low) * counts - 0.5).astype(int)


def draw_line(
    axes: Axes,
    archive: Archive,
    grid: tuple[int, ...],
    limits: Limits,
    labels: tuple[str, ...],
    fitness_label: str,
) -> Any:
    """Draws a grid of one dimension as bars."""
    low, high = float(limits[0][0]), float(limits[1][0])
    order = np.argsort(archive.centroids[:, 0])
    edges = np.linspace(low, high, grid[0] + 1)
    return draw_bars(axes, archive.fitnesses[order], edges, labels[0], fitness_label)


def draw_nested(
    axes: Axes,
    archive: Archive,
    grid: tuple[int, ...],
    limits: Limits,
    labels: tuple[str, ...],
) -> Any:
    """Draws a grid; odd dimensions run along x, even ones along y."""
    columns, rows = tuple(range(len(grid)))[0::2], tuple(range(len(grid)))[1::2]
    cells = grid_indices(archive.centroids, grid, limits)
    width = math.prod(grid[d] for d in columns)
    height = math.prod(grid[d] for d in rows)
    image = np.full((height, width), np.nan)
    x, y = _nest(cells, columns, grid), _nest(cells, rows, grid)
    image[y, x] = np.where(archive.filled, archive.fitnesses, np.nan)
    colours = fitness_colours(archive.fitnesses)
    mappable = axes.imshow(
        np.ma.masked_invalid(image),
        origin="lower",
        extent=(0, width, 0, height),
        aspect=width / height,
        interpolation="nearest",
        cmap=colours.cmap.with_extremes(bad=EMPTY),
        norm=colours.norm,
    )
    for name, dimensions in (("x", columns), ("y", rows)):
        _label_nested(axes, name, dimensions, grid, limits, labels)
    return mappable


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
    axis = axes.xaxis if name == "x" else axes.yaxis
    values, texts = round_ticks(low[outer], high[outer])
    share = (values - low[outer]) / (high[outer] - low[outer])
    axis.set_ticks(share * grid[outer] * block, texts)
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
