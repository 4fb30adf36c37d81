"""Actors that learn over short windows with gradients of the physics."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import optax

from newton_qd import checks
from newton_qd.envs.state import select
from newton_qd.gradients.flow import passed_back
from newton_qd.physics.explicit_mesh import varying_alike
from newton_qd.qd.emitters.actor_critic_settings import ActorCriticSettings
from newton_qd.qd.emitters.whitening import Whitening
from newton_qd.qd.scoring.task import Task
from newton_qd.types import Environment, PyTree, StateLike

Layers: TypeAlias = list[tuple[jax.Array, jax.Array]]
"""Weights and bias of each layer of a perceptron."""

_SETTLING = 100  # random steps to measure the scale of observations
_LEAST = 0.1  # smallest deviation of an entry of an observation


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Learner:
    """One actor between two updates; for K actors, leaves (K, ...).

    Attributes:
        weights: (size,) weights of the policy, for whitened observations.
        aim: (1 + D,) weights of the reward and of each component of the measure.
        critic: The critic.
        target: A slower copy of the critic, from which the actor learns.
        moments: States of the optimizers of actor and critic.
        first: Initial states of the W worlds, leaves (W, ...).
        worlds: Current states of the worlds, leaves (W, ...).
        age: (W,) control steps since the start of each world's episode.
    """

    weights: jax.Array
    aim: jax.Array
    critic: Layers
    target: Layers
    moments: tuple[PyTree, PyTree]
    first: PyTree
    worlds: PyTree
    age: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class ActorCritic:
    r"""Short-horizon actor-critic for a weighted sum of rewards and measures.

    It follows Xu et al. 2022, "Accelerated policy learning with parallel differentiable
    simulation", equations 4 to 8. With the aim :math:`w`, the policy maximizes, with
    gradients of the physics,

    .. math:: \sum_{t<h} \gamma^t w \cdot (r_t, m_t) + \gamma^h V(s_h)

    over a window of h control steps, where V is the value of the last state. The next
    window continues from this state. V is fitted to TD(lambda) targets.

    A fall ends an episode, and the gradient of the physics does not see it, unless
    ``done`` has a gradient (:func:`~newton_qd.gradients.with_smooth_termination`): the
    return after a step is worth :math:`(1 - d_t) V`, also in this gradient. With
    ``actor_trace`` below 1, the policy maximizes the TD(lambda) return of the window,
    in which the value of every state counts, also that of a state shortly before a fall
    (Hafner et al. 2020, "Dream to control").

    With ``weight_noise``, the policy maximizes the mean return of the policies around
    it: each world has weights of its own for a window (Plappert et al. 2018, "Parameter
    space noise for exploration").

    Attributes:
        env: Environment of one world without auto-reset.
        policy: Maps weights (size,) and an observation to an action.
        measure: Maps the states before and after a control step to the measures (D,)
            of this step.
        episode_length: Control steps of an episode.
        settings: Settings of the learning.
        whitening: Converts the weights of an actor, which are for whitened
            observations, to those of ``policy``; the default changes nothing.

    Raises:
        TypeError: A function cannot be called, or another value has the wrong type.
        ValueError: ``episode_length`` is not an integer from 1.
    """

    env: Environment
    policy: Callable[[jax.Array, jax.Array], jax.Array]
    measure: Callable[[StateLike, StateLike], jax.Array]
    episode_length: int
    settings: ActorCriticSettings
    whitening: Whitening = dataclasses.field(default_factory=Whitening)

    def __post_init__(self) -> None:
        """Checks the arguments.

        Raises:
            TypeError: One has the wrong type.
            ValueError: ``episode_length`` is not an integer from 1.
        """
        checks.environment(self.env)
        allowed = "a function of weights and an observation"
        checks.function("policy", self.policy, allowed)
        allowed = "a function of the states before and after a control step"
        checks.function("measure", self.measure, allowed)
        checks.integer("episode_length", self.episode_length)
        allowed = "an ActorCriticSettings"
        checks.instance("settings", self.settings, ActorCriticSettings, allowed)
        checks.instance("whitening", self.whitening, Whitening, "a Whitening")

    @property
    def steps(self) -> int:
        """Control steps of an update."""
        return self.settings.worlds * self.settings.window

    @functools.cached_property
    def optimizers(self) -> tuple[PyTree, PyTree]:
        """Optimizers of actor and critic, of ``optax``."""
        rates = self.settings.rate, self.settings.critic_rate
        actor, critic = (
            optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate, b1=0.7))
            for rate in rates
        )
        return actor, critic

    def worlds(self, first: StateLike) -> PyTree:
        """Returns the worlds of an actor, leaves (W, ...), all in the same state."""
        number = self.settings.worlds
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (number, *jnp.shape(leaf))), first
        )

    def scale(self, key: jax.Array, first: PyTree) -> tuple[jax.Array, jax.Array]:
        """Returns mean and deviation (no,) of observations with random actions.

        Args:
            key: Key of the actions.
            first: Initial states of the worlds, leaves (W, ...).
        """
        key, first = varying_alike((key, first))
        shape = (_SETTLING, len(first.done), self.env.action_size)
        actions = jax.random.uniform(key, shape, first.obs.dtype, -1, 1)

        def advance(state: PyTree, action: jax.Array) -> tuple[PyTree, jax.Array]:
            after = jax.vmap(self.env.step)(state, action)
            state = select((after.done > 0) | ~_sound(after), first, after)
            return state, state.obs

        obs = jax.lax.scan(advance, first, actions)[1].reshape(-1, first.obs.shape[-1])
        # entries that hardly change, such as the load of a foot in the air, must not
        # become large
        return obs.mean(axis=0), jnp.maximum(obs.std(axis=0), _LEAST)

    def begin(
        self, key: jax.Array, weights: jax.Array, aim: jax.Array, first: PyTree
    ) -> Learner:
        """Returns a new actor with a new critic.

        Args:
            key: Key of the weights of the critic.
            weights: (size,) weights of the actor, for whitened observations.
            aim: (1 + D,) weights of the reward and of each measure.
            first: Initial states of its worlds, leaves (W, ...).
        """
        number = self.settings.worlds
        critic = _network(key, (first.obs.shape[-1], *self.settings.critic, 1))
        actor_optimizer, critic_optimizer = self.optimizers
        return Learner(
            weights=weights,
            aim=aim,
            critic=critic,
            target=critic,
            moments=(actor_optimizer.init(weights), critic_optimizer.init(critic)),
            first=first,
            worlds=first,
            # worlds of all ages, so that they do not restart at the same time
            age=jnp.arange(number, dtype=jnp.int32) * self.episode_length // number,
        )

    def moved(self, learner: Learner, weights: jax.Array) -> Learner:
        """Returns the actor with other weights, and with a new optimizer for them.

        Args:
            learner: The actor, whose critic and worlds stay.
            weights: (size,) weights, for whitened observations.
        """
        moments = self.optimizers[0].init(weights), learner.moments[1]
        return dataclasses.replace(learner, weights=weights, moments=moments)

    def update(
        self, learner: Learner, scale: tuple[jax.Array, jax.Array], key: jax.Array
    ) -> tuple[Learner, jax.Array]:
        """Runs one window: one step of the actor, several steps of the critic.

        Args:
            learner: The actor.
            scale: Mean and deviation of observations.
            key: Key of the noise and of the order of the critic's batches.

        Returns:
            The actor after the window, and whether the gradient was not finite (). If
            it was not finite, the actor does not change, and its worlds restart.
        """
        # else the gradient would be the sum over all devices
        learner, scale, key = varying_alike((learner, scale, key))
        settings = self.settings
        noise_key, order_key = jax.random.split(key)

        def loss(weights: jax.Array) -> tuple[jax.Array, PyTree]:
            plain = self.whitening.plain(weights, scale)
            returns, found = self._windows(plain, learner, scale, noise_key)
            return -returns.sum(), found

        slope, found = jax.grad(loss, has_aux=True)(learner.weights)
        last, obs, targets, dones = found
        failed = ~jnp.all(jnp.isfinite(slope)) | ~jnp.all(jnp.isfinite(targets))
        change, moments = self.optimizers[0].update(
            slope / self.steps, learner.moments[0]
        )
        critic, critic_moments = self._fit(learner, scale, order_key, obs, targets)
        target = jax.tree.map(
            lambda new, old: 0.8 * new + 0.2 * old, critic, learner.target
        )
        # an episode that a fall has ended began again within the window
        since = jnp.argmax(dones[:, ::-1] > 0, axis=1).astype(jnp.int32)
        age = learner.age + settings.window
        age = jnp.where(jnp.any(dones > 0, axis=1), since, age)
        over = (age >= self.episode_length) | ~_sound(last) | failed
        learned = Learner(
            weights=learner.weights + change,
            aim=learner.aim,
            critic=critic,
            target=target,
            moments=(moments, critic_moments),
            first=learner.first,
            worlds=select(over, learner.first, last),
            age=jnp.where(over, 0, age),
        )
        kept = dataclasses.replace(learner, worlds=learned.worlds, age=learned.age)
        return select(failed, kept, learned), failed

    def _windows(
        self, weights: jax.Array, learner: Learner, scale: PyTree, key: jax.Array
    ) -> tuple[jax.Array, PyTree]:
        """Runs the windows of all worlds, each with its noise.

        Returns:
            The returns (worlds,), and the rest of ``_window``, leaves (worlds, ...).
        """
        settings = self.settings
        shape = (settings.worlds, settings.window, self.env.action_size)
        noise = settings.noise * jax.random.normal(key, shape, weights.dtype)
        weights_axis = None
        if settings.weight_noise:
            key, shape = jax.random.fold_in(key, 0), (settings.worlds, weights.size)
            other = jax.random.normal(key, shape, weights.dtype)
            weights, weights_axis = weights + settings.weight_noise * other, 0
        run = jax.vmap(self._window, in_axes=(weights_axis, None, None, 0, 0, 0))
        return run(weights, learner, scale, learner.first, learner.worlds, noise)

    def _value(self, critic: Layers, scale: PyTree, obs: jax.Array) -> jax.Array:
        mean, deviation = scale
        for weights, bias in critic[:-1]:
            obs = jnp.tanh(((obs - mean) / deviation) @ weights + bias)
            mean, deviation = 0.0, 1.0
        weights, bias = critic[-1]
        # the output of the network has the scale of the reward of one step
        return (obs @ weights + bias)[0] / (1 - self.settings.discount)

    def _window(
        self,
        weights: jax.Array,
        learner: Learner,
        scale: tuple[jax.Array, jax.Array],
        first: PyTree,
        state: PyTree,
        noise: jax.Array,
    ) -> tuple[jax.Array, PyTree]:
        """Runs one world's window.

        Returns:
            The return, and the last state, observations, targets and ends of episodes.
        """
        settings = self.settings

        def advance(state: PyTree, noise: jax.Array) -> tuple[PyTree, PyTree]:
            one = jnp.ones((), noise.dtype)
            before = passed_back(state, one, settings.clip)
            action = self.policy(weights, before.obs) + noise
            after = self.env.step(before, jnp.clip(action, -1, 1))
            gain = jnp.append(after.reward, self.measure(before, after)) @ learner.aim
            value = self._value(learner.target, scale, after.obs)
            ended, beyond = after.done, ()
            if settings.beyond_length:
                ended = ended - after.info.get("truncation", 0)
                full = after.done > ended
                # the gradient of another value, which may be NaN, does not count
                seen = jnp.where(full, after.obs, 0)
                beyond = full, self._value(learner.target, scale, seen)
            row = gain, ended, value, jnp.where(_sound(after), value, 0), beyond
            return select(after.done > 0, first, after), (state.obs, after.done, row)

        last, (obs, dones, rows) = jax.lax.scan(advance, state, noise)

        def back(sums: PyTree, row: PyTree) -> tuple[PyTree, jax.Array]:
            total, target = sums
            gain, ended, value, lost, beyond = row
            if beyond:  # the rest of the window belongs to another episode
                total, target = (jnp.where(beyond[0], beyond[1], x) for x in sums)
            mixed = (1 - settings.trace) * value + settings.trace * target
            if settings.actor_trace < 1:  # else without the value, also if it is NaN
                part = settings.actor_trace
                total = (1 - part) * value + part * total
            # after a fall, the value has no gradient; only done has one
            total = jnp.where(ended > 0, jax.lax.stop_gradient(lost), total)
            total = gain + settings.discount * (1 - ended) * total
            target = gain + settings.discount * jnp.where(ended > 0, 0, mixed)
            return (total, target), target

        ends = (rows[2][-1], rows[2][-1])
        (total, _), targets = jax.lax.scan(back, ends, rows, reverse=True)
        return total, jax.lax.stop_gradient((last, obs, targets, dones))

    def _fit(
        self,
        learner: Learner,
        scale: PyTree,
        key: jax.Array,
        obs: PyTree,
        targets: PyTree,
    ) -> tuple[Layers, PyTree]:
        """Fits the critic to its targets (worlds, window) in several steps."""
        optimizer = self.optimizers[1]
        obs, targets = obs.reshape(self.steps, -1), targets.reshape(self.steps)
        factor = 1 - self.settings.discount

        def error(critic: Layers, rows: jax.Array) -> jax.Array:
            value = functools.partial(self._value, critic, scale)
            values = jax.vmap(value)(obs[rows])
            return jnp.square(factor * (values - targets[rows])).mean()

        def fit(carry: PyTree, rows: jax.Array) -> tuple[PyTree, None]:
            critic, moments = carry
            change, moments = optimizer.update(jax.grad(error)(critic, rows), moments)
            return (optax.apply_updates(critic, change), moments), None

        number, batches = self.steps, self.settings.batches
        keys = jax.random.split(key, self.settings.epochs)
        order = jax.vmap(lambda k: jax.random.permutation(k, number))(keys)
        order = order[:, : number // batches * batches].reshape(
            self.settings.epochs * batches, -1
        )
        return jax.lax.scan(fit, (learner.critic, learner.moments[1]), order)[0]


def measure_of(task: Task) -> Callable[[StateLike, StateLike], jax.Array]:
    """Returns the function of the measures (D,) of a control step of a task.

    If the descriptor is the final position, the measure is the velocity [m/s]. For
    other tasks, the descriptor is a mean over the episode, and the measure is the state
    descriptor.
    """
    if not task.reads_end:
        return lambda before, after: after.info["state_descriptor"]

    def velocity(before: Any, after: Any) -> jax.Array:
        names = "state_descriptor"
        return (after.info[names] - before.info[names]) / task.env.dt

    return velocity


def _sound(state: PyTree) -> jax.Array:
    """Returns whether the observation of a world is finite."""
    return jnp.all(jnp.isfinite(state.obs), axis=-1)


def _network(key: jax.Array, sizes: tuple[int, ...]) -> Layers:
    """Returns weights of a perceptron with small outputs."""
    layers = []
    for index, (rows, columns) in enumerate(itertools.pairwise(sizes)):
        scale = (0.01 if index == len(sizes) - 2 else 1.0) / rows**0.5
        own = jax.random.fold_in(key, index)
        weights = scale * jax.random.normal(own, (rows, columns), jnp.float32)
        layers.append((weights, jnp.zeros((columns,), jnp.float32)))
    return layers
