"""Measurements of the gradient doctor: derivatives, differences and noisy samples."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import Env
from newton_qd.envs.state import at_fault
from newton_qd.gradients.exact import finite_rows
from newton_qd.gradients.flow import tree_norm
from newton_qd.gradients.mixed import Mixture, mixture, normal_noise
from newton_qd.gradients.outcome import Tally
from newton_qd.physics.system import PhysicsState
from newton_qd.types import Genotype, PolicyFunction, PyTree, RNGKey

DISTANCES = (1e-4, 1e-6, 1e-8, 1e-10)
"""Steps of the central differences; the step that agrees best counts.

The smallest steps are for chaotic motion: the gradient over 32 steps of a halfcheetah
may have a norm of 1e9.
"""
REACH = 1e-2
"""Norm of the finite changes that show which contacts limit a gradient's validity."""


@dataclasses.dataclass(frozen=True)
class Subject:
    """The rewards of an episode as a function of a genotype, to be differentiated."""

    env: Env
    policy: PolicyFunction | None
    steps: int
    key: jax.Array

    def rewards(self, genotype: Genotype) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """Returns rewards (steps,), 0 after the end; alive, contacts and faults."""

        def advance(carry: PyTree, action: jax.Array | None) -> tuple[PyTree, PyTree]:
            state, tally = carry
            if action is None:
                assert self.policy is not None
                action = self.policy(genotype, state.obs)
            state = self.env.step(state, action)
            over, reward = tally.over, tally.gained(state.reward)
            physics = state.pipeline_state
            touching = jnp.zeros((0,), bool)
            if isinstance(physics, PhysicsState):
                touching = physics.normal_impulse > 0
            seen = (reward, ~over, touching & ~over, at_fault(state) & ~over)
            return (state, tally.add(state.reward, state.done)), seen

        first = self.env.reset(self.key)
        start = (first, Tally.zero(first.reward.dtype))
        plan = genotype if self.policy is None else None
        body = jax.checkpoint(advance, prevent_cse=False)
        _, (rewards, *seen) = jax.lax.scan(body, start, plan, length=self.steps)
        return rewards, tuple(seen)

    def body_name(self, body: int) -> str:
        """Returns the name of a body of a simulated robot."""
        robot: Any = self.env
        return robot.system.body_names[body]

    def returns(
        self, genotype: Genotype, ends: np.ndarray
    ) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """Returns sums (rows,) of the rewards up to the ends (rows,) of horizons."""
        rewards, seen = self.rewards(genotype)
        rows = np.arange(self.steps)[None] < ends[:, None]
        return jnp.asarray(rows, rewards.dtype) @ rewards, seen

    def gradients(
        self, genotype: Genotype, ends: np.ndarray
    ) -> tuple[jax.Array, Genotype, jax.Array]:
        """Computes returns (rows,), their gradients (rows, ...) and faults (steps,)."""
        values, pull, seen = jax.vjp(
            lambda x: self.returns(x, ends), genotype, has_aux=True
        )
        (rows,) = jax.vmap(pull)(jnp.eye(len(ends), dtype=values.dtype))
        return values, rows, seen[-1]


@dataclasses.dataclass(frozen=True)
class Differences:
    """Derivatives of all returns along random directions.

    Attributes:
        norms: (worlds, steps) norm of the gradient of the return up to each step.
        exact: (worlds, directions, steps) component of the gradient along a direction.
        central: (worlds, directions, distances, steps) central differences over
            ``DISTANCES``, then over ``REACH``.
        sizes: (worlds, steps) sum of the absolute rewards up to each step.
        alive: (worlds, steps) whether the episode has not ended before each step.
        faulty: (worlds, steps) whether the world has a fault after each step.
        switched: (worlds, directions, steps, nb) whether a body has contact for one of
            the two changes of size ``REACH`` only.
    """

    norms: np.ndarray
    exact: np.ndarray
    central: np.ndarray
    sizes: np.ndarray
    alive: np.ndarray
    faulty: np.ndarray
    switched: np.ndarray


