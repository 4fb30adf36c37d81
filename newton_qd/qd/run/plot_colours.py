"""Parts that all pictures share: colours of fitness, bars, and round ticks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EMPTY = "0.88"
"""Colour of a cell without an elite."""


def fitness_colours(fitnesses: np.ndarray) -> Any:
    """Returns matplotlib's map from fitness to colour, for a colour bar too.

    Args:
        fitnesses: (cells,) fitnesses, ``-inf`` in empty cells.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    finite = fitnesses[np.isfinite(fitnesses)]
    span = (finite.min(), finite.max()) if len(finite) else (0.0, 1.0)
    colours = ScalarMappable(Normalize(*span), colormaps["viridis"])
    colours.set_array(finite)
    return colours


def round_ticks(low: float, high: float) -> tuple[np.ndarray, list[str]]:
    """Returns values (ticks,) with few digits between two limits, and their texts."""
    from matplotlib.ticker import MaxNLocator

    low, high = float(low), float(high)
    locator = MaxNLocator(nbins=7, steps=[1, 2, 2.5, 5, 10])
    values = np.asarray(locator.tick_values(low, high))
    margin = 1e-6 * (high - low)
    values = values[(values >= low - margin) & (values <= high + margin)]
    # + 0.0 turns a negative zero into zero
    return values, [f"{round(value, 12) + 0.0:g}" for value in values]


def draw_bars(
    axes: Axes,
    fitnesses: np.ndarray,
    edges: np.ndarray,
    label: str,
    fitness_label: str,
) -> Any:
    """Draws cells of one dimension as bars as high as their fitness.

    Args:
        axes: Axes to draw into.
        fitnesses: (cells,) fitnesses along the axis, ``-inf`` in empty cells.
        edges: (cells + 1,) borders of the cells.
        label: Name of the descriptor.
        fitness_label: Name of the fitness.
    """
    colours = fitness_colours(fitnesses)
    filled = np.isfinite(fitnesses)
    least, most = colours.get_clim()
    span = (most - least) or max(abs(most), 1.0)
    # A bar from zero shows the fitness; one far from zero, differences of fitness.
    bottom = 0.0 if 0 <= least <= span else least - 0.1 * span
    top = most + 0.05 * span
    widths = np.diff(edges)
    axes.bar(
        edges[:-1][~filled],
        top - bottom,
        widths[~filled],
        bottom=bottom,
        align="edge",
        color=EMPTY,
    )
    axes.bar(
        edges[:-1][filled],
        fitnesses[filled] - bottom,
        widths[filled],
        bottom=bottom,
        align="edge",
        color=colours.to_rgba(fitnesses[filled]),
        edgecolor="white",
        linewidth=0.5,
    )
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(bottom, top)
    axes.set_xticks(*round_ticks(edges[0], edges[-1]))
    axes.set_xlabel(label)
    axes.set_ylabel(fitness_label)
    return colours
