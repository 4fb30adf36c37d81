"""Increase the return of ants by gradient ascent; print a descriptor's gradient.

    python examples/gradient_of_return.py

Sixteen ants run without a policy, each with its own sequence of actions. Each follows
its own gradient, so the result is sixteen gaits.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import jax
import jax.numpy as jnp

import newton_qd
from newton_qd.gradients import (
    Episode,
    EpisodeGradients,
    GradientOptions,
    with_smooth_descriptor,
)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--steps", type=int, default=40, help="control steps of 0.05 s")
    parser.add_argument("--iterations", type=int, default=60)
    arguments = parser.parse_args(argv)

    env = newton_qd.create("ant_uni", auto_reset=False)
    episode = Episode(
        with_smooth_descriptor(env),
        None,  # no policy: the genotypes are the actions
        newton_qd.tables.descriptor_extractor["ant_uni"],
        episode_length=arguments.steps,
        # contact makes the gradient grow with the steps that it goes back
        options=GradientOptions(clip=10.0),
    )
    key, start = jax.random.key(0), jax.random.key(1)
    shape = (arguments.worlds, arguments.steps, env.action_size)
    plans = 0.3 * jax.random.uniform(key, shape, env.dtype, -1.0, 1.0)

    @jax.jit
    def climb(plans):
        result = episode.gradient(plans, start)
        uphill = result.gradients[:, 0]
        size = jnp.sqrt(jnp.sum(jnp.square(uphill), axis=(1, 2), keepdims=True))
        return jnp.clip(plans + 0.3 * uphill / (size + 1e-6), -1.0, 1.0), result

    def report(iteration: int, result: EpisodeGradients) -> None:
        fitness, faulty = result.fitnesses, int(result.faulty.sum())
        print(
            f"iteration {iteration:3d}: mean return {fitness.mean():6.1f}, "
            f"best {fitness.max():6.1f}, faulty {faulty}"
        )

    for iteration in range(arguments.iterations):
        plans, result = climb(plans)
        if iteration % max(arguments.iterations // 5, 1) == 0:
            report(iteration, result)
    _, result = climb(plans)
    report(arguments.iterations, result)
    best = int(result.fitnesses.argmax())
    print(
        f"the best one's feet touch the ground {result.descriptors[best]} of the time"
    )
    norms = jnp.sqrt(jnp.sum(jnp.square(result.gradients[best, 1:]), axis=(1, 2)))
    print(f"gradients of these four have norms {norms}")


if __name__ == "__main__":
    main()