def take_differences(
    subject: Subject, genotypes: Genotype, key: RNGKey, directions: int
) -> tuple[Differences, Genotype]:
    """Returns the derivatives, and the gradients, leaves (worlds, steps, ...)."""
    every = np.arange(1, subject.steps + 1, dtype=np.int32)
    sides = np.array([[d, -d] for d in (*DISTANCES, REACH)])

    def one(
        genotype: Genotype, drawn: Genotype
    ) -> tuple[dict[str, jax.Array], Genotype]:
        along = jax.vmap(_unit)(drawn)
        _, gradients, faulty = subject.gradients(genotype, every)
        components = jax.vmap(jax.vmap(_inner, (0, None)), (None, 0))

        def at(direction: Genotype, distance: jax.Array) -> PyTree:
            there = jax.tree.map(lambda x, u: x + distance * u, genotype, direction)
            return subject.rewards(there)

        moved = jax.vmap(jax.vmap(jax.vmap(at, (None, 0)), (None, 0)), (0, None))
        rewards, (alive, touching, _) = moved(along, jnp.asarray(sides))
        returns = jnp.cumsum(rewards, axis=-1)
        central = (returns[:, :, 0] - returns[:, :, 1]) / (2 * sides[:, :1])
        return {
            "norms": jax.vmap(tree_norm)(gradients),
            "exact": components(gradients, along),
            "central": central,
            "sizes": jnp.cumsum(jnp.abs(rewards[0, 0, 0])),
            "alive": alive[0, 0, 0],
            "faulty": faulty,
            "switched": touching[:, -1, 0] != touching[:, -1, 1],
        }, gradients

    drawn = normal_noise(key, genotypes, directions)
    found, gradients = jax.jit(jax.vmap(one))(genotypes, drawn)
    return Differences(**jax.tree.map(np.asarray, found)), gradients


def _unit(tree: PyTree) -> PyTree:
    """Returns a pytree divided by its norm; a norm of 0 changes nothing."""
    norm = tree_norm(tree)
    divisor = jnp.where(norm == 0, 1, norm)
    return jax.tree.map(lambda x: x / divisor, tree)


def _inner(a: PyTree, b: PyTree) -> jax.Array:
    """Returns the inner product () of two pytrees."""
    return functools.reduce(
        jnp.add, jax.tree.leaves(jax.tree.map(lambda x, y: (x * y).sum(), a, b))
    )


def take_samples(
    subject: Subject,
    genotypes: Genotype,
    centre: Genotype,
    noise: Genotype,
    sigma: float,
    ends: np.ndarray,
) -> tuple[Mixture, np.ndarray, np.ndarray]:
    """Returns first- and zeroth-order estimates (worlds, horizons) under noise.

    Args:
        subject: The rewards of an episode.
        genotypes: Leaves (worlds, ...).
        centre: Leaves (worlds, horizons, ...): the gradients without noise.
        noise: Leaves (worlds, samples, ...), normal with deviation ``sigma``.
        sigma: Standard deviation of the noise.
        ends: (horizons,) control steps.

    Returns:
        The estimates; the components (worlds, 2, horizons) of their means along the
        gradient without noise, for which few samples are enough; and the number of
        pairs of samples without a fault for each world (worlds,).
    """

    def one(
        genotype: Genotype, centre: Genotype, noise: Genotype
    ) -> tuple[Mixture, jax.Array, jax.Array]:
        pairs = jax.tree.map(
            lambda x, w: jnp.stack([x + w, x - w], axis=1), genotype, noise
        )
        both = jax.vmap(jax.vmap(functools.partial(subject.gradients, ends=ends)))
        values, gradients, faulty = both(pairs)
        sound = jnp.isfinite(values).all(axis=(1, 2)) & ~faulty.any(axis=(1, 2))
        lost = ~jax.vmap(jax.vmap(finite_rows))(gradients).all(axis=(0, 1))
        mixed = mixture(values, gradients, noise, sound, lost, sigma=sigma)
        uphill = jax.vmap(_unit)(centre)
        inner = jax.vmap(_inner)
        slopes = [inner(mean, uphill) for mean in (mixed.first, mixed.zeroth)]
        slopes[0] = jnp.where(lost, jnp.nan, slopes[0])
        return mixed, jnp.stack(slopes), sound.sum()

    mixed, slopes, sound = jax.jit(jax.vmap(one))(genotypes, centre, noise)
    return mixed, np.asarray(slopes), np.asarray(sound)
