"""CMA-MEGA as an emitter of QDax, with exact gradients through the physics.

python examples/gradient_qd.py
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from typing import Any

import jax
from qdax.core.containers.mapelites_repertoire import compute_euclidean_centroids
from qdax.core.map_elites import MAPElites
from qdax.utils.metrics import default_qd_metrics

from newton_qd.gradients import GradientOptions, with_smooth_descriptor
from newton_qd.qd import EvolveConfig, episode_of, make_policy, make_task
from newton_qd.qd.emitters import CMAMEGAEmitter


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="ant_omni")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--points", type=int, default=4, help="solution points")
    parser.add_argument("--batch-size", type=int, default=32, help="of each point")
    parser.add_argument("--episode-length", type=int, default=100)
    options = parser.parse_args()

    config = EvolveConfig(env_name=options.env, episode_length=options.episode_length)
    task = make_task(config)
    # without this, the gradient of feet on the ground is 0
    env = with_smooth_descriptor(task.env, 0.1, straight_through=True)
    task = dataclasses.replace(task, env=env)
    policy = make_policy(task.env, (32,))
    start, key = jax.random.key(0), jax.random.key(1)
    # The loop evaluates all offspring without gradients, the emitter four points with.
    episode = episode_of(
        task, policy, config.episode_length, options=GradientOptions(clip=10.0)
    )
    plain: Any = episode.scoring()
    exact = episode.scoring(episode.gradient)
    emitter = CMAMEGAEmitter(
        lambda genotypes, _: exact(genotypes, start),
        sigma_g=0.5,
        batch_size=options.batch_size,
        num_emitters=options.points,
    )
    offset = task.qd_offset(config.episode_length)
    search = MAPElites(
        lambda genotypes, _: plain(genotypes, start),
        emitter,
        functools.partial(default_qd_metrics, qd_offset=offset),
    )
    low, high = (limit.tolist() for limit in task.limits)
    side = round(1024 ** (1 / len(low)))
    cells = compute_euclidean_centroids((side,) * len(low), low, high)
    population = jax.vmap(policy.init)(jax.random.split(key, emitter.batch_size))
    repertoire, state, metrics = jax.jit(search.init)(population, cells, key)
    update = jax.jit(search.update)
    for iteration in range(options.iterations + 1):
        if iteration % 10 == 0 or iteration == options.iterations:
            print(
                f"iteration {iteration}: QD score {metrics['qd_score']:,.0f}, "
                f"coverage {metrics['coverage']:.1f} %, "
                f"best {metrics['max_fitness']:.1f}, rejected {state.rejected}"
            )
        if iteration < options.iterations:
            key, step_key = jax.random.split(key)
            repertoire, state, metrics = update(repertoire, state, step_key)


if __name__ == "__main__":
    main()
