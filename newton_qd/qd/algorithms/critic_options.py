"""Options of QDax's emitters with a critic."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.algorithms.options import Options
from newton_qd.qd.config import ConfigError, EvolveConfig

if TYPE_CHECKING:  # importing a list of algorithms imports no JAX
    from newton_qd.qd.scoring.rollout import Policy


@dataclasses.dataclass(frozen=True, kw_only=True)
class CriticOptions(Options):
    """Options of an emitter with a critic, with the names of QDax.

    Attributes:
        num_critic_training_steps: Updates of the critic in a generation.
        num_pg_training_steps: Updates of each policy that follows the critic.
        replay_buffer_size: Transitions in the replay buffer, also in checkpoints.
        critic_hidden_layer_size: Widths of the critic's hidden layers.
        critic_learning_rate: Learning rate of the critic [-].
        policy_learning_rate: Learning rate of policies that follow the critic [-].
        noise_clip: Limit of the noise on the actions of the critic's targets [-].
        policy_noise: Standard deviation of this noise [-].
        discount: Discount of a control step [-].
        reward_scaling: Factor of the rewards [-].
        batch_size: Transitions of one update.
        soft_tau_update: Share of the new weights in an update of target networks [-].
        policy_delay: Updates of the critic for each update of its greedy actor.
    """

    num_critic_training_steps: int = 300
    num_pg_training_steps: int = 100
    # QDax's default is a million. Each checkpoint contains the buffer.
    replay_buffer_size: int = 100_000
    critic_hidden_layer_size: tuple[int, ...] = (256, 256)
    critic_learning_rate: float = 3e-4
    policy_learning_rate: float = 1e-3
    noise_clip: float = 0.5
    policy_noise: float = 0.2
    discount: float = 0.99
    reward_scaling: float = 1.0
    batch_size: int = 256
    soft_tau_update: float = 0.005
    policy_delay: int = 2

    def check(self) -> None:
        """Checks the values with which a critic would grow without limit.

        Raises:
            ValueError: A value is out of its range.
        """
        checks.number("discount", self.discount, most=1)
        checks.number("soft_tau_update", self.soft_tau_update, most=1)


def require_buffer(config: EvolveConfig, size: int) -> None:
    """Checks that the replay buffer can hold the steps of a generation.

    Raises:
        ConfigError: It is too small.
    """
    steps = config.batch_size * config.starts * config.episode_length
    if size < steps:
        allowed = f"integers from {steps} (batch_size * starts * episode_length)"
        raise ConfigError(message("options: replay_buffer_size", size, allowed))


def require_linen(config: EvolveConfig, policy: Policy) -> None:
    """Checks that the policy is a module of Flax linen, as QDax's emitters need.

    Raises:
        ConfigError: It is another network.
    """
    if policy.network is None:
        why = "which trains a module of Flax linen"
        allowed = "a task whose network is None or such a module, or another algorithm"
        raise ConfigError(message("algorithm", config.algorithm, allowed, why=why))


def require_batch_size(config: EvolveConfig, name: str, value: int | None) -> None:
    """Checks that an option does not change the size of a generation.

    Raises:
        ConfigError: The value is given, and differs from the size of a generation.
    """
    if value not in (None, config.batch_size):
        allowed = f"batch_size ({config.batch_size})"
        raise ConfigError(message(f"options: {name}", value, allowed))
