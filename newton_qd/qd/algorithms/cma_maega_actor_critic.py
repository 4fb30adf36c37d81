"""CMA-MAEGA for large policies, with gradients of actors over short windows."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.checks import message
from newton_qd.qd.algorithms.cma_mega import population_of
from newton_qd.qd.algorithms.gradient_options import SHORT, initial_scale
from newton_qd.qd.algorithms.learning import LearningOptions, learning_method
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.config import ConfigError, EvolveConfig

# A fall ends an episode, and a gradient over a window does not see it. Humanoids fall
# too, but slowly.
_SMALL_STEPS = {"rate": 3e-4, "sigma_g": 0.1}


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArborescenceActorOptions(LearningOptions):
    """Options of CMA-MAEGA with actors that learn over short windows.

    Attributes:
        points: Number of solution points that share a generation equally.
        sigma_g: Initial standard deviation of the coefficients of the gradients, which
            have length 1, in units of policy weights [-].
        probes: Updates of a generation that find the gradients of a point. Fitness and
            the D components of the descriptor get equal parts, so it is a multiple of
            1 + D.
        walks: Updates of a generation that move a point.
        restart_period: Restart each point after this many generations; 0: only by its
            restart rule.
        learning_rate: Rate at which the threshold of a cell rises, 0 to 1 [-].
    """

    points: int = 4
    sigma_g: float = 0.3
    probes: int = 30
    walks: int = 4
    restart_period: int = 0
    learning_rate: float = 0.1
    worlds: int = 16
    window: int = 32
    rate: float = 2e-3
    discount: float = 0.99
    actor_trace: float = 0.95
    epochs: int = 4

    def episodes(self, config: EvolveConfig) -> int:
        """Returns the control steps of a generation's updates, counted in episodes."""
        updates = self.points * (self.probes + self.walks)
        return -(-updates * self.worlds * self.window // config.episode_length)


def _make(context: EmitterContext, options: ArborescenceActorOptions) -> Any:
    """CMA-MAEGA as in PPGA, with the short-horizon actor-critic.

    Raises:
        ConfigError: A generation cannot be divided by the number of points, or
            ``probes`` by the number of gradients.
    """
    from newton_qd.qd.emitters import WindowArborescenceEmitter
    from newton_qd.qd.emitters.annealed import OnAnnealedRepertoire

    config, (task, method) = context.config, learning_method(context, options)
    each, rest = divmod(options.probes, 1 + task.descriptor_length)
    if rest or not each:
        why = f"which fitness and {task.descriptor_length} descriptors share equally"
        allowed = f"multiples of {1 + task.descriptor_length}"
        raise ConfigError(message("options: probes", options.probes, allowed, why=why))
    emitter = WindowArborescenceEmitter(
        context.score,
        method,
        task.env.reset(context.reset_key),
        probes=each,
        walks=options.walks,
        sigma_g=options.sigma_g,
        batch_size=population_of(options.points, config),
        num_emitters=options.points,
        restart_period=options.restart_period or None,
    )
    return OnAnnealedRepertoire(
        emitter,
        learning_rate=options.learning_rate,
        # The lowest return with a positive share in the QD score.
        threshold_min=-context.task.qd_offset(config.episode_length),
    )


def _gradients(config: EvolveConfig, options: ArborescenceActorOptions) -> int:
    return options.episodes(config)


def _evaluations(config: EvolveConfig, options: ArborescenceActorOptions) -> int:
    # the solution points are evaluated too, before their offspring
    return config.batch_size + options.points + options.episodes(config)


CMA_MAEGA_ACTOR_CRITIC = AlgorithmSpec(
    name="cma-maega-actor-critic",
    summary="CMA-MAEGA for large policies: gradients of the solution points come from "
    "actors that learn over short windows, and such actors move the points",
    make=_make,
    options=ArborescenceActorOptions,
    varies=False,
    tuned={
        "halfcheetah_uni": SHORT,
        **dict.fromkeys(("hopper_uni", "walker2d_uni"), _SMALL_STEPS),
    },
    evaluations=_evaluations,
    evaluates_first=True,
    gradients=_gradients,
    evaluates=True,
    takes_faulty=True,
    initial_scale=initial_scale,
)
