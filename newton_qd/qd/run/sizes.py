"""The memory that a run needs at least, from its settings."""

from __future__ import annotations

import itertools
import math
from typing import Any

from newton_qd import memory
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.task import Task
from newton_qd.wrappers.vector import state_bytes

_WEIGHT = 4  # bytes of a weight of a policy
# Smaller batches are not worth the time to trace a reset.
_LARGE = 10_000


def check_memory(config: EvolveConfig, task: Task, device: Any) -> None:
    """Checks that the population and the archive of a run can fit in memory.

    Args:
        config: Settings with a grid or a number of centroids.
        task: Task of the run.
        device: JAX device of the run; ``None``: JAX's default device.

    Raises:
        ConfigError: They cannot.
    """
    policy = _WEIGHT * _policy_size(config, task)
    cells = config.centroids or math.prod(config.grid or (1,))
    # parents, their children, and the children that the archive compares
    needed = (3 * config.batch_size + cells) * policy
    if config.batch_size > _LARGE:
        needed += config.batch_size * state_bytes(task.env)
    given = (config.batch_size, config.hidden, cells)
    name = "batch_size, hidden, cells"
    most = memory.limit_here() if device is None else memory.limit(device)
    memory.check(name, given, needed, most, ConfigError)


def _policy_size(config: EvolveConfig, task: Task) -> int:
    """Returns the number of weights of a policy."""
    if task.network is not None:
        return policy_for(task, config.hidden).size
    # without making the network, which may be too large
    widths = (task.env.observation_size, *config.hidden, task.env.action_size)
    return sum((before + 1) * after for before, after in itertools.pairwise(widths))
