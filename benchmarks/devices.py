"""One evaluation on one device and on several: the same results, and how much faster.

    python benchmarks/devices.py [--env ant_uni] [--batch-size 8192] [--devices 2]

Two kinds of individuals are evaluated: sequences of actions, whose results must be
bitwise the same, and policies, perceptrons whose matrix products XLA may round in
another way for another batch, to 1e-5 of the largest return. Every device must step
its share of the worlds, no more. Needs neither QDax nor Flax. The exit code is 1 if
something of this does not hold.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from throughput import seconds

from newton_qd.gradients import Episode
from newton_qd.physics.launch import Launcher
from newton_qd.physics.native import all_plans
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.scoring.sharding import device_mesh, shard_scoring
from newton_qd.qd.scoring.task import Task, make_task

HIDDEN = 64
TOLERANCE = 1e-5
REPETITIONS = 3


def watch_launches() -> set[tuple[str, str, int]]:
    """Collects device, kernel and number of worlds of every launch on a GPU."""
    seen: set[tuple[str, str, int]] = set()
    launch = Launcher.launch

    def watched(
        self: Launcher, name: str, worlds: int, *args: Any, **rest: Any
    ) -> None:
        seen.add((self.device.alias, name, worlds))
        launch(self, name, worlds, *args, **rest)

    Launcher.launch = watched
    return seen


def launched_on_cpu() -> np.ndarray:
    """Launches on a CPU until now and their worlds, a row for each kernel."""
    counts = [(plan.launches, plan.worlds) for plan in all_plans()]
    return np.array(counts, np.int64).reshape(-1, 2)


def perceptron(env: Any) -> tuple[int, Callable[[Any, jax.Array], jax.Array]]:
    """Number of weights, and the policy as a function of weights and observation."""
    shapes = [
        (env.observation_size, HIDDEN),
        (HIDDEN, HIDDEN),
        (HIDDEN, env.action_size),
    ]
    ends = np.cumsum([rows * columns for rows, columns in shapes])

    def act(weights: jax.Array, observation: jax.Array) -> jax.Array:
        parts = jnp.split(weights, ends[:-1])
        for part, shape in zip(parts, shapes, strict=True):
            observation = jnp.tanh(observation @ part.reshape(shape))
        return observation

    return int(ends[-1]), act


def scoring(task: Task, act: Any, length: int) -> Any:
    """Scores of a batch of weights, or of actions where there is no policy."""
    episode = Episode(task.env, act, task.descriptor_extractor, episode_length=length)

    def score(genotypes: jax.Array, key: jax.Array) -> Any:
        outcome = jax.vmap(episode, in_axes=(0, None))(genotypes, key)
        return outcome.fitness, outcome.descriptor, {}

    return score


def compare(
    name: str,
    score: Any,
    genotypes: jax.Array,
    counts: list[int],
    steps: int,
    seen: set[tuple[str, str, int]],
) -> float:
    """Prints speeds; returns the largest difference over the largest return."""
    worst, first, alone = 0.0, None, 0.0
    for count in counts:
        run = jax.jit(shard_scoring(score, device_mesh(count)))
        duration = seconds(
            lambda run=run: run(genotypes, jax.random.key(1)), REPETITIONS
        )
        before = launched_on_cpu()
        found = [np.asarray(x) for x in run(genotypes, jax.random.key(1))[:2]]
        # the kernel with most launches is the step
        launches, worlds = max([[0, 0], *(launched_on_cpu() - before).tolist()])
        if launches:
            seen.add(("cpu", "step_forward", worlds // launches))
        first = found if first is None else first
        alone = alone or duration
        scale = float(np.abs(first[0]).max())
        difference = max(
            float(np.abs(a - b).max()) for a, b in zip(first, found, strict=True)
        )
        worst = max(worst, difference / scale)
        print(
            f"{name} on {count} device(s): {len(genotypes) * steps / duration:,.0f} "
            f"steps/s, {alone / duration:.2f} times as fast, differs by "
            f"{difference / scale:.1e}"
        )
    return worst


def main() -> int:
    """Compares, and returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", default="ant_uni")
    parser.add_argument("--batch-size", type=int, default=8192)
    parser.add_argument("--episode-length", type=int, default=100)
    parser.add_argument("--devices", type=int, help="at most (default: all)")
    options = parser.parse_args()
    count = options.devices or len(jax.devices())
    config = EvolveConfig(env_name=options.env, episode_length=options.episode_length)
    task, length = make_task(config), options.episode_length
    print(f"{options.env}, {count} x {jax.devices()[0].device_kind}")
    seen = watch_launches()
    counts = [1] if count == 1 else [1, count]
    keys = jax.random.split(jax.random.key(0))
    shape = (options.batch_size, length * task.env.action_size)
    actions = jax.random.uniform(keys[0], shape, jnp.float32, -1.0, 1.0)
    score = scoring(task, None, length)
    replayed = compare("actions", score, actions, counts, length, seen)
    size, act = perceptron(task.env)
    weights = 0.1 * jax.random.normal(keys[1], (options.batch_size, size), jnp.float32)
    score = scoring(task, act, length)
    played = compare("policies", score, weights, counts, length, seen)
    steps = {(alias, worlds) for alias, name, worlds in seen if name == "step_forward"}
    print("worlds of a step, by device:", *sorted(steps))
    share = -(-options.batch_size // count)
    shared = {alias for alias, worlds in steps if worlds == share}
    everywhere = len(shared) == count or jax.default_backend() == "cpu"
    right = {worlds for _, worlds in steps} == {options.batch_size, share}
    good = replayed == 0 and played <= TOLERANCE and everywhere and right
    print("all as it should be" if good else "NOT as it should be")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
