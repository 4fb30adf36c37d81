"""Shows how an actor alone learns, without an archive, with different settings.

One actor maximizes the return with gradients of the physics over short windows. The
table has the return of its policy, without noise, from a start state that it has not
seen, how long the robot stays up, and how far it gets. These are medians of several
seeds, with the lowest and the highest return in brackets:

    python benchmarks/actor_alone.py humanoid_uni --updates 200
    python benchmarks/actor_alone.py hopper_uni --settings discount=0.995 epochs=8 \
        noise=0.3 --compare termination_width 0 0.03 --seeds 5

Without ``--compare``, it compares plain observations with whitened ones. With
``--episodes-after``, the actor then goes on with the gradient of whole episodes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import UnknownEnvironment
from newton_qd.qd import ConfigError, EvolveConfig, make_task
from newton_qd.qd.algorithms.episode_learning import (
    EpisodeLearningOptions,
    episode_learning,
)
from newton_qd.qd.algorithms.gradient_options import (
    DifferentiableOptions,
    differentiable,
)
from newton_qd.qd.emitters.actor_critic_learner import (
    ActorCritic,
    Learner,
    measure_of,
)
from newton_qd.qd.emitters.actor_critic_settings import ActorCriticSettings
from newton_qd.qd.emitters.whitening import Whitening
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.rollout import Policy
from newton_qd.qd.scoring.task import Task

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


@dataclasses.dataclass(frozen=True)
class Trial:
    """An actor at the start of its learning, and what it learns with."""

    task: Task
    policy: Policy
    method: ActorCritic
    scale: tuple[jax.Array, jax.Array]
    actor: Learner
    test_key: jax.Array
    key: jax.Array

    def plain(self, actor: Learner) -> jax.Array:
        """Returns the weights of an actor, for plain observations."""
        return self.method.whitening.plain(actor.weights, self.scale)


def begun(env_name: str, settings: ActorCriticSettings, seed: int) -> Trial:
    """Returns a new actor that maximizes the return."""
    config = EvolveConfig(env_name=env_name, episode_length=LENGTH, hidden=(64, 64))
    task = differentiable(
        make_task(config), DifferentiableOptions(), settings.termination_width
    )
    policy = policy_for(task, config.hidden)
    white = Whitening.of(policy) if settings.whiten else Whitening()
    measure = measure_of(task)
    method = ActorCritic(
        task.env, policy.of_weights, measure, LENGTH, settings, whitening=white
    )
    keys = jax.random.split(jax.random.key(seed), 6)
    first = task.env.reset(keys[0])
    worlds = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (settings.worlds, *jnp.shape(leaf))), first
    )
    scale = jax.jit(method.scale)(keys[1], worlds)
    aim = jnp.zeros(1 + task.descriptor_length).at[0].set(1)
    actor = method.begin(keys[2], policy.init(keys[3]), aim, worlds)
    return Trial(task, policy, method, scale, actor, keys[4], keys[5])


def returns(
    env_name: str,
    settings: ActorCriticSettings,
    updates: int,
    every: int,
    seed: int,
    episodes_after: int | None = None,
) -> list:
    """What the actor's policy does after each ``every`` updates: see ``walk``."""
    trial = begun(env_name, settings, seed)
    env, act, actor = trial.task.env, trial.policy.of_weights, trial.actor
    update = jax.jit(trial.method.update)
    try_out = jax.jit(
        lambda weights: walk(env, lambda o: act(weights, o), trial.test_key)
    )
    found = []
    for number in range(updates + 1):
        if number == episodes_after:
            actor = trial.method.moved(actor, actor.weights)
            options = EpisodeLearningOptions(episodes_after=1)
            later = episode_learning(trial.task, options, trial.method)
            assert later is not None
            update = jax.jit(later.update)
        if number % every == 0:
            found.append(try_out(trial.plain(actor)))
        key = jax.random.fold_in(trial.key, number)
        actor, _ = update(actor, trial.scale, key)
    return found


def changed(text: str, kind: type = ActorCriticSettings) -> tuple[str, Any]:
    """A setting of a dataclass and its value, from ``name=value``."""
    name, equals, value = text.partition("=")
    names = [field.name for field in dataclasses.fields(kind)]
    if name not in names or not equals:
        allowed = f"name=value with one of {', '.join(names)}"
        raise argparse.ArgumentTypeError(f"got {text!r}; allowed: {allowed}")
    try:
        found = json.loads(value)
        kind(**{name: found})
    except (ValueError, TypeError) as error:  # a JSON error is a ValueError
        raise argparse.ArgumentTypeError(f"{text!r}: {error}") from error
    return name, found


def cell(runs: list[tuple[jax.Array, jax.Array, jax.Array]]) -> str:
    """Return, steps and way of all seeds, as columns of the table."""
    scores, steps, ways = np.array(runs, dtype=np.float64).T
    text = f"{np.median(scores):.0f}"
    if len(runs) > 1:
        text += f" ({scores.min():.0f} to {scores.max():.0f})"
    return f"{text} | {np.median(steps):.0f} | {np.median(ways):.1f}"


def main() -> None:
    """Prints the returns with each value of a setting."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env_name")
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--every", type=int, default=20)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--episodes-after",
        type=int,
        metavar="UPDATES",
        help="updates after which the actor learns from whole episodes",
    )
    parser.add_argument("--settings", type=changed, nargs="+", default=[])
    parser.add_argument("--compare", nargs="+", default=["whiten", "false", "true"])
    args = parser.parse_args()
    name, *values = args.compare
    if not values:
        parser.error(f"--compare: got {name}; allowed: a setting and its values")
    for option in ("seeds", "updates", "every"):
        if getattr(args, option) < 1:
            given = getattr(args, option)
            parser.error(f"--{option}: got {given}; allowed: an integer from 1")
    try:
        make_task(EvolveConfig(env_name=args.env_name))
    except (UnknownEnvironment, ConfigError) as error:
        parser.error(str(error))
    try:
        pairs = [changed(f"{name}={value}") for value in values]
    except argparse.ArgumentTypeError as error:
        parser.error(f"--compare: {error}")
    base = dataclasses.replace(SETTINGS, **dict(args.settings))
    found = [
        [
            returns(
                args.env_name,
                dataclasses.replace(base, **{key: value}),
                args.updates,
                args.every,
                seed,
                args.episodes_after,
            )
            for seed in range(args.seeds)
        ]
        for key, value in pairs
    ]
    heads = [f"{name}={value}: return | steps | way [m]" for value in values]
    print(f"| updates | {' | '.join(heads)} |")
    print("|---" * (1 + 3 * len(values)) + "|")
    for index in range(args.updates // args.every + 1):
        cells = [cell([run[index] for run in runs]) for runs in found]
        print(f"| {index * args.every} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
