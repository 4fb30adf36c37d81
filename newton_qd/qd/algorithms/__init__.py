"""The algorithms of ``evolve``: what each of them proposes next.

Each is an emitter of QDax. Genotypes are weight vectors (size,) throughout; emitters
that need the parameters of a network see them through ``_OfParameters``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd import compat
from newton_qd.qd.algorithms.gradient_algorithms import GRADIENT_ALGORITHMS
from newton_qd.qd.algorithms.parts import (
    Algorithm,
    Parts,
    isoline,
    isoline_emitter,
    settings,
)
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.scoring.rollout import Policy


class _OfParameters:
    """An emitter of network parameters as one of weight vectors.

    Args:
        emitter: Emitter of QDax.
        policy: Says how weights and parameters belong together.
        convert: Makes QDax's transitions from the dictionary of the scores.
    """

    def __init__(
        self, emitter: Any, policy: Policy, convert: Callable[[Any], Any]
    ) -> None:
        self._emitter = emitter
        self._policy = policy
        self._convert = convert

    def init(self, key: jax.Array, **told: Any) -> Any:
        """Returns the state before the second generation."""
        return self._emitter.init(key=key, **self._told(told))

    def emit(self, repertoire: Any, state: Any, key: jax.Array) -> Any:
        """Returns weights (N, size) and what the emitter remembers of them."""
        parameters, remembered = self._emitter.emit(self._seen(repertoire), state, key)
        return jax.vmap(self._policy.ravel)(parameters), remembered

    def state_update(self, emitter_state: Any, **told: Any) -> Any:
        """Learns from a generation."""
        return self._emitter.state_update(emitter_state, **self._told(told))

    def _seen(self, repertoire: Any) -> Any:
        return repertoire.replace(genotypes=self._unravel(repertoire.genotypes))

    def _unravel(self, genotypes: jax.Array) -> Any:
        return jax.vmap(self._policy.unravel)(genotypes)

    def _told(self, told: dict[str, Any]) -> dict[str, Any]:
        extra = told["extra_scores"]
        return {
            **told,
            "repertoire": self._seen(told["repertoire"]),
            "genotypes": self._unravel(told["genotypes"]),
            "extra_scores": {
                **extra,
                "transitions": self._convert(extra["transitions"]),
            },
        }


def _require_batch_size(config: EvolveConfig, name: str, value: Any) -> None:
    """Refuses an option that would give a generation another size."""
    if value != config.batch_size:
        raise ConfigError(
            f"options: {name} is batch_size ({config.batch_size}), not {value!r}"
        )


@dataclasses.dataclass(frozen=True)
class _NoOptions:
    """Settings of an algorithm that has no others than those of a run."""


def _me(parts: Parts) -> Any:
    """MAP-Elites with iso+line variation (Vassiliades and Mouret 2018)."""
    settings(_NoOptions, parts.config)
    return isoline_emitter(parts.config, parts.config.batch_size)


@dataclasses.dataclass(frozen=True)
class CMAMEOptions:
    """Options of CMA-ME (Fontaine et al. 2020).

    Attributes:
        emitters: Number of emitters that take turns.
        sigma_g: Initial step size, in units of policy weights [-].
    """

    emitters: int = 4
    sigma_g: float = 0.5


def _cma_me(parts: Parts) -> Any:
    """CMA-ME with improvement emitters; its memory grows with size squared."""
    from qdax.core.emitters.cma_improvement_emitter import CMAImprovementEmitter
    from qdax.core.emitters.cma_pool_emitter import CMAPoolEmitter

    options = settings(CMAMEOptions, parts.config, least=1)
    if not options.sigma_g > 0:
        raise ConfigError(f"options: sigma_g must be positive, got {options.sigma_g}")
    emitter = CMAImprovementEmitter(
        batch_size=parts.config.batch_size,
        genotype_dim=parts.policy.size,
        centroids=parts.centroids,
        sigma_g=options.sigma_g,
        min_count=1,
    )
    return CMAPoolEmitter(num_states=options.emitters, emitter=emitter)


_REPLAY_BUFFER = 100_000
"""Transitions that are kept; a million, as QDax has it, would be in checkpoints."""


def _pga_me(parts: Parts) -> Any:
    """PGA-ME: half of the variations follow a critic (Nilsson and Cully 2021)."""
    compat.install()  # QDax's file imports environments that JAX of today refuses
    from qdax.core.emitters.pga_me_emitter import PGAMEConfig, PGAMEEmitter
    from qdax.core.neuroevolution.buffers.buffer import QDTransition

    options = settings(
        PGAMEConfig,
        parts.config,
        least=1,
        env_batch_size=parts.config.batch_size,
        replay_buffer_size=_REPLAY_BUFFER,
    )
    _require_batch_size(parts.config, "env_batch_size", options.env_batch_size)
    mutated = int(options.proportion_mutation_ga * parts.config.batch_size)
    if not 0 < mutated < parts.config.batch_size:
        raise ConfigError(
            f"options: proportion_mutation_ga = {options.proportion_mutation_ga} of "
            f"batch_size = {parts.config.batch_size} must be some individuals, not all"
        )
    emitter = PGAMEEmitter(
        options, parts.policy.network, parts.task.env, isoline(parts.config)
    )
    return _OfParameters(emitter, parts.policy, lambda steps: QDTransition(**steps))


def _dcrl_me(parts: Parts) -> Any:
    """DCRL-ME: a critic and an actor that know the descriptor (Faldor et al. 2024)."""
    compat.install()  # as above
    from qdax.core.emitters.dcrl_me_emitter import DCRLMEConfig, DCRLMEEmitter
    from qdax.core.neuroevolution.buffers.buffer import DCRLTransition
    from qdax.core.neuroevolution.networks.networks import MLPDC

    config = parts.config
    quarter = config.batch_size // 4
    options = settings(
        DCRLMEConfig,
        config,
        least=1,
        ga_batch_size=config.batch_size - 2 * quarter,
        dcrl_batch_size=quarter,
        ai_batch_size=quarter,
        replay_buffer_size=_REPLAY_BUFFER,
    )
    shares = options.ga_batch_size, options.dcrl_batch_size, options.ai_batch_size
    if min(shares) < 1 or sum(shares) != config.batch_size:
        raise ConfigError(
            "options: ga_batch_size, dcrl_batch_size and ai_batch_size must be at "
            f"least 1 and add up to batch_size ({config.batch_size}), got {shares}"
        )
    actor = MLPDC(
        layer_sizes=(*config.hidden, parts.task.env.action_size),
        kernel_init=jax.nn.initializers.lecun_uniform(),
        final_activation=jnp.tanh,
    )

    def convert(steps: dict[str, jax.Array]) -> Any:
        # It weighs rewards by the distance of descriptors, so none may be negative.
        rewards = jnp.maximum(steps["rewards"] + parts.task.reward_offset, 0.0)
        shape = (*rewards.shape, parts.task.descriptor_length)
        unknown = jnp.full(shape, jnp.nan, rewards.dtype)  # the emitter fills it in
        return DCRLTransition(
            **{**steps, "rewards": rewards}, desc=unknown, desc_prime=unknown
        )

    emitter = DCRLMEEmitter(
        options, parts.policy.network, actor, parts.task.env, isoline(config)
    )
    return _OfParameters(emitter, parts.policy, convert)


class _FromOne:
    """ME-ES, which grows from one individual, in a population of any size."""

    def __init__(self, emitter: Any) -> None:
        self.emit = emitter.emit
        self.state_update = emitter.state_update
        self._emitter = emitter

    def init(self, key: jax.Array, genotypes: Any, **told: Any) -> Any:
        """Returns the state before the second generation."""
        first = jax.tree.map(lambda leaf: leaf[:1], genotypes)
        return self._emitter.init(key=key, genotypes=first, **told)


def _me_es(parts: Parts) -> Any:
    """ME-ES: evolution strategies from elites (Colas et al. 2020)."""
    from qdax.core.emitters.mees_emitter import MEESConfig, MEESEmitter

    samples = parts.config.batch_size
    options = settings(MEESConfig, parts.config, least=1, sample_number=samples)
    _require_batch_size(parts.config, "sample_number", options.sample_number)
    if options.sample_mirror and samples % 2:
        raise ConfigError(
            f"batch_size must be even for 'me-es' with sample_mirror, got {samples}"
        )
    emitter = MEESEmitter(
        options,
        # The archive of its novelty holds one descriptor for each generation.
        total_generations=max(
            parts.config.iterations + 1, options.novelty_nearest_neighbors
        ),
        scoring_fn=parts.score,
        num_descriptors=parts.task.descriptor_length,
    )
    return _FromOne(emitter)


ALGORITHMS: Mapping[str, Algorithm] = {
    "me": Algorithm(_me),
    "cma-me": Algorithm(_cma_me, smallest=2, double=False),
    "pga-me": Algorithm(_pga_me, transitions=True, smallest=2, double=False),
    "dcrl-me": Algorithm(_dcrl_me, transitions=True, double=False),
    # The samples of a gradient, and the individual that they lead to.
    "me-es": Algorithm(
        _me_es,
        evaluates=True,
        evaluations=lambda config: config.batch_size + 1,
        smallest=2,
        double=False,
    ),
    **GRADIENT_ALGORITHMS,
}
"""The algorithms of ``evolve`` by their names."""
