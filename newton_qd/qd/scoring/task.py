"""The task of an evolution: an environment, its descriptor and their names."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from newton_qd.checks import listed, message
from newton_qd.qd.config import ConfigError, EvolveConfig


@dataclasses.dataclass(frozen=True)
class Task:
    """A Quality-Diversity task.

    Attributes:
        env: Environment with unbatched ``reset`` and ``step`` and without
            auto-reset.
        descriptor_extractor: Maps ``(data, mask)`` to descriptors (N, D), with
            ``data.state_desc`` (N, T, D) and ``mask`` (N, T) equal to 1 after the
            end of an episode.
        limits: Lowest and highest descriptor, (D,) each.
        labels: D names for the axes of plots.
        reward_offset: Number per control step that makes returns positive, for the QD
            score only.
    """

    env: Any
    descriptor_extractor: Callable[[Any, jax.Array], jax.Array]
    limits: tuple[np.ndarray, np.ndarray]
    labels: tuple[str, ...]
    reward_offset: float

    @property
    def descriptor_length(self) -> int:
        """Number of components of the descriptor."""
        return len(self.labels)


def make_task(config: EvolveConfig) -> Task:
    """Creates the registered task of a configuration.

    Args:
        config: Settings, of which ``env_name`` and ``episode_length`` are used.

    Raises:
        UnknownEnvironment: No environment of this name is registered.
        ConfigError: The environment has no descriptor, no reward offset, or no finite
            limits of its descriptor. Or the grid does not fit the descriptor.
    """
    # imported here, because the registry imports every environment
    import newton_qd

    name = config.env_name
    if name not in newton_qd.registered_envs():
        raise newton_qd.UnknownEnvironment(name, newton_qd.registered_envs())
    tasks = sorted(newton_qd.tables.descriptor_extractor)
    if name not in tasks:
        why = "which has no descriptor"
        raise ConfigError(message("env_name", name, listed(tasks), why=why))
    if name not in newton_qd.tables.reward_offset:
        allowed = "names with one, so pass reward_offset to newton_qd.register"
        why = "which has no reward_offset"
        raise ConfigError(message("env_name", name, allowed, why=why))
    length = _declared_length(name)
    if length is not None:
        config.resolve(length)  # its error comes before the slow part
    env: Any = newton_qd.create(
        name, episode_length=config.episode_length, auto_reset=False
    )
    low, high = (np.asarray(x, np.float32) for x in env.descriptor_limits)
    if not np.all(np.isfinite([low, high])):
        allowed = "finite numbers, such as minval and maxval of XYPositionWrapper"
        given = (low.tolist(), high.tolist())
        raise ConfigError(message(f"descriptor limits of {name!r}", given, allowed))
    return Task(
        env=env,
        descriptor_extractor=newton_qd.tables.descriptor_extractor[name],
        limits=(low, high),
        labels=_labels(env, len(low)),
        reward_offset=float(newton_qd.tables.reward_offset[name]),
    )


def _declared_length(name: str) -> int | None:
    """Returns the length of a descriptor without building its environment.

    ``None``: only the environment knows it.
    """
    from newton_qd import tasks, wrappers

    spec = tasks.ENVIRONMENTS[name]
    found = [
        wrapper.wrapper
        for wrapper in spec.wrappers
        if isinstance(wrapper.wrapper, type)
        and issubclass(wrapper.wrapper, wrappers.DescriptorWrapper)
    ]
    if not found:
        return None
    if issubclass(found[-1], wrappers.FeetContactWrapper):
        return len(spec.feet) if spec.feet else None
    match getattr(found[-1], "limits", None):
        case (tuple() | list() as lowest, _):
            return len(lowest)
    return None  # wrong limits have an error of their own


def _labels(env: Any, length: int) -> tuple[str, ...]:
    if env.state_descriptor_name == "feet_contact":
        return tuple(f"{foot} contact" for foot in env.unwrapped.robot.feet)
    if env.state_descriptor_name == "xy_position" and length == 2:
        return ("final x [m]", "final y [m]")
    return tuple(f"descriptor {index + 1}" for index in range(length))
