"""What it costs an individual if its episodes end with different descriptors."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.scoring.task import Task


@dataclasses.dataclass(frozen=True)
class Scatter:
    r"""The price of scattered descriptors, for ``robust_scoring``.

    An individual whose episodes end far from each other does not fill its cell, because
    the next episode ends elsewhere. So its fitness f counts as

    .. math:: \frac{f + o}{1 + (\sigma / w)^2} - o.

    Here :math:`\sigma` is the scatter: the root mean square, over the episodes, of the
    distance of their descriptors from the individual's mean or median. :math:`w` is the
    width, and :math:`o` the offset. A fitness below :math:`-o` stays as it is.

    How much reproducibility is worth against fitness is a choice; Flageat et al. 2024,
    "Exploring the Performance-Reproducibility Trade-off in Quality-Diversity", compare
    other ways to make it.

    Attributes:
        width: Scatter that halves the fitness with offset, in units of the descriptor.
        offset: Number that makes fitnesses positive.

    Raises:
        ValueError: The width is not positive and finite, or the offset is not finite.
    """

    width: float
    offset: float

    def __post_init__(self) -> None:
        """Checks both numbers."""
        checks.number("width", self.width, above=0)
        checks.number("offset", self.offset)

    def counted(
        self, fitnesses: jax.Array, descriptors: jax.Array, middle: jax.Array
    ) -> jax.Array:
        """Returns the fitnesses (N,) that count.

        Args:
            fitnesses: (N,) mean or median fitness of each individual.
            descriptors: (starts, N, D) descriptors of its episodes.
            middle: (N, D) mean or median of them.
        """
        square = jnp.zeros_like(fitnesses)
        # a reduction of XLA could depend on the size of the batch
        for found in descriptors:
            for axis in range(found.shape[-1]):
                square = square + ((found[:, axis] - middle[:, axis]) / self.width) ** 2
        share = 1 / (1 + square / len(descriptors))
        positive = fitnesses + self.offset
        return jnp.where(positive > 0, positive * share - self.offset, fitnesses)


def scatter_of(config: EvolveConfig, task: Task) -> Scatter | None:
    """Returns the price that the settings ask for; ``None``: none.

    The width is ``config.scatter`` times the edge of a cube with the volume of a cell:
    (volume of the descriptor's range / cells) ** (1 / D).

    Args:
        config: Settings with a grid or a number of centroids.
        task: Task to solve.

    Raises:
        ConfigError: There is one start state, so nothing is scattered.
    """
    if not config.scatter:
        return None
    if config.starts == 1:
        allowed = "0, or more than one start state (starts)"
        raise ConfigError(message("scatter", config.scatter, allowed))
    lowest, highest = (np.asarray(x, np.float64) for x in task.limits)
    cells = config.centroids or math.prod(config.grid or (1,))
    width = float((np.prod(highest - lowest) / cells) ** (1 / len(lowest)))
    offset = float(task.qd_offset(config.episode_length))
    return Scatter(width=config.scatter * width, offset=offset)
