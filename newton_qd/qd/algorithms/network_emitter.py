"""Adapter for emitters of QDax that need network parameters, not weight vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from newton_qd.qd.scoring.rollout import Policy
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire

if TYPE_CHECKING:
    from qdax.core.emitters.emitter import Emitter


class OfParameters:
    """Converts an emitter of network parameters to an emitter of weight vectors.

    Args:
        emitter: Emitter of QDax.
        policy: Converts between weights and parameters.
        convert: Makes QDax's transitions from the dictionary of the scores.
    """

    def __init__(
        self,
        emitter: Emitter,
        policy: Policy,
        convert: Callable[[dict[str, jax.Array]], PyTree],
    ) -> None:
        self._emitter = emitter
        self._policy = policy
        self._convert = convert

    def init(self, key: jax.Array, **told: PyTree) -> PyTree:
        """Returns the state before the second generation."""
        return self._emitter.init(key=key, **self._told(told))

    def emit(
        self, repertoire: Repertoire, state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Returns weights (N, size) and the emitter's data about them."""
        parameters, remembered = self._emitter.emit(self._seen(repertoire), state, key)
        return jax.vmap(self._policy.ravel)(parameters), remembered

    def state_update(self, emitter_state: PyTree, **told: PyTree) -> PyTree:
        """Learns from a generation."""
        return self._emitter.state_update(emitter_state, **self._told(told))

    def _seen(self, repertoire: Repertoire) -> Repertoire:
        return repertoire.replace(genotypes=self._unravel(repertoire.genotypes))

    def _unravel(self, genotypes: jax.Array) -> Genotype:
        return jax.vmap(self._policy.unravel)(genotypes)

    def _told(self, told: dict[str, PyTree]) -> dict[str, PyTree]:
        told = _without_unsound(told)
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


def _without_unsound(told: dict[str, PyTree]) -> dict[str, PyTree]:
    """Replaces episodes with numbers that are not finite by those of others.

    A replay buffer keeps what it is told, and a single NaN in it would make the weights
    of the critic NaN for the rest of a run.

    Args:
        told: What the emitter is told, with ``transitions`` (N, T, ...).

    Returns:
        The same with the episodes and descriptors of sound individuals in place of
        those of others, and zeros if no individual is sound.
    """
    extra = told["extra_scores"]
    steps = extra["transitions"]
    number = len(told["descriptors"])
    sound = jnp.ones((number,), bool)
    for leaf in jax.tree.leaves(steps):
        sound = sound & jnp.all(jnp.isfinite(leaf.reshape(number, -1)), axis=1)
    own = jnp.arange(number)
    sound_first = jnp.argsort(~sound, stable=True)
    other = sound_first[own % jnp.maximum(jnp.sum(sound), 1)]
    source = jnp.where(sound, own, other)

    def replaced(leaf: jax.Array) -> jax.Array:
        return jnp.where(jnp.any(sound), leaf[source], jnp.zeros_like(leaf))

    descriptors = ("episode_descriptors",) if "episode_descriptors" in extra else ()
    names = ("transitions", *descriptors)
    found = {name: jax.tree.map(replaced, extra[name]) for name in names}
    return {
        **told,
        "descriptors": replaced(told["descriptors"]),
        "extra_scores": {**extra, **found},
    }
