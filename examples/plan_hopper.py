"""Optimize two seconds of a hopper's actions by gradient: it runs without falling.

    python examples/plan_hopper.py

No gradient sees the jump at the end of an episode. The optimized reward therefore
decreases before the hopper falls. The printed return is that of the task itself. Needs
optax, which comes with the extra ``qd``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import optax

import newton_qd
from newton_qd.gradients import Episode, GradientOptions
from newton_qd.wrappers import Wrapper


class Cautious(Wrapper):
    """A hopper that loses reward inside of the healthy range, towards its edge."""

    def step(self, state, action, params=None):
        """Advances by one step."""
        state = self.env.step(state, action, params)
        height, pitch = state.pipeline_state.q[1], state.pipeline_state.q[2]
        # healthy: |pitch| below 0.2 rad, height above 0.7 m; it stands at 1.25 m
        lean = jnp.maximum(jnp.abs(pitch) / 0.2 - 0.25, 0) / 0.75
        low = jnp.maximum(1.0 - height, 0) / 0.3
        penalty = 2.0 * (jnp.square(lean) + jnp.square(low))
        return state.replace(reward=state.reward - penalty)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plans", type=int, default=16)
    parser.add_argument("--steps", type=int, default=250, help="of 0.008 s")
    parser.add_argument("--iterations", type=int, default=150)
    arguments = parser.parse_args(argv)

    env = newton_qd.create("hopper", episode_length=None, auto_reset=False)
    # no policy: the genotypes are the actions
    settings = {"episode_length": arguments.steps, "unravel": jnp.tanh}
    cautious = Episode(
        Cautious(env),
        # the discount shrinks the gradient more than each step backwards grows it
        options=GradientOptions(window=100, discount=0.97, clip=100.0),
        **settings,
    )
    returns = jax.jit(jax.vmap(Episode(env, **settings), (0, None)))
    key, optimizer = jax.random.key(0), optax.adam(0.05)
    shape = (arguments.plans, arguments.steps, env.action_size)
    plans = 0.1 * jax.random.normal(jax.random.key(1), shape, env.dtype)
    moments = optimizer.init(plans)

    @jax.jit
    def climb(plans, moments):
        uphill = cautious.gradient(plans, key).gradients[:, 0]
        size = jnp.sqrt(jnp.sum(jnp.square(uphill), axis=(1, 2), keepdims=True))
        change, moments = optimizer.update(-uphill / (size + 1e-6), moments)
        return plans + change, moments

    for iteration in range(arguments.iterations + 1):
        if iteration % max(arguments.iterations // 10, 1) == 0:
            found = returns(plans, key).fitness
            mean, best = found.mean(), found.max()
            print(f"iteration {iteration:3d}: mean return {mean:.1f}, best {best:.1f}")
        plans, moments = climb(plans, moments)


if __name__ == "__main__":
    main()
