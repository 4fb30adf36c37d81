"""Where the time of one generation of ``evolve`` goes, on the present device.

    python benchmarks/generation.py [--env ant_uni] [--batch-size 256]

The emitter, the evaluation of what it proposes, and the archive are measured, the
environment alone, which replays the actions of the evaluation without a policy, and an
evaluation whose individuals have only biases of their own: what that saves is the time
to read weights. Medians after a warm-up, of wall time and of processor time;
the latter says more where the machine does other things too.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.gradients import Episode
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.rollout import make_policy, make_scoring_function
from newton_qd.qd.scoring.task import make_task


def durations(run: Callable[[], Any], repetitions: int) -> np.ndarray:
    """Median wall and processor time (2,) of ``run`` [s], after one run more."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repetitions):
        wall, processor = time.perf_counter(), time.process_time()
        jax.block_until_ready(run())
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    return np.median(times, axis=0)


def measure(config: EvolveConfig, repetitions: int) -> dict[str, np.ndarray]:
    """Wall and processor time (2,) [s] of the parts of a generation.

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
    key = jax.random.key(1)
    genotypes, remembered = search._ask(state.repertoire, state.emitter, key)
    scores = search._score(genotypes, key)

    policy = make_policy(task.env, config.hidden)
    length = config.episode_length
    watch = jax.jit(make_scoring_function(task, policy, length, transitions=True))
    fitnesses, _, extra = watch(genotypes, key)
    actions = extra["transitions"]["actions"]
    episode = Episode(task.env, None, task.descriptor_extractor, episode_length=length)
    replay = jax.jit(jax.vmap(episode, in_axes=(0, None)))
    if not jnp.array_equal(replay(actions, key).fitness, fitnesses):
        raise RuntimeError("the replayed actions gave other returns")
    one = policy.unravel(genotypes[0])

    def apply_shared(own: Any, observation: jax.Array) -> jax.Array:
        mixed = jax.tree.map(lambda a, b: a if a.ndim == 2 else b, one, own)
        return policy.apply(mixed, observation)

    shared = dataclasses.replace(policy, apply=apply_shared)
    score_shared = jax.jit(make_scoring_function(task, shared, length))
    runs: dict[str, Callable[[], Any]] = {
        "ask": lambda: search._ask(state.repertoire, state.emitter, key),
        "evaluation": lambda: search._score(genotypes, key),
        "environment": lambda: replay(actions, key),
        "shared": lambda: score_shared(genotypes, key),
        "tell": lambda: search._tell(
            state.repertoire,
            state.emitter,
            genotypes,
            remembered,
            scores,
            np.float32(0),
        ),
    }
    return {name: durations(run, repetitions) for name, run in runs.items()}


def main() -> None:
    """Prints one line for each part."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
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
    times = measure(config, options.repetitions)
    learning = times["ask"] + times["tell"]
    whole = learning + times["evaluation"]
    print(
        f"{options.env}, {options.algorithm}, {jax.default_backend()}, "
        f"{os.cpu_count()} cores; wall and processor time of one generation"
    )
    for name, part in (
        ("steps of the environment", times["environment"]),
        ("policy", times["evaluation"] - times["environment"]),
        ("  of it, reading weights", times["evaluation"] - times["shared"]),
        ("emitter and archive", learning),
        ("all", whole),
    ):
        shares = "  ".join(
            f"{seconds:7.3f} s {seconds / total:6.1%}"
            for seconds, total in zip(part, whole, strict=True)
        )
        print(f"{name:26}{shares}")


if __name__ == "__main__":
    main()
