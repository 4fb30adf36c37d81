"""Checks of what an episode is given."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Error, Fact, listed, message
from newton_qd.envs.base import Env
from newton_qd.types import Environment, Genotype
from newton_qd.wrappers.base import outermost
from newton_qd.wrappers.episode import EpisodeWrapper


def check_first(env: Any, first: Any, described: bool) -> None:
    """Checks the first state of an episode.

    Args:
        env: The environment.
        first: The state.
        described: Whether the episode reads its state descriptor.

    Raises:
        TypeError: It is not a state.
        ValueError: It is a state of several worlds or of another precision, or lacks
            the state descriptor.
    """
    if not hasattr(first, "reward"):
        allowed = "a key of jax.random, or a state of the environment"
        raise TypeError(message("start", first, allowed))
    if jnp.ndim(first.reward):
        given = Fact(f"a state of a batch of shape {jnp.shape(first.reward)}")
        allowed = "of one world, under jax.vmap for more"
        raise ValueError(message("start", given, allowed))
    if isinstance(env, Env) and jnp.result_type(first.reward) != env.dtype:
        given = Fact(f"a state of {jnp.result_type(first.reward)}")
        raise ValueError(message("start", given, f"{env.dtype}, as the environment"))
    if described and "state_descriptor" not in first.info:
        given = Fact("states with no state descriptor")
        allowed = (
            "QD tasks, as ant_uni, or descriptor_extractor=None without transitions"
        )
        raise ValueError(message("env", given, allowed))


def check_length(
    env: Environment, episode_length: int, error: Error = ValueError
) -> None:
    """Checks that the environment does not end episodes before.

    Args:
        env: The environment.
        episode_length: Control steps of an episode.
        error: Class to raise instead.

    Raises:
        ValueError: It does.
    """
    limit = outermost(env, EpisodeWrapper) if isinstance(env, Env) else None
    if limit is None:
        return
    most = -(-limit.episode_length // limit.action_repeat)
    if episode_length > most:
        allowed = f"at most {most}, the steps after which the environment ends"
        raise error(message("episode_length", episode_length, allowed))


def check_genotypes(genotypes: Genotype) -> int:
    """Checks genotypes of several episodes; returns their number N.

    Args:
        genotypes: Leaves (N, ...).

    Raises:
        ValueError: There are no leaves, or they have other first axes.
    """
    allowed = "a pytree with leaves (N, ...)"
    shapes = [jnp.shape(leaf) for leaf in jax.tree.leaves(genotypes)]
    if not shapes:
        raise ValueError(message("genotypes", Fact("no leaves"), allowed))
    numbers = {shape[:1] for shape in shapes}
    if len(numbers) > 1 or () in numbers:
        texts = list(dict.fromkeys(map(str, shapes)))
        given = Fact(f"leaves of shape {listed(texts)}")
        raise ValueError(message("genotypes", given, allowed))
    return shapes[0][0]


def check_weights(genotypes: Genotype, weights: Any) -> None:
    """Checks the weights of sums of fitness and descriptor.

    Args:
        genotypes: Leaves (N, ...).
        weights: (N, R, 1 + D) weights; ``differentiate`` checks the last axis.

    Raises:
        TypeError: They are not an array.
        ValueError: They have another shape, or the genotypes are wrong.
    """
    allowed = "an array of shape (N, R, 1 + D)"
    if not isinstance(weights, jax.Array | np.ndarray):
        given = Fact(f"a {type(weights).__name__}")
        raise TypeError(message("weights", given, allowed))
    shape, number = jnp.shape(weights), check_genotypes(genotypes)
    if len(shape) != 3 or shape[0] != number or not shape[1]:
        allowed = f"shape ({number}, R, 1 + D), R from 1"
        raise ValueError(message("weights", Fact(f"shape {shape}"), allowed))
