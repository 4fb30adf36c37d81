"""How far steps along the gradients of elites hold, and what a gradient costs.

    python benchmarks/study_steps.py ant_uni --flows 0,10,1 0,0,1 0,1,0.95 16,0,1
    python benchmarks/study_steps.py hopper_uni --steps 200 --flows 0,0,1 0,10,1 \
        --lengths 0.0005 0.001 0.002 0.005 0.01 0.02
    python benchmarks/study_steps.py ant_omni --flows 0,10,1 0,1,1

MAP-Elites runs for ten generations. Its elites take steps of some lengths along the
normalized gradient of their fitness, those nearest to empty cells along that of
the distance to these, and both along random directions. Each flow is window, clip
and discount of ``GradientOptions``, 0 for none.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.gradients import (
    Episode,
    GradientOptions,
    with_smooth_descriptor,
)
from newton_qd.qd import EvolveConfig, make_policy, make_scoring_function, make_task
from newton_qd.qd.emitters.cells import draw_cells, empty_targets, nearest_cells
from newton_qd.qd.run.search import Search

PARENTS = 32
GENERATIONS = 10
SMOOTH_WIDTH = 0.1


def flow(text: str) -> GradientOptions:
    """Reads window, clip and discount."""
    window, clip, discount = text.split(",")
    return GradientOptions(
        window=int(window) or None,
        clip=float(clip) or None,
        discount=float(discount),
        checkpoint_every=None,
    )


def units(ways: jax.Array) -> jax.Array:
    """(N, size) directions of length one."""
    length = jnp.linalg.norm(ways, axis=1, keepdims=True)
    return ways / jnp.maximum(length, 1e-20)


def row(label: str, values: np.ndarray, better: np.ndarray) -> None:
    """Prints medians over the parents, and the share of better offspring.

    Args:
        label: Direction of the steps.
        values: (parents, lengths) what offspring have.
        better: (parents, lengths) whether they are better than the parent.
    """
    print(
        f"{label:30} better {np.round(better.mean(0), 2)} "
        f"median {np.round(np.median(values, axis=0), 3)} "
        f"best of all {np.median(values.max(axis=1)):.2f}",
        flush=True,
    )


def seconds(function: Callable[..., Any], *values: Any) -> float:
    """Processor time of a call that is compiled [s]."""
    jax.block_until_ready(function(*values))
    begin = time.process_time()
    jax.block_until_ready(function(*values))
    return time.process_time() - begin


def arguments() -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--flows", nargs="*", default=["0,10,1"])
    lengths = [0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0]
    parser.add_argument("--lengths", nargs="*", type=float, default=lengths)
    return parser.parse_args()


def main() -> None:
    """Measures one task."""
    args = arguments()
    config = EvolveConfig(env_name=args.task, episode_length=args.steps)
    task = make_task(config)
    search = Search(config.resolve(task.descriptor_length), task)
    state = search.empty()
    for _ in range(GENERATIONS):
        state = search.advance(state)
    elites = state.repertoire
    start = jax.random.split(jax.random.key(config.seed), 4)[1]  # as ``Search`` has it
    policy = make_policy(task.env, config.hidden)
    score = jax.jit(make_scoring_function(task, policy, args.steps))
    filled = elites.fitnesses[:, 0] > -jnp.inf
    keys = jax.random.split(jax.random.key(0), 3)
    targets = empty_targets(elites, keys[0], PARENTS)
    climbers = draw_cells(keys[1], filled, PARENTS)
    movers = nearest_cells(elites.descriptors, filled, targets)
    weights = elites.genotypes[jnp.concatenate([climbers, movers])]
    fitness, found, _ = score(weights, start)
    error = targets - found[PARENTS:]
    uphill = jnp.eye(1, 1 + error.shape[1])
    directions = jnp.concatenate(
        [jnp.tile(uphill, (PARENTS, 1)), jnp.pad(error, ((0, 0), (1, 0)))]
    )
    plain = seconds(score, jnp.tile(weights, (2, 1)), start) / 2

    def show(label: str, ways: jax.Array) -> None:
        steps = jnp.asarray(args.lengths, jnp.float32)[:, None] * units(ways)[:, None]
        offspring = (weights[:, None] + steps).reshape(-1, weights.shape[1])
        values, ends, _ = score(offspring, start)
        gain = np.asarray(values.reshape(len(weights), -1) - fitness[:, None])[:PARENTS]
        row(f"fitness, {label}", gain, gain > 0)
        ends = ends.reshape(len(weights), -1, ends.shape[1])[PARENTS:]
        left = jnp.linalg.norm(ends - targets[:, None], axis=2)
        share = np.asarray(left / jnp.linalg.norm(error, axis=1, keepdims=True))
        row(f"closer, {label}", 1 - share, share < 1)

    show("random", jax.random.normal(keys[2], weights.shape))
    env = with_smooth_descriptor(task.env, SMOOTH_WIDTH, straight_through=True)
    for text in args.flows:
        episode = Episode(
            env,
            policy.apply,
            task.descriptor_extractor,
            episode_length=args.steps,
            options=flow(text),
            unravel=policy.unravel,
        )
        gradient = jax.jit(episode.directional)
        ways = gradient(weights, directions[:, None], start).gradients[:, 0]
        show(text, ways)
        cost = seconds(gradient, weights, directions[:, None], start) / plain
        norm = float(jnp.median(jnp.linalg.norm(ways[:PARENTS], axis=1)))
        print(
            f"  norm of the gradient {norm:.3g}, {cost:.1f} times a score", flush=True
        )


if __name__ == "__main__":
    main()
