"""Gradient steps as the variation operator of MAP-Elites."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import ArrayLike
from qdax.core.emitters.repertoire_selectors.selector import Selector

from newton_qd.checks import Fact, message
from newton_qd.qd.emitters.argument_checks import check_optimizer
from newton_qd.qd.emitters.elite_gradients import EliteGradientEmitter, check_steps
from newton_qd.qd.scoring.gradient_scores import normalize, read_scores
from newton_qd.types import (
    ExtraScores,
    Genotype,
    PyTree,
    Repertoire,
    ScoringFunction,
)


class GradientVariationEmitter(EliteGradientEmitter):
    r"""Elites increase their fitness, or move along descriptors, by exact gradients.

    Each parent draws one of the given directions d and takes ``steps`` steps of an
    optimizer along

    .. math:: d_0 \nabla f(\theta) + \sum_j d_j \nabla m_j(\theta)

    with normalized gradients. This is the policy-gradient variation of PGA-ME (Nilsson
    & Cully, "Policy Gradient Assisted MAP-Elites", GECCO 2021), with the exact gradient
    of the return instead of the gradient of a critic. Like Fontaine & Nikolaidis 2021,
    it can also use gradients of descriptors. Combine it with an emitter of random
    variations, such as QDax's ``MixingEmitter``.
    """

    def __init__(
        self,
        batch_size: int,
        optimizer: optax.GradientTransformation,
        *,
        steps: int = 1,
        scoring_function: ScoringFunction | None = None,
        directions: ArrayLike | None = None,
        selector: Selector | None = None,
    ) -> None:
        """Sets the steps and their directions.

        Args:
            batch_size: Individuals emitted in one iteration.
            optimizer: Optimizer, such as ``optax.adam(0.01)``. Each offspring starts
                with a new state.
            steps: Gradient steps of each offspring. The first step uses the stored
                gradients of the parent.
            scoring_function: Function of scores with gradients, see
                ``gradient_scores.py``. A second step needs it.
            directions: (K, 1 + D) coefficients of the normalized gradients, first of
                the fitness. ``None``: only the fitness, (1, 0, ..., 0).
            selector: Selector of QDax; ``None``: uniform, with replacement.

        Raises:
            TypeError: ``optimizer`` is not one of optax, or ``selector`` is not an
                instance of QDax's ``Selector``.
            ValueError: ``steps`` needs a ``scoring_function``, ``directions`` is not a
                finite matrix with a row, or a number is out of its range.
        """
        super().__init__(batch_size, selector)
        check_optimizer(optimizer)
        check_steps(steps, scoring_function)
        if directions is not None:
            directions = _matrix(directions)
        self._optimizer = optimizer
        self._steps = steps
        self._scoring_function = scoring_function
        self._directions = directions

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Draws parents and moves each along its direction.

        Returns:
            (batch_size, size) offspring and an empty dictionary. If gradients are not
            finite, the offspring does not move.

        Raises:
            GradientsError: The scoring function returns no gradients with the right
                shape.
            ValueError: ``directions`` does not fit the number of descriptors.
        """
        parent_key, direction_key, score_key = jax.random.split(key, 3)
        cells = emitter_state.select(
            repertoire, parent_key, self._batch_size, self._selector
        )
        genotypes = repertoire.genotypes[cells]
        gradients = emitter_state.at(repertoire, cells)
        directions = self._draw(direction_key, gradients)
        states = jax.vmap(self._optimizer.init)(genotypes)

        def climb(genotypes: Genotype, states: Any, gradients: Any) -> tuple[Any, Any]:
            ascent = jnp.einsum("nr,nrs->ns", directions, normalize(gradients))
            # optax minimizes.
            update: Any = jax.vmap(self._optimizer.update)
            updates, states = update(-ascent, states, genotypes)
            # Momentum must not move an offspring without a gradient.
            moves = jnp.any(gradients != 0, axis=(1, 2))[:, None]
            return genotypes + jnp.where(moves, updates, 0), states

        def step(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            genotypes, states = carry
            assert self._scoring_function is not None
            scored = self._scoring_function(genotypes, key)
            gradients = read_scores(genotypes, *scored).gradients
            return climb(genotypes, states, gradients), None

        carry = climb(genotypes, states, gradients)
        if self._steps > 1:
            keys = jax.random.split(score_key, self._steps - 1)
            carry, _ = jax.lax.scan(step, carry, keys)
        return carry[0], {}

    def _draw(self, key: jax.Array, gradients: jax.Array) -> jax.Array:
        """Draws directions (N, 1 + D) for gradients (N, 1 + D, size).

        Raises:
            ValueError: The length of a direction is not 1 + D.
        """
        count, rows = gradients.shape[:2]
        directions = self._directions
        if directions is None:
            directions = np.eye(1, rows)
        if directions.shape[1] != rows:
            given = Fact(f"{directions.shape[1]} columns")
            raise ValueError(message("directions", given, f"1 + D = {rows} columns"))
        drawn = jax.random.randint(key, (count,), 0, len(directions))
        return jnp.asarray(directions, gradients.dtype)[drawn]


def _matrix(directions: ArrayLike) -> np.ndarray:
    """Returns directions (K, 1 + D) as an array.

    Raises:
        ValueError: They are not a finite matrix with at least one row.
    """
    allowed = "finite numbers (K, 1 + D), K from 1"
    try:
        found = np.asarray(directions)
    except ValueError as failure:  # rows of several lengths
        raise ValueError(message("directions", directions, allowed)) from failure
    real = found.dtype.kind in "biuf" and found.ndim == 2 and len(found) > 0
    # optimizers work with single precision
    if not real or not np.all(np.abs(found) <= np.finfo(np.float32).max):
        raise ValueError(message("directions", found.tolist(), allowed))
    return found
