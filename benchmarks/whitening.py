"""Measures what whitened observations change for an actor alone, without an archive.

One actor maximizes the return with gradients of the physics over short windows. The
table has the return of its policy, without noise, from a start state that it has not
seen, how long the robot stays up, and how far it gets:

    python benchmarks/whitening.py humanoid_uni --updates 200
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import jax.numpy as jnp

from newton_qd.qd import EvolveConfig, make_task
from newton_qd.qd.algorithms.gradient_options import (
    DifferentiableOptions,
    differentiable,
)
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic, measure_of
from newton_qd.qd.emitters.actor_critic_settings import ActorCriticSettings
from newton_qd.qd.emitters.whitening import Whitening
from newton_qd.qd.scoring.networks import policy_for

SETTINGS = ActorCriticSettings(
    worlds=64, window=32, rate=2e-3, discount=0.99, actor_trace=0.95, epochs=4
)
LENGTH = 250


def walk(env: Any, act: Any, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return of an episode, its steps before a fall, and the way of the torso [m]."""

    def step(state: Any, _: None) -> tuple[Any, tuple[Any, ...]]:
        after = env.step(state, act(state.obs))
        place = after.pipeline_state.torso_xy
        return after, (after.reward, after.done, place)

    first = env.reset(key)
    _, (rewards, dones, places) = jax.lax.scan(step, first, length=LENGTH)
    # the step that ends the episode counts, as in a search
    up = jnp.cumsum(dones) - dones == 0
    last = places[up.sum() - 1] - first.pipeline_state.torso_xy
    return jnp.sum(rewards * up), up.sum(), last[0]


def returns(env_name: str, whiten: bool, updates: int, every: int, seed: int) -> list:
    """What the actor's policy does after each ``every`` updates: see ``walk``."""
    config = EvolveConfig(env_name=env_name, episode_length=LENGTH, hidden=(64, 64))
    task = differentiable(make_task(config), DifferentiableOptions())
    policy = policy_for(task, config.hidden)
    white = Whitening.of(policy) if whiten else Whitening()
    measure = measure_of(task)
    method = ActorCritic(
        task.env, policy.of_weights, measure, LENGTH, SETTINGS, whitening=white
    )
    keys = jax.random.split(jax.random.key(seed), 6)
    first = task.env.reset(keys[0])
    worlds = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (SETTINGS.worlds, *jnp.shape(leaf))), first
    )
    scale = jax.jit(method.scale)(keys[1], worlds)
    aim = jnp.zeros(1 + task.descriptor_length).at[0].set(1)
    actor = method.begin(keys[2], policy.init(keys[3]), aim, worlds)
    update = jax.jit(method.update)
    try_out = jax.jit(
        lambda weights: walk(task.env, lambda o: policy.of_weights(weights, o), keys[4])
    )
    found = []
    for number in range(updates + 1):
        if number % every == 0:
            found.append(try_out(white.plain(actor.weights, scale)))
        actor, _ = update(actor, scale, jax.random.fold_in(keys[5], number))
    return found


def main() -> None:
    """Prints the returns with and without whitening."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("env_name")
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--every", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    given = args.updates, args.every, args.seed
    pair = [returns(args.env_name, whiten, *given) for whiten in (False, True)]
    print(
        "| updates | plain: return | steps | way [m] | whitened: return | steps | way |"
    )
    print("|---" * 7 + "|")
    for index, rows in enumerate(zip(*pair, strict=True)):
        cells = [f"{score:.0f} | {steps} | {way:.1f}" for score, steps, way in rows]
        print(f"| {index * args.every} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
