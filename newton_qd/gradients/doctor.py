"""The gradient doctor: over how many control steps a gradient can be used, and why."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import Env
from newton_qd.envs.options import check_count, check_positive
from newton_qd.errors import FaultError
from newton_qd.gradients.doctor_input import (
    checked_genotypes,
    checked_horizons,
    made_env,
    refuse_faults,
)
from newton_qd.gradients.episode import Policy, at_fault
from newton_qd.gradients.exact import finite_rows
from newton_qd.gradients.flow import tree_norm
from newton_qd.gradients.mixed import Mixture, mixture
from newton_qd.gradients.report import ContactRow, GradientReport, HorizonRow
from newton_qd.physics.system import PhysicsState

DISTANCES = (1e-4, 1e-6, 1e-8, 1e-10)
"""Steps of the central differences; the one that agrees best counts.

The smallest are for chaotic motion: over 32 steps of a halfcheetah a gradient may have
the norm 1e9.
"""
REACH = 1e-2
"""Norm of the finite changes that show where contacts end a gradient's validity."""
_BREAK = 0.1  # error of a step's derivative over that reach, above which it is broken


@dataclasses.dataclass(frozen=True)
class _Subject:
    """What is differentiated: the rewards of an episode as a function of a genotype."""

    env: Any
    policy: Policy | None
    steps: int
    key: jax.Array

    def rewards(self, genotype: Any) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """Rewards (steps,), 0 after the end; who is alive, what touches, faults."""

        def advance(carry: Any, action: jax.Array | None) -> Any:
            state, over = carry
            if action is None:
                assert self.policy is not None
                action = self.policy(genotype, state.obs)
            state = self.env.step(state, action)
            reward = jnp.where(over, 0, state.reward)
            physics = state.pipeline_state
            touching = jnp.zeros((0,), bool)
            if isinstance(physics, PhysicsState):
                touching = physics.normal_impulse > 0
            seen = (reward, ~over, touching & ~over, at_fault(state) & ~over)
            return (state, over | (state.done > 0)), seen

        start = (self.env.reset(self.key), jnp.zeros((), bool))
        plan = genotype if self.policy is None else None
        body = jax.checkpoint(advance, prevent_cse=False)
        _, (rewards, *seen) = jax.lax.scan(body, start, plan, length=self.steps)
        return rewards, tuple(seen)

    def returns(
        self, genotype: Any, ends: np.ndarray
    ) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """Sums (rows,) of the rewards up to the ends (rows,) of several horizons."""
        rewards, seen = self.rewards(genotype)
        rows = np.arange(self.steps)[None] < ends[:, None]
        return jnp.asarray(rows, rewards.dtype) @ rewards, seen

    def gradients(
        self, genotype: Any, ends: np.ndarray
    ) -> tuple[jax.Array, Any, jax.Array]:
        """Returns up to the ends, gradients (rows, ...), and faults (steps,)."""
        values, pull, seen = jax.vjp(
            lambda x: self.returns(x, ends), genotype, has_aux=True
        )
        (rows,) = jax.vmap(pull)(jnp.eye(len(ends), dtype=values.dtype))
        return values, rows, seen[-1]


def diagnose_gradients(
    env: Env | str,
    *,
    policy: Policy | None = None,
    genotypes: Any = None,
    horizons: Sequence[int] = (1, 2, 4, 8, 16, 32, 64),
    worlds: int = 8,
    directions: int = 8,
    samples: int = 16,
    sigma: float = 0.05,
    seed: int = 0,
) -> GradientReport:
    """Measures what the gradient of the return is worth, horizon by horizon.

    Three comparisons, all in float64: with central differences along random
    directions, whether the gradient is that of the function; of first- with
    zeroth-order estimates under noise, whether it is a better guide than an evolution
    strategy with as many samples (Suh et al. 2022, "Do differentiable simulators give
    better policy gradients?"); and over finite changes, which contacts end its
    validity, and when.

    Args:
        env: Name, or an environment of one world in float64. Rewards count up to the
            first ``done``.
        policy: Maps a genotype and an observation to an action, or ``None``.
        genotypes: Pytree with one entry a world in front; without a policy plans of
            actions (worlds, steps, nu), by default uniform random ones.
        horizons: Numbers of control steps, ascending.
        worlds: Number of random plans; not read where there are genotypes. All worlds
            share one reset.
        directions: Random directions of the differences, in each world.
        samples: Pairs of noisy samples, in each world.
        sigma: Standard deviation of the noise, in the units of the genotype.
        seed: Seed of reset, plans, directions and noise.

    Returns:
        The report: ``print`` it, or ``write`` it to a folder.

    Raises:
        TypeError: A setting is of another type.
        ValueError: A setting is out of its range, or the environment in float32.
        FaultError: A world is at fault, or too many of its noisy samples are.
    """
    check_count("worlds", worlds)
    check_count("directions", directions)
    check_count("samples", samples, 2)
    check_count("seed", seed, 0, 2**32 - 1)
    check_positive("sigma", sigma)
    horizons = checked_horizons(horizons)
    with jax.enable_x64(True):
        made = made_env(env)
        reset_key, plan_key, *keys = jax.random.split(jax.random.key(seed), 4)
        subject = _Subject(made, policy, int(horizons[-1]), reset_key)
        if genotypes is None and policy is None:
            shape = (worlds, subject.steps, made.action_size)
            genotypes = jax.random.uniform(plan_key, shape, made.dtype, -1, 1)
        genotypes = checked_genotypes(genotypes, made, policy, subject.steps)
        name = env if isinstance(env, str) else made.name
        counts = (directions, samples)
        return _report(name, subject, genotypes, keys, horizons, *counts, sigma)


