"""Actors that learn during the search and add their policies to the archive."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from qdax.core.emitters.emitter import Emitter

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs.state import select
from newton_qd.physics.explicit_mesh import varying_alike
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic, Learner
from newton_qd.qd.emitters.argument_checks import check_range
from newton_qd.qd.emitters.cells import draw_elites, empty_targets
from newton_qd.qd.emitters.episode_learner import EpisodeLearning
from newton_qd.qd.emitters.restarts import LONGEST_LIFE, due_for_restart
from newton_qd.qd.scoring.gradient_scores import genotype_matrix
from newton_qd.types import (
    ExtraScores,
    Genotype,
    PyTree,
    Repertoire,
    StateLike,
)

Update: TypeAlias = Callable[
    [Learner, tuple[jax.Array, jax.Array], jax.Array], tuple[Learner, jax.Array]
]
"""Maps an actor, the scale of observations and a key to the actor after an update, and
whether its gradient was lost ()."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ActorCriticState:
    """Actors between two generations.

    Attributes:
        learners: The K actors, leaves (K, ...).
        scale: Mean and standard deviation of observations, (no,) each.
        snapshots: (branches, K, size) weights of the actors during the generation, for
            whitened observations.
        failed: (K,) number of updates of the generation without a finite gradient.
        generation: () number of generations of the actors.
        key: Key of the next generation.
    """

    learners: Learner
    scale: tuple[jax.Array, jax.Array]
    snapshots: jax.Array
    failed: jax.Array
    generation: jax.Array
    key: jax.Array


