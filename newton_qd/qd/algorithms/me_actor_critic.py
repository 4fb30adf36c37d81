"""MAP-Elites with actors that learn over short windows."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.checks import message
from newton_qd.qd.algorithms.climbing import CLIMBING, ClimbingOptions, ascent_emitter
from newton_qd.qd.algorithms.episode_learning import (
    EpisodeLearningOptions,
    episode_learning,
)
from newton_qd.qd.algorithms.gradient_options import MAZES, initial_scale
from newton_qd.qd.algorithms.learning import LearningOptions, learning_method
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext, batch_and
from newton_qd.qd.algorithms.variation import with_isoline
from newton_qd.qd.config import ConfigError, EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCriticOptions(LearningOptions, EpisodeLearningOptions, ClimbingOptions):
    """Options of MAP-Elites with actors that learn with gradients of the physics.

    Attributes:
        actors: Number of actors.
        branches: Times per generation that each actor produces offspring.
        copies: Offspring of an actor each time; the rest of the generation are
            iso+line variations.
        updates: Updates of an actor before each production of offspring.
        steered: Share of the actors that follow directions of the descriptor [-].
        fitness: Weight of the reward of steered actors [-].
        lifetime: Generations after which a steered actor restarts from a random elite.
        to_empty: Share of the steered actors whose direction leads from their elite to
            a cell without one, once they restart [-]; the others have a random one.
    """

    actors: int = 2
    branches: int = 2
    copies: int = 8
    updates: int = 1
    steered: float = 0.5
    fitness: float = 0.1
    lifetime: int = 10
    to_empty: float = 0.0

    def episodes(self, config: EvolveConfig) -> int:
        """Returns the differentiated control steps of a generation, in episodes.

        If actors learn from windows first and then from episodes, it is the larger
        number of the two.
        """
        times = self.actors * self.branches * self.worlds
        learnt = -(-times * self.updates * self.window // config.episode_length)
        if self.episodes_after:
            learnt = max(learnt, times * self.episode_updates)
        return learnt + self.climbing_episodes


# To walk far in any direction takes many updates.
_LONG = {"lifetime": 60}
# In a maze, an actor that maximizes the reward learns to fall at once.
_STEERED = {"steered": 1.0, "fitness": 0.0, **_LONG}
_ACTORS = {"ant_omni": _LONG, **dict.fromkeys(MAZES, _STEERED)}


def _make(context: EmitterContext, options: ActorCriticOptions) -> Any:
    """MAP-Elites with the policies of actors that learn over short windows.

    Raises:
        ConfigError: The actors have more offspring than a generation can contain.
    """
    from newton_qd.qd.emitters import ActorCriticEmitter

    config, (task, method) = context.config, learning_method(context, options)
    emitter = ActorCriticEmitter(
        method,
        task.env.reset(context.reset_key),
        actors=options.actors,
        branches=options.branches,
        copies=options.copies,
        updates=options.updates,
        steered=options.steered,
        fitness=options.fitness,
        lifetime=options.lifetime,
        measures=task.descriptor_length,
        later=episode_learning(context.task, options, method),
        to_empty=options.to_empty,
    )
    if emitter.batch_size > config.batch_size:
        given = options.actors, options.branches, options.copies
        allowed = f"at most batch_size = {config.batch_size} as their product"
        name = "options: actors, branches, copies"
        raise ConfigError(message(name, given, allowed))
    if not options.climbers:
        return with_isoline(emitter, config)
    rest = config.batch_size - emitter.batch_size
    return with_isoline(emitter, config, ascent_emitter(context, options, rest))


def _gradients(config: EvolveConfig, options: ActorCriticOptions) -> int:
    return options.episodes(config)


ME_ACTOR_CRITIC = AlgorithmSpec(
    name="me-actor-critic",
    summary="MAP-Elites with actors that learn over short windows from gradients of "
    "the physics; some actors increase fitness, others move along directions of the "
    "descriptor; a part of the offspring lies between actors and elites",
    make=_make,
    options=ActorCriticOptions,
    tuned={
        name: {**_ACTORS.get(name, {}), **CLIMBING.get(name, {})}
        for name in (*_ACTORS, "halfcheetah_uni")
    },
    evaluations=batch_and(_gradients),
    gradients=_gradients,
    initial_scale=initial_scale,
)
