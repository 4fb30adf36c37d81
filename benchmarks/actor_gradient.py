"""Shows whether the gradient of an actor points where its return rises.

An actor learns alone, as in ``actor_alone.py``. Then the exact gradient of the return
of whole episodes is compared with one from returns alone: evolution strategies with
pairs of opposite noise on the weights (Salimans et al. 2017, "Evolution strategies as a
scalable alternative to reinforcement learning", section 2). Both have the same noise
and several start states. The table has the cosine between the two for each limit of the
adjoint (``clip``) and width of the gradient of a fall (``termination_width``). The
estimate is noisy, so the cosine is divided by that which a perfect gradient would have.
"Limited" is the mean in which the gradient of a world counts with the median norm at
most. At last, the policy follows this mean:

    python benchmarks/actor_gradient.py walker2d_uni --settings discount=0.98 epochs=8 \
        window=64 clip=300 actor_trace=0.98 termination_width=0.1 noise=0.1 \
        weight_noise=0.05
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import actor_alone
import jax
import jax.numpy as jnp
import numpy as np
import optax

from newton_qd.gradients.flow import passed_back

NO_LIMIT = 1e9
WORLDS = 64
PAIRS = 1000  # in one call


def episode_return(
    trial: actor_alone.Trial, clip: float, weights: jax.Array, key: jax.Array
) -> jax.Array:
    """Return of an episode, whose gradient has a limit of the adjoint."""
    env, act = trial.task.env, trial.policy.of_weights

    def step(state: Any, _: None) -> tuple[Any, tuple[jax.Array, jax.Array]]:
        state = passed_back(state, jnp.ones(()), clip)
        after = env.step(state, act(weights, state.obs))
        return after, (after.reward, after.done)

    length = actor_alone.LENGTH
    _, (rewards, dones) = jax.lax.scan(step, env.reset(key), length=length)

    def back(
        total: jax.Array, row: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, None]:
        reward, done = row
        return reward + (1 - done) * total, None

    dones = dones.at[-1].set(0)  # the end of the episode is no fall
    return jax.lax.scan(back, jnp.zeros(()), (rewards, dones), reverse=True)[0]


def gradients(
    trial: actor_alone.Trial,
    clip: float,
    sigma: float,
    weights: jax.Array,
    key: jax.Array,
) -> jax.Array:
    """Gradients (worlds, size) with noise on weights and several start states."""
    noise_key, start_key = jax.random.split(key)
    noise = sigma * jax.random.normal(noise_key, (WORLDS, weights.size))
    starts = jax.random.split(start_key, WORLDS)
    slope = jax.grad(functools.partial(episode_return, trial, clip))
    return jax.vmap(slope)(weights + noise, starts)


def limited(slopes: jax.Array) -> jax.Array:
    """Mean (size,) of gradients with at most the median norm."""
    norms = jnp.linalg.norm(slopes, axis=1)
    factors = jnp.minimum(1, jnp.median(norms) / jnp.maximum(norms, 1e-9))
    return (factors[:, None] * slopes).mean(axis=0)


def estimate(
    trial: actor_alone.Trial, sigma: float, weights: jax.Array, calls: int
) -> tuple[np.ndarray, float]:
    """Gradient (size,) from returns alone, and its cosine with the true one."""
    score = functools.partial(episode_return, trial, NO_LIMIT)

    @jax.jit
    def call(key: jax.Array) -> jax.Array:
        noise_key, start_key = jax.random.split(key)
        noise = jax.random.normal(noise_key, (PAIRS, weights.size))
        starts = jax.random.split(start_key, PAIRS)
        rise = jax.vmap(score)(weights + sigma * noise, starts)
        rise -= jax.vmap(score)(weights - sigma * noise, starts)
        return rise @ noise / (2 * sigma * PAIRS)

    keys = jax.random.split(jax.random.key(7), calls)
    found = np.array([call(key) for key in keys])
    # two halves tell how much of an estimate is noise
    halves = cosine(found[::2].mean(axis=0), found[1::2].mean(axis=0))
    return found.mean(axis=0), np.sqrt(2 * max(halves, 0.0) / (1 + max(halves, 0.0)))


def cosine(one: Any, other: Any) -> float:
    """Cosine between two vectors."""
    one, other = np.asarray(one, np.float64), np.asarray(other, np.float64)
    return float(one @ other / np.linalg.norm(one) / np.linalg.norm(other))


def ascent(
    trial: actor_alone.Trial,
    slopes: Callable[[jax.Array, jax.Array], jax.Array],
    weights: jax.Array,
    rate: float,
    steps: int,
) -> jax.Array:
    """Weights after steps of Adam along the limited mean of gradients."""
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, b1=0.7))

    @jax.jit
    def step(carry: tuple[Any, Any], key: jax.Array) -> tuple[Any, Any]:
        weights, moments = carry
        change, moments = optimizer.update(-limited(slopes(weights, key)), moments)
        return weights + change, moments

    carry = weights, optimizer.init(weights)
    for key in jax.random.split(trial.key, steps):
        carry = step(carry, key)
    return carry[0]


def main() -> None:
    """Prints cosine, norm, and return after an ascent for each gradient."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("env_name")
    parser.add_argument("--updates", type=int, default=200, help="of the actor")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--settings", type=actor_alone.changed, nargs="+", default=[], metavar="NAME=X"
    )
    parser.add_argument("--sigma", type=float, default=0.02, help="noise on weights")
    parser.add_argument("--clips", type=float, nargs="+", default=[30, 300, NO_LIMIT])
    parser.add_argument("--widths", type=float, nargs="+", default=[0, 0.03, 0.1])
    parser.add_argument("--calls", type=int, default=16, help="thousands of pairs")
    parser.add_argument("--steps", type=int, default=100, help="of the ascent")
    parser.add_argument("--rate", type=float, default=5e-4, help="of the ascent")
    args = parser.parse_args()
    settings = dataclasses.replace(actor_alone.SETTINGS, **dict(args.settings))
    trial = actor_alone.begun(args.env_name, settings, args.seed)
    update, actor = jax.jit(trial.method.update), trial.actor
    for number in range(args.updates):
        key = jax.random.fold_in(trial.key, number)
        actor, _ = update(actor, trial.scale, key)
    weights = trial.plain(actor)
    tests = jax.random.split(trial.test_key, 8)
    score = functools.partial(episode_return, trial, NO_LIMIT)
    mean = jax.jit(
        lambda weights: jax.vmap(lambda key: score(weights, key))(tests).mean()
    )
    truth, best = estimate(trial, args.sigma, weights, args.calls)
    print(f"return {mean(weights):.0f}; the estimate has a cosine of {best:.2f}\n")
    heads = ("termination_width", "clip", "cosine", "limited", "norms of worlds")
    print("| " + " | ".join([*heads, "return after the ascent"]) + " |")
    print("|---" * 6 + "|", flush=True)
    for width in args.widths:
        other = dataclasses.replace(settings, termination_width=width)
        own = actor_alone.begun(args.env_name, other, args.seed)
        for clip in args.clips:
            slopes = functools.partial(gradients, own, clip, args.sigma)
            keys = jax.random.split(jax.random.key(3), 4)
            found = jnp.concatenate([jax.jit(slopes)(weights, key) for key in keys])
            after = ascent(own, slopes, weights, args.rate, args.steps)
            norms = np.percentile(np.linalg.norm(found, axis=1), [5, 50, 95])
            cosines = [cosine(x, truth) / best for x in (found.mean(0), limited(found))]
            cells = [f"{width:g}", "none" if clip >= NO_LIMIT else f"{clip:g}"]
            cells += [f"{x:.2f}" for x in cosines]
            cells += [", ".join(f"{x:.0f}" for x in norms), f"{mean(after):.0f}"]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
