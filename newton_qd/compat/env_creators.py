"""``qdax.tasks.brax.v1.env_creators`` of QDax 0.5: functions do not return keys."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax

from newton_qd import registry, tables
from newton_qd.checks import message
from newton_qd.compat.scoring import (
    PolicyNetwork,
    Scores,
    default_task,
    evaluate,
    get_mask_from_transitions,
    make_policy_network_play_step_fn_brax,
    population_size,
    reset_function,
)
from newton_qd.envs.base import Env
from newton_qd.envs.state import State
from newton_qd.extractors import check_extractor
from newton_qd.types import DescriptorExtractor, ExtraScores, Genotype, PyTree, RNGKey

if TYPE_CHECKING:
    from qdax.core.neuroevolution.networks.networks import MLP

__all__ = [
    "create",
    "create_brax_scoring_fn",
    "create_default_brax_task_components",
    "create_fn",
    "get_aurora_scoring_fn",
    "get_mask_from_transitions",
    "make_policy_network_play_step_fn_brax",
    "scoring_function_brax_envs",
]

ScoringFunction = Callable[[Genotype, RNGKey], Scores]


def create(env_name: str, *args: Any, legacy_spring: bool = True, **kwargs: Any) -> Env:
    """Builds an environment by its name.

    Args:
        env_name: One of ``newton_qd.registered_envs()``.
        *args: As for ``newton_qd.create``.
        legacy_spring: Must be true. It selects one of two engines in brax v1; this
            library has one engine.
        **kwargs: As for ``newton_qd.create``; ``brax_views`` is on.

    Returns:
        The environment. It has ``sys``, and its states have ``qp``.

    Raises:
        ValueError: ``legacy_spring`` is false.
    """
    if not legacy_spring:
        allowed = (
            "True; brax's position-based dynamics are not in this library, which has "
            "one physics"
        )
        raise ValueError(message("legacy_spring", legacy_spring, allowed))
    return registry.create(env_name, *args, **{"brax_views": True, **kwargs})


def create_fn(env_name: str, **kwargs: Any) -> Callable[..., Env]:
    """Returns ``create`` with these arguments; does not build the environment yet."""
    return functools.partial(create, env_name, **kwargs)


@functools.partial(
    jax.jit,
    static_argnames=(
        "episode_length",
        "play_reset_fn",
        "play_step_fn",
        "descriptor_extractor",
    ),
)
def scoring_function_brax_envs(
    policies_params: Genotype,
    key: jax.Array,
    episode_length: int,
    play_reset_fn: Callable[[jax.Array], State],
    play_step_fn: Callable[..., tuple],
    descriptor_extractor: DescriptorExtractor,
) -> Scores:
    """Evaluates policies in parallel.

    Args:
        policies_params: Parameters of N policies.
        key: Key for the resets and the steps.
        episode_length: Control steps of an evaluation.
        play_reset_fn: Maps a key to the first state of an episode.
        play_step_fn: Maps state, parameters and key to the next ones and a
            transition.
        descriptor_extractor: Maps transitions and mask to descriptors (N, D).

    Returns:
        Fitnesses (N,), descriptors (N, D) and ``{"transitions": ...}``.
    """
    count = population_size(policies_params)
    key, reset_key = jax.random.split(key)
    states = jax.vmap(play_reset_fn)(jax.random.split(reset_key, count))
    keys = jax.random.split(key, count)
    carry = (states, policies_params, keys)
    return evaluate(
        play_step_fn, carry, (0, 0, 0), episode_length, descriptor_extractor
    )


def create_brax_scoring_fn(
    env: Env,
    policy_network: PolicyNetwork,
    descriptor_extraction_fn: DescriptorExtractor,
    key: jax.Array,
    play_step_fn: Callable[..., tuple] | None = None,
    episode_length: int = 100,
    deterministic: bool = True,
    play_reset_fn: Callable[[jax.Array], State] | None = None,
) -> ScoringFunction:
    """Makes a scoring function of parameters and a key.

    Args:
        env: Environment with a state descriptor.
        policy_network: Flax module from observations to actions.
        descriptor_extraction_fn: Maps transitions and mask to descriptors (N, D).
        key: Key of the state in which all evaluations begin.
        play_step_fn: Replaces the step of ``env`` with ``policy_network``.
        episode_length: Control steps of an evaluation.
        deterministic: Whether all evaluations begin in one state.
        play_reset_fn: Replaces ``env.reset`` if ``deterministic`` is false.

    Raises:
        ValueError: The extractor is for another state descriptor than that of ``env``.
    """
    check_extractor(env, descriptor_extraction_fn)
    if play_step_fn is None:
        play_step_fn = make_policy_network_play_step_fn_brax(env, policy_network)
    _, reset_key = jax.random.split(key)
    return functools.partial(
        scoring_function_brax_envs,
        episode_length=episode_length,
        play_reset_fn=reset_function(env, reset_key, deterministic, play_reset_fn),
        play_step_fn=play_step_fn,
        descriptor_extractor=descriptor_extraction_fn,
    )


def create_default_brax_task_components(
    env_name: str,
    key: jax.Array,
    episode_length: int = 100,
    mlp_policy_hidden_layer_sizes: tuple[int, ...] = (64, 64),
    deterministic: bool = True,
) -> tuple[Env, MLP, ScoringFunction]:
    """Makes environment, policy and scoring function of a task.

    Args:
        env_name: Name of a Quality-Diversity environment.
        key: Key of the state in which all evaluations begin.
        episode_length: Control steps of an evaluation.
        mlp_policy_hidden_layer_sizes: Widths of the policy's hidden layers.
        deterministic: Whether all evaluations begin in one state.
    """
    env, policy_network = default_task(
        env_name, episode_length, mlp_policy_hidden_layer_sizes
    )
    scoring_fn = create_brax_scoring_fn(
        env,
        policy_network,
        tables.descriptor_extractor[env_name],
        key,
        episode_length=episode_length,
        deterministic=deterministic,
    )
    return env, policy_network, scoring_fn


def get_aurora_scoring_fn(
    scoring_fn: ScoringFunction,
    observation_extractor_fn: Callable[[PyTree], jax.Array],
    observations_key: str,
) -> Callable[[Genotype, RNGKey], tuple[jax.Array, None, ExtraScores]]:
    """Makes a scoring function without descriptors; AURORA computes them.

    Args:
        scoring_fn: Scoring function whose third result has ``transitions``.
        observation_extractor_fn: Maps transitions to the observations that AURORA
            encodes.
        observations_key: Key of these observations in the third result.
    """

    def score(params: Genotype, key: jax.Array) -> tuple[jax.Array, None, ExtraScores]:
        fitnesses, _, extra = scoring_fn(params, key)
        observations = observation_extractor_fn(extra["transitions"])
        return fitnesses, None, {**extra, observations_key: observations}

    return score
