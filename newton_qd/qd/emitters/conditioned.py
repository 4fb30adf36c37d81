"""One actor that knows the target descriptor, for the whole archive."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from qdax.core.emitters.emitter import Emitter

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.physics.explicit_mesh import varying_alike
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic, Learner
from newton_qd.qd.emitters.aims import AimedEnv, AimedState, ConditionedPolicy
from newton_qd.qd.emitters.argument_checks import check_range
from newton_qd.qd.emitters.cells import draw_cells, draw_elites
from newton_qd.qd.scoring.gradient_scores import genotype_matrix
from newton_qd.types import (
    ExtraScores,
    Genotype,
    PyTree,
    Repertoire,
    StateLike,
)

_LARGEST = 6.0  # of the multipliers' logits
_CANDIDATES = 8  # empty cells, of which the nearest to a filled one is a target


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ConditionedState:
    """The actor between two generations.

    Attributes:
        learner: The actor; its worlds have targets.
        scale: Mean and standard deviation of observations, (no,) each.
        unit: () return that counts as much as half of the descriptor's extent: the
            largest deviation of the archive's fitness so far.
        logits: (cells,) multiplier of the distance to each cell, as a logit.
        cells: (copies,) targets of the next copies.
        failed: (1,) number of updates of the generation without a finite gradient.
        key: Key of the next generation.
    """

    learner: Learner
    scale: tuple[jax.Array, jax.Array]
    unit: jax.Array
    logits: jax.Array
    cells: jax.Array
    failed: jax.Array
    key: jax.Array


class ConditionedActorEmitter(Emitter):
    r"""Emits policies of one actor that is told the descriptor to reach.

    The actor learns over short windows through the physics (Xu et al. 2022). Its worlds
    aim at cells of the archive, filled ones and empty ones near them. It increases

    .. math:: T \left((1 - \lambda_d) \sum_t r_t / u - \lambda_d |m - d|\right)

    for a target d and the descriptor m of the episode. The multiplier
    :math:`\lambda_d` of a cell rises while policies for this cell miss it by more than
    a tolerance, and falls otherwise.

    In each generation, the actor emits copies of itself for some targets, and
    individuals between its policy for an elite's cell and the elite e,

    .. math:: a_d + s (e - a_d) + \sigma \epsilon, \qquad s \sim U(0, 1),

    with a standard deviation that is drawn log-uniformly from a range.
    """

    def __init__(
        self,
        method: ActorCritic,
        env: AimedEnv,
        policy: ConditionedPolicy,
        first: StateLike,
        *,
        copies: int,
        between: int,
        updates: int,
        spread: tuple[float, float] = (0.005, 0.1),
        empty: float = 0.5,
        tolerance: float = 0.1,
        dual_rate: float = 0.3,
        conditioned: bool = True,
    ) -> None:
        """Sets the actor and how much it learns.

        Args:
            method: Learning method of the actor, with ``env`` and ``policy``.
            env: Environment of the worlds.
            policy: Policy that depends on a target.
            first: Initial state of every episode, without target.
            copies: Copies of the actor in a generation.
            between: Individuals between the actor and elites.
            updates: Updates of the actor in a generation.
            spread: Range of the standard deviation of the noise, in units of the
                genotype.
            empty: Share of the targets that are empty cells [-].
            tolerance: Allowed distance to a target, in units of half of the
                descriptor's extent [-].
            dual_rate: Largest change of the logit of a multiplier by one policy [-].
            conditioned: Whether the actor is told its target. If not, it increases the
                return alone, and all copies are equal.

        Raises:
            TypeError: ``method`` is no ``ActorCritic``, ``policy`` no
                ``ConditionedPolicy``, or another value has the wrong type.
            ValueError: A number is out of its range.
        """
        checks.instance("method", method, ActorCritic, "an ActorCritic")
        checks.instance("policy", policy, ConditionedPolicy, "a ConditionedPolicy")
        for name, value in (("copies", copies), ("between", between)):
            checks.integer(name, value, least=0, most=None)
        if copies + between < 1:
            allowed = "at least 1 as their sum"
            raise ValueError(message("copies, between", (copies, between), allowed))
        checks.integer("updates", updates, most=None)
        check_range("spread", spread)
        checks.number("empty", empty, least=0, most=1)
        checks.number("tolerance", tolerance, above=0)
        checks.number("dual_rate", dual_rate, least=0)
        checks.flag("conditioned", conditioned)
        self._method = method
        self._env = env
        self._policy = policy
        self._first = first
        self._copies = copies
        self._between = between
        self._updates = updates
        self._spread = spread
        self._empty = empty
        self._tolerance = tolerance
        self._dual_rate = dual_rate
        self._conditioned = conditioned

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one generation."""
        return self._copies + self._between

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> PyTree:
        """Starts from the best of the initial population, for all targets.

        Raises:
            GradientsError: Genotypes are not one array.
        """
        del descriptors, extra_scores
        genotypes = genotype_matrix(genotypes)
        key, scale_key, aim_key, cell_key, critic_key = jax.random.split(key, 5)
        fitnesses = fitnesses.reshape(-1)
        actor = self._policy.unconditioned(genotypes[jnp.argmax(fitnesses)])
        length = self._method.episode_length
        finite = jnp.isfinite(fitnesses)
        kept = jnp.where(finite, fitnesses, 0)
        some = _spread(jnp.where(finite, fitnesses, -jnp.inf))
        # a mean with a mask is rounded in another way
        spread = jnp.where(jnp.all(finite), jnp.std(kept), some)
        unit = jnp.maximum(spread / length, 1e-6) * length
        logits = jnp.zeros((len(repertoire.centroids),), actor.dtype)
        worlds = self._worlds(repertoire, logits, unit, aim_key)
        aim = jnp.ones((1,), actor.dtype)
        state = ConditionedState(
            learner=self._method.begin(critic_key, actor, aim, worlds),
            scale=self._scale(scale_key, worlds),
            unit=unit,
            logits=logits,
            cells=self._targets(repertoire, cell_key, self._copies),
            failed=jnp.zeros((1,), jnp.int32),
            key=key,
        )
        return varying_alike((state, repertoire))[0]

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Specializes the actor for targets.

        Returns:
            (copies + between, size) weights, and the number of updates whose gradient
            ``overflowed``, (1,).
        """
        state, special = emitter_state, self._specialized
        copies = special(state, repertoire.centroids[state.cells])
        cell_key, part_key, size_key, noise_key = jax.random.split(key, 4)
        cells = draw_elites(repertoire, cell_key, self._between)
        white = self._method.whitening
        elites = white.whitened(repertoire.genotypes[cells], state.scale)
        actors = special(state, repertoire.descriptors[cells])
        shape, dtype = (self._between, 1), elites.dtype
        part = jax.random.uniform(part_key, shape, dtype)
        low, high = self._spread
        sizes = low * (high / low) ** jax.random.uniform(size_key, shape, dtype)
        noise = jax.random.normal(noise_key, elites.shape, dtype)
        mixed = actors + part * (elites - actors) + sizes * noise
        offspring = white.plain(jnp.concatenate([copies, mixed]), state.scale)
        return offspring, {"overflowed": state.failed}

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: Any = None,
        descriptors: Any = None,
        extra_scores: ExtraScores | None = None,
    ) -> PyTree:
        """Changes the multipliers, draws new targets, and learns for a generation."""
        del genotypes, extra_scores
        state = emitter_state
        key, aim_key, cell_key, learn_key = jax.random.split(state.key, 4)
        logits = self._multipliers(
            state,
            repertoire,
            descriptors[: self._copies],
            fitnesses.reshape(-1)[: self._copies],
        )
        # with JAX x64, QDax's archive has fitnesses in double precision
        spread = _spread(repertoire.fitnesses[:, 0]).astype(state.unit.dtype)
        unit = jnp.maximum(state.unit, spread)
        # worlds take new targets when their episodes begin
        worlds = self._worlds(repertoire, logits, unit, aim_key)
        learner = dataclasses.replace(state.learner, first=worlds)

        def learn(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            learner, failed = carry
            learner, lost = self._method.update(learner, state.scale, key)
            return (learner, failed + lost), None

        keys = jax.random.split(learn_key, self._updates)
        begin = varying_alike((learner, jnp.zeros_like(state.failed)))
        (learner, failed), _ = jax.lax.scan(learn, begin, keys)
        cells = self._targets(repertoire, cell_key, self._copies)
        return ConditionedState(learner, state.scale, unit, logits, cells, failed, key)

    def _specialized(self, state: PyTree, descriptors: jax.Array) -> jax.Array:
        """Returns the actor's policies (N, size) for descriptors (N, D)."""
        targets = self._told(self._env.scaled(descriptors))
        specialize = jax.vmap(self._policy.specialized, (None, 0))
        return specialize(state.learner.weights, targets)

    def _told(self, targets: jax.Array) -> jax.Array:
        return targets if self._conditioned else jnp.zeros_like(targets)

    def _targets(self, repertoire: Repertoire, key: jax.Array, count: int) -> jax.Array:
        """Draws cells (count,): filled ones, and empty ones near filled ones."""
        filled_key, empty_key, near_key = jax.random.split(key, 3)
        filled = repertoire.fitnesses[:, 0] > -jnp.inf
        number = round(self._empty * count)
        chosen = draw_cells(filled_key, filled, count - number)
        shape = (number, _CANDIDATES)
        some = draw_cells(empty_key, ~filled, number * _CANDIDATES).reshape(shape)
        near = draw_cells(near_key, filled, number * _CANDIDATES).reshape(shape)
        place = self._env.scaled(repertoire.centroids)
        gaps = place[some][:, :, None] - place[near][:, None]
        distance = jnp.min(jnp.sum(jnp.square(gaps), axis=-1), axis=2)
        best = jnp.argmin(distance, axis=1)
        empty = jnp.take_along_axis(some, best[:, None], axis=1)[:, 0]
        return jnp.concatenate([chosen, empty])

    def _worlds(
        self, repertoire: Repertoire, logits: jax.Array, unit: jax.Array, key: jax.Array
    ) -> AimedState:
        """Returns starts of all worlds, with new targets."""
        cells = self._targets(repertoire, key, self._method.settings.worlds)
        targets = self._told(self._env.scaled(repertoire.centroids[cells]))
        share = jax.nn.sigmoid(logits[cells])
        share = share if self._conditioned else jnp.zeros_like(share)
        length = self._method.episode_length
        weights = jnp.stack([(1 - share) * length / unit, share], axis=1)
        return jax.vmap(self._env.aimed, (None, 0, 0))(self._first, targets, weights)

    def _scale(self, key: jax.Array, worlds: AimedState) -> tuple:
        """Returns the scale of observations; that of targets is known."""
        mean, deviation = self._method.scale(key, worlds)
        size = worlds.state.obs.shape[-1]
        return mean.at[size:].set(0), deviation.at[size:].set(0.5)

    def _multipliers(
        self,
        state: PyTree,
        repertoire: Repertoire,
        descriptors: jax.Array,
        fitnesses: jax.Array,
    ) -> jax.Array:
        """Returns the logits after the last copies have reached their descriptors.

        A copy without a finite fitness had a fault, so its descriptor means nothing.
        """
        place = self._env.scaled
        missed = place(descriptors) - place(repertoire.centroids[state.cells])
        distance = jnp.linalg.norm(missed, axis=1)
        excess = jnp.clip(distance / self._tolerance - 1, -1, 1)
        counts = jnp.isfinite(excess) & jnp.isfinite(fitnesses)
        change = jnp.where(counts, self._dual_rate * excess, 0)
        logits = state.logits.at[state.cells].add(change)
        return jnp.clip(logits, -_LARGEST, _LARGEST)


def _spread(fitnesses: jax.Array) -> jax.Array:
    """Returns the standard deviation () of the fitness of the filled cells, or 0."""
    filled = fitnesses > -jnp.inf
    # without a filled cell, this is the deviation of zeros
    counted = filled | ~jnp.any(filled)
    return jnp.std(jnp.where(filled, fitnesses, 0), where=counted)
