"""Whether saved results belong to a task, as far as their arrays show it."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.archive import Archive
from newton_qd.qd.run.cells import cell_centroids
from newton_qd.qd.run.checkpoint import Checkpoint


def require_same_task(
    name: str,
    stored: Archive | Checkpoint,
    config: EvolveConfig,
    limits: tuple[np.ndarray, np.ndarray],
    size: int,
) -> None:
    """Checks that saved results are those of a task.

    A module may have another environment of the same name than before.

    Args:
        name: Name of the results in the error.
        stored: The results.
        config: Settings with a grid or a number of centroids.
        limits: Lowest and highest descriptor of the task, (D,) each.
        size: Weights of a policy for the task.

    Raises:
        ConfigError: Policies have another size, or the cells are those of another
            descriptor or of other limits.
    """
    if stored.genotypes.shape[1] != size:
        given = Fact(f"genotypes of {stored.genotypes.shape[1]} numbers")
        allowed = f"{size}, the weights of a policy of {config.env_name!r} with "
        allowed += f"hidden layers {config.hidden}"
        raise ConfigError(message(name, given, allowed))
    cells, (low, high) = stored.centroids, limits
    if cells.shape[1] == len(low) and _fit(cells, config, limits):
        return
    shown = [
        f"from {_line(least)} to {_line(most)}"
        for least, most in (_box(cells), (low, high))
    ]
    given = Fact(f"centres of cells {shown[0]}")
    allowed = f"cells {shown[1]}, the limits of the task; start a new run for another "
    allowed += "descriptor; a run with a task_factory needs it again"
    raise ConfigError(message(name, given, allowed))


def changed_elites(
    stored: Archive | Checkpoint,
    score: Callable[[jax.Array], tuple[jax.Array, jax.Array]],
    count: int,
) -> tuple[int, int]:
    """Evaluates elites again, at most as many as there are in a generation.

    Args:
        stored: The results.
        score: Maps genotypes (count, size) to fitnesses (count,) and descriptors
            (count, D), from the start states of the run.
        count: Individuals of a generation.

    Returns:
        How many of them have another fitness or descriptor, and how many there are.
    """
    cells = np.flatnonzero(stored.fitnesses > -np.inf)[:count]
    rows = np.resize(cells, count)  # repeats cells, to have one size
    fitnesses, found = map(np.asarray, score(jnp.asarray(stored.genotypes[rows])))
    same = fitnesses.astype(stored.fitnesses.dtype) == stored.fitnesses[rows]
    places = found.astype(stored.descriptors.dtype) == stored.descriptors[rows]
    same &= places.all(axis=1)
    return int((~same[: len(cells)]).sum()), len(cells)


def _fit(
    cells: np.ndarray, config: EvolveConfig, limits: tuple[np.ndarray, np.ndarray]
) -> bool:
    """Whether cells (cells, D) are those between the limits.

    Another machine may find another Voronoi tessellation. So its centres must only be
    inside of the limits, and reach them up to about the width of a cell.
    """
    low, high = limits
    slack = 1e-3 * (high - low)
    if config.grid is not None:
        grid = np.asarray(cell_centroids(config, limits, jax.random.key(0)))
        return grid.shape == cells.shape and bool((abs(cells - grid) <= slack).all())
    least, most = _box(cells)
    width = len(cells) ** (-1 / len(low)) * (high - low)
    inside = (least >= low - slack) & (most <= high + slack)
    reach = (least <= low + width) & (most >= high - width)
    return bool((inside & reach).all())


def _box(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest and the highest centre, (D,) each."""
    return cells.min(axis=0), cells.max(axis=0)


def _line(values: np.ndarray) -> str:
    """Returns the text of values (D,), however many they are, in one line."""
    return " ".join(str(values).split())
