"""The methods of ``optimize.py``: analytic gradients, and evolution strategies."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from optimize_problems import STEPS, Cautious, Problem, make_network

from newton_qd.gradients import Episode, GradientOptions
from newton_qd.qd.emitters.actor_critic_learner import ActorCritic, ActorCriticSettings


class Method(Protocol):
    """One way to solve a problem."""

    @property
    def steps(self) -> int:
        """Control steps of one world that an update takes."""
        ...

    def init(self, seed: int) -> Any:
        """What an update begins from."""
        ...

    def update(self, carry: Any) -> Any:
        """One update, jitted."""
        ...

    def solutions(self, carry: Any) -> Any:
        """Solutions to judge, leaves (n, ...); the best of them counts."""
        ...


def first_solution(problem: Problem, key: jax.Array, hidden: tuple[int, ...]) -> Any:
    """A plan of small actions, or a policy whose actions are small."""
    env = problem.env
    if problem.policy is None:
        shape = (STEPS, env.action_size)
        return 0.1 * jax.random.normal(key, shape, jnp.float32)
    sizes = (env.observation_size, *hidden, env.action_size)
    return make_network(key, sizes, 0.01)


@dataclasses.dataclass(frozen=True, eq=False)
class GradientPlan:
    """Adam on the windowed gradients of several plans at once.

    Attributes:
        problem: A problem whose solutions are plans.
        plans: Number of plans; the best counts.
        rate: Learning rate of Adam.
        options: Windows and clipping.
        caution: Weight of the penalty of ``Cautious``.
        spread: Standard deviation of the first plans, before their tanh.
        renewal: Updates after which the worse half of the plans begins again as noisy
            copies of the better half.
    """

    problem: Problem
    plans: int
    rate: float
    options: GradientOptions
    caution: float
    spread: float
    renewal: int

    @property
    def steps(self) -> int:
        """Control steps of an update."""
        return self.plans * STEPS

    def init(self, seed: int) -> Any:
        """Plans, state of Adam, and the key of the reset."""
        keys = jax.random.split(jax.random.key(seed + 1000), 2)
        plans = self._draw(keys[0])
        moments = optax.adam(self.rate).init(plans)
        return plans, moments, jax.random.key(seed), keys[1], 0

    def _draw(self, key: jax.Array) -> jax.Array:
        """Random plans (plans, STEPS, nu)."""
        shape = (self.plans, STEPS, self.problem.env.action_size)
        return self.spread * jax.random.normal(key, shape, jnp.float32)

    @functools.partial(jax.jit, static_argnums=0)
    def update(self, carry: Any) -> Any:
        """One step of Adam."""
        plans, optimizer, reset_key, key, count = carry
        episode = Episode(
            Cautious(self.problem.env, self.caution),
            episode_length=STEPS,
            unravel=jnp.tanh,
            options=self.options,
        )
        key, renewal_key = jax.random.split(key)
        found = episode.gradient(plans, reset_key)
        downhill = -found.gradients[:, 0]
        # Adam forgets the size; what one plan's gradient has lost must not come back
        size = jnp.sqrt(jnp.sum(jnp.square(downhill), axis=(1, 2), keepdims=True))
        downhill = downhill / jnp.maximum(size, 1e-6)
        change, optimizer = optax.adam(self.rate).update(downhill, optimizer)
        plans = plans + change
        order = jnp.argsort(-found.fitnesses)
        half = self.plans // 2
        parents = order.at[half:].set(order[: self.plans - half])
        due = (count + 1) % self.renewal == 0
        plans, optimizer = jax.tree.map(
            lambda x: jnp.where(due, x[parents], x) if x.ndim else x,
            (plans, optimizer),
        )
        new = due & (jnp.arange(self.plans) >= half)
        plans = plans + jnp.where(new[:, None, None], self._draw(renewal_key), 0)
        return plans, optimizer, reset_key, key, count + 1

    def solutions(self, carry: Any) -> Any:
        """All plans."""
        return carry[0]


@dataclasses.dataclass(frozen=True, eq=False)
class ShortHorizon:
    """The short-horizon actor-critic of ``newton_qd.qd.emitters.actor_critic_learner``.

    Attributes:
        problem: A problem whose solutions are policies.
        settings: How it learns.
        hidden: Widths of the hidden layers of the policy.
    """

    problem: Problem
    settings: ActorCriticSettings
    hidden: tuple[int, ...] = (64, 64)

    @property
    def steps(self) -> int:
        """Control steps of an update."""
        return self._method.steps

    @functools.cached_property
    def _example(self) -> tuple[jax.Array, Any]:
        like = first_solution(self.problem, jax.random.key(0), self.hidden)
        return ravel_pytree(like)

    @functools.cached_property
    def _method(self) -> ActorCritic:
        policy, unravel = self.problem.policy, self._example[1]
        assert policy is not None
        return ActorCritic(
            self.problem.env,
            lambda weights, obs: policy(unravel(weights), obs),
            lambda before, after: jnp.zeros((0,)),
            STEPS,
            self.settings,
        )

    def init(self, seed: int) -> Any:
        """The actor, the scale of observations, and a key."""
        keys = jax.random.split(jax.random.key(seed + 1000), 5)
        env, worlds = self.problem.env, self.settings.worlds
        first = jax.jit(jax.vmap(env.reset))(jax.random.split(keys[2], worlds))
        weights = ravel_pytree(first_solution(self.problem, keys[0], self.hidden))[0]
        learner = self._method.begin(keys[1], weights, jnp.ones((1,)), first)
        return learner, jax.jit(self._method.scale)(keys[4], first), keys[3]

    @functools.partial(jax.jit, static_argnums=0)
    def update(self, carry: Any) -> Any:
        """One window: a step of the policy, several of the value."""
        learner, scale, key = carry
        key, own = jax.random.split(key)
        return self._method.update(learner, scale, own)[0], scale, key

    def solutions(self, carry: Any) -> Any:
        """The policy."""
        return jax.vmap(self._example[1])(carry[0].weights[None])


@dataclasses.dataclass(frozen=True, eq=False)
class Evolution:
    """A strategy of evosax.

    Attributes:
        problem: The problem.
        strategy: Class of ``evosax.algorithms``.
        population: Solutions of a generation.
        resets: Episodes that a solution is scored by; plans have one.
        sigma: Standard deviation of the first generation.
        rate: Learning rate of Adam, for strategies that have an optimizer.
        hidden: Widths of the hidden layers of a policy.
    """

    problem: Problem
    strategy: str
    population: int
    resets: int
    sigma: float
    rate: float | None = None
    hidden: tuple[int, ...] = ()

    @property
    def steps(self) -> int:
        """Control steps of an update, less where episodes end early."""
        return self.population * self.resets * STEPS

    @functools.cached_property
    def _algorithm(self) -> tuple[Any, Any]:
        """The strategy and its parameters."""
        from evosax import algorithms  # pyright: ignore[reportMissingImports]

        options: dict[str, Any] = {}
        if self.rate is not None:
            options["optimizer"] = optax.adam(self.rate)
        if self.strategy == "Open_ES":
            options["std_schedule"] = optax.constant_schedule(self.sigma)
        like = first_solution(self.problem, jax.random.key(0), self.hidden)
        made = getattr(algorithms, self.strategy)(self.population, like, **options)
        params = made.default_params
        if self.strategy != "Open_ES":
            params = params.replace(std_init=self.sigma)
        return made, params

    def init(self, seed: int) -> Any:
        """State of the strategy, and keys of its noise and of the resets."""
        made, params = self._algorithm
        keys = jax.random.split(jax.random.key(seed + 1000), 3)
        like = first_solution(self.problem, keys[0], self.hidden)
        return made.init(keys[1], like, params), keys[2], jax.random.key(seed)

    @functools.partial(jax.jit, static_argnums=0)
    def update(self, carry: Any) -> Any:
        """One generation; all of its solutions start from the same resets."""
        made, params = self._algorithm
        state, key, reset_key = carry
        key, ask, tell, resets = jax.random.split(key, 4)
        keys = reset_key[None]
        if self.problem.policy is not None:
            keys = jax.random.split(resets, self.resets)
        population, state = made.ask(ask, state, params)
        scores = self.problem.returns(population, keys).mean(axis=1)
        state, _ = made.tell(tell, population, -scores, state, params)
        return state, key, reset_key

    def solutions(self, carry: Any) -> Any:
        """The mean; of plans, whose score has no noise, the best one too."""
        made, _ = self._algorithm
        mean = made.get_mean(carry[0])
        if self.problem.policy is not None:
            return jax.tree.map(lambda x: x[None], mean)
        best = carry[0].best_solution.reshape(mean.shape)
        return jnp.stack([mean, jnp.where(jnp.isfinite(best), best, mean)])
