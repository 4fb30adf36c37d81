"""The gradient doctor: over how many control steps a gradient can be used, and why."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import Env
from newton_qd.gradients.episode import Policy
from newton_qd.gradients.exact import finite_rows
from newton_qd.gradients.flow import tree_norm
from newton_qd.gradients.mixed import Mixture, mixture
from newton_qd.gradients.report import ContactRow, GradientReport, HorizonRow
from newton_qd.physics.system import PhysicsState
from newton_qd.registry import create

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

    def rewards(self, genotype: Any) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Rewards (steps,), 0 after the end; who is alive, which bodies touch."""

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
            return (state, over | (state.done > 0)), (reward, ~over, touching & ~over)

        start = (self.env.reset(self.key), jnp.zeros((), bool))
        plan = genotype if self.policy is None else None
        body = jax.checkpoint(advance, prevent_cse=False)
        _, (rewards, alive, touching) = jax.lax.scan(
            body, start, plan, length=self.steps
        )
        return rewards, (alive, touching)

    def returns(self, genotype: Any, ends: np.ndarray) -> jax.Array:
        """Sums (rows,) of the rewards up to the ends (rows,) of several horizons."""
        rewards, _ = self.rewards(genotype)
        rows = np.arange(self.steps)[None] < ends[:, None]
        return jnp.asarray(rows, rewards.dtype) @ rewards

    def gradients(self, genotype: Any, ends: np.ndarray) -> tuple[jax.Array, Any]:
        """Returns up to the ends and their gradients, leaves (rows, ...)."""
        values, pull = jax.vjp(lambda x: self.returns(x, ends), genotype)
        (rows,) = jax.vmap(pull)(jnp.eye(len(ends), dtype=values.dtype))
        return values, rows


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
        env: Name, or an environment of one world in float64 without auto-reset.
        policy: Maps a genotype and an observation to an action; ``None``: genotypes
            are open-loop actions.
        genotypes: Pytree with one entry a world in front; ``None``: uniform random
            actions.
        horizons: Numbers of control steps, ascending.
        worlds: Number of random plans; they share one reset.
        directions: Random directions of the differences, in each world.
        samples: Pairs of noisy samples, in each world.
        sigma: Standard deviation of the noise, in the units of the genotype.
        seed: Seed of reset, plans, directions and noise.

    Returns:
        The report: ``print`` it, or ``write`` it to a folder.

    Raises:
        ValueError: A setting is out of its range, or the environment in float32.
    """
    counts = {"worlds": worlds, "directions": directions, "samples": samples}
    _check(horizons, policy, genotypes, sigma, **counts)
    with jax.enable_x64(True):
        made = _made(env)
        reset_key, plan_key, *keys = jax.random.split(jax.random.key(seed), 4)
        subject = _Subject(made, policy, int(horizons[-1]), reset_key)
        if genotypes is None:
            shape = (worlds, subject.steps, made.action_size)
            genotypes = jax.random.uniform(plan_key, shape, made.dtype, -1, 1)
        rows, contacts = _found(
            subject, genotypes, keys, horizons, directions, samples, sigma
        )
        return GradientReport(
            name=env if isinstance(env, str) else made.name,
            dt=made.dt,
            open_loop=policy is None,
            sigma=sigma,
            horizons=rows,
            contacts=contacts,
        )


def _found(
    subject: _Subject,
    genotypes: Any,
    keys: Sequence[jax.Array],
    horizons: Sequence[int],
    directions: int,
    samples: int,
    sigma: float,
) -> tuple[tuple[HorizonRow, ...], tuple[ContactRow, ...]]:
    """The rows of a report; the keys are those of the directions and of the noise."""
    ends = np.asarray(horizons, np.int32)
    difference, gradients = _differences(subject, genotypes, keys[0], directions)
    centre = jax.tree.map(lambda x: x[:, ends - 1], gradients)
    noise = jax.tree.map(lambda x: sigma * x, _normal(keys[1], genotypes, samples))
    mixed, slopes = _sampled(subject, genotypes, centre, noise, sigma, ends)
    rows = _rows(ends, subject.env.dt, difference, mixed, slopes)
    return rows, _contacts(subject.env, difference)


def _check(
    horizons: Sequence[int],
    policy: Any,
    genotypes: Any,
    sigma: float,
    **counts: int,
) -> None:
    ascending = all(a < b for a, b in itertools.pairwise(horizons))
    if not horizons or horizons[0] < 1 or not ascending:
        raise ValueError(f"horizons={horizons!r}: allowed: ascending integers from 1")
    for name, value in counts.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(f"{name}={value!r}: allowed: integers from 1")
    if counts["samples"] < 2:
        raise ValueError(f"samples={counts['samples']!r}: allowed: integers from 2")
    if not sigma > 0:
        raise ValueError(f"sigma={sigma!r}: allowed: above 0")
    if (policy is None) != (genotypes is None):
        raise ValueError(
            "policy and genotypes: one of them is None; allowed: both or neither"
        )


def _made(env: Env | str) -> Any:
    """The environment to diagnose."""
    if isinstance(env, str):
        return create(env, episode_length=None, auto_reset=False, dtype="float64")
    if env.dtype != np.float64:
        raise ValueError(
            f"env: in {env.dtype}; allowed: float64, as create({env.name!r}, "
            "dtype='float64', auto_reset=False) under jax.enable_x64(True)"
        )
    return env


@dataclasses.dataclass(frozen=True)
class _Differences:
    """Derivatives of all returns along random directions.

    Attributes:
        norms: (worlds, steps) norm of the gradient of the return up to each step.
        exact: (worlds, directions, steps) its component along each direction.
        central: (worlds, directions, distances, steps) central differences over
            ``DISTANCES``, then over ``REACH``.
        alive: (worlds, steps) whether the episode goes on before each step.
        switched: (worlds, directions, steps, nb) whether a body touches on one side of
            ``REACH`` and not on the other.
    """

    norms: np.ndarray
    exact: np.ndarray
    central: np.ndarray
    alive: np.ndarray
    switched: np.ndarray


def _differences(
    subject: _Subject, genotypes: Any, key: jax.Array, directions: int
) -> tuple[_Differences, Any]:
    """The derivatives, and the gradients, leaves (worlds, steps, ...)."""
    every = np.arange(1, subject.steps + 1, dtype=np.int32)
    sides = np.array([[d, -d] for d in (*DISTANCES, REACH)])

    def one(genotype: Any, drawn: Any) -> tuple[dict[str, jax.Array], Any]:
        along = jax.vmap(_unit)(drawn)
        gradients = subject.gradients(genotype, every)[1]
        components = jax.vmap(jax.vmap(_inner, (0, None)), (None, 0))

        def at(direction: Any, distance: jax.Array) -> Any:
            there = jax.tree.map(lambda x, u: x + distance * u, genotype, direction)
            return subject.rewards(there)

        moved = jax.vmap(jax.vmap(jax.vmap(at, (None, 0)), (None, 0)), (0, None))
        rewards, (alive, touching) = moved(along, jnp.asarray(sides))
        returns = jnp.cumsum(rewards, axis=-1)
        central = (returns[:, :, 0] - returns[:, :, 1]) / (2 * sides[:, :1])
        return {
            "norms": jax.vmap(tree_norm)(gradients),
            "exact": components(gradients, along),
            "central": central,
            "alive": alive[0, 0, 0],
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
) -> tuple[Mixture, np.ndarray]:
    """First- and zeroth-order estimates (worlds, horizons) under noise.

    Args:
        subject: The rewards of an episode.
        genotypes: Leaves (worlds, ...).
        centre: Leaves (worlds, horizons, ...): the gradients without noise.
        noise: Leaves (worlds, samples, ...), normal with deviation ``sigma``.
        sigma: That deviation.
        ends: (horizons,) control steps.

    Returns:
        The estimates, and the components (worlds, 2, horizons) of their means along
        the gradient without noise, which few samples tell apart.
    """

    def one(genotype: Any, centre: Any, noise: Any) -> tuple[Mixture, jax.Array]:
        pairs = jax.tree.map(
            lambda x, w: jnp.stack([x + w, x - w], axis=1), genotype, noise
        )
        both = jax.vmap(jax.vmap(functools.partial(subject.gradients, ends=ends)))
        values, gradients = both(pairs)
        sound = jnp.isfinite(values).all(axis=(1, 2))
        lost = ~jax.vmap(jax.vmap(finite_rows))(gradients).all(axis=(0, 1))
        mixed = mixture(values, gradients, noise, sound, lost, sigma=sigma)
        uphill = jax.vmap(_unit)(centre)
        inner = jax.vmap(_inner)
        slopes = [inner(mean, uphill) for mean in (mixed.first, mixed.zeroth)]
        return mixed, jnp.stack(slopes)

    mixed, slopes = jax.jit(jax.vmap(one))(genotypes, centre, noise)
    return mixed, np.asarray(slopes)


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
