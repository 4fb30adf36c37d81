"""The gradient doctor: measures for how many control steps a gradient is useful."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs.base import Env
from newton_qd.errors import FaultError
from newton_qd.gradients.doctor_input import (
    checked_genotypes,
    checked_horizons,
    made_env,
    refuse_faults,
)
from newton_qd.gradients.measurements import (
    DISTANCES,
    Differences,
    Subject,
    take_differences,
    take_samples,
)
from newton_qd.gradients.mixed import Mixture, normal_noise
from newton_qd.gradients.report import ContactRow, GradientReport, HorizonRow
from newton_qd.types import Genotype, PolicyFunction, RNGKey

_ROUNDING = 100  # of a return, in units of its last digit
_BREAK = 0.1  # relative error above which the derivative of a step is broken


def diagnose_gradients(
    env: Env | str,
    *,
    policy: PolicyFunction | None = None,
    genotypes: Genotype | None = None,
    horizons: Sequence[int] = (1, 2, 4, 8, 16, 32, 64),
    worlds: int = 8,
    directions: int = 8,
    samples: int = 16,
    sigma: float = 0.05,
    seed: int = 0,
) -> GradientReport:
    """Measures the quality of the gradient of the return for each horizon.

    It makes three comparisons, all in float64:

    - The gradient is compared with central differences along random directions. This
      shows whether the gradient is correct.
    - First- and zeroth-order estimates under noise are compared. This shows whether the
      gradient is better than an evolution strategy with as many samples (Suh et al.
      2022, "Do differentiable simulators give better policy gradients?").
    - The gradient is compared with finite changes. This shows which contacts limit its
      validity, and at which step.

    Args:
        env: Name, or an environment of one world in float64. Rewards count up to the
            first ``done``.
        policy: Maps a genotype and an observation to an action, or ``None``.
        genotypes: Pytree with leaves (worlds, ...). Without a policy: plans of actions
            (worlds, steps, nu), by default uniform random plans.
        horizons: Numbers of control steps, ascending.
        worlds: Number of random plans. It has no effect if genotypes are given. All
            worlds share one reset.
        directions: Number of random directions of the differences for each world.
        samples: Pairs of noisy samples for each world.
        sigma: Standard deviation of the noise, in the units of the genotype.
        seed: Seed of reset, plans, directions and noise.

    Returns:
        The report: ``print`` it, or ``write`` it to a folder.

    Raises:
        TypeError: A setting has the wrong type.
        ValueError: A setting is out of its range, or the environment is float32.
        FaultError: A world has a fault, or too many of its noisy samples have one.
    """
    checks.integer("worlds", worlds)
    checks.integer("directions", directions)
    checks.integer("samples", samples, least=2)
    checks.integer("seed", seed, least=0, most=2**32 - 1)
    checks.number("sigma", sigma, above=0)
    horizons = checked_horizons(horizons)
    with jax.enable_x64(True):
        made = made_env(env)
        reset_key, plan_key, *keys = jax.random.split(jax.random.key(seed), 4)
        subject = Subject(made, policy, int(horizons[-1]), reset_key)
        if genotypes is None and policy is None:
            shape = (worlds, subject.steps, made.action_size)
            genotypes = jax.random.uniform(plan_key, shape, made.dtype, -1, 1)
        genotypes = checked_genotypes(genotypes, made, policy, subject.steps)
        name = env if isinstance(env, str) else made.name
        counts = (directions, samples)
        return _report(name, subject, genotypes, keys, horizons, *counts, sigma)


def _report(
    name: str,
    subject: Subject,
    genotypes: Genotype,
    keys: Sequence[RNGKey],
    horizons: Sequence[int],
    directions: int,
    samples: int,
    sigma: float,
) -> GradientReport:
    """Returns the report; the two keys are for the directions and for the noise.

    Raises:
        FaultError: Too many noisy samples have a fault.
    """
    ends = np.asarray(horizons, np.int32)
    difference, gradients = take_differences(subject, genotypes, keys[0], directions)
    refuse_faults(difference.faulty)
    centre = jax.tree.map(lambda x: x[:, ends - 1], gradients)
    noise = normal_noise(keys[1], genotypes, samples, sigma)
    mixed, slopes, sound = take_samples(subject, genotypes, centre, noise, sigma, ends)
    if (sound < 2).any():
        raise FaultError(
            message(
                "sigma",
                sigma,
                "less noise, or more samples",
                why="fewer than two pairs of noisy samples of a world stay sound",
            )
        )
    return GradientReport(
        name=name,
        dt=subject.env.dt,
        open_loop=subject.policy is None,
        sigma=sigma,
        horizons=_rows(ends, subject.env.dt, difference, mixed, slopes),
        contacts=_contacts(subject, difference),
    )


def _rows(
    ends: np.ndarray,
    dt: float,
    difference: Differences,
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
        cosines, lengths = _agreement(difference, int(end) - 1)
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
                length=float(_farthest(lengths)),
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


def _farthest(lengths: np.ndarray) -> float:
    """Returns the ratio that is farthest from 1."""
    with np.errstate(divide="ignore"):  # the logarithm of 0 is the farthest
        return lengths[np.abs(np.log(lengths)).argmax()]


def _agreement(difference: Differences, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Compares exact and central derivatives, at the distance where they differ least.

    Returns:
        Their cosine (worlds,), and the length of the exact derivatives divided by that
        of the others (worlds,). If both are 0 up to rounding, both numbers are 1. If
        one is 0, the cosine is 0, and the ratio 0 or infinite.
    """
    exact = difference.exact[:, :, step]
    central = difference.central[:, :, :-1, step]
    own, other = np.linalg.norm(exact, axis=1), np.linalg.norm(central, axis=1)
    size = np.maximum(1.0, difference.sizes[:, step])[:, None]
    rounding = _ROUNDING * np.finfo(np.float64).eps * size / np.array(DISTANCES)
    still = (own <= rounding.min(axis=1)) & (other <= rounding).all(axis=1)
    apart = np.linalg.norm(exact[:, :, None] - central, axis=1)
    best = apart.argmin(axis=1)
    worlds = np.arange(len(best))
    chosen, length = central[worlds, :, best], other[worlds, best]
    lost = (own == 0) | (length == 0)
    inner = (exact * chosen).sum(axis=1)
    cosine = np.where(lost, 0.0, inner / np.where(lost, 1.0, own * length))
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 is not taken
        ratio = np.where(own == 0, 0.0, own / length)
    return np.where(still, 1.0, cosine), np.where(still, 1.0, ratio)


def _contacts(subject: Subject, difference: Differences) -> tuple[ContactRow, ...]:
    """Returns the contacts at the first step whose derivative is broken."""
    exact = np.diff(difference.exact, axis=2, prepend=0.0)
    finite = np.diff(difference.central[:, :, -1], axis=2, prepend=0.0)
    scale = np.sqrt(np.mean(exact**2, axis=1, keepdims=True))
    broken = np.abs(finite - exact) > _BREAK * np.maximum(scale, 1e-12)
    rows: dict[str, list[int]] = {}
    for world, direction in zip(*np.nonzero(broken.any(axis=2)), strict=True):
        step = int(broken[world, direction].argmax())
        before = difference.switched[world, direction, : step + 1].any(axis=0)
        bodies = [subject.body_name(int(b)) for b in np.flatnonzero(before)]
        for name in bodies or ["no contact"]:
            rows.setdefault(name, []).append(step + 1)
    pairs = broken.shape[0] * broken.shape[1]
    found = [
        ContactRow(name, len(steps) / pairs, int(min(steps)), float(np.median(steps)))
        for name, steps in rows.items()
    ]
    return tuple(sorted(found, key=lambda row: -row.share))
