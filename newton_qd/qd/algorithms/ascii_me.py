"""ASCII-ME, and its operator with exact gradients."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.qd.algorithms.gradient_options import SHORT, WINDOW
from newton_qd.qd.algorithms.options import Options
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext, batch_and
from newton_qd.qd.algorithms.variation import parents_in, with_isoline
from newton_qd.qd.config import EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class InterpolationOptions(Options):
    """Options of the ASCII operator.

    Attributes:
        share: Share of a generation from the operator [-]; the rest are iso+line
            variations.
        epochs: Steps of Adam for each offspring.
        deviation: Standard deviation of the policy as a normal distribution [-].
    """

    share: float = 0.5
    epochs: int = 32
    deviation: float = 2.0

    def settings(self, **more: float) -> Any:
        """Returns the settings of the operator.

        Args:
            **more: Other settings of ``Interpolation``.

        Raises:
            ValueError: A value is out of its range.
        """
        from newton_qd.qd.emitters.behaviors import Interpolation

        return Interpolation(epochs=self.epochs, deviation=self.deviation, **more)

    def offspring(self, config: EvolveConfig) -> int:
        """Returns the number of offspring of the operator in a generation.

        Raises:
            ConfigError: The share is out of its range, or too small.
        """
        return parents_in(config, self.share, 1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AsciiMEOptions(InterpolationOptions):
    """Options of ASCII-ME (Mitsides, Faldor and Cully 2025).

    Attributes:
        learning_rate: Learning rate of Adam [-].
        discount: Discount of a control step [-].
        clip_ratio: Smallest change of the likelihood of an action at which a policy
            moves no further away from the action [-].
    """

    learning_rate: float = 3e-3
    discount: float = 0.99
    clip_ratio: float = 0.2


def _make(context: EmitterContext, options: AsciiMEOptions) -> Any:
    """ASCII-ME: half of the offspring interpolate between behaviors."""
    from newton_qd.qd.emitters import AsciiEmitter

    config = context.config
    emitter = AsciiEmitter(
        context.policy.of_weights,
        options.settings(clip=options.clip_ratio),
        batch_size=options.offspring(config),
        episode_length=config.episode_length,
        rate=options.learning_rate,
        discount=options.discount,
    )
    return with_isoline(emitter, config)


ASCII_ME = AlgorithmSpec(
    name="ascii-me",
    summary="ASCII-ME: half of the offspring move towards the actions of another "
    "individual where these had a higher return, and away from them elsewhere",
    make=_make,
    options=AsciiMEOptions,
    transitions=True,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExactAsciiMEOptions(InterpolationOptions):
    """Options of ASCII-ME with exact gradients.

    Attributes:
        branches: Offspring of each parent, which share one gradient.
        window: Control steps after which the gradient is cut; 0: never.
        clip: Largest norm of the adjoint of a state; 0: no limit.
        reach: Largest change of an action that the operator aims at [-].
        slowest: Smallest learning rate of Adam [-].
        fastest: Largest learning rate of Adam [-].
        samples: Steps of the episode that an offspring learns from; 0: all.
    """

    epochs: int = 8
    branches: int = 8
    window: int = WINDOW
    clip: float = 100.0
    reach: float = 0.3
    slowest: float = 3e-5
    fastest: float = 3e-3
    samples: int = 64

    def parents(self, config: EvolveConfig) -> int:
        """Returns the number of parents with a gradient in each generation.

        Raises:
            ConfigError: A generation is too small, or a value is out of its range.
        """
        return parents_in(config, self.share, self.branches)


def _make_exact(context: EmitterContext, options: ExactAsciiMEOptions) -> Any:
    """ASCII-ME with the exact derivative of the return with respect to actions."""
    from newton_qd.gradients import Episode, GradientOptions
    from newton_qd.qd.emitters import ExactAsciiEmitter
    from newton_qd.qd.scoring.rollout import make_scoring_function

    config, task, key = context.config, context.task, context.reset_key
    length = config.episode_length
    score = make_scoring_function(task, context.policy, length, transitions=True)
    plan = Episode(
        task.env,
        episode_length=length,
        options=GradientOptions(
            window=options.window or None,
            clip=options.clip or None,
            checkpoint_every=None,
        ),
    )
    emitter = ExactAsciiEmitter(
        context.policy.of_weights,
        lambda genotypes, _: score(genotypes, key)[2]["transitions"],
        lambda actions, _: plan.gradient(actions, key),
        options.settings(),
        parents=options.parents(config),
        branches=options.branches,
        reach=options.reach,
        rates=(options.slowest, options.fastest),
        samples=options.samples or None,
    )
    return with_isoline(emitter, config)


def _gradients(config: EvolveConfig, options: ExactAsciiMEOptions) -> int:
    return options.parents(config)


def _from_one_start(config: EvolveConfig, options: ExactAsciiMEOptions) -> int:
    """Returns the number of episodes of parents: for actions, and differentiated."""
    return 2 * options.parents(config)


ASCII_ME_EXACT = AlgorithmSpec(
    name="ascii-me-exact",
    summary="ASCII-ME with exact gradients: half of the offspring move towards actions "
    "that raise the return by the gradient of the physics over short windows",
    make=_make_exact,
    options=ExactAsciiMEOptions,
    tuned={"halfcheetah_uni": SHORT},
    evaluations=batch_and(_from_one_start),
    gradients=_gradients,
    from_one_start=_from_one_start,
)
