"""Look at every QD task: spread of untrained policies, lowest reward, speed.

    python benchmarks/survey.py [--out survey.md] [--names ant_uni pointmaze]

*Coverage*: 1,000 policies with random weights (perceptrons of two hidden layers of 64,
tanh) from one start, one episode each; the share of 1,024 cells of the descriptor space
that they reach: a line, a grid of 32 x 32, or, beyond two dimensions, the cells of a
centroidal Voronoi tessellation. *Lowest reward*: of a step of these episodes; minus it
is the offset that would keep every QD score positive, beside the original's. *Speed*:
`env.step` in a jitted scan, random actions, relative to ant_uni per degree of freedom
and contact.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from throughput import measure

import newton_qd
from newton_qd.envs.base import PhysicsEnv
from newton_qd.qd import EvolveConfig, make_policy, make_task
from newton_qd.qd.rollout import Trajectories

POLICIES, STEPS, CELLS, HIDDEN = 1000, 1000, 1024, (64, 64)
HEAD = """# Survey of the tasks

Written by `benchmarks/survey.py`, whose head says how each column is measured ({cores}
cores of a CPU).

| task | coverage [%] | lowest reward of a step | original's reward offset | \
thousand steps/s, batch 256 | speed per (dof + contact), ant_uni = 1 |
|---|---|---|---|---|---|
"""


def roll_out(name: str) -> tuple[np.ndarray, float]:
    """Descriptors (n, nd) of random policies, and the lowest reward of a step."""
    task = make_task(EvolveConfig(env_name=name, episode_length=STEPS))
    policy = make_policy(task.env, HIDDEN)
    weights = jax.vmap(policy.init)(jax.random.split(jax.random.key(0), POLICIES))

    @jax.jit
    def run(weights: jax.Array) -> tuple[jax.Array, jax.Array]:
        parameters = jax.vmap(policy.unravel)(weights)
        start = jax.vmap(task.env.reset, in_axes=None, axis_size=POLICIES)(
            jax.random.key(1)
        )

        def advance(carry: Any, _: None) -> Any:
            state, over = carry
            seen = state.info["state_descriptor"], over
            action = jax.vmap(policy.apply)(parameters, state.obs)
            state = jax.vmap(task.env.step)(state, action)
            reward = jnp.where(over, jnp.inf, state.reward)
            return (state, over | (state.done > 0)), (*seen, reward)

        over = jnp.zeros((POLICIES,), bool)
        _, (described, over, rewards) = jax.lax.scan(
            advance, (start, over), None, length=STEPS
        )
        data = Trajectories(state_desc=jnp.swapaxes(described, 0, 1))
        mask = jnp.swapaxes(over, 0, 1).astype(described.dtype)
        return task.descriptor_extractor(data, mask), jnp.min(rewards)

    descriptors, lowest = run(weights)
    return np.asarray(descriptors), float(lowest)


def coverage(name: str, descriptors: np.ndarray) -> float:
    """Share of the cells that hold a descriptor [-]."""
    qd: Any = newton_qd.create(name)
    low, high = (np.asarray(limit) for limit in qd.descriptor_limits)
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


def speed(name: str) -> tuple[float, int]:
    """Environment steps per second, and the robot's degrees of freedom and contacts."""
    base = newton_qd.create(name).unwrapped
    size = 0
    if isinstance(base, PhysicsEnv):
        size = base.system.nv + len(base.system.contact_body)
    return measure(name, 256, 100, 2, 3)[0], size


def main() -> None:
    """Writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--names", nargs="+", default=list(newton_qd.reward_offset))
    options = parser.parse_args()
    rate, size = speed("ant_uni")
    text = HEAD.format(cores=os.cpu_count())
    for name in options.names:
        descriptors, lowest = roll_out(name)
        found = speed(name)
        relative = f"{found[0] * found[1] / (rate * size):.2f}" if found[1] else "-"
        text += (
            f"| `{name}` | {100 * coverage(name, descriptors):.1f} | {lowest:.2f} | "
            f"{newton_qd.reward_offset[name]:g} | {found[0] / 1e3:.0f} | {relative} |\n"
        )
        print(text.splitlines()[-1], flush=True)
    if options.out:
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
