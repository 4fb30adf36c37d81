"""Measures what whitened observations change for an actor alone, without an archive.

One actor maximizes the return with gradients of the physics over short windows. The
table has the return of its policy, without noise, from a start state that it has not
seen:

    python benchmarks/whitening.py humanoid_uni --updates 200
"""

from __future__ import annotations

import argparse

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
from newton_qd.qd.scoring.rollout import make_scoring_function

SETTINGS = ActorCriticSettings(
    worlds=64, window=32, rate=2e-3, discount=0.99, actor_trace=0.95, epochs=4
)
LENGTH = 250


def returns(env_name: str, whiten: bool, updates: int, every: int, seed: int) -> list:
    """Return of the actor's policy after each ``every`` updates."""
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
    score = jax.jit(make_scoring_function(task, policy, LENGTH))
    found = []
    for number in range(updates + 1):
        if number % every == 0:
            weights = white.plain(actor.weights, scale)
            found.append(float(score(weights[None], keys[4])[0][0]))
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
    print("| updates | plain | whitened |\n|---|---|---|")
    for index, (plain, whitened) in enumerate(zip(*pair, strict=True)):
        print(f"| {index * args.every} | {plain:.0f} | {whitened:.0f} |")


if __name__ == "__main__":
    main()
