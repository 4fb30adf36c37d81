"""Covariance matrix adaptation evolution strategy, for a few coefficients.

It follows Hansen, "The CMA Evolution Strategy: A Tutorial", arXiv:1604.00772, with
positive recombination weights. The implementation of QDax 0.5.0 does not fit. It
decomposes the covariance only in every twelfth update at these sizes, it takes the
whole population as parents, and it divides by zero in its first update.
"""

from __future__ import annotations

import dataclasses
import math

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks

# pyribs' and pycma's limit for the extent of the distribution.
_SMALLEST_EXTENT = 1e-11


class CMAESState(flax.struct.PyTreeNode):
    """The search distribution N(mean, sigma^2 C) of dimension n.

    Attributes:
        mean: (n,) mean.
        sigma: () step size.
        covariance: (n, n) covariance C.
        basis: (n, n) eigenvectors of C, one per column.
        scales: (n,) square roots of the eigenvalues of C.
        path_sigma: (n,) evolution path of the step size.
        path_covariance: (n,) evolution path of the covariance.
        updates: () updates since the start.
    """

    mean: jax.Array
    sigma: jax.Array
    covariance: jax.Array
    basis: jax.Array
    scales: jax.Array
    path_sigma: jax.Array
    path_covariance: jax.Array
    updates: jax.Array


@dataclasses.dataclass(frozen=True)
class CMAES:
    """The strategy and its constants (Hansen, table 1).

    Attributes:
        dimension: Number n of variables.
        population: Number of samples in one update; the better half are parents.
        sigma: Initial step size.
    """

    dimension: int
    population: int
    sigma: float

    def __post_init__(self) -> None:
        """Checks the values.

        Raises:
            ValueError: Fewer than two samples, or a step size that is not positive.
        """
        checks.integer("population", self.population, least=2, most=None)
        checks.number("sigma", self.sigma, above=0)

    @property
    def weights(self) -> np.ndarray:
        """(population // 2,) recombination weights of the parents, best first."""
        parents = self.population // 2
        weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
        return weights / np.sum(weights)

    def init(self, dtype: jnp.dtype) -> CMAESState:
        """Returns an isotropic distribution about zero."""
        n = self.dimension
        return CMAESState(
            mean=jnp.zeros(n, dtype),
            sigma=jnp.asarray(self.sigma, dtype),
            covariance=jnp.eye(n, dtype=dtype),
            basis=jnp.eye(n, dtype=dtype),
            scales=jnp.ones(n, dtype),
            path_sigma=jnp.zeros(n, dtype),
            path_covariance=jnp.zeros(n, dtype),
            updates=jnp.zeros((), jnp.int32),
        )

    def sample(self, state: CMAESState, key: jax.Array) -> jax.Array:
        """Draws samples (population, n) (eqs. 38 to 40)."""
        shape = (self.population, self.dimension)
        normal = jax.random.normal(key, shape, state.mean.dtype)
        return state.mean + state.sigma * (normal * state.scales) @ state.basis.T

    def update(self, state: CMAESState, ranked: jax.Array) -> CMAESState:
        """Moves the distribution towards the better samples.

        Args:
            state: Distribution that the samples were drawn from.
            ranked: (population, n) samples, best first.
        """
        n = self.dimension
        weights = self.weights
        mu_eff = 1 / float(np.sum(weights**2))
        c_sigma = (mu_eff + 2) / (n + mu_eff + 5)
        c_c = (4 + mu_eff / n) / (n + 4 + 2 * mu_eff / n)
        c_1 = 2 / ((n + 1.3) ** 2 + mu_eff)
        c_mu = min(1 - c_1, 2 * (mu_eff - 2 + 1 / mu_eff) / ((n + 2) ** 2 + mu_eff))
        excess = max(0.0, math.sqrt((mu_eff - 1) / (n + 1)) - 1)
        damping = 1 + 2 * excess + c_sigma
        # Expected length of a standard normal vector.
        chi = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))

        w = jnp.asarray(weights, state.mean.dtype)
        y = (ranked[: len(weights)] - state.mean) / state.sigma
        y_mean = w @ y
        # Step-size control (eqs. 43 and 44).
        whitened = state.basis @ ((state.basis.T @ y_mean) / state.scales)
        path_sigma = (1 - c_sigma) * state.path_sigma + math.sqrt(
            c_sigma * (2 - c_sigma) * mu_eff
        ) * whitened
        length = jnp.linalg.norm(path_sigma)
        sigma = state.sigma * jnp.exp(c_sigma / damping * (length / chi - 1))
        # Covariance (eqs. 45 and 47); the path stops while sigma grows fast.
        updates = state.updates + 1
        settled = jnp.sqrt(1 - (1 - c_sigma) ** (2 * updates.astype(w.dtype)))
        moving = (length / settled < (1.4 + 2 / (n + 1)) * chi).astype(w.dtype)
        path_covariance = (1 - c_c) * state.path_covariance + moving * math.sqrt(
            c_c * (2 - c_c) * mu_eff
        ) * y_mean
        kept = 1 - c_1 - c_mu + c_1 * (1 - moving) * c_c * (2 - c_c)
        covariance = (
            kept * state.covariance
            + c_1 * jnp.outer(path_covariance, path_covariance)
            + c_mu * (y.T * w) @ y
        )
        covariance = (covariance + covariance.T) / 2
        eigenvalues, basis = jnp.linalg.eigh(covariance)
        return CMAESState(
            mean=w @ ranked[: len(weights)],
            sigma=sigma,
            covariance=covariance,
            basis=basis,
            scales=jnp.sqrt(jnp.maximum(eigenvalues, jnp.finfo(w.dtype).tiny)),
            path_sigma=path_sigma,
            path_covariance=path_covariance,
            updates=updates,
        )

    def stopped(self, state: CMAESState) -> jax.Array:
        """Returns whether the distribution is too flat, too narrow or not finite ()."""
        widest, narrowest = jnp.max(state.scales), jnp.min(state.scales)
        extent = state.sigma * widest
        # Above this ratio the smallest eigenvalue is rounding error.
        largest_ratio = 1 / math.sqrt(jnp.finfo(state.mean.dtype).eps)
        flat = widest > largest_ratio * narrowest
        return flat | ~(extent >= _SMALLEST_EXTENT) | ~jnp.isfinite(extent)
