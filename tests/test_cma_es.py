"""CMA-ES against the tutorial's equations in NumPy, and against pyribs'."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from newton_qd.qd.emitters.cma_es import CMAES, CMAESState

DIMENSION, POPULATION = 4, 13
TARGET = np.array([1.0, -2.0, 0.5, 3.0])
STIFFNESS = np.array([1.0, 10.0, 100.0, 1000.0])


def loss(x: np.ndarray) -> np.ndarray:
    """(N,) an ill-conditioned quadratic of points (N, n)."""
    n = x.shape[-1]
    return np.sum(STIFFNESS[:n] * (x - TARGET[:n]) ** 2, axis=-1)


class Reference:
    """Hansen, arXiv:1604.00772, appendix A, in NumPy, with positive weights."""

    def __init__(self, n: int, population: int, sigma: float) -> None:
        mu = population // 2
        self.w = np.log(mu + 0.5) - np.log(np.arange(1, mu + 1))
        self.w /= self.w.sum()
        self.mu_eff = m = 1 / np.sum(self.w**2)
        self.cc = (4 + m / n) / (n + 4 + 2 * m / n)
        self.cs = (m + 2) / (n + m + 5)
        self.c1 = 2 / ((n + 1.3) ** 2 + m)
        self.cmu = min(1 - self.c1, 2 * (m - 2 + 1 / m) / ((n + 2) ** 2 + m))
        self.damps = 1 + 2 * max(0, np.sqrt((m - 1) / (n + 1)) - 1) + self.cs
        self.chi = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        self.mean, self.sigma, self.C = np.zeros(n), sigma, np.eye(n)
        self.pc, self.ps, self.count = np.zeros(n), np.zeros(n), 0

    def tell(self, ranked: np.ndarray) -> None:
        n, x = len(self.mean), ranked[: len(self.w)]
        old, self.mean = self.mean, self.w @ x
        y = (self.mean - old) / self.sigma
        values, B = np.linalg.eigh(self.C)
        root = B @ np.diag(values**-0.5) @ B.T
        self.ps = (1 - self.cs) * self.ps + np.sqrt(
            self.cs * (2 - self.cs) * self.mu_eff
        ) * root @ y
        self.count += 1
        norm = np.linalg.norm(self.ps)
        h = norm / np.sqrt(1 - (1 - self.cs) ** (2 * self.count)) < self.chi * (
            1.4 + 2 / (n + 1)
        )
        self.pc = (1 - self.cc) * self.pc + h * np.sqrt(
            self.cc * (2 - self.cc) * self.mu_eff
        ) * y
        steps = (x - old) / self.sigma
        self.C = (
            (1 + self.c1 * (1 - h) * self.cc * (2 - self.cc) - self.c1 - self.cmu)
            * self.C
            + self.c1 * np.outer(self.pc, self.pc)
            + self.cmu * steps.T @ np.diag(self.w) @ steps
        )
        self.sigma *= np.exp(self.cs / self.damps * (norm / self.chi - 1))


# with many samples of few variables, the step size is damped more
@pytest.mark.parametrize(("n", "population"), [(DIMENSION, POPULATION), (2, 26)])
def test_follows_the_tutorial(n: int, population: int, x64: None) -> None:
    strategy, reference = CMAES(n, population, 0.5), Reference(n, population, 0.5)
    sample, update = jax.jit(strategy.sample), jax.jit(strategy.update)
    state = strategy.init(jnp.dtype("float64"))
    for number in range(60 if n == DIMENSION else 20):
        x = np.asarray(sample(state, jax.random.key(number)))
        ranked = x[np.argsort(loss(x))]
        state = update(state, jnp.asarray(ranked))
        reference.tell(ranked)
    # Later, steps of 1e-7 about a mean of one amplify rounding.
    np.testing.assert_allclose(state.mean, reference.mean, rtol=1e-7)
    np.testing.assert_allclose(state.sigma, reference.sigma, rtol=1e-6)
    np.testing.assert_allclose(state.covariance, reference.C, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("share", [0.95, 1.05])
def test_the_covariance_path_stops_at_the_limit(share: float, x64: None) -> None:
    """The first path is short because it is new, which the limit takes into account."""
    strategy, reference = CMAES(4, 13, 0.5), Reference(4, 13, 0.5)
    limit = reference.chi * (1.4 + 2 / 5) * reference.sigma / np.sqrt(reference.mu_eff)
    ranked = np.tile(share * limit * np.array([0.6, 0.0, 0.8, 0.0]), (13, 1))
    begun = jax.jit(strategy.init, static_argnums=0)(np.dtype("float64"))
    state = jax.jit(strategy.update)(begun, ranked)
    reference.tell(ranked)
    assert reference.pc.any() == (share < 1)
    np.testing.assert_allclose(state.path_covariance, reference.pc, rtol=1e-12)
    np.testing.assert_allclose(state.covariance, reference.C, rtol=1e-12, atol=1e-15)


def test_samples_have_the_covariance(x64: None) -> None:
    covariance = np.diag([1.0, 4.0, 9.0]) + 0.5
    values, basis = np.linalg.eigh(covariance)
    state = CMAES(3, 2, 1.0).init(jnp.dtype("float64"))
    state = state.replace(
        mean=jnp.array([1.0, 2.0, 3.0]),
        sigma=jnp.array(0.1),
        covariance=jnp.asarray(covariance),
        basis=jnp.asarray(basis),
        scales=jnp.asarray(np.sqrt(values)),
    )
    x = np.asarray(CMAES(3, 100_000, 1.0).sample(state, jax.random.key(0)))
    np.testing.assert_allclose(x.mean(0), [1, 2, 3], atol=0.005)
    np.testing.assert_allclose(np.cov(x.T), 0.01 * covariance, atol=0.002)


def test_stops() -> None:
    strategy = CMAES(2, 6, 1.0)
    state = strategy.init(jnp.dtype("float32"))

    def stopped(**changes: float | list[float]) -> bool:
        new = {name: jnp.asarray(x, jnp.float32) for name, x in changes.items()}
        changed: CMAESState = state.replace(**new)
        return bool(strategy.stopped(changed))

    assert not stopped()
    assert not stopped(scales=[1.0, 1e-3])
    assert stopped(scales=[1.0, 1e-4])
    assert stopped(sigma=1e-12)
    assert stopped(sigma=1e-6, scales=[1e-6, 1e-6])
    assert stopped(sigma=np.inf)
    assert stopped(sigma=np.nan)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((3, 1, 1.0), "population: got 1; .* from 2"), ((3, 4, 0.0), "sigma: got 0.0; ")],
)
def test_refuses(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CMAES(*arguments)


def ours(seed: int, tolerance: float) -> int:
    """Updates until the mean's loss is below a tolerance."""
    strategy = CMAES(DIMENSION, POPULATION, 1.0)
    sample, update = jax.jit(strategy.sample), jax.jit(strategy.update)
    state = strategy.init(jnp.dtype("float64"))
    for count in range(1000):
        if loss(np.asarray(state.mean)) < tolerance:
            return count
        x = np.asarray(sample(state, jax.random.fold_in(jax.random.key(seed), count)))
        state = update(state, jnp.asarray(x[np.argsort(loss(x))]))
    return 1000


def pyribs(seed: int, tolerance: float) -> int:
    """The same with pyribs'."""
    from ribs.emitters.opt import CMAEvolutionStrategy

    strategy = CMAEvolutionStrategy(1.0, DIMENSION, POPULATION, seed)
    strategy.reset(np.zeros(DIMENSION))
    for count in range(1000):
        if loss(np.asarray(strategy.mean)) < tolerance:
            return count
        losses = loss(strategy.ask())
        order = np.argsort(losses)
        strategy.tell(order, losses, POPULATION // 2)
    return 1000


@pytest.mark.slow
def test_converges_as_fast_as_pyribs(x64: None) -> None:
    pytest.importorskip("ribs")
    own = np.array([ours(seed, 1e-8) for seed in range(5)])
    peer = np.array([pyribs(seed, 1e-8) for seed in range(5)])
    assert np.mean(own) < 1.2 * np.mean(peer), (own, peer)
