"""Evaluate one batch of policies on all devices.

    python examples/sharded_evaluation.py

On a machine without GPUs, virtual devices show that this works; they are not faster:

    XLA_FLAGS=--xla_force_host_platform_device_count=4 python ...
"""

from __future__ import annotations

import argparse
import time

import jax
import numpy as np

from newton_qd.qd import (
    EvolveConfig,
    device_mesh,
    make_policy,
    make_scoring_function,
    make_task,
    shard_scoring,
)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--episode-length", type=int, default=100)
    options = parser.parse_args()

    config = EvolveConfig(env_name=options.env, episode_length=options.episode_length)
    task = make_task(config)
    policy = make_policy(task.env, (64, 64))
    score = make_scoring_function(task, policy, config.episode_length)
    keys = jax.random.split(jax.random.key(0), options.batch_size)
    genotypes = jax.vmap(policy.init)(keys)

    mesh = device_mesh()
    results = []
    for name, function in (
        ("one device", score),
        (f"{mesh.size} devices", shard_scoring(score, mesh)),
    ):
        run = jax.jit(function)
        jax.block_until_ready(run(genotypes, jax.random.key(1)))  # compiles
        begin = time.perf_counter()
        fitnesses, descriptors, _ = run(genotypes, jax.random.key(1))
        fitnesses.block_until_ready()
        seconds = time.perf_counter() - begin
        steps = options.batch_size * options.episode_length
        print(f"{name}: {steps / seconds:,.0f} steps/s")
        results.append((np.asarray(fitnesses), np.asarray(descriptors)))
    same = all(np.array_equal(a, b) for a, b in zip(*results, strict=True))
    print(f"best return {results[0][0].max():.1f}; the same results: {same}")


if __name__ == "__main__":
    main()
