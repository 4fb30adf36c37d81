"""Gradient arborescence: CMA-ES searches for steps along the gradients of a point.

This is the shared part of CMA-MEGA (Fontaine & Nikolaidis, "Differentiable Quality
Diversity", NeurIPS 2021) and CMA-MAEGA. A solution point theta has the offspring

    theta + c_0 grad f(theta) + sum_j c_j grad m_j(theta),    c ~ N(mu, Sigma)

with normalized gradients. The offspring are ranked by their effect on the
archive. CMA-ES moves mu and Sigma towards the better half, and theta takes a gradient
step towards their weighted mean. A point that has converged restarts from an elite.

E points search in parallel; their states have leaves (E, ...).
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax
from jax.core import Tracer
from jax.typing import ArrayLike
from qdax.core.containers.mapelites_repertoire import get_cells_indices
from qdax.core.emitters.emitter import Emitter

from newton_qd import checks
from newton_qd.checks import Fact, listed, message
from newton_qd.envs.state import select
from newton_qd.physics.explicit_mesh import varying_alike
from newton_qd.qd.emitters.arborescence_state import ArborescenceState
from newton_qd.qd.emitters.argument_checks import check_optimizer
from newton_qd.qd.emitters.cma_es import CMAES, CMAESState
from newton_qd.qd.emitters.ranking import best_of
from newton_qd.qd.emitters.restarts import RestartRule
from newton_qd.qd.scoring.gradient_scores import (
    GradientsError,
    Scores,
    finite_scores,
    genotype_matrix,
    normalize,
    read_scores,
)
from newton_qd.types import (
    ExtraScores,
    Genotype,
    PyTree,
    Repertoire,
    ScoringFunction,
)


class ArborescenceEmitter(Emitter, abc.ABC):
    """Emitter with E solution points; subclasses define the rank of offspring.

    Attributes:
        default_restart_rule: Default rule for the restart of a point.
    """

    default_restart_rule: ClassVar[RestartRule]

    def __init__(
        self,
        scoring_function: ScoringFunction,
        *,
        sigma_g: float,
        batch_size: int = 36,
        num_emitters: int = 1,
        optimizer: optax.GradientTransformation | None = None,
        restart_rule: RestartRule | None = None,
        restart_period: int | None = None,
        start: ArrayLike | None = None,
    ) -> None:
        """Sets up the search; evaluates nothing.

        Args:
            scoring_function: Scores solution points (E, size) with gradients, see
                ``gradient_scores.py``. The loop may use a cheaper function without
                gradients.
            sigma_g: Initial standard deviation of the coefficients, in units of the
                genotype.
            batch_size: Individuals that each point emits in one iteration: the point
                itself and ``batch_size - 1`` offspring.
            num_emitters: Number E of solution points.
            optimizer: Optimizer of the points, such as ``optax.adam(0.002)``. ``None``:
                gradient ascent with rate 1, which moves a point to the weighted mean of
                its best offspring.
            restart_rule: Rule for restarts; ``None``: the rule of the paper.
            restart_period: Restart always after this many updates.
            start: (size,) first solution point. ``None``: random elites of the initial
                repertoire.

        Raises:
            TypeError: ``scoring_function`` is no function, or ``optimizer`` is not one
                of optax.
            ValueError: A number is out of its range, or ``restart_rule`` is unknown.
        """
        allowed = "a function of scores with gradients, as Episode.scoring makes it"
        checks.function("scoring_function", scoring_function, allowed)
        if optimizer is not None:
            check_optimizer(optimizer)
        rules = [rule.value for rule in RestartRule]
        if restart_rule is not None and restart_rule not in {*RestartRule, *rules}:
            raise ValueError(message("restart_rule", restart_rule, listed(rules)))
        for name, value, low in (
            ("batch_size", batch_size, 3),
            ("num_emitters", num_emitters, 1),
            ("restart_period", 1 if restart_period is None else restart_period, 1),
        ):
            checks.integer(name, value, least=low)
        checks.number("sigma_g", sigma_g, above=0)
        self._scoring_function = scoring_function
        self._sigma_g = sigma_g
        self._population = batch_size
        self._num_emitters = num_emitters
        self._optimizer = optax.sgd(1.0) if optimizer is None else optimizer
        self._restart_rule = RestartRule(restart_rule or self.default_restart_rule)
        self._restart_period = restart_period
        self._start = start

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one iteration, of all solution points."""
        return self._num_emitters * self._population

    @abc.abstractmethod
    def _bars(self, repertoire: Repertoire) -> jax.Array:
        """Returns the fitness (cells,) above which an individual enters."""

    @abc.abstractmethod
    def _rank(
        self, fitnesses: jax.Array, bars: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Rates offspring by their effect on the archive.

        Args:
            fitnesses: (B,) fitnesses, finite.
            bars: (B,) bars of their cells.

        Returns:
            (B,) class, the higher the better, and (B,) value within a class.
        """

    def init(
        self,
        key: jax.Array,
        repertoire: Repertoire,
        genotypes: Genotype,
        fitnesses: jax.Array,
        descriptors: jax.Array,
        extra_scores: ExtraScores,
    ) -> ArborescenceState:
        """Scores the first solution points.

        Raises:
            GradientsError: The scoring function returns no gradients, gradients with a
                wrong shape, or (outside ``jit``) gradients that are not finite. Or
                ``start`` has another shape than the genotypes.
        """
        del fitnesses, extra_scores
        size, dtype = genotype_matrix(genotypes).shape[1], genotypes.dtype
        keys = jax.random.split(key, 5)
        points_key, score_key, sample_key, state_key, begin_key = keys
        if self._start is None:
            points = repertoire.select(points_key, self._num_emitters).genotypes
        else:
            if jnp.shape(self._start) != (size,):
                given = Fact(f"shape {jnp.shape(self._start)}")
                allowed = f"the genotypes' shape {(size,)}"
                raise GradientsError(message("start", given, allowed))
            points = jnp.broadcast_to(
                jnp.asarray(self._start, dtype), (self._num_emitters, size)
            )
        state = self._state(
            repertoire,
            self._fresh(points, descriptors.shape[-1], begin_key, None),
            (state_key, score_key, sample_key),
            restarts=jnp.zeros((), jnp.int32),
            rejected=jnp.zeros((), jnp.int32),
        )
        if not isinstance(state.finite, Tracer) and not state.finite.any():
            raise GradientsError(
                "extra_scores['gradients'] or the scores of every first solution point "
                "are not finite: give another start"
            )
        return state

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Moves the solution points along their gradients.

        Args:
            repertoire: Not used, because the state has all random numbers.
            emitter_state: State to emit from.
            key: Not used.

        Returns:
            (E * B, size) each point followed by its offspring; an empty dictionary.
        """
        del repertoire, key
        points = emitter_state.points[:, None]
        steps = emitter_state.coefficients @ emitter_state.gradients
        emitted = jnp.concatenate([points, points + steps], axis=1)
        return emitted.reshape(-1, emitted.shape[-1]), {}

    def state_update(
        self,
        emitter_state: PyTree,
        repertoire: Repertoire = None,
        genotypes: Genotype | None = None,
        fitnesses: Any = None,
        descriptors: Any = None,
        extra_scores: ExtraScores | None = None,
    ) -> ArborescenceState:
        """Ranks the offspring, moves the points and scores them.

        Args:
            emitter_state: State that emitted.
            repertoire: Repertoire after the addition.
            genotypes: Not used.
            fitnesses: (E * B,) fitnesses of the emitted individuals.
            descriptors: (E * B, D) descriptors of the emitted individuals.
            extra_scores: Not used.

        Raises:
            GradientsError: The scoring function returns no gradients of the right
                shape.
        """
        del genotypes, extra_scores
        state, shape = emitter_state, (self._num_emitters, self._population)
        finite = finite_scores(fitnesses, descriptors).reshape(shape)
        cells = get_cells_indices(descriptors, repertoire.centroids)
        fitnesses = jnp.where(finite, jnp.reshape(fitnesses, shape), 0)
        # The first individual of each point is the point itself.
        cma_es, improved, flat = jax.vmap(self._adapt)(
            state.cma_es,
            state.coefficients,
            fitnesses[:, 1:],
            state.bars[cells].reshape(shape)[:, 1:],
            finite[:, 1:],
        )
        # A point was counted when its gradients were found.
        lost = ~finite.at[:, 0].set(finite[:, 0] | ~state.finite)
        keys = jax.random.split(state.key, 6)
        key, elite_key, score_key, sample_key, begin_key, move_key = keys
        points, optimizer = self._moved(state, cma_es.mean, move_key)
        strategy = self._strategy(descriptors.shape[-1])
        age, stopped = state.age + 1, jax.vmap(strategy.stopped)(cma_es)
        restart = flat | ~state.finite | stopped | self._given_up(improved, age)

        elites = repertoire.select(elite_key, self._num_emitters).genotypes
        fresh = self._fresh(elites, descriptors.shape[-1], begin_key, optimizer)
        search = select(restart, fresh, (points, cma_es, optimizer, age))
        return self._state(
            repertoire,
            search,
            (key, score_key, sample_key),
            restarts=state.restarts + jnp.sum(restart, dtype=jnp.int32),
            rejected=state.rejected + jnp.sum(lost, dtype=jnp.int32),
        )

    def _given_up(self, improved: jax.Array, age: jax.Array) -> jax.Array:
        """Returns whether points restart, by the rule or by their age (E,)."""
        restart = jnp.zeros_like(improved)
        if self._restart_rule is RestartRule.NO_IMPROVEMENT:
            restart |= ~improved
        if self._restart_period is not None:
            restart |= age >= self._restart_period
        return restart

    def _strategy(self, descriptor_length: int) -> CMAES:
        return CMAES(1 + descriptor_length, self._population - 1, self._sigma_g)

    def _fresh(
        self, points: jax.Array, descriptor_length: int, key: jax.Array, old: Any
    ) -> tuple:
        """Returns new searches from points: points, CMA-ES, optimizer and age."""
        strategy = self._strategy(descriptor_length)
        return (
            points,
            jax.vmap(lambda point: strategy.init(point.dtype))(points),
            self._begun(points, descriptor_length, key, old),
            jnp.zeros(self._num_emitters, jnp.int32),
        )

    def _begun(
        self, points: jax.Array, descriptor_length: int, key: jax.Array, old: Any
    ) -> Any:
        """Returns what moves new points (E, size): states of the optimizer.

        Args:
            points: (E, size) the points.
            descriptor_length: Number of components of the descriptor.
            key: Random key, for subclasses.
            old: What moved the points before; ``None`` at the start.
        """
        del descriptor_length, key, old
        return jax.vmap(self._optimizer.init)(points)

    def _moved(
        self, state: PyTree, means: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, Any]:
        """Returns all points (E, size) after a step, and what moves them.

        Args:
            state: State before the step.
            means: (E, 1 + D) means of the coefficients.
            key: Random key, for subclasses.
        """
        del key
        return jax.vmap(self._climb)(
            state.points, state.gradients, means, state.optimizer
        )

    def _scored(
        self, points: jax.Array, optimizer: Any, key: jax.Array
    ) -> tuple[Scores, Any]:
        """Returns the scores of points with normalized gradients, and their movers."""
        scores = read_scores(points, *self._scoring_function(points, key))
        return scores.replace(gradients=normalize(scores.gradients)), optimizer

    def _state(
        self,
        repertoire: Repertoire,
        search: tuple,
        keys: tuple[jax.Array, jax.Array, jax.Array],
        restarts: jax.Array,
        rejected: jax.Array,
    ) -> ArborescenceState:
        """Scores points and draws the coefficients of their offspring.

        Args:
            repertoire: Repertoire that the offspring must improve.
            search: Points, CMA-ES, optimizer and age, leaves (E, ...).
            keys: Keys of the state, of scoring and of sampling.
            restarts: () restarts so far.
            rejected: () individuals rejected so far, without the points.
        """
        (points, cma_es, optimizer, age), (key, score_key, sample_key) = search, keys
        scores, optimizer = self._scored(points, optimizer, score_key)
        # Only the bars are computed from the repertoire with the points.
        added = repertoire.add(points, scores.descriptors, scores.fitnesses)
        strategy = self._strategy(scores.descriptors.shape[-1])
        state = ArborescenceState(
            key=key,
            points=points,
            gradients=scores.gradients,
            finite=scores.finite,
            bars=self._bars(added),
            cma_es=cma_es,
            optimizer=optimizer,
            coefficients=jax.vmap(strategy.sample)(
                cma_es, jax.random.split(sample_key, self._num_emitters)
            ),
            age=age,
            restarts=restarts,
            rejected=rejected + jnp.sum(~scores.finite, dtype=jnp.int32),
        )
        # a new distribution consists of constants
        return varying_alike(state)

    def _adapt(
        self,
        cma_es: CMAESState,
        coefficients: jax.Array,
        fitnesses: jax.Array,
        bars: jax.Array,
        finite: jax.Array,
    ) -> tuple[CMAESState, jax.Array, jax.Array]:
        """Updates the distribution of one point.

        Args:
            cma_es: Distribution of the point.
            coefficients: (B, 1 + D) coefficients of its offspring.
            fitnesses: (B,) fitnesses of the offspring, zero if not finite.
            bars: (B,) bars of their cells.
            finite: (B,) whether fitness and descriptor are finite.

        Returns:
            The new distribution, whether any offspring would enter the archive, and
            whether all of them are equally good.
        """
        best_first, flat = best_of(*self._rank(fitnesses, bars), finite)
        # Failed offspring do not move the distribution.
        pull = jnp.where(finite[:, None], coefficients, cma_es.mean)
        strategy = self._strategy(coefficients.shape[1] - 1)
        improved = jnp.any(finite & (fitnesses > bars))
        return strategy.update(cma_es, pull[best_first]), improved, flat

    def _climb(
        self, point: jax.Array, gradients: jax.Array, mean: jax.Array, optimizer: Any
    ) -> tuple[jax.Array, Any]:
        """Moves one point towards the weighted mean of its best offspring."""
        # optax minimizes.
        update, optimizer = self._optimizer.update(
            -(mean @ gradients), optimizer, point
        )
        return jnp.asarray(optax.apply_updates(point, update)), optimizer
