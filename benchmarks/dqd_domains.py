"""Published domains of differentiable Quality-Diversity, with exact gradients.

Linear projection of sphere and Rastrigin, and the planar arm, exactly as Fontaine &
Nikolaidis, "Differentiable Quality Diversity", NeurIPS 2021, ran them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

BOUND = 5.12
SHIFT = 0.4 * BOUND


@dataclasses.dataclass(frozen=True)
class Domain:
    """A function with an objective in [0, 100] and two descriptors.

    Attributes:
        evaluate: Maps a solution (n,) to objective and descriptors (3,).
        limit: Maps n to the largest magnitude of a descriptor.
        sigma_omg: Standard deviation of OMG-MEGA's coefficients.
        sigma_cma: Initial standard deviation of the coefficients of CMA-MEGA and
            CMA-MAEGA.
    """

    evaluate: Callable[[jax.Array], jax.Array]
    limit: Callable[[int], float]
    sigma_omg: float
    sigma_cma: float

    def score(self, solutions: jax.Array) -> jax.Array:
        """(N, 3) objective and descriptors of solutions (N, n)."""
        return jax.vmap(self.evaluate)(solutions)

    def score_with_gradients(self, solutions: jax.Array) -> tuple[jax.Array, jax.Array]:
        """(N, 3) objective and descriptors, and (N, 3, n) their gradients."""

        def one(solution: jax.Array) -> tuple[jax.Array, jax.Array]:
            values, pull = jax.vjp(self.evaluate, solution)
            (rows,) = jax.vmap(pull)(jnp.eye(3, dtype=values.dtype))
            return values, rows

        return jax.vmap(one)(solutions)


def _projection(solution: jax.Array) -> jax.Array:
    """(2,) sums of the halves of a clipped solution."""
    inside = jnp.abs(solution) <= BOUND
    clipped = jnp.where(inside, solution, BOUND / jnp.where(inside, BOUND, solution))
    half = solution.shape[0] // 2
    return jnp.stack([jnp.sum(clipped[:half]), jnp.sum(clipped[half:])])


def _lp_sphere(solution: jax.Array) -> jax.Array:
    worst = (BOUND + SHIFT) ** 2
    objective = 100 * (1 - jnp.mean((solution - SHIFT) ** 2) / worst)
    return jnp.concatenate([objective[None], _projection(solution)])


def _rastrigin(offset: jax.Array) -> jax.Array:
    return 10 + offset**2 - 10 * jnp.cos(2 * jnp.pi * offset)


def _lp_rastrigin(solution: jax.Array) -> jax.Array:
    worst = _rastrigin(jnp.asarray(-BOUND - SHIFT, solution.dtype))
    objective = 100 * (1 - jnp.mean(_rastrigin(solution - SHIFT)) / worst)
    return jnp.concatenate([objective[None], _projection(solution)])


def _arm(solution: jax.Array) -> jax.Array:
    angles = jnp.cumsum(solution)
    objective = 100 * (1 - jnp.var(solution))
    ends = jnp.stack([objective, jnp.sum(jnp.cos(angles)), jnp.sum(jnp.sin(angles))])
    return ends


DOMAINS = {
    "lp_sphere": Domain(_lp_sphere, lambda n: n / 2 * BOUND, 10.0, 10.0),
    "lp_rastrigin": Domain(_lp_rastrigin, lambda n: n / 2 * BOUND, 10.0, 10.0),
    "arm": Domain(_arm, float, 1.0, 0.05),
}
