"""prototype."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.gradient_options import initial_scale
from newton_qd.qd.algorithms.learning import LearningOptions, learning_method
from newton_qd.qd.algorithms.me_actor_critic import ActorCriticOptions
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.algorithms.variation import with_isoline
from newton_qd.qd.config import EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class ValueGradientOptions(ActorCriticOptions):
    """Options.

    Attributes:
        parents: parents.
        steps: steps.
        snapshots: snapshots.
        elite_rate: rate.
        elite_noise: noise.
        normalized: n.
        random_starts: r.
    """

    actors: int = 0
    parents: int = 256
    steps: int = 4
    snapshots: int = 1
    elite_rate: float = 0.002
    elite_noise: float = 0.1
    elite_discount: float = 0.99
    normalized: bool = False
    random_starts: bool = True

    def episodes(self, config: EvolveConfig) -> int:
        own = -(-self.parents * (1 + self.steps) * 256 // config.episode_length)
        return own + (super().episodes(config) if self.actors else 0)


def _make(context: EmitterContext, options: ValueGradientOptions) -> Any:
    from qdax.core.emitters.multi_emitter import MultiEmitter

    from newton_qd.qd.emitters import ActorCriticEmitter
    from newton_qd.qd.emitters.value_gradient import ValueGradientEmitter

    config, (task, method) = context.config, learning_method(context, options)
    own = dataclasses.replace(
        options,
        rate=options.elite_rate,
        noise=options.elite_noise,
        discount=options.elite_discount,
    )
    first = task.env.reset(context.reset_key)
    emitter = ValueGradientEmitter(
        dataclasses.replace(method, settings=own),
        context.task.limits,
        parents=options.parents,
        updates=options.steps,
        snapshots=options.snapshots,
        normalized=options.normalized,
        random_starts=options.random_starts,
        first=first,
    )
    if options.actors:
        other = ActorCriticEmitter(
            method,
            first,
            actors=options.actors,
            branches=options.branches,
            copies=options.copies,
            updates=options.updates,
            steered=options.steered,
            fitness=options.fitness,
            lifetime=options.lifetime,
            measures=task.descriptor_length,
        )
        emitter = MultiEmitter((emitter, other))
    return with_isoline(emitter, config)


ME_VALUE_GRADIENT = AlgorithmSpec(
    name="me-value-gradient",
    summary="prototype",
    make=_make,
    options=ValueGradientOptions,
    evaluations=lambda c, o: c.batch_size + o.episodes(c),
    gradients=lambda c, o: o.episodes(c),
    initial_scale=initial_scale,
)
