"""What the gradient doctor is given: settings, environment, genotypes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.base import Env
from newton_qd.envs.options import check_count
from newton_qd.errors import FaultError
from newton_qd.registry import create
from newton_qd.types import Genotype, Policy


def refuse_faults(faulty: np.ndarray) -> None:
    """Raises where a world (worlds, steps) is at fault: a gradient of 0 says nothing.

    Raises:
        FaultError: One is.
    """
    worlds = faulty.any(axis=1)
    if worlds.any():
        step = int(faulty.any(axis=0).argmax()) + 1
        raise FaultError(
            f"genotypes: {np.sum(worlds)} of {np.size(worlds)} worlds are at fault, "
            f"the first one in control step {step}; allowed: those that stay sound "
            "over the longest horizon (newton_qd.check says what went wrong)"
        )


def checked_horizons(horizons: Sequence[int] | np.ndarray) -> tuple[int, ...]:
    """Numbers of control steps.

    Raises:
        TypeError: They are no sequence.
        ValueError: They are no ascending integers.
    """
    allowed = f"horizons={horizons!r}: allowed: ascending integers from 1"
    if isinstance(horizons, str) or not isinstance(horizons, (Sequence, np.ndarray)):
        raise TypeError(allowed)
    for steps in horizons:
        check_count("every one of horizons", steps)
    found = tuple(int(steps) for steps in horizons)
    if not found or not all(a < b for a, b in itertools.pairwise(found)):
        raise ValueError(allowed)
    return found


def checked_genotypes(
    genotypes: Genotype | None, env: Env, policy: Policy | None, length: int
) -> Genotype:
    """Genotypes in the precision of the environment; plans as long as is needed.

    Raises:
        ValueError: There are none, the leaves differ in the number of worlds, or plans
            are no actions (worlds, steps, nu) for all steps.
    """
    if genotypes is None:
        raise ValueError("genotypes=None: allowed with a policy: what it acts by")
    dtype = env.dtype
    arrays = jax.tree.map(np.asarray, genotypes)
    genotypes = jax.tree.map(
        lambda x: jnp.asarray(x, dtype if x.dtype.kind == "f" else None), arrays
    )
    shapes = [np.shape(x) for x in jax.tree.leaves(genotypes)]
    worlds = {shape[:1] for shape in shapes}
    if len(worlds) != 1 or worlds & {(), (0,)}:
        raise ValueError(
            f"genotypes: leaves of shapes {shapes} given; allowed: (worlds, ...) each"
        )
    if policy is not None:
        return genotypes
    plan = (length, env.action_size)
    if len(shapes) > 1 or len(shapes[0]) != 3 or shapes[0][2] != plan[1]:
        raise ValueError(
            f"genotypes: leaves of shapes {shapes} given without a policy; allowed: "
            f"actions (worlds, steps, {plan[1]})"
        )
    if shapes[0][1] < plan[0]:
        raise ValueError(
            f"genotypes: plans of {shapes[0][1]} steps given; allowed: at least "
            f"{plan[0]}, the longest of horizons"
        )
    return jax.tree.map(lambda x: jnp.asarray(x[:, : plan[0]], dtype), genotypes)


def made_env(env: Env | str) -> Env:
    """The environment to diagnose.

    Raises:
        TypeError: It is neither a name nor an environment.
        ValueError: It is in float32.
    """
    if isinstance(env, str):
        return create(env, episode_length=None, auto_reset=False, dtype="float64")
    if not hasattr(env, "step"):
        raise TypeError(f"env={env!r}: allowed: a name, or an environment")
    if env.dtype != np.float64:
        raise ValueError(
            f"env: in {env.dtype}; allowed: float64, as create({env.name!r}, "
            "dtype='float64', auto_reset=False) under jax.enable_x64(True)"
        )
    return env
