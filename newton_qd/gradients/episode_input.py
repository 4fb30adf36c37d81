"""Checks of what an episode is given."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.types import Genotype


def check_first(first: Any, described: bool) -> None:
    """Checks the first state of an episode.

    Args:
        first: The state.
        described: Whether the episode reads its state descriptor.

    Raises:
        TypeError: It is not a state.
        ValueError: It is a state of several worlds, or lacks the state descriptor.
    """
    if not hasattr(first, "reward"):
        allowed = "a key of jax.random, or a state of the environment"
        raise TypeError(message("start", first, allowed))
    if jnp.ndim(first.reward):
        given = Fact(f"a state of a batch of shape {jnp.shape(first.reward)}")
        allowed = "of one world, under jax.vmap for more"
        raise ValueError(message("start", given, allowed))
    if described and "state_descriptor" not in first.info:
        given = Fact("states with no state descriptor")
        allowed = (
            "QD tasks, as ant_uni, or descriptor_extractor=None without transitions"
        )
        raise ValueError(message("env", given, allowed))


def check_weights(genotypes: Genotype, weights: Any) -> None:
    """Checks the weights of sums of fitness and descriptor.

    Args:
        genotypes: Leaves (N, ...).
        weights: (N, R, 1 + D) weights; ``differentiate`` checks the last axis.

    Raises:
        TypeError: They are not an array.
        ValueError: They have another shape.
    """
    allowed = "an array of shape (N, R, 1 + D)"
    checks.instance("weights", weights, (jax.Array, np.ndarray), allowed)
    shape, number = jnp.shape(weights), len(jax.tree.leaves(genotypes)[0])
    if len(shape) != 3 or shape[0] != number or not shape[1]:
        allowed = f"shape ({number}, R, 1 + D), R from 1"
        raise ValueError(message("weights", Fact(f"shape {shape}"), allowed))
