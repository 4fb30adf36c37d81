"""``qdax.tasks.brax_envs`` of QDax 0.2 to 0.4: functions also return the next key."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax

from newton_qd import registry, tables
from newton_qd.compat.scoring import (
    PolicyNetwork,
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
    "create_policy_network_play_step_fn",
    "get_aurora_scoring_fn",
    "get_mask_from_transitions",
    "make_policy_network_play_step_fn_brax",
    "reset_based_scoring_actor_dc_function_brax_envs",
    "reset_based_scoring_function_brax_envs",
    "scoring_actor_dc_function_brax_envs",
    "scoring_function_brax_envs",
]

JumanjiState = Any
"""Type of a state of Jumanji, for annotations of older scripts."""

create_policy_network_play_step_fn = make_policy_network_play_step_fn_brax
"""Older name of this function."""

ScoresAndKey = tuple[jax.Array, jax.Array, ExtraScores, jax.Array]
ScoringFunction = Callable[[Genotype, RNGKey], ScoresAndKey]


def create(env_name: str, *args: Any, **kwargs: Any) -> Env:
    """Builds an environment by its name.

    Args:
        env_name: One of ``newton_qd.registered_envs()``.
        *args: As for ``newton_qd.create``.
        **kwargs: As for ``newton_qd.create``; ``brax_views`` is on.

    Returns:
        The environment. It has ``sys``, and its states have ``qp``.
    """
    return registry.create(env_name, *args, **{"brax_views": True, **kwargs})


def create_fn(env_name: str, **kwargs: Any) -> Callable[..., Env]:
    """Returns ``create`` with these arguments; does not build the environment yet."""
    return functools.partial(create, env_name, **kwargs)


@functools.partial(
    jax.jit,
    static_argnames=("episode_length", "play_step_fn", "behavior_descriptor_extractor"),
)
def scoring_function_brax_envs(
    policies_params: Genotype,
    random_key: jax.Array,
    init_states: State,
    episode_length: int,
    play_step_fn: Callable[..., tuple],
    behavior_descriptor_extractor: DescriptorExtractor,
) -> ScoresAndKey:
    """Evaluates policies from given states.

    Args:
        policies_params: Parameters of N policies.
        random_key: Key for the steps, the same for every policy.
        init_states: N states.
        episode_length: Control steps of an evaluation.
        play_step_fn: Maps state, parameters and key to the next ones and a
            transition.
        behavior_descriptor_extractor: Maps transitions and mask to descriptors
            (N, D).

    Returns:
        Fitnesses (N,), descriptors (N, D), ``{"transitions": ...}`` and a new key.
    """
    random_key, step_key = jax.random.split(random_key)
    found = evaluate(
        play_step_fn,
        (init_states, policies_params, step_key),
        (0, 0, None),
        episode_length,
        behavior_descriptor_extractor,
    )
    return *found, random_key


@functools.partial(
    jax.jit,
    static_argnames=(
        "episode_length",
        "play_step_actor_dc_fn",
        "behavior_descriptor_extractor",
    ),
)
def scoring_actor_dc_function_brax_envs(
    actors_dc_params: Genotype,
    descs: jax.Array,
    random_key: jax.Array,
    init_states: State,
    episode_length: int,
    play_step_actor_dc_fn: Callable[..., tuple],
    behavior_descriptor_extractor: DescriptorExtractor,
) -> ScoresAndKey:
    """Evaluates policies that have a target descriptor as an input.

    Args:
        actors_dc_params: Parameters of N policies.
        descs: (N, D) target descriptors.
        random_key: Key for the steps, the same for every policy.
        init_states: N states.
        episode_length: Control steps of an evaluation.
        play_step_actor_dc_fn: Maps state, descriptor, parameters and key to the next
            ones and a transition.
        behavior_descriptor_extractor: Maps transitions and mask to descriptors
            (N, D).

    Returns:
        Fitnesses (N,), descriptors (N, D), ``{"transitions": ...}`` and a new key.
    """
    random_key, step_key = jax.random.split(random_key)
    found = evaluate(
        play_step_actor_dc_fn,
        (init_states, descs, actors_dc_params, step_key),
        (0, 0, 0, None),
        episode_length,
        behavior_descriptor_extractor,
    )
    return *found, random_key


def reset_based_scoring_function_brax_envs(
    policies_params: Genotype,
    random_key: jax.Array,
    episode_length: int,
    play_reset_fn: Callable[[jax.Array], State],
    play_step_fn: Callable[..., tuple],
    behavior_descriptor_extractor: DescriptorExtractor,
) -> ScoresAndKey:
    """As ``scoring_function_brax_envs``, but from the states of ``play_reset_fn``."""
    init_states, random_key = _reset(
        random_key, population_size(policies_params), play_reset_fn
    )
    return scoring_function_brax_envs(
        policies_params,
        random_key,
        init_states,
        episode_length=episode_length,
        play_step_fn=play_step_fn,
        behavior_descriptor_extractor=behavior_descriptor_extractor,
    )


def reset_based_scoring_actor_dc_function_brax_envs(
    actors_dc_params: Genotype,
    descs: jax.Array,
    random_key: jax.Array,
    episode_length: int,
    play_reset_fn: Callable[[jax.Array], State],
    play_step_actor_dc_fn: Callable[..., tuple],
    behavior_descriptor_extractor: DescriptorExtractor,
) -> ScoresAndKey:
    """As ``scoring_actor_dc_function_brax_envs``, from states of ``play_reset_fn``."""
    init_states, random_key = _reset(
        random_key, population_size(actors_dc_params), play_reset_fn
    )
    return scoring_actor_dc_function_brax_envs(
        actors_dc_params,
        descs,
        random_key,
        init_states,
        episode_length=episode_length,
        play_step_actor_dc_fn=play_step_actor_dc_fn,
        behavior_descriptor_extractor=behavior_descriptor_extractor,
    )


@functools.partial(jax.jit, static_argnames=("count", "play_reset_fn"))
def _reset(
    random_key: jax.Array, count: int, play_reset_fn: Callable[[jax.Array], State]
) -> tuple[State, jax.Array]:
    """Returns the first states of ``count`` episodes, and a new key."""
    random_key, reset_key = jax.random.split(random_key)
    return jax.vmap(play_reset_fn)(jax.random.split(reset_key, count)), random_key


def create_brax_scoring_fn(
    env: Env,
    policy_network: PolicyNetwork,
    bd_extraction_fn: DescriptorExtractor,
    random_key: jax.Array,
    play_step_fn: Callable[..., tuple] | None = None,
    episode_length: int = 100,
    deterministic: bool = True,
    play_reset_fn: Callable[[jax.Array], State] | None = None,
) -> tuple[ScoringFunction, jax.Array]:
    """Makes a scoring function of parameters and a key.

    Args:
        env: Environment with a state descriptor.
        policy_network: Flax module from observations to actions.
        bd_extraction_fn: Maps transitions and mask to descriptors (N, D).
        random_key: Key of the state in which all evaluations begin.
        play_step_fn: Replaces the step of ``env`` with ``policy_network``.
        episode_length: Control steps of an evaluation.
        deterministic: Whether all evaluations begin in the same state.
        play_reset_fn: Replaces ``env.reset`` if ``deterministic`` is false.

    Returns:
        The scoring function and a new key.

    Raises:
        ValueError: The extractor is for another state descriptor than that of ``env``.
    """
    check_extractor(env, bd_extraction_fn)
    if play_step_fn is None:
        play_step_fn = make_policy_network_play_step_fn_brax(env, policy_network)
    if deterministic:
        random_key, reset_key = jax.random.split(random_key)
    else:
        reset_key = random_key
    scoring_fn = functools.partial(
        reset_based_scoring_function_brax_envs,
        episode_length=episode_length,
        play_reset_fn=reset_function(env, reset_key, deterministic, play_reset_fn),
        play_step_fn=play_step_fn,
        behavior_descriptor_extractor=bd_extraction_fn,
    )
    return scoring_fn, random_key


def create_default_brax_task_components(
    env_name: str,
    random_key: jax.Array,
    episode_length: int = 100,
    mlp_policy_hidden_layer_sizes: tuple[int, ...] = (64, 64),
    deterministic: bool = True,
) -> tuple[Env, MLP, ScoringFunction, jax.Array]:
    """Makes environment, policy and scoring function of a task.

    Args:
        env_name: Name of a Quality-Diversity environment.
        random_key: Key of the state in which all evaluations begin.
        episode_length: Control steps of an evaluation.
        mlp_policy_hidden_layer_sizes: Widths of the policy's hidden layers.
        deterministic: Whether all evaluations begin in one state.

    Returns:
        Environment, policy, scoring function and a new key.
    """
    env, policy_network = default_task(
        env_name, episode_length, mlp_policy_hidden_layer_sizes
    )
    scoring_fn, random_key = create_brax_scoring_fn(
        env,
        policy_network,
        tables.behavior_descriptor_extractor[env_name],
        random_key,
        episode_length=episode_length,
        deterministic=deterministic,
    )
    return env, policy_network, scoring_fn, random_key


def get_aurora_scoring_fn(
    scoring_fn: ScoringFunction,
    observation_extractor_fn: Callable[[PyTree], jax.Array],
) -> Callable[[Genotype, RNGKey], tuple[jax.Array, None, ExtraScores, jax.Array]]:
    """Makes a scoring function without descriptors; AURORA computes them.

    Args:
        scoring_fn: Scoring function whose third result has ``transitions``.
        observation_extractor_fn: Maps transitions to the observations that AURORA
            encodes. They are ``last_valid_observations`` of the third result.
    """

    def score(
        params: Genotype, random_key: jax.Array
    ) -> tuple[jax.Array, None, ExtraScores, jax.Array]:
        fitnesses, _, extra, random_key = scoring_fn(params, random_key)
        observations = observation_extractor_fn(extra["transitions"])
        extra = {**extra, "last_valid_observations": observations}
        return fitnesses, None, extra, random_key

    return score
