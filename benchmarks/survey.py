"""Measure every QD task: spread of untrained policies, lowest reward of a step.

    python benchmarks/survey.py [--names ant_uni pointmaze] [--out docs/survey.md]

Writes the page docs/survey.md, or only the rows of the names given; the page says how
each column is measured. ``reward_offset`` in newton_qd/tasks.py is its last column.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import newton_qd
from newton_qd.extractors import Trajectories
from newton_qd.qd import EvolveConfig, make_policy, make_task
from newton_qd.qd.scoring.task import Task

WORLDS, STEPS, CELLS, HIDDEN = 1000, 1000, 1024, (64, 64)
HEAD = f"""# Survey of the tasks

This page is written by `python benchmarks/survey.py --out docs/survey.md`
({os.cpu_count()} cores of a CPU). {WORLDS:,} untrained policies run one episode of
{STEPS:,} steps each, from one start state. They are perceptrons with two hidden layers
of {HIDDEN[0]} and tanh.

- *Coverage*: share of the {CELLS:,} cells of the descriptor space that the policies
  reach. The cells are those of a line, of a grid of 32 x 32 or, beyond two dimensions,
  of a centroidal Voronoi tessellation. {WORLDS:,} uniformly random points would reach
  62 %.
- *5 % to 95 %*: quantiles of each component of the descriptors, with its limits.
- *Lowest reward*: lowest reward of a step in these episodes, and in {WORLDS:,} more
  with uniformly random actions.
- *Offset*: minus the lowest reward, rounded up, and at least 0. Evolved policies may
  have lower rewards. It is `newton_qd.tables.reward_offset`.
- *Original*: the offset of the original suite. It is
  `newton_qd.tables.original_reward_offset`. A dash means that it has no such task.

| task | coverage [%] | 5 % to 95 % (limits) | lowest reward | original | offset |
|---|---|---|---|---|---|
"""
TAIL = """
The limits are those of the original suite, where it has the task. For position tasks of
walking robots they are wide, because trained robots run far. Untrained robots fall near
their start and reach few cells, humanoids the fewest.

This is the same in the original suite. For 500 such policies on its `humanoid_omni`
(`benchmarks/original_spread.py`), the quantiles are -0.36 and 0.54 m in x, -0.50 and
0.51 m in y. For 500 policies here they are -0.37 and 0.54 m, -0.54 and 0.51 m. In both
suites, these are the four cells of 1.9 m that meet at the start: 0.4 %.
"""

Act = Callable[[jax.Array, jax.Array], jax.Array]


def roll_out(task: Task, act: Act) -> tuple[np.ndarray, float]:
    """Runs one episode in every world.

    Args:
        task: The task.
        act: Maps the step's number () and observations (n, no) to actions (n, nu).

    Returns:
        Descriptors (n, nd), and the lowest reward of a step.
    """

    @jax.jit
    def run() -> tuple[jax.Array, jax.Array]:
        start = jax.vmap(task.env.reset, in_axes=None, axis_size=WORLDS)(
            jax.random.key(1)
        )

        def advance(carry: Any, step: jax.Array) -> Any:
            state, over = carry
            seen = state.info["state_descriptor"], over
            state = jax.vmap(task.env.step)(state, act(step, state.obs))
            reward = jnp.where(over, jnp.inf, state.reward)
            return (state, over | (state.done > 0)), (*seen, reward)

        over = jnp.zeros((WORLDS,), bool)
        _, (described, over, rewards) = jax.lax.scan(
            advance, (start, over), jnp.arange(STEPS)
        )
        data = Trajectories(state_desc=jnp.swapaxes(described, 0, 1))
        mask = jnp.swapaxes(over, 0, 1).astype(described.dtype)
        return task.descriptor_extractor(data, mask), jnp.min(rewards)

    descriptors, lowest = run()
    return np.asarray(descriptors), float(lowest)


def untrained(task: Task) -> Act:
    """Policies with random weights, one a world."""
    policy = make_policy(task.env, HIDDEN)
    weights = jax.vmap(policy.init)(jax.random.split(jax.random.key(0), WORLDS))
    parameters = jax.vmap(policy.unravel)(weights)
    return lambda step, obs: jax.vmap(policy.apply)(parameters, obs)


def random_actions(task: Task) -> Act:
    """Uniform random actions."""
    shape = (WORLDS, task.env.action_size)

    def act(step: jax.Array, obs: jax.Array) -> jax.Array:
        key = jax.random.fold_in(jax.random.key(2), step)
        return jax.random.uniform(key, shape, obs.dtype, -1, 1)

    return act


def coverage(limits: tuple[np.ndarray, np.ndarray], descriptors: np.ndarray) -> float:
    """Share of the cells within the limits that hold a descriptor [-]."""
    low, high = limits
    unit = np.clip((descriptors - low) / (high - low), 0.0, 1.0)
    if unit.shape[1] <= 2:
        side = round(CELLS ** (1 / unit.shape[1]))
        cells = np.minimum((unit * side).astype(int), side - 1)
        return len(np.unique(cells, axis=0)) / CELLS
    from qdax.core.containers.mapelites_repertoire import compute_cvt_centroids

    centroids = compute_cvt_centroids(
        unit.shape[1], 50_000, CELLS, 0.0, 1.0, jax.random.key(0)
    )
    apart = np.square(unit[:, None] - np.asarray(centroids)[None]).sum(axis=-1)
    return len(np.unique(apart.argmin(axis=1))) / CELLS


def survey(name: str) -> str:
    """Row of the page."""
    task = make_task(EvolveConfig(env_name=name, episode_length=STEPS))
    descriptors, lowest = roll_out(task, untrained(task))
    lowest = min(lowest, roll_out(task, random_actions(task))[1])
    quantiles = np.quantile(descriptors, [0.05, 0.95], axis=0).T
    spread = ", ".join(
        f"{found[0]:.2f} to {found[1]:.2f} ({low:g} to {high:g})"
        for found, low, high in zip(quantiles, *task.limits, strict=True)
    )
    # in hundredths; a task that is never punished needs none
    offset = max(0, math.ceil(-100 * lowest)) / 100
    original = newton_qd.tables.original_reward_offset.get(name)
    there = "-" if original is None else f"{original:g}"
    return (
        f"| `{name}` | {100 * coverage(task.limits, descriptors):.1f} | {spread} | "
        f"{lowest:.4f} | {there} | {offset:g} |"
    )


def main() -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument(
        "--names", nargs="+", default=list(newton_qd.tables.reward_offset)
    )
    options = parser.parse_args()
    text = HEAD
    for name in options.names:
        row = survey(name)
        print(row, flush=True)
        text += row + "\n"
    if options.out:
        options.out.write_text(text + TAIL, encoding="utf-8")


if __name__ == "__main__":
    main()