def _report(
    name: str,
    subject: _Subject,
    genotypes: Any,
    keys: Sequence[jax.Array],
    horizons: Sequence[int],
    directions: int,
    samples: int,
    sigma: float,
) -> GradientReport:
    """The findings; the keys are those of the directions and of the noise."""
    ends = np.asarray(horizons, np.int32)
    difference, gradients = _differences(subject, genotypes, keys[0], directions)
    refuse_faults(difference.faulty)
    centre = jax.tree.map(lambda x: x[:, ends - 1], gradients)
    noise = jax.tree.map(lambda x: sigma * x, _normal(keys[1], genotypes, samples))
    mixed, slopes, sound = _sampled(subject, genotypes, centre, noise, sigma, ends)
    if (sound < 2).any():
        raise FaultError(
            f"sigma={sigma!r}: fewer than two pairs of noisy samples of a world stay "
            "sound; allowed: less noise, or more samples"
        )
    return GradientReport(
        name=name,
        dt=subject.env.dt,
        open_loop=subject.policy is None,
        sigma=sigma,
        horizons=_rows(ends, subject.env.dt, difference, mixed, slopes),
        contacts=_contacts(subject.env, difference),
    )


@dataclasses.dataclass(frozen=True)
class _Differences:
    """Derivatives of all returns along random directions.

    Attributes:
        norms: (worlds, steps) norm of the gradient of the return up to each step.
        exact: (worlds, directions, steps) its component along each direction.
        central: (worlds, directions, distances, steps) central differences over
            ``DISTANCES``, then over ``REACH``.
        alive: (worlds, steps) whether the episode goes on before each step.
        faulty: (worlds, steps) whether the world is at fault after each step.
        switched: (worlds, directions, steps, nb) whether a body touches on one side of
            ``REACH`` and not on the other.
    """

    norms: np.ndarray
    exact: np.ndarray
    central: np.ndarray
    alive: np.ndarray
    faulty: np.ndarray
    switched: np.ndarray


def _differences(
    subject: _Subject, genotypes: Any, key: jax.Array, directions: int
) -> tuple[_Differences, Any]:
    """The derivatives, and the gradients, leaves (worlds, steps, ...)."""
    every = np.arange(1, subject.steps + 1, dtype=np.int32)
    sides = np.array([[d, -d] for d in (*DISTANCES, REACH)])

    def one(genotype: Any, drawn: Any) -> tuple[dict[str, jax.Array], Any]:
        along = jax.vmap(_unit)(drawn)
        _, gradients, faulty = subject.gradients(genotype, every)
        components = jax.vmap(jax.vmap(_inner, (0, None)), (None, 0))

        def at(direction: Any, distance: jax.Array) -> Any:
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
            "alive": alive[0, 0, 0],
            "faulty": faulty,
            "switched": touching[:, -1, 0] != touching[:, -1, 1],
        }, gradients

    drawn = _normal(key, genotypes, directions)
    found, gradients = jax.jit(jax.vmap(one))(genotypes, drawn)
    return _Differences(**jax.tree.map(np.asarray, found)), gradients


