"""Train one policy for an ant by the gradient of its return.

    python examples/train_ant.py

Sixteen ants with different resets share the weights of a small network. The gradient is
cut into windows of 16 steps and clipped, because feedback and contact make longer
gradients too large. Needs optax, which comes with the extra ``qd``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import optax

import newton_qd
from newton_qd.gradients import Episode, GradientOptions

HIDDEN = 32


def policy(weights, obs):
    hidden = jnp.tanh(weights["in"] @ jnp.clip(obs, -5.0, 5.0))
    return jnp.tanh(weights["out"] @ hidden)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--steps", type=int, default=64, help="control steps of 0.05 s")
    parser.add_argument("--iterations", type=int, default=200)
    arguments = parser.parse_args(argv)

    env = newton_qd.create(
        "ant", episode_length=None, auto_reset=False, use_contact_forces=False
    )
    episode = Episode(
        env,
        policy,
        episode_length=arguments.steps,
        options=GradientOptions(window=16, clip=1.0),
    )
    keys = jax.random.split(jax.random.key(0), 3)
    shapes = {"in": (HIDDEN, env.observation_size), "out": (env.action_size, HIDDEN)}
    weights = {
        "in": 0.2 * jax.random.normal(keys[0], shapes["in"], env.dtype),
        # small weights: a policy that reacts little has a gradient of useful size
        "out": 0.01 * jax.random.normal(keys[1], shapes["out"], env.dtype),
    }
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(5e-3))
    moments = optimizer.init(weights)

    def cost(weights, keys):
        found = jax.vmap(episode, (None, 0))(weights, keys)
        # A world with a fault has the fitness -inf: it counts as a failure, and only
        # the other worlds are in the mean.
        sound = jnp.where(found.faulty, 0.0, found.fitness)
        mean = sound.sum() / jnp.maximum((~found.faulty).sum(), 1)
        return -mean, found.faulty.sum()

    @jax.jit
    def improve(weights, moments, key):
        resets = jax.random.split(key, arguments.worlds)
        (value, faults), slope = jax.value_and_grad(cost, has_aux=True)(weights, resets)
        change, moments = optimizer.update(slope, moments)
        return optax.apply_updates(weights, change), moments, -value, faults

    for iteration in range(arguments.iterations + 1):
        key = jax.random.fold_in(keys[2], iteration)
        weights, moments, mean, faults = improve(weights, moments, key)
        if iteration % max(arguments.iterations // 10, 1) == 0:
            print(f"iteration {iteration:3d}: mean return {mean:6.1f}, faulty {faults}")


if __name__ == "__main__":
    main()
