"""The methods of ``optimize.py``: analytic gradients, and evolution strategies."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import optax
from optimize_problems import STEPS, Cautious, Layers, Problem, make_network, network

from newton_qd.envs.state import select
from newton_qd.gradients import GradientOptions, make_episode_gradient
from newton_qd.gradients.flow import passed_back


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
    """

    problem: Problem
    plans: int
    rate: float
    options: GradientOptions
    caution: float

    @property
    def steps(self) -> int:
        """Control steps of an update."""
        return self.plans * STEPS

    def init(self, seed: int) -> Any:
        """Plans, state of Adam, and the key of the reset."""
        keys = jax.random.split(jax.random.key(seed + 1000), self.plans)
        plans = jax.vmap(lambda key: first_solution(self.problem, key, ()))(keys)
        return plans, optax.adam(self.rate).init(plans), jax.random.key(seed)

    @functools.partial(jax.jit, static_argnums=0)
    def update(self, carry: Any) -> Any:
        """One step of Adam."""
        plans, optimizer, key = carry
        gradient = make_episode_gradient(
            Cautious(self.problem.env, self.caution),
            None,
            None,
            episode_length=STEPS,
            unravel=jnp.tanh,
            options=self.options,
        )
        downhill = -gradient(plans, key).gradients[:, 0]
        # Adam forgets the size; what one plan's gradient has lost must not come back
        size = jnp.sqrt(jnp.sum(jnp.square(downhill), axis=(1, 2), keepdims=True))
        downhill = downhill / jnp.maximum(size, 1e-6)
        change, optimizer = optax.adam(self.rate).update(downhill, optimizer)
        return plans + change, optimizer, key

    def solutions(self, carry: Any) -> Any:
        """All plans."""
        return carry[0]


