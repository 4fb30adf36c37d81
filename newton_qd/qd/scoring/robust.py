"""Scoring functions that evaluate each individual from several start states."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.checks import Fact, listed, message
from newton_qd.envs.inputs import require_key
from newton_qd.gradients.scores import unit_rows
from newton_qd.qd.config import STATISTICS, EvolveConfig
from newton_qd.qd.scoring.checked import check_scores
from newton_qd.qd.scoring.rollout import Policy, make_scoring_function
from newton_qd.qd.scoring.scatter import Scatter, scatter_of
from newton_qd.qd.scoring.task import Task
from newton_qd.types import ExtraScores, Genotype, PyTree, RNGKey, ScoringFunction


def robust_scoring(
    score: ScoringFunction,
    *,
    starts: int,
    statistic: str = "mean",
    scatter: Scatter | None = None,
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
        scatter: What it costs if the descriptors of an individual differ; ``None``:
            nothing. One start state has no scatter.

    Returns:
        Function with the arguments and results of ``score``. The fitness is ``-inf`` if
        that of any start is. Gradients are those of these fitnesses and descriptors; 0
        if that of any start is lost. Transitions of all starts follow each other, (N,
        starts T, ...), and beside them are the descriptors of their episodes,
        ``episode_descriptors`` (N, starts, D). With ``scatter``, the dictionary has the
        fitness without its price, ``unscattered`` (N,). The function raises
        ``ValueError`` for other entries of the dictionary, and for wrong shapes.

    Raises:
        TypeError: ``score`` is not a function, or ``scatter`` is no ``Scatter``.
        ValueError: ``starts`` is not an integer from 1, or ``statistic`` is unknown.
    """
    checks.function("score", score, "a function of genotypes and a key")
    checks.integer("starts", starts)
    checks.choice("statistic", statistic, STATISTICS)
    if scatter is not None:
        checks.instance("scatter", scatter, Scatter, "a Scatter, None")
    if starts == 1:
        return score

    def checked(
        genotypes: Genotype, key: RNGKey
    ) -> tuple[jax.Array, jax.Array, ExtraScores]:
        scores = score(genotypes, key)
        number = len(jax.tree.leaves(genotypes)[0])
        check_scores("score", scores, number)
        _check_parts(scores[2], number, 1 + scores[1].shape[1])
        return scores

    def scored(
        genotypes: Genotype, key: RNGKey
    ) -> tuple[jax.Array, jax.Array, ExtraScores]:
        require_key("key", key)
        keys = start_keys(key, starts)
        fitnesses, found, extra = jax.vmap(checked, (None, 0))(genotypes, keys)
        bad = jnp.any(jnp.isneginf(fitnesses), axis=0)
        rows = jnp.concatenate([fitnesses[..., None], found], axis=-1)
        # an infinite fitness would make weights of 0 to NaN
        rows = jnp.where(bad[..., None], jnp.zeros_like(rows), rows)
        weights = _weights(rows, statistic)
        mixed = _weighted(weights, rows)
        fitness = plain = jnp.where(bad, -jnp.inf, mixed[:, 0])
        beside: ExtraScores = {}
        slopes = None
        if "transitions" in extra:
            beside["episode_descriptors"] = jnp.moveaxis(rows[..., 1:], 0, 1)
        if scatter is not None:
            fitness, slopes = _scattered(scatter, rows, weights)
            fitness = jnp.where(bad, -jnp.inf, fitness)
            beside["unscattered"] = plain
        return fitness, mixed[:, 1:], _joined(extra, weights, slopes) | beside

    return scored


def start_keys(key: RNGKey, starts: int) -> RNGKey:
    """Returns the (starts,) keys of the resets of one evaluation.

    Args:
        key: Key of the evaluation.
        starts: Start states of each individual. A single one starts with ``key``.
    """
    return key[None] if starts == 1 else jax.random.split(key, starts)


def run_scoring(
    config: EvolveConfig, task: Task, policy: Policy, *, transitions: bool = False
) -> ScoringFunction:
    """Returns the scoring function of a run without gradients."""
    score = make_scoring_function(
        task, policy, config.episode_length, transitions=transitions
    )
    return robust(score, config, task)


