"""Measure what softer contacts cost in fidelity and gain in gradients.

    python benchmarks/softness.py [--robots ant halfcheetah hopper]

Writes the table of docs/gradients.md. *Weight of the first order*: what inverse
variances give it over the horizon, and *bias*: the share of the first-order slope that
the zeroth order does not confirm (`newton_qd.diagnose_gradients`). *Distance from
the stiffest*: distance of the torso from its position with the stiffest material, after
1 s of the same random actions from the same start; median over the worlds.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import newton_qd
from newton_qd.gradients import soft_to_stiff

FACTORS = (8.0, 4.0, 2.0, 1.0, 0.5)
HORIZON, WORLDS = 16, 16


def torso(env: Any, seconds: float) -> np.ndarray:
    """Torso coordinates (worlds, 2) along the ground and up, after random actions."""
    steps = round(seconds / env.dt)
    shape = (WORLDS, steps, env.action_size)
    actions = jax.random.uniform(jax.random.key(1), shape, env.dtype, -1, 1)

    def run(actions: jax.Array) -> jax.Array:
        state, _ = jax.lax.scan(
            lambda state, action: (env.step(state, action), None),
            env.reset(jax.random.key(0)),
            actions,
        )
        return state.pipeline_state.q[jnp.array([0, 2 if env.name == "ant" else 1])]

    return np.asarray(jax.jit(jax.vmap(run))(actions))


def main() -> None:
    """Prints one row a robot and factor."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", nargs="+", default=["ant", "halfcheetah", "hopper"])
    names = parser.parse_args().robots
    print(
        "| robot | softness | penetration at rest [mm] "
        "| distance from the stiffest [m] "
        f"| gradient norm, {HORIZON} steps | largest | weight of the first order | "
        "bias |\n"
        "|---|---|---|---|---|---|---|---|"
    )
    for name in names:
        with jax.enable_x64(True):
            env = newton_qd.create(
                name, episode_length=None, auto_reset=False, dtype="float64"
            )
            envs: Any = soft_to_stiff(env, FACTORS)
            reached = [torso(soft, 1.0) for soft in envs]
        for factor, soft, where in zip(FACTORS, envs, reached, strict=True):
            report = newton_qd.diagnose_gradients(
                soft, horizons=(HORIZON // 2, HORIZON), worlds=4, samples=8
            )
            row = report.horizons[-1]
            off = np.median(np.linalg.norm(where - reached[-1], axis=1))
            depth = 1e3 * soft.unwrapped.robot.material.static_penetration
            print(
                f"| {name} | {factor:g} | {depth:g} | {off:.3f} | {row.norm:.3g} | "
                f"{row.largest_norm:.3g} | {row.order:.3f} | "
                f"{row.bias:.2f} ± {row.bias_error:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
