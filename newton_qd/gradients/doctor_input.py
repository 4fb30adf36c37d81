"""Input of the gradient doctor: settings, environment, genotypes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env
from newton_qd.errors import FaultError
from newton_qd.registry import create
from newton_qd.types import Genotype, PolicyFunction


def refuse_faults(faulty: np.ndarray) -> None:
    """Checks that no world (worlds, steps) has a fault, because its gradient is 0.

    Raises:
        FaultError: A world has a fault.
    """
    worlds = faulty.any(axis=1)
    if worlds.any():
        step = int(faulty.any(axis=0).argmax()) + 1
        given = Fact(
            f"{np.sum(worlds)} of {np.size(worlds)} worlds at fault, the first one in "
            f"control step {step}"
        )
        allowed = (
            "those that stay sound over the longest horizon (newton_qd.check says what "
            "went wrong)"
        )
        raise FaultError(message("genotypes", given, allowed))


def checked_horizons(horizons: Sequence[int] | np.ndarray) -> tuple[int, ...]:
    """Returns the horizons as a tuple of integers.

    Raises:
        TypeError: They are not a sequence.
        ValueError: They are not ascending integers.
    """
    refusal = message("horizons", horizons, "ascending integers from 1")
    if isinstance(horizons, str) or not isinstance(horizons, (Sequence, np.ndarray)):
        raise TypeError(refusal)
    for index, steps in enumerate(horizons):
        checks.integer(f"horizons[{index}]", steps)
    found = tuple(int(steps) for steps in horizons)
    if not found or not all(a < b for a, b in itertools.pairwise(found)):
        raise ValueError(refusal)
    return found


def checked_genotypes(
    genotypes: Genotype | None, env: Env, policy: PolicyFunction | None, length: int
) -> Genotype:
    """Returns genotypes in the dtype of the environment; cuts plans to ``length``.

    Raises:
        ValueError: They are missing, their leaves have different numbers of worlds, a
            leaf for a policy is not floating-point, or plans are not actions (worlds,
            steps, nu) for all steps.
    """
    if genotypes is None:
        raise ValueError(message("genotypes", None, "with a policy: what it acts by"))
    dtype = env.dtype
    arrays = jax.tree.map(np.asarray, genotypes)
    genotypes = jax.tree.map(
        lambda x: jnp.asarray(
            x, dtype if jnp.issubdtype(x.dtype, jnp.floating) else None
        ),
        arrays,
    )
    shapes = [np.shape(x) for x in jax.tree.leaves(genotypes)]
    given = Fact(f"leaves of shapes {shapes}")
    worlds = {shape[:1] for shape in shapes}
    if len(worlds) != 1 or worlds & {(), (0,)}:
        raise ValueError(message("genotypes", given, "(worlds, ...) each"))
    if policy is not None:
        for leaf in jax.tree.leaves(genotypes):
            if not jnp.issubdtype(leaf.dtype, jnp.floating):
                given = Fact(f"a leaf of {leaf.dtype}")
                allowed = "floating-point leaves; the policy may keep other numbers"
                raise ValueError(message("genotypes", given, allowed))
        return genotypes
    plan = (length, env.action_size)
    if len(shapes) > 1 or len(shapes[0]) != 3 or shapes[0][2] != plan[1]:
        allowed = f"without a policy: actions (worlds, steps, {plan[1]})"
        raise ValueError(message("genotypes", given, allowed))
    if shapes[0][1] < plan[0]:
        given = Fact(f"plans of {shapes[0][1]} steps")
        allowed = f"at least {plan[0]}, the longest of horizons"
        raise ValueError(message("genotypes", given, allowed))
    return jax.tree.map(lambda x: jnp.asarray(x[:, : plan[0]], dtype), genotypes)


def made_env(env: Env | str) -> Env:
    """Returns the environment to diagnose.

    Raises:
        TypeError: It is neither a name nor an environment, or its base takes no
            ``dtype``.
        ValueError: It is float32, or has a batch.
    """
    if isinstance(env, str):
        return create(env, episode_length=None, auto_reset=False, dtype="float64")
    if not hasattr(env, "step"):
        raise TypeError(message("env", env, "a name, or an environment"))
    if env.dtype != np.float64:
        allowed = (
            f"float64, as create({env.name!r}, dtype='float64', auto_reset=False) "
            "under jax.enable_x64(True)"
        )
        raise ValueError(message("env", Fact(f"dtype {env.dtype}"), allowed))
    batch = getattr(env, "batch_size", None)
    if batch is not None:
        given = Fact(f"an environment of {batch} worlds")
        raise ValueError(message("env", given, "an environment of one world"))
    return env