@dataclasses.dataclass(frozen=True, eq=False)
class ActorCritic:
    """Short-horizon actor-critic (SHAC).

    Xu et al. 2022, "Accelerated policy learning with parallel differentiable
    simulation": the policy climbs the gradient of the return over a short window that
    ends with the value of its last state; the worlds go on from there.

    Attributes:
        problem: A problem whose solutions are policies.
        worlds: Number of worlds.
        window: Control steps of a window.
        rate: Learning rate of the policy.
        critic_rate: Learning rate of the value.
        clip: Largest norm of the adjoint of a world's state.
        noise: Standard deviation of the noise before the policy's last tanh.
        hidden: Widths of the hidden layers of policy and value.
        discount: Discount of a control step.
        trace: lambda of the targets of the value.
        epochs: Times that a window is fitted by the value.
        batches: Steps of its optimizer in each of them.
    """

    problem: Problem
    worlds: int = 64
    window: int = 16
    rate: float = 2e-3
    critic_rate: float = 2e-3
    clip: float = 10.0
    noise: float = 0.1
    hidden: tuple[int, ...] = (64, 64)
    discount: float = 0.99
    trace: float = 0.95
    epochs: int = 4
    batches: int = 4

    @property
    def steps(self) -> int:
        """Control steps of an update."""
        return self.worlds * self.window

    def _optimizer(self, rate: float) -> Any:
        return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, b1=0.7))

    def init(self, seed: int) -> Any:
        """Networks, states of their optimizers, worlds, and a key."""
        keys = jax.random.split(jax.random.key(seed + 1000), 4)
        env = self.problem.env
        actor = first_solution(self.problem, keys[0], self.hidden)
        critic = make_network(keys[1], (env.observation_size, *self.hidden, 1), 0.01)
        networks = {"actor": actor, "critic": critic, "target": critic}
        rates = ((self.rate, actor), (self.critic_rate, critic))
        moments = [self._optimizer(rate).init(layers) for rate, layers in rates]
        first = jax.jit(jax.vmap(env.reset))(jax.random.split(keys[2], self.worlds))
        # worlds at all ages, so that they do not begin again at once
        age = jnp.arange(self.worlds, dtype=jnp.int32) * STEPS // self.worlds
        return networks, moments, (first, first, age), keys[3]

    @functools.partial(jax.jit, static_argnums=0)
    def update(self, carry: Any) -> Any:
        """One window: a step of the policy, several of the value."""
        networks, moments, (first, state, age), key = carry
        key, noise_key, order_key = jax.random.split(key, 3)
        shape = (self.worlds, self.window, self.problem.env.action_size)
        noise = self.noise * jax.random.normal(noise_key, shape, jnp.float32)

        def loss(actor: Layers) -> tuple[jax.Array, Any]:
            run = functools.partial(self._window, actor, networks["target"])
            returns, found = jax.vmap(run)(first, state, noise)
            return -returns.sum() / self.steps, found

        slope, (state, obs, targets) = jax.grad(loss, has_aux=True)(networks["actor"])
        change, actor_moments = self._optimizer(self.rate).update(slope, moments[0])
        actor = optax.apply_updates(networks["actor"], change)
        critic, critic_moments = self._fit(
            networks["critic"], moments[1], order_key, obs, targets
        )
        target = jax.tree.map(
            lambda new, old: 0.8 * new + 0.2 * old, critic, networks["target"]
        )
        age = age + self.window
        old = age >= STEPS
        state = jax.vmap(select)(old, first, state)
        networks = {"actor": actor, "critic": critic, "target": target}
        worlds = (first, state, jnp.where(old, 0, age))
        return networks, [actor_moments, critic_moments], worlds, key

    def _value(self, critic: Layers, obs: jax.Array) -> jax.Array:
        # the network's numbers are rewards of a step
        return network(critic, self.problem.seen(obs))[0] / (1 - self.discount)

    def _window(
        self, actor: Layers, critic: Layers, first: Any, state: Any, noise: jax.Array
    ) -> tuple[jax.Array, Any]:
        """One world's window: its return, last state, observations and targets."""

        def advance(state: Any, noise: jax.Array) -> tuple[Any, Any]:
            one = jnp.ones((), jnp.float32)
            # every step scales the adjoint, which the loss has divided by ``steps``
            state = passed_back(state, one, self.clip / self.steps)
            drive = network(actor, self.problem.seen(state.obs))
            after = self.problem.env.step(state, jnp.tanh(drive + noise))
            value = self._value(critic, after.obs)
            row = (state.obs, after.reward, after.done > 0, value)
            return select(after.done > 0, first, after), row

        last, (obs, rewards, dones, values) = jax.lax.scan(advance, state, noise)

        def back(sums: Any, row: Any) -> tuple[Any, jax.Array]:
            total, target = sums
            reward, done, value = row
            mixed = (1 - self.trace) * value + self.trace * target
            total, target = (
                reward + self.discount * jnp.where(done, 0, x) for x in (total, mixed)
            )
            return (total, target), target

        rows = (rewards, dones, values)
        (total, _), targets = jax.lax.scan(
            back, (values[-1], values[-1]), rows, reverse=True
        )
        return total, jax.lax.stop_gradient((last, obs, targets))

    def _fit(
        self, critic: Layers, moments: Any, key: jax.Array, obs: Any, targets: Any
    ) -> tuple[Layers, Any]:
        """Some steps of the value towards its targets (worlds, window)."""
        optimizer = self._optimizer(self.critic_rate)
        obs, targets = obs.reshape(self.steps, -1), targets.reshape(self.steps)

        def error(critic: Layers, rows: jax.Array) -> jax.Array:
            values = jax.vmap(functools.partial(self._value, critic))(obs[rows])
            return jnp.square((1 - self.discount) * (values - targets[rows])).mean()

        def fit(carry: Any, rows: jax.Array) -> tuple[Any, None]:
            critic, moments = carry
            change, moments = optimizer.update(jax.grad(error)(critic, rows), moments)
            return (optax.apply_updates(critic, change), moments), None

        keys = jax.random.split(key, self.epochs)
        order = jax.vmap(lambda k: jax.random.permutation(k, self.steps))(keys)
        order = order.reshape(self.epochs * self.batches, -1)
        return jax.lax.scan(fit, (critic, moments), order)[0]

    def solutions(self, carry: Any) -> Any:
        """The policy."""
        return jax.tree.map(lambda x: x[None], carry[0]["actor"])


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
