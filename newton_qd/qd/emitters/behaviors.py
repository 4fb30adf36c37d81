"""What policies did in an episode, and the variation of a policy by behavior.

This is the operator of ASCII-ME, "action sequence crossover with performance-informed
interpolation" (Mitsides, Faldor and Cully 2025, "Scaling policy gradient
Quality-Diversity with massive parallelization via behavioral variations").
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import optax

from newton_qd import checks

FlatPolicy: TypeAlias = Callable[[jax.Array, jax.Array], jax.Array]
"""Maps weights (size,) and an observation (no,) to an action (nu,)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Behavior:
    """One episode of a policy; for N policies, leaves (N, T, ...).

    Attributes:
        obs: (T, no) observation before each step.
        actions: (T, nu) action of each step.
        returns: (T,) discounted sum of the rewards from each step to the end.
        counts: (T,) 1 if the step belongs to the episode, 0 after its end.
    """

    obs: jax.Array
    actions: jax.Array
    returns: jax.Array
    counts: jax.Array


@dataclasses.dataclass(frozen=True, kw_only=True)
class Interpolation:
    """Settings of the variation of a policy by behavior.

    Attributes:
        epochs: Steps of Adam for each offspring.
        deviation: Standard deviation of the policy as a normal distribution [-].
        clip: Smallest change of the likelihood of an action, below 1, at which the
            policy moves no further away from the action [-].
        similarity: Smallest weight of a step, for observations that differ [-].

    Raises:
        ValueError: A value is out of its range.
    """

    epochs: int = 32
    deviation: float = 2.0
    clip: float = 0.2
    similarity: float = 0.25

    def __post_init__(self) -> None:
        """Checks every value.

        Raises:
            ValueError: A value is out of its range.
        """
        checks.integer("epochs", self.epochs, most=None)
        checks.number("deviation", self.deviation, above=0)
        checks.number("clip", self.clip, least=0, most=1)
        checks.number("similarity", self.similarity, least=0, most=1)


def behavior_of(steps: dict[str, jax.Array], length: int, discount: float) -> Behavior:
    """Returns the behavior of N policies in their first episode.

    Args:
        steps: ``obs``, ``actions``, ``rewards`` and ``dones``, (N, T, ...) each, as the
            ``transitions`` of a scoring function.
        length: Control steps of an episode; later steps belong to other episodes.
        discount: Discount of a control step [-].

    Returns:
        Behaviors, leaves (N, length, ...). A behavior that is not finite counts in no
        step and is 0.
    """
    obs, actions = steps["obs"][:, :length], steps["actions"][:, :length]
    rewards, dones = steps["rewards"][:, :length], steps["dones"][:, :length]
    over = jnp.cumsum(dones > 0, axis=1) - (dones > 0) > 0
    sound = jnp.all(jnp.isfinite(obs), axis=(1, 2))
    sound &= jnp.all(jnp.isfinite(rewards), axis=1)
    sound &= jnp.all(jnp.isfinite(actions), axis=(1, 2))
    counts = ~over & sound[:, None]

    def back(total: jax.Array, reward: jax.Array) -> tuple[jax.Array, jax.Array]:
        total = reward + discount * total
        return total, total

    gained = jnp.where(counts, rewards, 0).T
    start = jnp.zeros_like(gained[0])
    returns = jax.lax.scan(back, start, gained, reverse=True)[1].T
    kept = sound[:, None, None]
    return Behavior(
        obs=jnp.where(kept, obs, 0),
        actions=jnp.where(kept, actions, 0),
        returns=returns,
        counts=counts.astype(returns.dtype),
    )


def preference(own: Behavior, other: Behavior, least: float) -> jax.Array:
    """Returns how much better the other behavior is, at each step (T,).

    It is the difference of the returns, times the cosine of the observations, because
    an action counts for the state in which it was taken.

    Args:
        own: Behavior of a policy.
        other: Behavior of another one.
        least: Smallest cosine; it holds too where the own episode has ended.
    """
    dot = jnp.sum(own.obs * other.obs, axis=-1)
    norms = jnp.linalg.norm(own.obs, axis=-1) * jnp.linalg.norm(other.obs, axis=-1)
    cosine = jnp.where(norms > 0, dot / jnp.where(norms > 0, norms, 1), 0)
    cosine = jnp.maximum(jnp.where(own.counts > 0, cosine, 0), least)
    return cosine * (other.returns - own.returns) * other.counts


def interpolated(
    policy: FlatPolicy,
    weights: jax.Array,
    behavior: Behavior,
    preferred: jax.Array,
    rate: jax.Array | float,
    settings: Interpolation,
) -> jax.Array:
    r"""Moves a policy towards the actions that are preferred, and away from the others.

    Adam increases

    .. math:: \frac{1}{T} \sum_t \min(z_t \rho_t, z_t \max(\rho_t, 1 - c)), \qquad
        \rho_t = \exp\left(-\frac{|a_t - \pi_\theta(o_t)|^2}{2 \sigma^2}\right).

    The gradient is the change of behavior :math:`z_t (a_t - \pi_\theta(o_t))`, times
    the derivative of the policy's actions with respect to its weights.

    Args:
        policy: The policy.
        weights: (size,) its weights.
        behavior: Observations and actions of T steps.
        preferred: (T,) preference z of each step; negative: away from the action.
        rate: () learning rate.
        settings: Other settings.

    Returns:
        (size,) new weights.
    """
    adam = optax.scale_by_adam()
    floor = 1 - settings.clip

    def loss(weights: jax.Array) -> jax.Array:
        actions = jax.vmap(policy, (None, 0))(weights, behavior.obs)
        squares = jnp.sum(jnp.square(behavior.actions - actions), axis=-1)
        ratio = jnp.exp(-squares / (2 * settings.deviation**2))
        gain = jnp.minimum(preferred * ratio, preferred * jnp.maximum(ratio, floor))
        return -jnp.mean(gain)

    def step(carry: tuple[jax.Array, Any], _: None) -> tuple[tuple, None]:
        weights, moments = carry
        change: Any
        change, moments = adam.update(jax.grad(loss)(weights), moments)
        return (weights - rate * change, moments), None

    start = (weights, adam.init(weights))
    return jax.lax.scan(step, start, length=settings.epochs)[0][0]
