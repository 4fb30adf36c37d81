"""MAP-Elites with one actor that is told the target descriptor."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.qd.algorithms.gradient_options import (
    SHORT,
    WINDOW,
    differentiable,
    initial_scale,
    on_robots_that_fall,
)
from newton_qd.qd.algorithms.learning import LearningOptions
from newton_qd.qd.algorithms.options import only_with
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext, batch_and
from newton_qd.qd.algorithms.variation import part_of, with_isoline
from newton_qd.qd.config import ConfigError, EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConditionedOptions(LearningOptions):
    """Options of MAP-Elites with an actor that is told the target descriptor.

    Attributes:
        copies: Share of a generation that are copies of the actor for targets [-].
        between: Share of a generation that lies between the actor and elites [-]; the
            rest are iso+line variations.
        updates: Updates of the actor in a generation.
        empty: Share of the targets that are empty cells [-].
        tolerance: Allowed distance to a target, in units of half of the descriptor's
            extent [-].
        dual_rate: Largest change of a multiplier's logit by one policy [-].
        conditioned: Whether the actor is told its target; if not, it increases the
            return alone.
    """

    worlds: int = 32
    window: int = WINDOW
    rate: float = 1e-3
    actor_trace: float = 0.7
    copies: float = 0.0625
    between: float = 0.1875
    updates: int = 1
    empty: float = only_with("conditioned", 0.5)
    tolerance: float = only_with("conditioned", 0.1)
    dual_rate: float = only_with("conditioned", 0.3)
    conditioned: bool = True

    def numbers(self, config: EvolveConfig) -> tuple[int, int]:
        """Returns the numbers of copies, and of individuals between actor and elites.

        Raises:
            ConfigError: They are more than a generation, or none.
        """
        for name in ("copies", "between"):
            value = getattr(self, name)
            name = f"options: {name}"
            checks.number(name, value, least=0, most=1, error=ConfigError)
        found = tuple(part_of(config, x) for x in (self.copies, self.between))
        if not 1 <= sum(found) <= config.batch_size:
            given = self.copies, self.between
            allowed = f"from 1 to batch_size = {config.batch_size} individuals together"
            raise ConfigError(message("options: copies, between", given, allowed))
        return found[0], found[1]

    def episodes(self, config: EvolveConfig) -> int:
        """Returns the control steps of a generation's updates, counted in episodes."""
        return -(-self.updates * self.worlds * self.window // config.episode_length)


def _make(context: EmitterContext, options: ConditionedOptions) -> Any:
    """MAP-Elites with the policies of an actor that is told the target descriptor.

    Raises:
        ConfigError: The task has a network of its own, or the options do not fit the
            size of a generation.
    """
    from newton_qd.qd.emitters import ActorCritic, ConditionedActorEmitter
    from newton_qd.qd.emitters.aims import AimedEnv, ConditionedPolicy, no_measure
    from newton_qd.qd.emitters.whitening import Whitening

    config = context.config
    if context.task.network is not None:
        why = "which needs the default network"
        allowed = "a task whose network is None, or an algorithm that takes any network"
        raise ConfigError(message("algorithm", config.algorithm, allowed, why=why))
    copies, between = options.numbers(config)
    task = differentiable(context.task, options, options.termination_width)
    env = AimedEnv(task, config.episode_length)
    policy = ConditionedPolicy(context.policy, task.descriptor_length)
    white = Whitening.of(context.policy) if options.whiten else Whitening()
    length = config.episode_length
    emitter = ConditionedActorEmitter(
        ActorCritic(env, policy.act, no_measure, length, options, white),
        env,
        policy,
        task.env.reset(context.reset_key),
        copies=copies,
        between=between,
        updates=options.updates,
        empty=options.empty,
        tolerance=options.tolerance,
        dual_rate=options.dual_rate,
        conditioned=options.conditioned,
    )
    return with_isoline(emitter, config)


def _gradients(config: EvolveConfig, options: ConditionedOptions) -> int:
    return options.episodes(config)


ME_CONDITIONED = AlgorithmSpec(
    name="me-conditioned",
    summary="MAP-Elites with one actor for the whole archive that is told the target "
    "descriptor; it learns over short windows from gradients of the physics, and a "
    "part of the offspring are its policies for cells of the archive",
    make=_make,
    options=ConditionedOptions,
    tuned={"halfcheetah_uni": SHORT, **on_robots_that_fall(rate=3e-4)},
    evaluations=batch_and(_gradients),
    gradients=_gradients,
    takes_faulty=True,
    initial_scale=initial_scale,
)
