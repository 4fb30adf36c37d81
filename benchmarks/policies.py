"""Measures what the policies of ASCII-ME's repository change for an algorithm.

There, ASCII-ME has other policies than MAP-Elites, PGA-ME and DCRL-ME: tanh in the
hidden layers, small actions at the start, and no tanh at the end. So their actions have
no bound: neither these environments nor those of brax v1 clip them. QDax's policies,
which the others have, have ReLU in the hidden layers, and end in tanh. This script runs
MAP-Elites and ASCII-ME with both kinds, and with either of them with and without the
last tanh:

    python benchmarks/policies.py hopper_uni --evaluations 100000

Scores are sums of the fitness of all elites without an offset, as in the article.
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from qdax.core.neuroevolution.networks.networks import MLP
from study_protocols import FIELD
from study_runs import chosen, variants

from newton_qd.qd import EvolveConfig, make_task
from newton_qd.qd.run.search import Search
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.task import Task

ALGORITHMS = ("me", "ascii-me")
KINDS = ("QDax", "QDax, unbounded", "ASCII-ME", "ASCII-ME, bounded")


def network(kind: str, actions: int, hidden: tuple[int, ...]) -> Any:
    """Returns a network of a kind; ``None``: QDax's own."""
    if kind == "QDax":
        return None
    sizes, initializers = (*hidden, actions), jax.nn.initializers
    if kind == "QDax, unbounded":
        return MLP(layer_sizes=sizes, kernel_init=initializers.lecun_uniform())
    return MLP(
        layer_sizes=sizes,
        activation=nn.tanh,
        kernel_init=initializers.orthogonal(2**0.5),
        kernel_init_final=initializers.orthogonal(0.01),
        final_activation=jnp.tanh if kind == "ASCII-ME, bounded" else None,
    )


def largest_action(task: Task, hidden: tuple[int, ...], weights: np.ndarray) -> float:
    """Returns the largest action of a policy in an episode [-]."""
    policy = policy_for(task, hidden)

    def step(state: Any, _: None) -> tuple[Any, jax.Array]:
        action = policy.of_weights(jnp.asarray(weights), state.obs)
        return task.env.step(state, action), jnp.abs(action).max()

    @jax.jit
    def run(key: jax.Array) -> jax.Array:
        first = task.env.reset(key)
        return jax.lax.scan(step, first, length=FIELD.settings["episode_length"])[1]

    return float(run(jax.random.key(0)).max())


def scores(name: str, algorithm: str, kind: str, args: Any) -> list[str]:
    """Runs an algorithm, and returns the cells of its row."""
    given = {**FIELD.settings_of(name), "batch_size": args.batch_size}
    config = EvolveConfig(
        env_name=name,
        algorithm=algorithm,
        seed=args.seed,
        iterations=10**6,
        **{**given, **variants()[chosen(algorithm, name)]},
    )
    task = make_task(config)
    config = config.resolve(task.descriptor_length)
    own = network(kind, task.env.action_size, config.hidden)
    task = dataclasses.replace(task, network=own)
    search = Search(config, task)
    state = search.empty()
    while not len(state.metrics) or state.metrics[-1][1] < args.evaluations:
        state = search.advance(state)
    found = np.asarray(state.repertoire.fitnesses)[:, 0]
    filled = np.isfinite(found)
    best = np.asarray(state.repertoire.genotypes)[np.argmax(found)]
    return [
        *(name, algorithm, kind),
        f"{found[filled].sum():,.0f}",
        f"{100 * filled.mean():.1f}",
        f"{found.max():.0f}",
        f"{largest_action(task, config.hidden, best):.1f}",
    ]


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env_name", choices=FIELD.tasks)
    parser.add_argument(
        "--algorithms", nargs="*", choices=ALGORITHMS, default=ALGORITHMS
    )
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=KINDS)
    parser.add_argument("--evaluations", type=int, default=100_000)
    parser.add_argument("--batch-size", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    head = ("task", "algorithm", "policies", "sum of the fitness", "coverage [%]")
    head = (*head, "best", "largest action of the best [-]")
    print(f"| {' | '.join(head)} |\n{'|---' * len(head)}|")
    for algorithm in args.algorithms:
        for kind in args.kinds:
            cells = scores(args.env_name, algorithm, kind, args)
            print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
