"""Evolve gaits of an ant, print the archive, and run its best policy.

    python examples/evolve_ant.py

The command ``newton-qd evolve ant_uni`` does the first step and writes files.
"""

from __future__ import annotations

import jax

from newton_qd.qd import EvolveConfig, evolve, make_policy, make_task


def main() -> None:
    config = EvolveConfig(env_name="ant_uni", iterations=40, seed=0)
    result = evolve(config)
    archive = result.archive
    print(f"{archive.filled.sum()} gaits in {len(archive.filled)} cells")

    best = archive.fitnesses.argmax()
    print(f"best return {archive.fitnesses[best]:.1f}")
    print(f"its feet touch the ground {archive.descriptors[best]} of the time")

    env = make_task(config).env
    policy = make_policy(env, config.hidden)
    weights = policy.unravel(archive.genotypes[best])

    @jax.jit
    def rollout(key: jax.Array) -> jax.Array:
        def advance(state, _):
            state = env.step(state, policy.apply(weights, state.obs))
            return state, state.metrics["x_position"]

        return jax.lax.scan(advance, env.reset(key), None, config.episode_length)[1]

    print(f"from another start it walks to x = {rollout(jax.random.key(1))[-1]:.2f} m")


if __name__ == "__main__":
    main()
