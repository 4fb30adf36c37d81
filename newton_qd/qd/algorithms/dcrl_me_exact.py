"""DCRL-ME with exact slopes."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from newton_qd.qd.algorithms.dcrl_me import DCRLMEOptions
from newton_qd.qd.algorithms.gradient_options import differentiable, DifferentiableOptions
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.algorithms.variation import isoline_emitter
from newton_qd.qd.config import EvolveConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExactDCRLMEOptions(DCRLMEOptions):
    """Options.

    Attributes:
        worlds: worlds
        window: window
        trace: trace
        clip: clip
        noise: noise
        width: width
        windows: windows
        most: most
        termination_width: width
    """

    worlds: int = 2048
    window: int = 32
    trace: float = 0.95
    clip: float = 100.0
    noise: float = 0.1
    width: float = 0.2
    windows: int = 4
    most: float = 0.0
    termination_width: float = 0.0


def _episodes(config: EvolveConfig, options: ExactDCRLMEOptions) -> int:
    return -(-options.worlds * options.window // config.episode_length)


def _make(context: EmitterContext, options: ExactDCRLMEOptions) -> Any:
    import jax
    import jax.numpy as jnp

    from newton_qd import compat

    compat.install()
    from qdax.core.emitters.dcrl_emitter import DCRLConfig
    from qdax.core.emitters.multi_emitter import MultiEmitter
    from qdax.core.neuroevolution.buffers.buffer import DCRLTransition
    from qdax.core.neuroevolution.networks.networks import MLPDC

    from newton_qd.qd.algorithms.network_emitter import OfParameters
    from newton_qd.qd.emitters.sloped_critic import SlopedEmitter, SlopeSettings

    config, task = context.config, context.task
    settings = {**dataclasses.asdict(options), **options.shares(config)}
    names = [f.name for f in dataclasses.fields(SlopeSettings)]
    slopes = SlopeSettings(**{name: settings[name] for name in names})
    names = [f.name for f in dataclasses.fields(DCRLConfig)]
    rest = settings["ga_batch_size"]
    own = DCRLConfig(**{name: settings[name] for name in names})
    actor = MLPDC(
        layer_sizes=(*config.hidden, task.env.action_size),
        kernel_init=jax.nn.initializers.lecun_uniform(),
        final_activation=jnp.tanh,
    )

    def convert(steps: dict[str, jax.Array]) -> Any:
        rewards = jnp.maximum(steps["rewards"] + task.reward_offset, 0.0)
        shape = (*rewards.shape, task.descriptor_length)
        unknown = jnp.full(shape, jnp.nan, rewards.dtype)
        return DCRLTransition(
            **{**steps, "rewards": rewards}, desc=unknown, desc_prime=unknown
        )

    smooth = differentiable(task, DifferentiableOptions(), options.termination_width)
    emitter = SlopedEmitter(
        own,
        context.policy.network,
        actor,
        task.env,
        slopes,
        smooth.env,
        config.episode_length,
        task.reward_offset,
    )
    both = MultiEmitter((emitter, isoline_emitter(config, rest)))
    return OfParameters(both, context.policy, convert)


DCRL_ME_EXACT = AlgorithmSpec(
    name="dcrl-me-exact",
    summary="DCRL-ME with a critic that learns exact slopes too",
    make=_make,
    options=ExactDCRLMEOptions,
    least=0,
    transitions=True,
    double=False,
    evaluations=lambda c, o: c.batch_size + _episodes(c, o),
    gradients=_episodes,
)
