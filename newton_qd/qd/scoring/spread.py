"""What it costs an individual if its episodes end with different descriptors."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.scoring.task import Task


@dataclasses.dataclass(frozen=True)
class Spread:
    r"""The price of a spread of descriptors.

    An individual whose episodes end far from each other does not fill its cell: the next
    episode ends elsewhere. So its fitness f counts as

    .. math:: \frac{f + o}{1 + (\sigma / w)^2} - o,

    where :math:`\sigma` is the distance of its descriptors from their mean or median
    (root mean square over the episodes), :math:`w` a width, and :math:`o` the offset
    that makes all fitnesses positive.

    Attributes:
        width: Spread that halves the fitness with offset, in units of the descriptor.
        offset: Number that makes fitnesses positive.
    """

    width: float
    offset: float

    def weighed(
        self, fitnesses: jax.Array, descriptors: jax.Array, middle: jax.Array
    ) -> jax.Array:
        """Returns the fitnesses (N,) that count.

        Args:
            fitnesses: (N,) mean or median fitness of each individual.
            descriptors: (starts, N, D) descriptors of its episodes.
            middle: (N, D) mean or median of them.
        """
        away = jnp.sum((descriptors - middle) ** 2, axis=-1)
        share = 1 / (1 + jnp.mean(away, axis=0) / self.width**2)
        return (fitnesses + self.offset) * share - self.offset


def spread_of(config: EvolveConfig, task: Task) -> Spread | None:
    """Returns the price that the settings ask for; ``None``: none.

    Args:
        config: Settings with a grid or a number of centroids.
        task: Task to solve.
    """
    if not config.spread:
        return None
    lowest, highest = (np.asarray(x, np.float64) for x in task.limits)
    cells = config.centroids or math.prod(config.grid or ())
    width = (np.prod(highest - lowest) / cells) ** (1 / len(lowest))
    offset = task.reward_offset * config.episode_length
    return Spread(width=config.spread * float(width), offset=offset)