class ActorCriticEmitter(Emitter):
    r"""Emits the policies of actors that learn with gradients of the physics.

    PGA-ME (Nilsson and Cully 2021) emits the policy of its greedy actor. This emitter
    does the same with several actors, and with the short-horizon actor-critic (Xu et
    al. 2022) instead of TD3. Some actors maximize the fitness. The others follow a
    direction u in descriptor space, drawn uniformly from the sphere. They maximize the
    sum of

    .. math:: \lambda r_t + u \cdot m_t,

    where :math:`m_t` is the measure that a control step adds to the descriptor. So they
    move in this direction, to the border of the archive. After a number of generations,
    they restart from a random elite with another direction.

    An actor a emits several individuals at several times. One of them is a copy of its
    weights. The others lie between the actor and elites e,

    .. math:: a + s (e - a) + \sigma \epsilon, \qquad s \sim U(0, 1),

    with a standard deviation that is drawn log-uniformly from a range.
    """

    def __init__(
        self,
        method: ActorCritic,
        first: StateLike,
        *,
        actors: int,
        branches: int,
        copies: int = 1,
        updates: int,
        spread: tuple[float, float] = (0.005, 0.1),
        steered: float = 0.5,
        fitness: float = 0.1,
        lifetime: int = 10,
        measures: int,
        later: EpisodeLearning | None = None,
        to_empty: float = 0.0,
    ) -> None:
        """Sets the actors and how much they learn.

        Args:
            method: Learning method of an actor.
            first: Initial state of every episode.
            actors: Number of actors.
            branches: Times per generation that actors produce offspring.
            copies: Offspring of an actor each time.
            updates: Updates of each actor before each time.
            spread: Range of the standard deviation of the noise, in units of the
                genotype.
            steered: Share of the actors that follow directions of the descriptor [-].
            fitness: Weight of the reward for steered actors [-].
            lifetime: Generations after which a steered actor restarts.
            measures: Length of the descriptor.
            later: How actors learn after some generations; ``None``: as before.
            to_empty: Share of the steered actors that restart with the direction from
                their elite to an empty cell [-]; the others have random directions.

        Raises:
            TypeError: ``method`` is no ``ActorCritic``, ``later`` no
                ``EpisodeLearning``, or another value has the wrong type.
            ValueError: A number is out of its range.
        """
        checks.instance("method", method, ActorCritic, "an ActorCritic")
        allowed = "an EpisodeLearning"
        checks.instance("later", later, EpisodeLearning, allowed, optional=True)
        counts = {"actors": actors, "branches": branches, "copies": copies}
        counts = {**counts, "updates": updates}
        for name, value in counts.items():
            checks.integer(name, value, most=None)
        checks.integer("lifetime", lifetime, most=LONGEST_LIFE)
        checks.integer("measures", measures)
        check_range("spread", spread)
        for name, share in {"steered": steered, "to_empty": to_empty}.items():
            checks.number(name, share, least=0, most=1)
        checks.number("fitness", fitness)
        self._method = method
        self._first = first
        self._actors = actors
        self._branches = branches
        self._copies = copies
        self._spread = spread
        self._updates = updates
        # steered actors are last
        self._follow = np.arange(actors) >= actors - round(steered * actors)
        self._fitness = fitness
        self._lifetime = lifetime
        self._measures = measures
        self._later = later
        self._to_empty = to_empty

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one generation."""
        return self._actors * self._branches * self._copies

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> PyTree:
        """Starts from weights of the initial population.

        With whitening, they are read as weights for whitened observations, which makes
        them other policies.

        Raises:
            GradientsError: Genotypes are not one array.
            ValueError: ``measures`` is not the length of a descriptor.
        """
        del extra_scores
        genotypes = genotype_matrix(genotypes)
        length = descriptors.shape[-1]
        if self._measures != length:
            allowed = f"{length}, the length of a descriptor"
            raise ValueError(message("measures", self._measures, allowed))
        key, scale_key, aim_key, critic_key = jax.random.split(key, 4)
        # repeats the best if there are more actors than individuals
        order = jnp.resize(jnp.argsort(-fitnesses.reshape(-1)), (self._actors,))
        weights = genotypes[order]
        learners = self._begun(critic_key, weights, self._aims(aim_key))
        state = ActorCriticState(
            learners=learners,
            scale=self._method.scale(scale_key, self._method.worlds(self._first)),
            snapshots=jnp.tile(weights, (self._branches, 1, 1)),
            failed=jnp.zeros((self._actors,), jnp.int32),
            generation=jnp.zeros((), jnp.int32),
            key=key,
        )
        return varying_alike((state, repertoire))[0]

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Draws individuals between actors and elites.

        Returns:
            (copies * branches * actors, size) weights, and the number of gradients that
            ``overflowed``, (actors,).
        """
        white, scale = self._method.whitening, emitter_state.scale
        snapshots = emitter_state.snapshots
        actors = snapshots.reshape(-1, snapshots.shape[-1])
        cell_key, part_key, size_key, noise_key = jax.random.split(key, 4)
        shape = (self._copies - 1, len(actors))
        cells = draw_elites(repertoire, cell_key, shape[0] * shape[1])
        elites = white.whitened(repertoire.genotypes[cells], scale)
        elites = elites.reshape(*shape, actors.shape[-1])
        dtype = actors.dtype
        part = jax.random.uniform(part_key, (*shape, 1), dtype)
        smallest, largest = self._spread
        sizes = jax.random.uniform(size_key, (*shape, 1), dtype)
        sizes = smallest * (largest / smallest) ** sizes
        noise = jax.random.normal(noise_key, elites.shape, dtype)
        between = actors + part * (elites - actors) + sizes * noise
        offspring = jnp.concatenate([actors, between.reshape(-1, actors.shape[-1])])
        overflowed = {"overflowed": emitter_state.failed}
        return white.plain(offspring, scale), overflowed

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: jax.Array | None = None,
        descriptors: jax.Array | None = None,
        extra_scores: ExtraScores | None = None,
    ) -> PyTree:
        """Restarts actors at the end of their lifetime; learns for a generation."""
        del genotypes, fitnesses, descriptors, extra_scores
        state = emitter_state
        key, renewal_key, learn_key = jax.random.split(state.key, 3)
        learners = self._renewed(state, repertoire, renewal_key)
        by_windows = functools.partial(
            self._learned, self._method.update, self._updates
        )
        told = learners, state.scale, learn_key
        later = self._later
        if later is None:
            learners, failed, snapshots = by_windows(*told)
        else:
            learners, failed, snapshots = jax.lax.cond(
                state.generation >= later.after,
                functools.partial(self._by_episodes, later, state.generation),
                by_windows,
                *told,
            )
        return ActorCriticState(
            learners, state.scale, snapshots, failed, state.generation + 1, key
        )

    def _learned(
        self,
        method: Update,
        updates: int,
        learners: Learner,
        scale: PyTree,
        key: jax.Array,
    ) -> tuple[Learner, jax.Array, jax.Array]:
        """Returns actors, lost gradients and snapshots after a generation."""
        update = jax.vmap(method, in_axes=(0, None, 0))

        def learn(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            learners, failed = carry
            keys = jax.random.split(key, self._actors)
            learners, lost = update(learners, scale, keys)
            return (learners, failed + lost), None

        def branch(carry: tuple, key: jax.Array) -> tuple[tuple, jax.Array]:
            keys = jax.random.split(key, updates)
            carry, _ = jax.lax.scan(learn, carry, keys)
            return carry, carry[0].weights

        begin = varying_alike((learners, jnp.zeros((self._actors,), jnp.int32)))
        keys = jax.random.split(key, self._branches)
        (learners, failed), snapshots = jax.lax.scan(branch, begin, keys)
        return learners, failed, snapshots

    def _by_episodes(
        self,
        later: EpisodeLearning,
        generation: jax.Array,
        learners: Learner,
        scale: PyTree,
        key: jax.Array,
    ) -> tuple[Learner, jax.Array, jax.Array]:
        """Does what ``_learned`` does, from whole episodes."""
        # these gradients have another length than those of windows, which the optimizer
        # remembers
        fresh = jax.vmap(self._method.moved)(learners, learners.weights)
        learners = select(generation == later.after, fresh, learners)
        return self._learned(later.update, later.updates, learners, scale, key)

    def _begun(self, key: jax.Array, weights: jax.Array, aims: jax.Array) -> Learner:
        """Returns K new actors with weights (K, size)."""
        keys = jax.random.split(key, self._actors)
        begin = jax.vmap(self._method.begin, in_axes=(0, 0, 0, None))
        return begin(keys, weights, aims, self._method.worlds(self._first))

    def _aims(self, key: jax.Array) -> jax.Array:
        """Returns the aims (K, 1 + D) of the actors; steered actors are last."""
        shape = (self._actors, self._measures)
        ways = jax.random.normal(key, shape, jnp.float32)
        ways = ways / jnp.linalg.norm(ways, axis=1, keepdims=True)
        steered = self._follow
        return jnp.concatenate(
            [
                jnp.where(steered, jnp.float32(self._fitness), 1)[:, None],
                jnp.where(steered[:, None], ways, 0),
            ],
            axis=1,
        )

    def _toward_empty(
        self,
        aims: jax.Array,
        repertoire: Repertoire,
        cells: jax.Array,
        key: jax.Array,
    ) -> jax.Array:
        """Returns the aims; some actors go from their elite to an empty cell.

        Args:
            aims: (K, 1 + D) aims.
            repertoire: The archive.
            cells: (K,) cells of the elites from which the actors restart.
            key: Key of the choice.
        """
        cell_key, choice_key = jax.random.split(key)
        targets = empty_targets(repertoire, cell_key, self._actors)
        ways = targets - repertoire.descriptors[cells]
        lengths = jnp.linalg.norm(ways, axis=1, keepdims=True)
        ways = ways / jnp.where(lengths > 0, lengths, 1)
        chosen = jax.random.uniform(choice_key, (self._actors,)) < self._to_empty
        chosen = chosen & self._follow
        return aims.at[:, 1:].set(jnp.where(chosen[:, None], ways, aims[:, 1:]))

    def _renewed(
        self, state: ActorCriticState, repertoire: Repertoire, key: jax.Array
    ) -> Learner:
        """Returns the actors; restarts those with a finished lifetime from elites."""
        aim_key, cell_key, critic_key = jax.random.split(key, 3)
        cells = draw_elites(repertoire, cell_key, self._actors)
        weights = repertoire.genotypes[cells]
        weights = self._method.whitening.whitened(weights, state.scale)
        aims = self._aims(aim_key)
        if self._to_empty:
            empty_key = jax.random.fold_in(aim_key, 1)
            aims = self._toward_empty(aims, repertoire, cells, empty_key)
        new = self._begun(critic_key, weights, aims)
        due = due_for_restart(state.generation, self._lifetime, self._actors)
        begun = state.generation > 0
        return select(due & self._follow & begun, new, state.learners)
