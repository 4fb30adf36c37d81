"""Spread of untrained policies on the original's tasks, as survey.py measures ours.

    peer/bin/python benchmarks/original_spread.py [--names humanoid_omni]

Runs in the environment of brax v1 (see README.md) and imports nothing of newton_qd.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from qdax.tasks.brax import v1

HIDDEN, SIDE = (64, 64), 32


def last_descriptors(env: Any, worlds: int, steps: int) -> tuple[np.ndarray, ...]:
    """Runs one episode of each of some policies with random weights.

    Args:
        env: A task with a state descriptor.
        worlds: Number of policies.
        steps: Steps after which an episode counts as over.

    Returns:
        State descriptors (worlds, nd) and steps (worlds,) at the ends of the episodes.
    """
    sizes = (env.observation_size, *HIDDEN, env.action_size)

    def weights(key: jax.Array) -> list[jax.Array]:
        shapes = zip(jax.random.split(key, 3), sizes[:-1], sizes[1:], strict=True)
        draw = jax.nn.initializers.lecun_uniform()
        return [draw(k, (rows, columns)) for k, rows, columns in shapes]

    def act(layers: list[jax.Array], x: jax.Array) -> jax.Array:
        for layer in layers[:-1]:
            x = jax.nn.relu(x @ layer)
        return jnp.tanh(x @ layers[-1])

    layers = jax.vmap(weights)(jax.random.split(jax.random.PRNGKey(0), worlds))
    start = jax.vmap(env.reset)(jnp.stack([jax.random.PRNGKey(1)] * worlds))

    def advance(carry: Any, _: None) -> Any:
        state, over = carry
        seen = state.info["state_descriptor"], over
        state = jax.vmap(env.step)(state, jax.vmap(act)(layers, state.obs))
        return (state, over | (state.done > 0)), seen

    first = start, jnp.zeros((worlds,), bool)
    run = jax.jit(lambda first: jax.lax.scan(advance, first, None, length=steps)[1])
    described, over = (np.asarray(x) for x in run(first))
    last = np.count_nonzero(~over, axis=0) - 1
    return described[last, np.arange(worlds)], last + 1


def main() -> None:
    """Prints coverage and quantiles."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--names", nargs="+", default=["humanoid_omni"])
    parser.add_argument("--worlds", type=int, default=500)
    parser.add_argument("--steps", type=int, default=100)
    options = parser.parse_args()
    for name in options.names:
        env = v1.create(name, episode_length=1000)
        found, steps = last_descriptors(env, options.worlds, options.steps)
        low, high = (np.asarray(ends) for ends in env.state_descriptor_limits)
        unit = np.clip((found - low) / (high - low), 0.0, 1.0)
        cells = np.unique(np.minimum((unit * SIDE).astype(int), SIDE - 1), axis=0)
        print(
            f"{name}: {100 * len(cells) / SIDE**2:.1f} % of the cells; 5 % and 95 % "
            f"{np.quantile(found, [0.05, 0.95], axis=0).round(2).tolist()}; "
            f"{np.median(steps):.0f} steps"
        )


if __name__ == "__main__":
    main()
