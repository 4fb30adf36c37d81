"""Elites that move towards empty cells."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.qd.emitters.cells import empty_targets, nearest_cells
from newton_qd.qd.emitters.elite_gradients import EliteGradientEmitter, check_steps
from newton_qd.qd.scoring.gradient_scores import read_scores
from newton_qd.types import ExtraScores, PyTree, Repertoire, ScoringFunction

# Keeps the system regular if no descriptor has a gradient.
_TINY = 1e-12
# A Jacobian with larger entries is scaled to this: sums of squares may overflow.
_LARGE = 1e15


class SteeringEmitter(EliteGradientEmitter):
    r"""Moves elites to the centres of empty cells, with gradients of descriptors.

    It draws empty cells with centres c. Parents are the elites whose descriptors m are
    nearest to c. Each parent takes ``steps`` damped Gauss-Newton steps

    .. math::

        \theta \leftarrow \theta + J^T (J J^T + \lambda I)^{-1} (c - m),
        \qquad \lambda = \textrm{damping} \cdot \textrm{tr}(J J^T) / D

    with the Jacobian J (D, size) of the descriptors (Levenberg 1944 and Marquardt
    1963). The dual form is for more unknowns than equations; it gives the shortest
    step. If no cell is empty, the emitter draws from all cells.
    """

    def __init__(
        self,
        batch_size: int,
        *,
        max_step: float,
        steps: int = 1,
        scoring_function: ScoringFunction | None = None,
        damping: float = 1e-3,
    ) -> None:
        """Sets the steps.

        Args:
            batch_size: Individuals emitted in one iteration.
            max_step: Longest step, in units of the genotype.
            steps: Steps of each offspring. The first step uses the stored gradients of
                the parent.
            scoring_function: Function of scores with gradients, see
                ``gradient_scores.py``. A second step needs it.
            damping: Relative damping [-].

        Raises:
            ValueError: ``steps`` needs a ``scoring_function``, or a number is out of
                its range.
        """
        super().__init__(batch_size)
        check_steps(steps, scoring_function)
        for name, value in (("max_step", max_step), ("damping", damping)):
            checks.number(name, value, above=0)
        self._max_step = max_step
        self._steps = steps
        self._scoring_function = scoring_function
        self._damping = damping

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Draws empty cells and moves the nearest elites towards them.

        Returns:
            (batch_size, size) offspring and an empty dictionary. If gradients are not
            finite, the offspring does not move. If no elite has known gradients, all
            elites can be parents, and the first step is 0.

        Raises:
            GradientsError: The scoring function returns no gradients with the right
                shape.
        """
        target_key, score_key = jax.random.split(key)
        targets = empty_targets(repertoire, target_key, self._batch_size)
        known = emitter_state.known(repertoire)
        filled = repertoire.fitnesses[:, 0] > -jnp.inf
        wanted = jnp.where(jnp.any(known), known, filled)
        parents = nearest_cells(repertoire.descriptors, wanted, targets)
        genotypes = repertoire.genotypes[parents]
        gradients = emitter_state.at(repertoire, parents)
        genotypes += self._step(
            gradients[:, 1:], targets - repertoire.descriptors[parents]
        )

        def step(genotypes: jax.Array, key: jax.Array) -> tuple[jax.Array, None]:
            assert self._scoring_function is not None
            scores = read_scores(genotypes, *self._scoring_function(genotypes, key))
            error = jnp.where(scores.finite[:, None], targets - scores.descriptors, 0)
            return genotypes + self._step(scores.gradients[:, 1:], error), None

        if self._steps > 1:
            keys = jax.random.split(score_key, self._steps - 1)
            genotypes, _ = jax.lax.scan(step, genotypes, keys)
        return genotypes, {}

    def _step(self, jacobian: jax.Array, error: jax.Array) -> jax.Array:
        """Returns steps (N, size) against errors (N, D), for Jacobians (N, D, size)."""
        size = jacobian.shape[1]
        error = error.astype(jacobian.dtype)
        largest = jnp.max(jnp.abs(jacobian), axis=(1, 2), keepdims=True)
        large = largest > _LARGE
        scale = jnp.where(large, _LARGE / jnp.where(large, largest, 1), 1)
        jacobian = jacobian * scale
        gram = jnp.einsum("nds,nes->nde", jacobian, jacobian)
        damping = self._damping * jnp.trace(gram, axis1=1, axis2=2) / size + _TINY
        gram += damping[:, None, None] * jnp.eye(size, dtype=gram.dtype)
        weights = jnp.linalg.solve(gram, error[..., None])[..., 0]
        step = jnp.einsum("nd,nds->ns", weights, jacobian) * scale[:, 0]
        length = jnp.linalg.norm(step, axis=1, keepdims=True)
        return step * (self._max_step / jnp.maximum(length, self._max_step))
