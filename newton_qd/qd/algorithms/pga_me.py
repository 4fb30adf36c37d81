"""PGA-ME of QDax."""

from __future__ import annotations

import dataclasses
from typing import Any

from newton_qd.checks import message
from newton_qd.qd.algorithms.critic_options import (
    CriticOptions,
    require_batch_size,
    require_buffer,
    require_linen,
)
from newton_qd.qd.algorithms.spec import AlgorithmSpec, EmitterContext
from newton_qd.qd.algorithms.variation import isoline, with_own_isoline
from newton_qd.qd.config import ConfigError


@dataclasses.dataclass(frozen=True, kw_only=True)
class PGAMEOptions(CriticOptions):
    """Options of PGA-ME (Nilsson and Cully 2021); QDax's ``PGAMEConfig``.

    Attributes:
        env_batch_size: Individuals of a generation; ``--batch-size`` sets it.
        proportion_mutation_ga: Share of the iso+line variations in a generation [-].
        greedy_learning_rate: Learning rate of the greedy actor [-].
    """

    env_batch_size: int | None = None
    proportion_mutation_ga: float = 0.5
    greedy_learning_rate: float = 3e-4


def _make(context: EmitterContext, options: PGAMEOptions) -> Any:
    """PGA-ME: half of the variations follow a critic (Nilsson and Cully 2021).

    Raises:
        ConfigError: The options do not fit the size of a generation, or the network is
            no module of Flax linen.
    """
    from newton_qd import compat

    with compat.installed():  # its file imports environments that fail with today's JAX
        from qdax.core.emitters.pga_me_emitter import PGAMEConfig, PGAMEEmitter
    from qdax.core.neuroevolution.buffers.buffer import QDTransition

    from newton_qd.qd.algorithms.network_emitter import OfParameters

    size = context.config.batch_size
    require_linen(context.config, context.policy)
    require_batch_size(context.config, "env_batch_size", options.env_batch_size)
    require_buffer(context.config, options.replay_buffer_size)
    if not 0 < int(options.proportion_mutation_ga * size) < size:
        name = "options: proportion_mutation_ga"
        allowed = f"some individuals of batch_size = {size}, not all"
        raise ConfigError(message(name, options.proportion_mutation_ga, allowed))
    emitter = PGAMEEmitter(
        PGAMEConfig(**{**dataclasses.asdict(options), "env_batch_size": size}),
        context.policy.network,
        context.task.env,
        isoline(context.config),
    )
    emitter = with_own_isoline(emitter, context.config)
    return OfParameters(emitter, context.policy, lambda steps: QDTransition(**steps))


PGA_ME = AlgorithmSpec(
    name="pga-me",
    summary="PGA-ME: half of the variations follow a learned critic",
    make=_make,
    options=PGAMEOptions,
    least=1,
    transitions=True,
    smallest=2,
    double=False,
)
