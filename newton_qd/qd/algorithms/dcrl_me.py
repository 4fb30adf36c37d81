"""DCRL-ME of QDax."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, cast

from newton_qd import checks
from newton_qd.checks import listed, message
from newton_qd.qd.algorithms.critic_options import (
    CriticOptions,
    require_buffer,
    require_linen,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.algorithms.variation import isoline, with_own_isoline
from newton_qd.qd.config import ConfigError, EvolveConfig

if TYPE_CHECKING:
    import jax

    from newton_qd.qd.scoring.task import Task


@dataclasses.dataclass(frozen=True, kw_only=True)
class DCRLMEOptions(CriticOptions):
    """Options of DCRL-ME (Faldor et al. 2024); QDax's ``DCRLMEConfig``.

    Attributes:
        ga_batch_size: Iso+line variations in a generation; by default the rest.
        dcrl_batch_size: Individuals that follow the critic; by default a quarter.
        ai_batch_size: Individuals from the actor; by default a quarter.
        lengthscale: Distance of descriptors at which a reward is smaller by a factor e.
        actor_learning_rate: Learning rate of the actor [-].
    """

    ga_batch_size: int | None = None
    dcrl_batch_size: int | None = None
    ai_batch_size: int | None = None
    lengthscale: float = 0.1
    actor_learning_rate: float = 3e-4
    num_critic_training_steps: int = 3000
    num_pg_training_steps: int = 150
    batch_size: int = 100

    def check(self) -> None:
        """Checks the values with which critic or actor would be NaN.

        Raises:
            ValueError: A value is out of its range.
        """
        super().check()
        checks.number("lengthscale", self.lengthscale, above=0)

    def shares(self, config: EvolveConfig) -> dict[str, int]:
        """Returns the sizes of the three parts of a generation, by option name.

        Raises:
            ConfigError: A part is empty, or their sum is not the size of a generation.
        """
        quarter = config.batch_size // 4
        found = {
            "ga_batch_size": config.batch_size - 2 * quarter,
            "dcrl_batch_size": quarter,
            "ai_batch_size": quarter,
        }
        given = {name: getattr(self, name) for name in found}
        found |= {name: value for name, value in given.items() if value is not None}
        sizes = tuple(found.values())
        if min(sizes) < 1 or sum(sizes) != config.batch_size:
            names = f"options: {listed(found)}"
            allowed = "integers from 1 that add up to batch_size "
            allowed += f"({config.batch_size})"
            raise ConfigError(message(names, sizes, allowed))
        return found


@dataclasses.dataclass(frozen=True)
class _Described:
    """What QDax's emitter reads of an environment, with the descriptor of the task.

    Limits of the environment may be infinite, or missing.

    Attributes:
        observation_size: Length of an observation.
        action_size: Length of an action.
        descriptor_length: Number D of components of the descriptor.
        descriptor_limits: Lowest and highest descriptor, (D,) each.
    """

    observation_size: int
    action_size: int
    descriptor_length: int
    descriptor_limits: tuple[jax.Array, jax.Array]

    @classmethod
    def of(cls, task: Task) -> _Described:
        """Returns the sizes and limits of a task."""
        import jax.numpy as jnp

        low, high = (jnp.asarray(limit, jnp.float32) for limit in task.limits)
        env = task.env
        sizes = env.observation_size, env.action_size, task.descriptor_length
        return cls(*sizes, (low, high))


def _make(context: EmitterContext, options: DCRLMEOptions) -> Any:
    """DCRL-ME: critic and actor depend on the descriptor (Faldor et al. 2024).

    Raises:
        ConfigError: The options do not fit the size of a generation, the descriptor has
            another length than the state descriptor, or the network is no module of
            Flax linen.
    """
    import jax
    import jax.numpy as jnp

    from newton_qd import compat

    with compat.installed():  # its file imports environments that fail with today's JAX
        from qdax.core.emitters.dcrl_me_emitter import DCRLMEConfig, DCRLMEEmitter
    from qdax.core.neuroevolution.buffers.buffer import DCRLTransition
    from qdax.core.neuroevolution.networks.networks import MLPDC

    from newton_qd.qd.algorithms.each_episode import EachEpisode
    from newton_qd.qd.algorithms.network_emitter import OfParameters

    config, task = context.config, context.task
    task.require_length()
    require_linen(config, context.policy)
    require_buffer(config, options.replay_buffer_size)
    actor = MLPDC(
        layer_sizes=(*config.hidden, task.env.action_size),
        kernel_init=jax.nn.initializers.lecun_uniform(),
        final_activation=jnp.tanh,
    )

    def convert(steps: dict[str, jax.Array]) -> Any:
        # Rewards are weighted by the distance of descriptors, so they must not be
        # negative.
        rewards = jnp.maximum(steps["rewards"] + task.reward_offset, 0.0)
        shape = (*rewards.shape, task.descriptor_length)
        unknown = jnp.full(shape, jnp.nan, rewards.dtype)  # the emitter sets it
        return DCRLTransition(
            **{**steps, "rewards": rewards}, desc=unknown, desc_prime=unknown
        )

    def made(times: int) -> Any:
        """Returns the emitter for generations so many times as large."""
        shares = {name: times * size for name, size in options.shares(config).items()}
        emitter = DCRLMEEmitter(
            DCRLMEConfig(**{**dataclasses.asdict(options), **shares}),
            context.policy.network,
            actor,
            cast("Any", _Described.of(task)),
            isoline(config),
        )
        return with_own_isoline(emitter, config)

    emitter: Any = made(1)
    if config.starts > 1:
        emitter = EachEpisode(emitter, made(config.starts), config.starts)
    return OfParameters(emitter, context.policy, convert)


DCRL_ME = AlgorithmSpec(
    name="dcrl-me",
    summary="DCRL-ME: like `pga-me`, with a critic and an actor that depend on the "
    "descriptor; the critic and the actor each produce a quarter of the generation",
    make=_make,
    options=DCRLMEOptions,
    least=1,
    transitions=True,
    double=False,
)
