"""Pictures of archives whose cells are not a grid: tessellations and scatter plots."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.plot_colours import EMPTY, draw_bars, fitness_colours, round_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Limits = tuple[np.ndarray, np.ndarray]
_NEIGHBOURS = 24  # borders that are cut at once; nearly all cells need no more


def draw_intervals(
    axes: Axes,
    archive: Archive,
    limits: Limits,
    labels: tuple[str, ...],
    fitness_label: str,
) -> Any:
    """Draws a tessellation of one dimension as bars."""
    order = np.argsort(archive.centroids[:, 0])
    centres = archive.centroids[order, 0]
    between = (centres[1:] + centres[:-1]) / 2
    edges = np.concatenate([[limits[0][0]], between, [limits[1][0]]])
    return draw_bars(axes, archive.fitnesses[order], edges, labels[0], fitness_label)


def draw_tessellation(
    axes: Axes, archive: Archive, limits: Limits, labels: tuple[str, ...]
) -> Any:
    """Draws the cells of a Voronoi tessellation of two dimensions."""
    from matplotlib.collections import PolyCollection

    colours = fitness_colours(archive.fitnesses)
    shades = np.asarray(colours.to_rgba(np.where(archive.filled, archive.fitnesses, 0)))
    faces = [
        shade if filled else EMPTY
        for shade, filled in zip(shades, archive.filled, strict=True)
    ]
    low, high = limits
    axes.add_collection(
        PolyCollection(
            voronoi_cells(archive.centroids, limits),
            facecolors=faces,
            edgecolors="white",
            linewidths=0.5,
        )
    )
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_box_aspect(1)
    axes.set_xticks(*round_ticks(low[0], high[0]))
    axes.set_yticks(*round_ticks(low[1], high[1]))
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    return colours


def voronoi_cells(centroids: np.ndarray, limits: Limits) -> list[np.ndarray]:
    """Returns the corners (corners, 2) of each cell of a tessellation in a box.

    Each cell begins as the box. The border with each neighbour cuts a part off, until
    the next neighbour is too far away to reach any corner.

    Args:
        centroids: (cells, 2) centres of the cells.
        limits: Lowest and highest descriptor, (2,) each.
    """
    points = np.asarray(centroids, np.float64)
    (left, bottom), (right, top) = (np.asarray(x, np.float64) for x in limits)
    box = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    cells = []
    for index, point in enumerate(points):
        squares = ((points - point) ** 2).sum(axis=1)
        squares[index] = np.inf
        order = _nearest_first(squares)
        corners = box
        for other in order:
            reach = ((corners - point) ** 2).sum(axis=1).max()
            if squares[other] >= 4 * reach:  # infinite for the cell itself
                break
            corners = _cut(corners, point, points[other])
        cells.append(corners)
    return cells


def _nearest_first(squares: np.ndarray) -> itertools.chain[int]:
    """Yields indices by distance; sorts the far ones only if they are asked for."""
    count = min(_NEIGHBOURS, len(squares) - 1)
    near = np.argpartition(squares, count)[:count] if count else np.zeros(0, int)
    near = near[np.argsort(squares[near])]
    return itertools.chain(
        near.tolist(), (i for i in np.argsort(squares)[len(near) :].tolist())
    )


def _cut(corners: np.ndarray, point: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns the part of a convex polygon that is nearer to one point than another."""
    normal = other - point
    height = (corners - (point + other) / 2) @ normal
    inside = height <= 0
    if inside.all():
        return corners
    kept = []
    for i in range(len(corners)):
        j = (i + 1) % len(corners)
        if inside[i]:
            kept.append(corners[i])
        if inside[i] != inside[j]:
            share = height[i] / (height[i] - height[j])
            kept.append(corners[i] + share * (corners[j] - corners[i]))
    return np.asarray(kept).reshape(-1, 2)


def draw_pairs(
    figure: Figure,
    archive: Archive,
    limits: tuple[np.ndarray, np.ndarray],
    labels: tuple[str, ...],
) -> tuple[list[Axes], Any]:
    """Draws the descriptors of all individuals, one panel per pair of dimensions."""
    low, high = limits
    points = archive.descriptors[archive.filled]
    fitnesses = archive.fitnesses[archive.filled]
    pairs = list(itertools.combinations(range(len(labels)), 2))
    columns = math.ceil(math.sqrt(len(pairs)))
    panels = []
    colours = fitness_colours(archive.fitnesses)
    # The best individuals are on top, because they are the most interesting.
    order = np.argsort(fitnesses)
    for index, (a, b) in enumerate(pairs):
        axes = figure.add_subplot(math.ceil(len(pairs) / columns), columns, index + 1)
        shades = colours.to_rgba(fitnesses[order])
        axes.scatter(points[order, a], points[order, b], c=shades, s=12)
        margin_a, margin_b = 0.03 * (high[a] - low[a]), 0.03 * (high[b] - low[b])
        axes.set_xlim(low[a] - margin_a, high[a] + margin_a)
        axes.set_ylim(low[b] - margin_b, high[b] + margin_b)
        axes.set_xticks(*round_ticks(low[a], high[a]))
        axes.set_yticks(*round_ticks(low[b], high[b]))
        axes.set_xlabel(labels[a])
        axes.set_ylabel(labels[b])
        panels.append(axes)
    return panels, colours
