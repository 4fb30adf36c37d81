"""Several offspring along one gradient of each parent."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from qdax.core.emitters.emitter import Emitter

from newton_qd import checks
from newton_qd.gradients.exact import DirectionalGradient
from newton_qd.qd.emitters.cells import draw_cells, empty_targets, nearest_cells
from newton_qd.qd.scoring.gradient_scores import genotype_matrix
from newton_qd.types import ExtraScores, PyTree, Repertoire


class GradientLineEmitter(Emitter):
    r"""Places several offspring along the gradient of each parent.

    A parent :math:`\theta` has the offspring

    .. math:: \theta + s_i \frac{g}{|g|}, \qquad \log s_i \sim U

    with log-uniform step lengths from the shortest to the longest. They are stratified:
    there are as many strata as offspring, and each has one step length. Some parents
    increase their fitness, :math:`g = \nabla f(\theta)`. They are drawn uniformly from
    the elites. The others move towards the centre c of an empty cell, :math:`g =
    -\nabla |m(\theta) - c|^2 / 2`. They are the elites whose descriptors m are nearest
    to c.

    Several offspring use one row of a gradient, and the archive selects the best step
    length. If a gradient costs many evaluations, this is cheaper than
    ``GradientVariationEmitter``. Step lengths do not depend on the units of the task.
    The state of this emitter is empty.
    """

    def __init__(
        self,
        gradient: DirectionalGradient,
        *,
        parents: int,
        branches: int,
        shortest: float,
        longest: float,
        steered: float = 0.5,
    ) -> None:
        """Sets the parents and the steps.

        Args:
            gradient: Gradient along directions, such as
                :meth:`newton_qd.Episode.directional`.
            parents: Parents in one iteration.
            branches: Offspring of each parent.
            shortest: Shortest step, in units of the genotype.
            longest: Longest step.
            steered: Share of the parents that move towards empty cells [-].

        Raises:
            TypeError: ``gradient`` is not a function, or a number is none.
            ValueError: A number is out of its range.
        """
        checks.function("gradient", gradient, "a function, such as Episode.directional")
        for name, value in (("parents", parents), ("branches", branches)):
            checks.integer(name, value, most=None)
        checks.number("shortest", shortest, above=0)
        checks.number("longest", longest, least=shortest)
        checks.number("steered", steered, least=0, most=1)
        self._gradient = gradient
        self._parents = parents
        self._branches = branches
        self._steps = shortest, longest
        self._steered = round(steered * parents)

    @property
    def batch_size(self) -> int:
        """Individuals emitted in one iteration."""
        return self._parents * self._branches

    def emit(
        self, repertoire: Repertoire, emitter_state: PyTree, key: jax.Array
    ) -> tuple[jax.Array, ExtraScores]:
        """Draws parents and follows one gradient of each.

        Returns:
            (parents * branches, size) offspring, and whether a gradient ``overflowed``,
            (parents,). If a gradient is zero or not finite, the direction is random.

        Raises:
            GradientsError: Genotypes are not one array.
        """
        del emitter_state
        climb_key, target_key, step_key, way_key, score_key = jax.random.split(key, 5)
        filled = repertoire.fitnesses[:, 0] > -jnp.inf
        climbing = self._parents - self._steered
        climbers = draw_cells(climb_key, filled, climbing)
        targets = empty_targets(repertoire, target_key, self._steered)
        movers = nearest_cells(repertoire.descriptors, filled, targets)
        cells = jnp.concatenate([climbers, movers])

        error = targets - repertoire.descriptors[movers]
        uphill = jnp.eye(1, 1 + error.shape[1], dtype=error.dtype)
        towards = jnp.pad(error, ((0, 0), (1, 0)))
        directions = jnp.concatenate([jnp.tile(uphill, (climbing, 1)), towards])
        genotypes = genotype_matrix(repertoire.genotypes)[cells]
        found = self._gradient(genotypes, directions[:, None], score_key)
        units = _units(found.gradients[:, 0], way_key)
        steps = self._draw(step_key, genotypes.dtype)
        offspring = genotypes[:, None] + steps[..., None] * units[:, None]
        lost = found.overflowed[:, 0] | found.faulty
        return offspring.reshape(-1, offspring.shape[-1]), {"overflowed": lost}

    def _draw(self, key: jax.Array, dtype: Any) -> jax.Array:
        """Draws step lengths (parents, branches)."""
        drawn = jax.random.uniform(key, (self._parents, self._branches), dtype)
        stratum = (jnp.arange(self._branches, dtype=dtype) + drawn) / self._branches
        shortest, longest = self._steps
        return shortest * (longest / shortest) ** stratum


def _units(gradients: jax.Array, key: jax.Array) -> jax.Array:
    """Returns unit vectors (N, size) along gradients, random if a gradient is zero."""
    random = jax.random.normal(key, gradients.shape, gradients.dtype)
    # Scaled first, because the square of a large gradient may overflow.
    largest = jnp.max(jnp.abs(gradients), axis=1, keepdims=True)
    usable = (largest > 0) & jnp.isfinite(largest)
    ways = jnp.where(usable, gradients / jnp.where(usable, largest, 1), random)
    return ways / jnp.linalg.norm(ways, axis=1, keepdims=True)
