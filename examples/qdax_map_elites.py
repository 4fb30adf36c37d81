"""Run MAP-Elites with QDax's own classes.

    python examples/qdax_map_elites.py

A script for QDax needs only the two lines after the first imports: the import of
``newton_qd.compat`` and ``install()``.
"""

# QDax's annotations differ from what its functions take and return.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false
from __future__ import annotations

import argparse
import functools

import jax
import jax.numpy as jnp

import newton_qd.compat

newton_qd.compat.install()

from qdax.core.containers.mapelites_repertoire import compute_cvt_centroids
from qdax.core.emitters.mutation_operators import isoline_variation
from qdax.core.emitters.standard_emitters import MixingEmitter
from qdax.core.map_elites import MAPElites
from qdax.tasks.brax import v1 as environments
from qdax.tasks.brax.v1.env_creators import create_default_brax_task_components
from qdax.utils.metrics import default_qd_metrics


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--batch-size", type=int, default=128)
    parser.add_argument("--episode-length", type=int, default=100)
    options = parser.parse_args()

    key, task_key, init_key = jax.random.split(jax.random.key(0), 3)
    env, policy, score = create_default_brax_task_components(
        options.env, task_key, options.episode_length, (32,)
    )
    variation = functools.partial(isoline_variation, iso_sigma=0.02, line_sigma=0.2)
    offset = environments.reward_offset[options.env] * options.episode_length
    algorithm = MAPElites(
        scoring_function=score,
        emitter=MixingEmitter(lambda x, _: x, variation, 1.0, options.batch_size),
        metrics_function=functools.partial(default_qd_metrics, qd_offset=offset),
    )
    low, high = env.descriptor_limits
    centroids = compute_cvt_centroids(
        env.descriptor_length, 10_000, 256, low.tolist(), high.tolist(), init_key
    )
    keys = jax.random.split(init_key, options.batch_size)
    observations = jnp.zeros((options.batch_size, env.observation_size))
    population = jax.vmap(policy.init)(keys, observations)
    repertoire, state, metrics = algorithm.init(population, centroids, init_key)
    update = jax.jit(algorithm.update)
    for iteration in range(options.iterations + 1):
        if iteration % 10 == 0 or iteration == options.iterations:
            print(
                f"iteration {iteration}: QD score {metrics['qd_score']:,.0f}, "
                f"coverage {metrics['coverage']:.1f} %, "
                f"best {metrics['max_fitness']:.1f}"
            )
        if iteration < options.iterations:
            key, step_key = jax.random.split(key)
            repertoire, state, metrics = update(repertoire, state, step_key)


if __name__ == "__main__":
    main()
