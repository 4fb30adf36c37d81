"""Where the time of one generation of ``evolve`` goes, on the present device.

    python benchmarks/generation.py [--env ant_uni] [--batch-size 256]

One generation is measured as a whole; then the evaluation of a batch of elites alone;
then the environment alone, which replays the actions of these elites from the same
start, without a policy. Times are medians after a warm-up.
"""

from __future__ import annotations

import argparse
import os
import time

import jax
import jax.numpy as jnp
from throughput import seconds

from newton_qd.gradients.episode import make_episode
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.rollout import make_policy, make_scoring_function
from newton_qd.qd.search import Search
from newton_qd.qd.task import make_task


def measure(config: EvolveConfig, repetitions: int) -> dict[str, float]:
    """Durations [s] of a generation and of its parts.

    Args:
        config: Settings; ``iterations`` generations come before the measured ones.
        repetitions: Runs that the medians are taken of.

    Raises:
        RuntimeError: The replayed actions did not give the same returns.
    """
    task = make_task(config)
    search = Search(config.resolve(task.descriptor_length), task)
    state = search.empty()
    for _ in range(config.iterations + 1):
        state = search.advance(state)
    generation = seconds(lambda: search.advance(state).repertoire, repetitions)

    policy = make_policy(task.env, config.hidden)
    elites = state.repertoire.genotypes[state.repertoire.fitnesses[:, 0] > -jnp.inf]
    genotypes = jnp.resize(elites, (config.batch_size, policy.size))
    key, length = jax.random.key(1), config.episode_length
    score = jax.jit(make_scoring_function(task, policy, length))
    evaluation = seconds(lambda: score(genotypes, key), repetitions)

    watch = jax.jit(make_scoring_function(task, policy, length, transitions=True))
    fitnesses, _, extra = watch(genotypes, key)
    actions = extra["transitions"]["actions"]
    episode = make_episode(
        task.env, None, task.descriptor_extractor, episode_length=length
    )
    replay = jax.jit(jax.vmap(episode, in_axes=(0, None)))
    if not jnp.array_equal(replay(actions, key).fitness, fitnesses):
        raise RuntimeError("the replayed actions gave other returns")
    environment = seconds(lambda: replay(actions, key), repetitions)
    return {
        "generation": generation,
        "evaluation": evaluation,
        "environment": environment,
    }


def main() -> None:
    """Prints one line for each part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--algorithm", default="me")
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--episode-length", type=int, default=250)
    parser.add_argument("--generations", type=int, default=5, help="before these")
    parser.add_argument("--repetitions", type=int, default=5)
    options = parser.parse_args()
    config = EvolveConfig(
        env_name=options.env,
        algorithm=options.algorithm,
        iterations=options.generations,
        batch_size=options.batch_size,
        episode_length=options.episode_length,
        hidden=(64, 64),
    )
    begin = time.perf_counter()
    times = measure(config, options.repetitions)
    whole = times["generation"]
    print(
        f"{options.env}, {options.algorithm}, {jax.default_backend()}, "
        f"{os.cpu_count()} cores: one generation takes {whole:.2f} s"
    )
    for name, part in (
        ("steps of the environment", times["environment"]),
        ("policy and descriptor", times["evaluation"] - times["environment"]),
        ("emitter and archive", whole - times["evaluation"]),
    ):
        print(f"{name:26} {part:8.3f} s  {part / whole:6.1%}")
    print(f"measured in {time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