def robust(score: ScoringFunction, config: EvolveConfig, task: Task) -> ScoringFunction:
    """Returns ``robust_scoring`` with the settings of a run.

    Raises:
        ConfigError: The settings do not fit each other.
    """
    return robust_scoring(
        score,
        starts=config.starts,
        statistic=config.statistic,
        scatter=scatter_of(config, task),
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


def _scattered(
    scatter: Scatter, rows: jax.Array, weights: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Returns the fitness (N,) that counts, and its slope for each row.

    Args:
        scatter: The price.
        rows: (starts, N, 1 + D) fitness and descriptor of each episode.
        weights: Weight of each start in the statistic, with the same shape.
    """

    def total(rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        middle = _weighted(weights, rows)
        fitness = scatter.counted(middle[:, 0], rows[..., 1:], middle[:, 1:])
        return jnp.sum(fitness), fitness

    # individuals do not depend on each other, so the slope of the sum is that of each
    slopes, fitness = jax.grad(total, has_aux=True)(rows)
    return fitness, slopes


def _joined(
    extra: ExtraScores, weights: jax.Array, slopes: jax.Array | None
) -> ExtraScores:
    """Returns the dictionary of the scores, from those of all starts.

    Args:
        extra: Dictionary whose leaves begin with the axis of the starts.
        weights: (starts, N, R) weight of each start in each row.
        slopes: (starts, N, R) slope of the fitness with respect to each row; ``None``:
            the fitness is the first row.

    """
    joined: dict[str, Any] = {
        name: jax.tree.map(_PARTS[name], value) for name, value in extra.items()
    }
    if "gradients" in extra:
        mixed = jax.tree.map(lambda x: _mixed(weights, slopes, x), extra["gradients"])
        lost = _lost(joined, weights[0], every_row=slopes is not None)
        mixed = jax.tree.map(lambda x: _without(lost, x), mixed)
        joined["gradients"] = mixed
        joined["normalized_grads"] = unit_rows(mixed)
    return joined


def _check_parts(extra: ExtraScores, number: int, rows: int) -> None:
    """Checks the dictionary of the scores of one start.

    Args:
        extra: The dictionary.
        number: Number N of individuals.
        rows: Number R of rows: fitness and components of the descriptor.

    Raises:
        ValueError: It has entries whose mean is not defined, or of another shape.
    """
    for name, value in extra.items():
        if name not in _PARTS:
            raise ValueError(message("extra scores", name, listed(_PARTS)))
        for leaf in jax.tree.leaves(value):
            shape = jnp.shape(leaf)
            fits, allowed = {
                "transitions": (len(shape) > 1, " T, ..."),
                "faulty": (len(shape) == 1, ""),
                "overflowed": (shape[1:] == (rows,), f" {rows}"),
            }.get(name, (len(shape) > 1 and shape[-1] == rows, f" ..., {rows}"))
            if shape[:1] != (number,) or not fits:
                name, given = f"extra scores: {name}", Fact(f"shape {shape}")
                raise ValueError(message(name, given, f"shape ({number},{allowed})"))


def _mixed(
    weights: jax.Array, slopes: jax.Array | None, gradients: jax.Array
) -> jax.Array:
    """Returns gradients (N, ..., R) of the results, from (starts, N, ..., R)."""
    inner = (1,) * (gradients.ndim - weights.ndim)
    shape = (*weights.shape[:2], *inner, weights.shape[2])
    mixed = _weighted(weights.reshape(shape), gradients)
    if slopes is None:
        return mixed
    first = jnp.sum(_weighted(slopes.reshape(shape), gradients), axis=-1)
    return mixed.at[..., 0].set(first)


def _lost(joined: ExtraScores, rows: jax.Array, *, every_row: bool) -> jax.Array:
    """Returns which gradients (N, R) are not known, because one of a start is not.

    Args:
        joined: Dictionary with ``faulty`` (N,) and ``overflowed`` (N, R), if known.
        rows: (N, R) an array of this shape.
        every_row: Whether the first row depends on all rows.
    """
    lost = jnp.zeros(rows.shape, bool)
    if "faulty" in joined:
        lost = lost | joined["faulty"][:, None]
    if "overflowed" in joined:
        lost = lost | joined["overflowed"]
    first = jnp.any(lost, axis=1) if every_row else lost[:, 0]
    return lost.at[:, 0].set(first)


def _without(lost: jax.Array, leaf: jax.Array) -> jax.Array:
    """Returns gradients (N, ..., R) with 0 where they are lost (N, R)."""
    inner = (1,) * (leaf.ndim - 2)
    lost = lost.reshape(lost.shape[0], *inner, lost.shape[1])
    return jnp.where(lost, jnp.zeros_like(leaf), leaf)


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
