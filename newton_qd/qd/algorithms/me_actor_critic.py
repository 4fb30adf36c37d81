"""MAP-Elites with actors that learn by the gradient of the physics, for ``evolve``."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.gradient_options import differentiable
from newton_qd.qd.algorithms.parts import Algorithm, Parts, isoline_emitter, settings
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.emitters.actor_critic_learner import (
    ActorCritic,
    ActorCriticSettings,
    measure_of,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticOptions(ActorCriticSettings):
    """Options of MAP-Elites with actors that learn by the gradient of the physics.

    Attributes:
        actors: Number of actors.
        branches: Times in a generation that actors have offspring.
        copies: Offspring of an actor then; the rest of the generation are iso+line
            variations.
        updates: Updates of an actor between two of these times.
        steered: Share of the actors that follow directions of the descriptor [-].
        fitness: Weight of the reward of these [-].
        lifetime: Generations after which these begin again.
        smooth_width: As in ``FlowOptions``.
        initial_scale: As in ``FlowOptions``.
    """

    actors: int = 2
    branches: int = 2
    copies: int = 8
    updates: int = 1
    steered: float = 0.5
    fitness: float = 0.1
    lifetime: int = 10
    smooth_width: float = 0.1
    initial_scale: float = 1.0

    def episodes(self, config: EvolveConfig) -> int:
        """Episodes that the control steps of a generation's updates amount to."""
        updates = self.actors * self.branches * self.updates
        return -(-updates * self.worlds * self.window // config.episode_length)


def _options(config: EvolveConfig) -> ActorCriticOptions:
    """Options of a run."""
    return settings(ActorCriticOptions, config)


def _me_actor_critic(parts: Parts) -> Any:
    """MAP-Elites with the policies of actors that learn over short horizons."""
    from qdax.core.emitters.multi_emitter import MultiEmitter

    from newton_qd.qd.emitters.actor_critic import ActorCriticEmitter

    config, policy = parts.config, parts.policy
    options = _options(config)
    task = differentiable(parts.task, options.smooth_width)
    method = ActorCritic(
        task.env,
        lambda weights, obs: policy.apply(policy.unravel(weights), obs),
        measure_of(task),
        config.episode_length,
        options,
    )
    emitter = ActorCriticEmitter(
        method,
        task.env.reset(parts.reset_key),
        actors=options.actors,
        branches=options.branches,
        copies=options.copies,
        updates=options.updates,
        steered=options.steered,
        fitness=options.fitness,
        lifetime=options.lifetime,
        measures=task.descriptor_length,
    )
    rest = config.batch_size - emitter.batch_size
    if rest < 0:
        raise ConfigError(
            f"options: actors = {options.actors} times branches = {options.branches} "
            f"times copies = {options.copies} are more than batch_size = "
            f"{config.batch_size}"
        )
    if not rest:
        return emitter
    return MultiEmitter((emitter, isoline_emitter(config, rest)))


def _actor_critic_episodes(config: EvolveConfig) -> int:
    return _options(config).episodes(config)


def _actor_critic_scale(config: EvolveConfig) -> float:
    return _options(config).initial_scale


ME_ACTOR_CRITIC = Algorithm(
    _me_actor_critic,
    evaluations=lambda config: config.batch_size + _actor_critic_episodes(config),
    gradients=_actor_critic_episodes,
    initial_scale=_actor_critic_scale,
)
"""Its row of the table of algorithms."""
