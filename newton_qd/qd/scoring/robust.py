"""Scoring functions that evaluate each individual from several start states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.checks import listed, message
from newton_qd.gradients.scores import unit_rows
from newton_qd.qd.config import STATISTICS, EvolveConfig
from newton_qd.qd.scoring.rollout import Policy, make_scoring_function
from newton_qd.qd.scoring.spread import Spread, spread_of
from newton_qd.qd.scoring.task import Task
from newton_qd.types import ExtraScores, Genotype, PyTree, RNGKey, ScoringFunction

_KNOWN = ("transitions", "gradients", "normalized_grads", "faulty", "overflowed")


def robust_scoring(
    score: ScoringFunction,
    *,
    starts: int,
    statistic: str = "mean",
    spread: Spread | None = None,
) -> ScoringFunction:
    """Makes a scoring function that evaluates each individual from several starts.

    All individuals share the start states, which follow from the key. All episodes of a
    batch run in one launch. If the environment draws its physical parameters at a reset
    (:class:`~newton_qd.wrappers.RandomParamsWrapper`), each start has its own.

    Args:
        score: Scoring function of genotypes and one key, as ``make_scoring_function``
            and ``Episode.scoring`` return it.
        starts: Start states of each individual.
        statistic: ``"mean"`` or ``"median"`` of the fitnesses, and of each component
            of the descriptors.
        spread: What the spread of an individual's descriptors costs; ``None``: nothing.

    Returns:
        Function with the arguments and results of ``score``. The fitness is ``-inf`` if
        that of any start is. Gradients are those of the statistic. Transitions of all
        starts follow each other, (N, starts T, ...). It raises ``ValueError`` for other
        entries of the dictionary.

    Raises:
        TypeError: ``score`` is not a function.
        ValueError: ``starts`` is not an integer from 1, or ``statistic`` is unknown.
    """
    checks.function("score", score, "a function of genotypes and a key")
    checks.integer("starts", starts)
    checks.choice("statistic", statistic, STATISTICS)
    if starts == 1:
        return score

    def scored(
        genotypes: Genotype, key: RNGKey
    ) -> tuple[jax.Array, jax.Array, ExtraScores]:
        keys = jax.random.split(key, starts)
        fitnesses, found, extra = jax.vmap(score, (None, 0))(genotypes, keys)
        bad = jnp.any(jnp.isneginf(fitnesses), axis=0)
        rows = jnp.concatenate([fitnesses[..., None], found], axis=-1)
        # an infinite fitness would make weights of 0 to NaN
        rows = jnp.where(bad[..., None], jnp.zeros_like(rows), rows)
        weights = _weights(rows, statistic)
        mixed = _weighted(weights, rows)
        fitness = mixed[:, 0]
        if spread is not None:
            fitness = spread.weighed(fitness, found, mixed[:, 1:])
        fitness = jnp.where(bad, -jnp.inf, fitness)
        return fitness, mixed[:, 1:], _joined(extra, weights)

    return scored


def run_scoring(
    config: EvolveConfig,
    task: Task,
    policy: Policy,
    *,
    transitions: bool = False,
    starts: int = 0,
) -> ScoringFunction:
    """Returns the scoring function of a run without gradients."""
    score = make_scoring_function(
        task, policy, config.episode_length, transitions=transitions
    )
    return robust_scoring(
        score,
        starts=starts or config.starts,
        statistic=config.statistic,
        spread=spread_of(config, task),
    )


def _weights(rows: jax.Array, statistic: str) -> jax.Array:
    """Returns the weight (starts, N, R) of each start in the mean or median of rows."""
    starts = rows.shape[0]
    if statistic == "mean":
        return jnp.full_like(rows, 1.0 / starts)
    order = jnp.argsort(rows, axis=0, stable=True)
    rank = jnp.argsort(order, axis=0, stable=True)
    low, high = (starts - 1) // 2, starts // 2
    half = jnp.asarray(0.5, rows.dtype)
    return half * (rank == low) + half * (rank == high)


def _weighted(weights: jax.Array, rows: jax.Array) -> jax.Array:
    """Returns the weighted sum over the first axis, in its order.

    A reduction of XLA could depend on the size of the batch.
    """
    total = weights[0] * rows[0]
    for weight, row in zip(weights[1:], rows[1:], strict=True):
        total = total + weight * row
    return total


def _joined(extra: ExtraScores, weights: jax.Array) -> ExtraScores:
    """Returns the dictionary of the scores, from those of all starts.

    Raises:
        ValueError: It has entries whose mean is not defined.
    """
    joined: dict[str, Any] = {}
    for name, value in extra.items():
        if name not in _KNOWN:
            allowed = f"{listed(_KNOWN)}"
            raise ValueError(message("extra scores", name, allowed))
        joined[name] = jax.tree.map(_PARTS[name], value)
    if "gradients" in extra:
        mixed = jax.tree.map(lambda x: _mixed(weights, x), extra["gradients"])
        sound = ~joined["faulty"]
        mixed = jax.tree.map(lambda x: _where(sound, x), mixed)
        joined["gradients"] = mixed
        joined["normalized_grads"] = unit_rows(mixed)
    return joined


def _mixed(weights: jax.Array, gradients: jax.Array) -> jax.Array:
    """Returns gradients (N, ..., R) of the statistic, from (starts, N, ..., R)."""
    inner = (1,) * (gradients.ndim - weights.ndim)
    shape = (*weights.shape[:2], *inner, weights.shape[2])
    return _weighted(weights.reshape(shape), gradients)


def _where(sound: jax.Array, leaf: jax.Array) -> jax.Array:
    shape = (-1, *(1,) * (leaf.ndim - 1))
    return jnp.where(sound.reshape(shape), leaf, jnp.zeros_like(leaf))


def _end_to_end(leaf: jax.Array) -> jax.Array:
    """Returns (N, starts T, ...) from (starts, N, T, ...)."""
    moved = jnp.moveaxis(leaf, 0, 1)
    return moved.reshape(moved.shape[0], -1, *moved.shape[3:])


def _any(leaf: jax.Array) -> jax.Array:
    return jnp.any(leaf, axis=0)


def _replaced(leaf: PyTree) -> PyTree:
    return leaf


_PARTS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "transitions": _end_to_end,
    "gradients": _replaced,
    "normalized_grads": _replaced,
    "faulty": _any,
    "overflowed": _any,
}
