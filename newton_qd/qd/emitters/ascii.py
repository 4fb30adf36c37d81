"""Variation by behavior: with behaviors of others, or with exact gradients."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from qdax.core.emitters.emitter import Emitter

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.gradients.exact import EpisodeGradient
from newton_qd.qd.emitters.argument_checks import check_range
from newton_qd.qd.emitters.behaviors import (
    Behavior,
    FlatPolicy,
    Interpolation,
    behavior_of,
    interpolated,
    preference,
)
from newton_qd.qd.emitters.cells import accepted_cells, draw_cells, draw_elites
from newton_qd.qd.scoring.gradient_scores import genotype_matrix
from newton_qd.types import ExtraScores, Genotype, PyTree, Repertoire


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class AsciiState:
    """Behaviors between two generations.

    Attributes:
        elites: Behavior of the elite of each cell, leaves (cells, T, ...), without
            actions.
        fitnesses: (cells,) fitness of the individual with this behavior. It counts only
            while the cell has an individual with this fitness.
        others: Behaviors of the last generation, leaves (N, T, ...).
    """

    elites: Behavior
    fitnesses: jax.Array
    others: Behavior


class AsciiEmitter(Emitter):
    """The ASCII operator of ASCII-ME (Mitsides, Faldor and Cully 2025).

    Each parent is moved by the behavior of one individual of the last generation:
    towards its actions in the steps from which it got a higher return than the parent,
    and away from them in the others. The scoring function must return ``transitions``.
    ASCII-ME is this emitter together with iso+line variations.

    The state has the behaviors of a whole generation, those of other emitters included.
    So in ``jax.lax.scan``, the initial population must be as large as a generation.
    """

    def __init__(
        self,
        policy: FlatPolicy,
        settings: Interpolation,
        *,
        batch_size: int,
        episode_length: int,
        rate: float = 3e-3,
        discount: float = 0.99,
    ) -> None:
        """Sets the operator.

        Args:
            policy: The policy.
            settings: Settings of the operator.
            batch_size: Individuals emitted in one generation.
            episode_length: Control steps of an episode.
            rate: Learning rate of Adam [-].
            discount: Discount of a control step [-].

        Raises:
            TypeError: ``policy`` is no function, ``settings`` no ``Interpolation``, or
                another value has the wrong type.
            ValueError: A number is out of its range.
        """
        _check_operator(policy, settings)
        checks.integer("batch_size", batch_size, most=None)
        checks.integer("episode_length", episode_length, most=None)
        checks.number("rate", rate, above=0)
        checks.number("discount", discount, least=0, most=1)
        self._policy = policy
        self._settings = settings
        self._batch_size = batch_size
        self._length = episode_length
        self._rate = rate
        self._discount = discount

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one generation."""
        return self._batch_size

    @property
    def use_all_data(self) -> bool:
        """Whether it learns of the offspring of other emitters: always true."""
        return True

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> PyTree:
        """Stores the behaviors of the initial population.

        Raises:
            GradientsError: Genotypes are not one array.
            ValueError: The scoring function returns no transitions.
        """
        del key, fitnesses
        genotypes = genotype_matrix(genotypes)
        seen = self._seen(extra_scores)
        cells = repertoire.centroids.shape[0]

        def empty(leaf: jax.Array) -> jax.Array:
            return jnp.zeros((cells, *leaf.shape[1:]), leaf.dtype)

        worst = jnp.full((cells,), -jnp.inf, repertoire.fitnesses.dtype)
        state = AsciiState(jax.tree.map(empty, _without_actions(seen)), worst, seen)
        return _stored(state, repertoire, genotypes, descriptors, seen)

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Draws parents and other behaviors, and varies the parents.

        Returns:
            (batch_size, size) offspring and an empty dictionary.
        """
        parent_key, other_key = jax.random.split(key)
        filled = repertoire.fitnesses[:, 0] > -jnp.inf
        known = filled & (repertoire.fitnesses[:, 0] == emitter_state.fitnesses)
        wanted = jnp.where(jnp.any(known), known, filled)
        cells = draw_cells(parent_key, wanted, self._batch_size)
        number = len(emitter_state.others.returns)
        drawn = jax.random.randint(other_key, (self._batch_size,), 0, number)

        def vary(cell: jax.Array, row: jax.Array) -> jax.Array:
            own = jax.tree.map(lambda x: x[cell], emitter_state.elites)
            other = jax.tree.map(lambda x: x[row], emitter_state.others)
            preferred = preference(own, other, self._settings.similarity)
            weights = repertoire.genotypes[cell]
            return interpolated(
                self._policy, weights, other, preferred, self._rate, self._settings
            )

        return jax.vmap(vary)(cells, drawn), {}

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: Any = None,
        descriptors: Any = None,
        extra_scores: Any = None,
    ) -> PyTree:
        """Stores the behaviors of the generation and of the new elites."""
        del fitnesses
        seen = self._seen(extra_scores)
        return _stored(emitter_state, repertoire, genotypes, descriptors, seen)

    def _seen(self, extra_scores: ExtraScores) -> Behavior:
        """Returns the behaviors of a generation.

        Raises:
            ValueError: The scoring function returns no transitions.
        """
        if "transitions" not in extra_scores:
            allowed = "a scoring function that returns transitions"
            raise ValueError(message("extra scores", sorted(extra_scores), allowed))
        steps = extra_scores["transitions"]
        return behavior_of(steps, self._length, self._discount)


def _without_actions(behavior: Behavior) -> Behavior:
    return dataclasses.replace(behavior, actions=behavior.actions[..., :0])


def _stored(
    state: AsciiState,
    repertoire: Repertoire,
    genotypes: Any,
    descriptors: jax.Array,
    seen: Behavior,
) -> AsciiState:
    """Returns the state with a generation that the repertoire has seen."""
    cells, held = accepted_cells(repertoire, genotypes, descriptors)
    held &= seen.counts[:, 0] > 0
    target = jnp.where(held, cells, len(state.fitnesses))
    fitnesses = repertoire.fitnesses[cells, 0]
    return AsciiState(
        elites=jax.tree.map(
            lambda old, new: old.at[target].set(new, mode="drop"),
            state.elites,
            _without_actions(seen),
        ),
        fitnesses=state.fitnesses.at[target].set(fitnesses, mode="drop"),
        others=seen,
    )


class ExactAsciiEmitter(Emitter):
    r"""The ASCII operator with exact gradients in place of another behavior.

    ASCII-ME estimates which actions raise the return from another behavior. Here the
    physics says it: with the derivative :math:`g_t = dR / da_t` of the return of the
    parent's own episode, at fixed actions of all other steps, the parent moves towards

    .. math:: a_t + s \frac{g_t / G}{\max(1, |g_t| / G)},

    where G is the median of :math:`|g_t|` over the episode. The derivative goes through
    the physics, not through the policy, so feedback does not make it larger. Several
    offspring of a parent share one derivative and differ in the learning rate, which is
    drawn log-uniformly, and in the steps that they learn from. The state of this
    emitter is empty.
    """

    def __init__(
        self,
        policy: FlatPolicy,
        rollout: Callable[[jax.Array, jax.Array], dict[str, jax.Array]],
        gradient: EpisodeGradient,
        settings: Interpolation,
        *,
        parents: int,
        branches: int,
        reach: float = 0.3,
        rates: tuple[float, float] = (3e-5, 3e-3),
        samples: int | None = None,
    ) -> None:
        """Sets the operator.

        Args:
            policy: The policy.
            rollout: Maps genotypes (N, size) and a key to their transitions.
            gradient: Gradient of the return with respect to actions (N, T, nu) of an
                episode with the same start, such as :meth:`newton_qd.Episode.gradient`
                without policy and descriptor.
            settings: Settings of the operator. ``clip`` and ``similarity`` have no
                effect, because no policy moves away from an action.
            parents: Parents in one generation.
            branches: Offspring of each parent.
            reach: Largest change s of an action that the operator aims at [-].
            rates: Range of the learning rate [-].
            samples: Steps of the episode that an offspring learns from, drawn with
                replacement; ``None``: all.

        Raises:
            TypeError: A function cannot be called, ``settings`` is no
                ``Interpolation``, or another value has the wrong type.
            ValueError: A number is out of its range.
        """
        _check_operator(policy, settings)
        checks.function("rollout", rollout, "a function of genotypes and a key")
        allowed = "a function, such as Episode.gradient"
        checks.function("gradient", gradient, allowed)
        for name, value in (("parents", parents), ("branches", branches)):
            checks.integer(name, value, most=None)
        checks.integer("samples", samples, most=None, optional=True)
        checks.number("reach", reach, above=0)
        check_range("rates", rates)
        self._policy = policy
        self._rollout = rollout
        self._gradient = gradient
        self._settings = settings
        self._parents = parents
        self._branches = branches
        self._reach = reach
        self._rates = rates
        self._samples = samples

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one generation."""
        return self._parents * self._branches

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Draws parents, and moves each along the derivative of its return.

        Returns:
            (parents * branches, size) offspring, and whether a derivative
            ``overflowed`` or was lost to a fault, (parents,). Such a parent does not
            move, and neither does one whose derivative is 0.

        Raises:
            GradientsError: Genotypes are not one array.
        """
        del emitter_state
        cell_key, rate_key, step_key, score_key = jax.random.split(key, 4)
        cells = draw_elites(repertoire, cell_key, self._parents)
        weights = genotype_matrix(repertoire.genotypes)[cells]
        steps = self._rollout(weights, score_key)
        own = behavior_of(steps, steps["rewards"].shape[1], 1.0)
        found = self._gradient(own.actions, score_key)
        better = dataclasses.replace(
            own, actions=improved(own, found.gradients[:, 0], self._reach)
        )
        shape = (self._parents, self._branches)
        low, high = self._rates
        part = jax.random.uniform(rate_key, shape, weights.dtype)
        rates = low * (high / low) ** part

        def vary(start: Any, aim: Behavior, rate: Any, key: Any) -> jax.Array:
            if self._samples is not None:
                length = len(aim.counts)
                drawn = jax.random.randint(key, (self._samples,), 0, length)
                aim = jax.tree.map(lambda leaf: leaf[drawn], aim)
            return interpolated(
                self._policy, start, aim, aim.counts, rate, self._settings
            )

        keys = jax.random.split(step_key, shape)
        branch = jax.vmap(vary, (None, None, 0, 0))
        offspring = jax.vmap(branch)(weights, better, rates, keys)
        lost = jnp.any(found.overflowed, axis=1) | found.faulty
        flat = ~jnp.any(found.gradients[:, 0] != 0, axis=(1, 2))
        # without slopes, Adam would make full steps of rounding errors
        still = (lost | flat)[:, None, None]
        offspring = jnp.where(still, weights[:, None], offspring)
        return offspring.reshape(-1, weights.shape[1]), {"overflowed": lost}


def improved(own: Behavior, slopes: jax.Array, reach: float) -> jax.Array:
    """Returns actions (N, T, nu) that raise the returns of N episodes.

    Args:
        own: The behaviors.
        slopes: (N, T, nu) derivatives of the returns with respect to the actions.
        reach: Largest change of an action [-].
    """
    # scaled first: squares of large numbers are not finite in single precision
    largest = jnp.max(jnp.abs(slopes), axis=(1, 2), keepdims=True)
    slopes = slopes / jnp.where(largest > 0, largest, 1)
    lengths = jnp.linalg.norm(slopes, axis=-1)
    known = jnp.where((own.counts > 0) & (lengths > 0), lengths, jnp.nan)
    typical = jnp.nanmedian(known, axis=1, keepdims=True)
    typical = jnp.where(typical > 0, typical, 1)
    unit = slopes / jnp.maximum(lengths, typical)[..., None]
    return jnp.clip(own.actions + reach * unit, -1, 1)


def _check_operator(policy: FlatPolicy, settings: Interpolation) -> None:
    """Checks what the operator needs.

    Raises:
        TypeError: ``policy`` is no function, or ``settings`` no ``Interpolation``.
    """
    checks.function("policy", policy, "a function of weights and an observation")
    checks.instance("settings", settings, Interpolation, "an Interpolation")