def _normal(key: jax.Array, genotypes: Any, count: int) -> Any:
    """Normal numbers, leaves (worlds, count, ...)."""
    leaves, structure = jax.tree.flatten(genotypes)
    keys = jax.random.split(key, len(leaves))
    drawn = [
        jax.random.normal(k, (len(x), count, *x.shape[1:]), x.dtype)
        for k, x in zip(keys, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, drawn)


def _unit(tree: Any) -> Any:
    """A pytree over its norm, or as it is where that is 0."""
    norm = tree_norm(tree)
    divisor = jnp.where(norm == 0, 1, norm)
    return jax.tree.map(lambda x: x / divisor, tree)


def _inner(a: Any, b: Any) -> jax.Array:
    """Inner product () of two pytrees."""
    return functools.reduce(
        jnp.add, jax.tree.leaves(jax.tree.map(lambda x, y: (x * y).sum(), a, b))
    )


def _sampled(
    subject: _Subject,
    genotypes: Any,
    centre: Any,
    noise: Any,
    sigma: float,
    ends: np.ndarray,
) -> tuple[Mixture, np.ndarray, np.ndarray]:
    """First- and zeroth-order estimates (worlds, horizons) under noise.

    Args:
        subject: The rewards of an episode.
        genotypes: Leaves (worlds, ...).
        centre: Leaves (worlds, horizons, ...): the gradients without noise.
        noise: Leaves (worlds, samples, ...), normal with deviation ``sigma``.
        sigma: That deviation.
        ends: (horizons,) control steps.

    Returns:
        The estimates; the components (worlds, 2, horizons) of their means along the
        gradient without noise, which few samples tell apart; and how many pairs of
        samples of each world (worlds,) stay sound.
    """

    def one(
        genotype: Any, centre: Any, noise: Any
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


def _rows(
    ends: np.ndarray,
    dt: float,
    difference: _Differences,
    mixed: Mixture,
    slopes: np.ndarray,
) -> tuple[HorizonRow, ...]:
    first, zeroth = slopes[:, 0], slopes[:, 1]
    scale = np.maximum(np.abs(first).mean(axis=0), 1e-300)
    apart = (first - zeroth) / scale
    scatter = (
        apart.std(axis=0, ddof=1) if len(apart) > 1 else np.full(len(ends), np.inf)
    )
    rows = []
    for index, end in enumerate(ends):
        alive = difference.alive[:, end - 1]
        cosines = _cosines(difference, int(end) - 1)
        norms = difference.norms[:, end - 1]
        rows.append(
            HorizonRow(
                steps=int(end),
                seconds=float(end * dt),
                alive=float(alive.mean()),
                norm=float(np.median(norms)),
                largest_norm=float(norms.max()),
                cosine=float(np.median(cosines)),
                worst_cosine=float(cosines.min()),
                first_deviation=_root(mixed.first_variance, index),
                zeroth_deviation=_root(mixed.zeroth_variance, index),
                bias=float(apart[:, index].mean()),
                bias_error=float(scatter[index] / np.sqrt(len(apart))),
                order=float(np.median(np.asarray(mixed.order)[:, index])),
            )
        )
    return tuple(rows)


def _root(variance: jax.Array, index: int) -> float:
    return float(np.sqrt(np.median(np.asarray(variance)[:, index])))


def _cosines(difference: _Differences, step: int) -> np.ndarray:
    """Cosine (worlds,) of exact and central derivatives over all directions."""
    exact = difference.exact[:, :, step]
    central = difference.central[:, :, :-1, step]
    scale = np.linalg.norm(exact, axis=1)[:, None] * np.linalg.norm(central, axis=1)
    inner = (exact[:, :, None] * central).sum(axis=1)
    zero = scale == 0
    return np.where(zero, 1.0, inner / np.where(zero, 1.0, scale)).max(axis=1)


def _contacts(env: Any, difference: _Differences) -> tuple[ContactRow, ...]:
    """Where finite changes leave the gradient: the first broken step of each pair."""
    exact = np.diff(difference.exact, axis=2, prepend=0.0)
    finite = np.diff(difference.central[:, :, -1], axis=2, prepend=0.0)
    scale = np.sqrt(np.mean(exact**2, axis=1, keepdims=True))
    broken = np.abs(finite - exact) > _BREAK * np.maximum(scale, 1e-12)
    rows: dict[str, list[int]] = {}
    for world, direction in zip(*np.nonzero(broken.any(axis=2)), strict=True):
        step = int(broken[world, direction].argmax())
        before = difference.switched[world, direction, : step + 1].any(axis=0)
        bodies = [env.system.body_names[b] for b in np.flatnonzero(before)]
        for name in bodies or ["no contact"]:
            rows.setdefault(name, []).append(step + 1)
    pairs = broken.shape[0] * broken.shape[1]
    found = [
        ContactRow(name, len(steps) / pairs, int(min(steps)), float(np.median(steps)))
        for name, steps in rows.items()
    ]
    return tuple(sorted(found, key=lambda row: -row.share))
